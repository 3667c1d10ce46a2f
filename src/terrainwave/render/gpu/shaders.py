"""GLSL 3.30 core. `INDIRECT` is defined if one call draws all patches."""

# Skirts reach as far below a surface as a neighbour's surface may be: within τ, and not below the
# block under the terrain.
OUTPUTS = """
uniform mat4 view_projection;
uniform float skirt_reach;  // metres per metre of distance, where looked at from the side
uniform float base;         // z of the base relative to the eye
out vec3 v_seen;            // relative to the eye
out vec2 v_sample;          // in samples of the piece's level
out vec2 v_grid;            // column, row of the full grid
out float v_below;          // 0 on the surface
flat out float v_layer;     // of the slopes
flat out vec2 v_about;      // level, error

float skirt_depth(vec3 seen, float most) {
    float away = length(seen), beside = max(length(seen.xy), 1e-6);
    return min(min(skirt_reach * away * away / beside, most), max(seen.z - base, 0.0));
}
"""

# Row k of `instances` holds block k in four texels:
# (x, y, z of its corner at z = 0, relative to the eye; share of the parent's surface)
# (depth of skirts, layer, level, samples of the full grid per sample)
# (columns, rows of the full grid right of and below its corner; columns, rows left of and above)
# (error in metres, unused, unused, unused)
INSTANCE = (
    OUTPUTS
    + """
uniform sampler2D instances;
uniform vec4 sample_axes;   // metres per sample of the full grid: x by col, x by row, y ...
uniform float z_scale;

vec4 of_instance(int k) {
    return texelFetch(instances, ivec2(k, INSTANCE_NUMBER), 0);
}

// `heights`: of the block's own surface and of its parent's.
void place_vertex(vec2 place, vec2 heights, bool is_skirt) {
    vec4 a = of_instance(0), b = of_instance(1), c = of_instance(2);
    vec2 full = place * b.w;
    vec3 seen = a.xyz;
    seen.x += full.x * sample_axes.x + full.y * sample_axes.y;
    seen.y += full.x * sample_axes.z + full.y * sample_axes.w;
    seen.z += mix(heights.x, heights.y, a.w) * z_scale;
    v_below = is_skirt ? 1.0 : 0.0;
    seen.z -= is_skirt ? skirt_depth(seen, b.x) : 0.0;
    v_seen = seen;
    v_sample = place;
    v_layer = b.y;
    v_about = vec2(b.z, of_instance(3).x);
    v_grid = c.zw + full;
    gl_ClipDistance[0] = c.x - full.x;
    gl_ClipDistance[1] = c.y - full.y;
    gl_Position = view_projection * vec4(seen, 1.0);
}
"""
)

TERRAIN_VERTEX = (
    """
#version 330 core
//DEFINES
in vec2 in_place;
in vec2 in_heights;
#ifdef INDIRECT
in int in_instance;
#else
uniform int in_instance;
#endif
out float gl_ClipDistance[2];
"""
    + INSTANCE.replace("INSTANCE_NUMBER", "in_instance")
    + """
void main() {
    bool is_skirt = in_place.x >= 32768.0;
    vec2 place = vec2(is_skirt ? in_place.x - 32768.0 : in_place.x, in_place.y) * 0.5;
    place_vertex(place, in_heights, is_skirt);
}
"""
)

_HAZE = """
uniform vec4 haze;          // colour, density per metre
uniform float haze_start;   // metres from the eye

vec3 hazed(vec3 rgb, vec3 seen) {
    float away = max(length(seen) - haze_start, 0.0) * haze.w;
    return mix(haze.rgb, rgb, exp(-away * away));
}
"""

