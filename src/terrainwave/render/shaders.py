"""GLSL 3.30 core. `INDIRECT` is defined where one call draws all patches."""

# Row k of `instances` holds patch k in four texels:
# (x, y, z of its first sample at z = 0, relative to the eye; share of the parent's surface)
# (depth of skirts, slope layer, parent's slope layer or -1, samples of the full grid per sample)
# (columns, rows of the full grid right of and below its first sample; column, row in the parent)
# (level, error in metres, height of z = 0 in metres, unused)
_INSTANCE = """
#ifdef INDIRECT
in int in_instance;
#else
uniform int in_instance;
#endif
uniform sampler2D instances;
"""

TERRAIN_VERTEX = (
    """
#version 330 core
//DEFINES
in vec2 in_place;
in vec2 in_heights;
"""
    + _INSTANCE
    + """
uniform mat4 view_projection;
uniform vec4 sample_axes;   // metres per sample of the full grid: x by col, x by row, y ...
uniform float z_scale;
uniform float side;         // cells of a block
uniform vec2 last;          // column, row of the full grid
out vec3 v_seen;            // relative to the eye
out vec2 v_sample;          // in samples of the block's level
out float v_height;         // metres, without exaggeration
flat out ivec2 v_layers;
out vec2 v_grid;            // column, row of the full grid
flat out vec4 v_parent;     // offset in the parent's samples; level; error
out float gl_ClipDistance[2];
void main() {
    vec4 a = texelFetch(instances, ivec2(0, in_instance), 0);
    vec4 b = texelFetch(instances, ivec2(1, in_instance), 0);
    vec4 c = texelFetch(instances, ivec2(2, in_instance), 0);
    vec4 d = texelFetch(instances, ivec2(3, in_instance), 0);
    bool is_skirt = in_place.x >= 32768.0;
    vec2 place = vec2(is_skirt ? in_place.x - 32768.0 : in_place.x, in_place.y) * 0.5;
    vec2 full = place * b.w;
    float z = mix(in_heights.x, in_heights.y, a.w);
    vec3 seen = a.xyz;
    seen.x += full.x * sample_axes.x + full.y * sample_axes.y;
    seen.y += full.x * sample_axes.z + full.y * sample_axes.w;
    seen.z += z * z_scale - (is_skirt ? b.x : 0.0);
    v_seen = seen;
    v_sample = place;
    v_height = d.z + z;
    v_layers = ivec2(b.yz);
    v_parent = vec4(c.zw, d.xy);
    v_grid = last - c.xy + full;
    gl_ClipDistance[0] = c.x - full.x;
    gl_ClipDistance[1] = c.y - full.y;
    gl_Position = view_projection * vec4(seen, 1.0);
}
"""
)

TERRAIN_FRAGMENT = """
#version 330 core
in vec3 v_seen;
in vec2 v_sample;
in float v_height;
in vec2 v_grid;
flat in ivec2 v_layers;
flat in vec4 v_parent;
uniform sampler2DArray slopes;
uniform sampler2D drape;
uniform vec4 drape_place;   // first column and row it covers, 1 / columns, 1 / rows
uniform float drape_share;
uniform sampler2D ramp;
uniform vec2 ramp_range;    // heights at its ends, metres
uniform vec3 sun;           // unit vector towards it
uniform float side;
uniform float z_scale;
uniform vec4 sample_axes;
uniform vec4 haze;          // colour, density per metre
uniform int coloring;       // 0 ramp, 1 level, 2 error, 3 ground, 4 plain, 5 flat
uniform float shade;        // share of light and shadow
uniform float error_range;
out vec4 color;

vec3 wheel(float t) {
    return 0.55 + 0.4 * cos(6.2831853 * (t + vec3(0.0, 0.33, 0.67)));
}

vec2 slope_at(vec2 beside) {
    return texture(slopes, vec3((v_sample + beside + 1.5) / (side + 3.0), float(v_layers.x))).xy;
}

// Ridges positive, gullies negative: the change of slope over two samples.
float bend() {
    float x = slope_at(vec2(-1.0, 0.0)).x - slope_at(vec2(1.0, 0.0)).x;
    float y = slope_at(vec2(0.0, -1.0)).y - slope_at(vec2(0.0, 1.0)).y;
    return x * sign(sample_axes.x) + y * sign(sample_axes.w);
}

void main() {
    vec2 slope = slope_at(vec2(0.0));
    vec3 normal = normalize(vec3(-slope * z_scale, 1.0));
    float steep = 1.0 - normalize(vec3(-slope, 1.0)).z;
    vec3 base;
    float t = clamp((v_height - ramp_range.x) / (ramp_range.y - ramp_range.x), 0.0, 1.0);
    if (coloring == 1) base = wheel(v_parent.z * 0.381966);
    else if (coloring == 2) {
        float share = clamp(v_parent.w / error_range, 0.0, 1.0);
        base = mix(vec3(0.16, 0.37, 0.60), vec3(0.93, 0.78, 0.25), sqrt(share));
    }
    else if (coloring == 4 || coloring == 5) base = vec3(0.82, 0.80, 0.76);
    else {
        base = texture(ramp, vec2(t, 0.5)).rgb;
        if (coloring == 3) {
            float bent = clamp(bend() * 1.6, -1.0, 1.0);
            vec3 rock = mix(vec3(0.40, 0.37, 0.33), vec3(0.58, 0.56, 0.53), t);
            base = mix(base, rock, smoothstep(0.08, 0.30, steep + 0.05 * bent));
            base *= 1.0 + 0.22 * bent;
        }
    }
    vec2 at = (v_grid + 0.5 - drape_place.xy) * drape_place.zw;
    float draped = 0.0;
    if (drape_share > 0.0) {
        vec4 photo = texture(drape, at, -0.5);  // a little sharper: slopes are seen aslant
        if (all(greaterThanEqual(at, vec2(0.0))) && all(lessThanEqual(at, vec2(1.0))))
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
    float away = length(v_seen) * haze.w;
    rgb = mix(haze.rgb, rgb, exp(-away * away));
    color = vec4(rgb, 1.0);
}
"""

SKY_VERTEX = """
#version 330 core
out vec2 v_ndc;
void main() {
    v_ndc = vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID & 2) * 2 - 1);
    gl_Position = vec4(v_ndc, 0.99999, 1.0);
}
"""

SKY_FRAGMENT = """
#version 330 core
in vec2 v_ndc;
uniform mat3 axes;          // columns right, up, forward
uniform vec2 tangents;
uniform vec3 zenith;
uniform vec3 horizon;
uniform vec3 sun;
out vec4 color;
void main() {
    vec3 ray = normalize(axes * vec3(v_ndc * tangents, 1.0));
    float up = clamp(ray.z, -0.25, 1.0);
    vec3 rgb = mix(horizon, zenith, pow(max(up, 0.0), 0.55));
    rgb = mix(rgb, horizon * 0.86, smoothstep(0.0, 0.25, -up));
    float glow = pow(max(dot(ray, sun), 0.0), 24.0);
    rgb += vec3(0.22, 0.17, 0.09) * glow;
    color = vec4(rgb, 1.0);
}
"""