# Alpha marks skirts: `Canvas.skirts_seen`.
SKIRT_ALPHA = 254
TERRAIN_FRAGMENT = (
    """
#version 330 core
in vec3 v_seen;
in vec2 v_sample;
in vec2 v_grid;
in float v_below;            // above 0 on skirts
flat in float v_layer;
flat in vec2 v_about;         // level, error
uniform sampler2DArray slopes;
uniform sampler2D drape;
uniform vec4 drape_place;   // first column and row it covers, 1 / columns, 1 / rows
uniform float drape_share;
uniform sampler2D detail;    // a finer part of the drape
uniform vec4 detail_place;
uniform float detail_share;
uniform sampler2D ramp;      // columns: the sea's colours, then the land's; rows: to the north
uniform vec4 ramp_range;    // values of the sea's first and last colour, of the land's
uniform sampler2D water;     // where values up to the sea's last colour are water
uniform vec3 water_place;    // samples per texel; 1 / columns, 1 / rows
uniform vec2 height_texels;  // metres: of texel 0, per 1
uniform vec2 northwards;    // share of the way north: at the eye, per metre
uniform vec3 sun;           // unit vector towards it
uniform float side;
uniform float z_scale;
uniform vec4 sample_axes;
uniform int coloring;       // 0 ramp, 1 level, 2 error, 3 ground, 4 plain, 5 flat, 6 slope,
                            // 7 textured
uniform float shade;        // share of light and shadow
out vec4 color;
"""
    + _HAZE
    + """
vec3 wheel(float t) {
    return 0.55 + 0.4 * cos(6.2831853 * (t + vec3(0.0, 0.33, 0.67)));
}

vec3 texel_at(vec2 beside) {
    return texture(slopes, vec3((v_sample + beside + 1.5) / (side + 3.0), v_layer)).xyz;
}

vec2 slope_at(vec2 beside) {
    return texel_at(beside).xy;
}

// Ridges positive, gullies negative: the change of the slope to the east over two samples
// eastwards and of that to the north over two northwards, however the raster lies.
float bend() {
    vec2 by_col = slope_at(vec2(-1.0, 0.0)) - slope_at(vec2(1.0, 0.0));
    vec2 by_row = slope_at(vec2(0.0, -1.0)) - slope_at(vec2(0.0, 1.0));
    vec2 east = normalize(vec2(sample_axes.w, -sample_axes.z));
    vec2 north = normalize(vec2(-sample_axes.y, sample_axes.x));
    float turned = sign(sample_axes.x * sample_axes.w - sample_axes.y * sample_axes.z);
    return turned * (dot(vec2(by_col.x, by_row.x), east) + dot(vec2(by_col.y, by_row.y), north));
}

float random_at(ivec2 cell) {
    uint h = uint(cell.x) * 0x9E3779B1u ^ uint(cell.y) * 0x85EBCA77u;
    h = (h ^ (h >> 15)) * 0x2C1B3C6Du;
    h = (h ^ (h >> 12)) * 0x297A2D39u;
    return float((h ^ (h >> 15)) >> 8) / 16777216.0;
}

float noise(vec2 place) {
    ivec2 cell = ivec2(floor(place));
    vec2 t = place - vec2(cell);
    t = t * t * (3.0 - 2.0 * t);
    return mix(
        mix(random_at(cell), random_at(cell + ivec2(1, 0)), t.x),
        mix(random_at(cell + ivec2(0, 1)), random_at(cell + ivec2(1, 1)), t.x), t.y);
}

// Grain of about 0.5, fixed to the ground: its finest cells are four pixels and more, and fade
// before they are smaller. `finest`: log2 of their size in samples.
float grain(vec2 place, float finest) {
    float size = exp2(floor(finest)), share = fract(finest);
    float total = (1.0 - share) * noise(place / size);
    total += noise(place / (2.0 * size)) + noise(place / (4.0 * size));
    return (total + share * noise(place / (8.0 * size))) / 3.0;
}

// Soil, scree and rock over the colours of heights, blended by slope, curvature and height.
vec3 textured(vec3 base, float steep, float bent, float height) {
    vec2 across = fwidth(v_grid);
    float finest = log2(4.0 * max(max(across.x, across.y), 1e-6));
    float coarse = grain(v_grid, finest + 2.0), fine = grain(v_grid, finest);
    float snow = smoothstep(0.84, 0.95, min(base.r, base.b));
    float grey = dot(base, vec3(0.3, 0.5, 0.2));
    // Soil: darker in hollows, where it is moist.
    vec3 soil = base * (0.62 + 0.76 * mix(coarse, fine, 0.5)) * (1.0 + 0.25 * bent);
    vec3 scree = mix(vec3(grey), vec3(0.55, 0.52, 0.48), 0.75) * (0.55 + 0.9 * fine);
    // Rock: beds of about equal height, of any thickness, bent a little.
    float metres = length(sample_axes.xz) * 2.0, high = height / metres + 0.8 * coarse;
    float beds = grain(vec2(high, 0.02 * (v_grid.x + v_grid.y)), finest + 0.5);
    beds = smoothstep(0.25, 0.75, mix(beds, fine, 0.35));
    vec3 rock = mix(vec3(0.38, 0.36, 0.33), vec3(0.60, 0.57, 0.53), beds);
    rock = mix(vec3(grey), rock, 0.8) * (0.75 + 0.5 * coarse);
    float ragged = steep + 0.05 * bent + 0.16 * (coarse - 0.5);
    vec2 bare = mix(vec2(0.10, 0.24), vec2(0.18, 0.36), snow);
    float is_rock = smoothstep(bare.x, bare.y, ragged);
    // Scree lies below rock, in hollows and on slopes that are not too steep for it.
    float is_scree = smoothstep(0.03, 0.10, ragged) * clamp(0.35 - bent, 0.0, 1.0) * (1.0 - snow);
    vec3 covered = mix(soil, mix(soil, base, 0.7), snow);
    return mix(mix(covered, scree, is_scree), rock, is_rock);
}

void main() {
    vec3 texel = texel_at(vec2(0.0));
    vec2 slope = texel.xy;
    vec3 normal = normalize(vec3(-slope * z_scale, 1.0));
    float steep = 1.0 - normalize(vec3(-slope, 1.0)).z;
    vec3 base;
    float value = coloring == 2 ? v_about.y
        : coloring == 6 ? degrees(atan(length(slope)))
        : height_texels.x + height_texels.y * texel.z;
    bool is_sea = value <= ramp_range.y;
    bool is_ground = coloring == 3 || coloring == 7;
    if (is_ground && is_sea) {
        float found = texture(water, (v_grid / water_place.x + 0.5) * water_place.yz).r;
        is_sea = found > 0.75 || (found > 0.25 && value >= -ramp_range.y);
    }
    vec2 ends = is_sea ? ramp_range.xy : ramp_range.zw;
    float t = clamp((value - ends.x) / (ends.y - ends.x), 0.0, 1.0);
    float colors = float(textureSize(ramp, 0).x) / 2.0;
    float column = (is_sea ? 0.5 : colors + 0.5) + t * (colors - 1.0);
    vec2 ramp_place = vec2(column / (2.0 * colors), northwards.x + northwards.y * v_seen.y);
    if (coloring == 1) base = wheel(v_about.x * 0.381966);
    else if (coloring == 4 || coloring == 5) base = vec3(0.82, 0.80, 0.76);
    else {
        base = texture(ramp, ramp_place).rgb;
        float bent = is_ground ? clamp(bend() * 1.6, -1.0, 1.0) : 0.0;
        if (coloring == 7) {
            if (!is_sea) base = textured(base, steep, bent, value);
        } else if (is_ground) {
            vec3 rock = mix(vec3(0.40, 0.37, 0.33), vec3(0.58, 0.56, 0.53), t);
            // Snow stays on steeper ground than soil does.
            float snow = smoothstep(0.84, 0.95, min(base.r, base.b));
            vec2 bare = mix(vec2(0.08, 0.30), vec2(0.16, 0.42), snow);
            if (!is_sea) base = mix(base, rock, smoothstep(bare.x, bare.y, steep + 0.05 * bent));
            base *= 1.0 + 0.22 * bent;
        }
    }
    vec2 at = (v_grid + 0.5 - drape_place.xy) * drape_place.zw;
    float draped = 0.0;
    if (drape_share > 0.0) {
        vec4 photo = texture(drape, at, -0.5);  // a little sharper: slopes are seen aslant
        if (any(lessThan(at, vec2(0.0))) || any(greaterThan(at, vec2(1.0)))) photo.a = 0.0;
        vec2 near = (v_grid + 0.5 - detail_place.xy) * detail_place.zw;
        vec4 fine = texture(detail, near, -0.5);
        vec2 rim = min(near, 1.0 - near);
        float share = clamp(min(rim.x, rim.y) * 16.0, 0.0, 1.0) * detail_share * fine.a;
        photo = mix(photo, vec4(fine.rgb, 1.0), share);
        draped = photo.a * drape_share;
        base = mix(base, photo.rgb, draped);
    }
    // A photo has light and shadow of its own.
    float shading = shade * (1.0 - 0.55 * draped);
    float lit = max(dot(normal, sun), 0.0) / max(sun.z, 0.25);
    float sky = 0.5 + 0.5 * normal.z;
    // A weak second light from across keeps shadows from going black.
    float fill = max(dot(normal, vec3(-sun.xy, sun.z)), 0.0);
    float light = mix(1.0, 0.30 * sky + 0.22 * fill + 0.60 * min(lit, 1.45), shading);
    vec3 warm = mix(vec3(0.86, 0.92, 1.06), vec3(1.04, 1.0, 0.94), clamp(lit, 0.0, 1.0));
    vec3 rgb = base * light * mix(vec3(1.0), warm, shading);
    if (coloring == 5) rgb = base;
    color = vec4(hazed(rgb, v_seen), v_below > 0.0 ? SKIRT : 1.0);
}
""".replace("SKIRT", f"{SKIRT_ALPHA / 255}")
)

SKY_VERTEX = """
#version 330 core
out vec2 v_ndc;
void main() {
    v_ndc = vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID & 2) * 2 - 1);
    gl_Position = vec4(v_ndc, 0.99999, 1.0);
}
"""

# Without depth: the sky and, if any, the ground, which fades into haze next to the terrain. The sky
# begins where the ground ends, not at the horizon: from above both are in view.
SKY_FRAGMENT = """
#version 330 core
in vec2 v_ndc;
uniform mat3 axes;          // columns right, up, forward
uniform vec2 tangents;
uniform vec3 zenith;
uniform vec3 horizon;
uniform vec3 sun;
uniform vec3 eye;           // local metres
uniform float base;         // z of the ground
uniform vec2 middle, first; // x and y of the terrain's middle and of its first sample
uniform mat2 sample_steps;  // metres per column and per row
uniform vec2 last;          // column, row
uniform float reach;        // metres beside the terrain where the ground ends
uniform float extent;       // metres
uniform bool has_ground;
out vec4 color;

const vec3 GROUND = vec3(0.71, 0.70, 0.68);

void main() {
    vec3 ray = normalize(axes * vec3(v_ndc * tangents, 1.0));
    float height = eye.z - base;
    float up = ray.z;
    if (has_ground && height > 0.0) {
        // Where this way leaves a circle around the ground.
        vec2 way = normalize(ray.xy + vec2(1e-9, 0.0)), from = eye.xy - middle;
        float radius = extent / 2.0 + reach, nearest = -dot(from, way);
        float inside = nearest * nearest - dot(from, from) + radius * radius;
        float leaves = max(nearest + sqrt(max(inside, 0.0)), height);
        up += height / length(vec2(height, leaves));
    }
    up = clamp(up, -0.25, 1.0);
    vec3 rgb = mix(horizon, zenith, pow(clamp(up * 2.8, 0.0, 1.0), 0.75));
    if (!has_ground) rgb = mix(rgb, horizon * 0.86, smoothstep(0.0, 0.25, -up));
    float glow = pow(max(dot(ray, sun), 0.0), 24.0);
    rgb += vec3(0.22, 0.17, 0.09) * glow;
    if (has_ground && height > 0.0 && ray.z < 0.0) {
        vec2 place = eye.xy + ray.xy * (height / -ray.z);
        vec2 at = inverse(sample_steps) * (place - first);
        float beside = length(sample_steps * (at - clamp(at, vec2(0.0), last)));
        // Darker at the foot of the block, as if it kept light away.
        vec3 ground = GROUND * (1.0 - 0.34 * exp(-beside / (0.035 * extent)));
        rgb = mix(ground, rgb, smoothstep(0.0, reach, beside));
    }
    color = vec4(rgb, 1.0);
}
"""

# Walls, floor and lids: see `solid`.
SOLID_VERTEX = """
#version 330 core
in vec2 in_place;           // column, row of the full grid
in float in_height;         // metres, without exaggeration
in float in_kind;           // 0 top of a wall, 1 its base, 2 floor, 3 lid
in vec2 in_normal;          // of walls, outwards
uniform mat4 view_projection;
uniform vec4 sample_axes;
uniform vec3 origin;        // the first sample at z = 0, relative to the eye
uniform float z_scale;
uniform float base;         // z of the base relative to the eye
uniform float depth;        // of the base below the lowest height, metres
out vec3 v_seen;
out vec2 v_normal;
flat out int v_kind;
void main() {
    vec3 seen = origin;
    seen.x += in_place.x * sample_axes.x + in_place.y * sample_axes.y;
    seen.y += in_place.x * sample_axes.z + in_place.y * sample_axes.w;
    seen.z = in_kind == 1.0 || in_kind == 2.0 ? base : seen.z + in_height * z_scale;
    // The floor, which shows through holes, ends within the walls, not along their foot.
    if (in_kind == 2.0 && base < 0.0) seen.z += 0.1 * depth;
    v_seen = seen;
    v_normal = in_normal;
    v_kind = int(in_kind);
    gl_Position = view_projection * vec4(seen, 1.0);
    // Skirts end in the plane of a wall, or a little outside: a wall that is seen from outside
    // hides them. From inside it lets all else be seen.
    if (in_kind <= 1.0) {
        float side = dot(in_normal, seen.xy) < 0.0 ? -1.0 : 1.0;
        gl_Position.z += side * 2e-5 * gl_Position.w;
    }
}
"""

# Alpha marks surfaces that are not data: `Canvas.pick` skips them.
SOLID_ALPHA = 250
SOLID_FRAGMENT = (
    """
#version 330 core
in vec3 v_seen;
in vec2 v_normal;
flat in int v_kind;
uniform vec3 sun;
uniform float base;
uniform float depth;        // of the base below the lowest height, metres
uniform float shade;
uniform float hatch;        // pixels from stripe to stripe
out vec4 color;
"""
    + _HAZE
    + """
const vec3 WALL = vec3(0.56, 0.515, 0.465);
const vec3 GAP = vec3(0.80, 0.80, 0.79), STRIPE = vec3(0.60, 0.60, 0.60);

void main() {
    vec3 rgb;
    if (v_kind >= 2) {
        float across = fract((gl_FragCoord.x + gl_FragCoord.y) / hatch);
        float soft = 1.0 / hatch;
        float stripe = smoothstep(0.30 - soft, 0.30 + soft, abs(across - 0.5));
        rgb = mix(GAP, STRIPE, stripe);
    } else {
        float lit = max(dot(v_normal, normalize(sun.xy + vec2(1e-9))), 0.0);
        float above = clamp((v_seen.z - base) / depth, 0.0, 1.0);
        float light = mix(1.0, (0.62 + 0.38 * lit) * (0.72 + 0.28 * above), shade);
        rgb = WALL * light;
    }
    color = vec4(hazed(rgb, v_seen), ALPHA);
}
""".replace("ALPHA", f"{SOLID_ALPHA / 255}")
)
