/*
 * A plane of method predictive (docs/format-predictive.md, P.5 ... P.7), as js/src/predictive-plane.js
 * has it.
 */

typedef int i32;
typedef unsigned u32;
typedef long long i64;

#define EXPORT(name) __attribute__((export_name(name)))

enum { HH, HL, LH };

/* Written by js/src/predictive-kernels.js, in this order. */
typedef struct {
  i32 plane, n_rows, n_cols, pitch; /* of the plane; samples of a row of the lattice */
  i32 first, place, place_step, place_row; /* of its sample 0, 0, and from one to the next */
  i32 is_mixed, is_clamped, step, z_min, z_max, shift, inverse, n_taps, n_data;
  i32 *values, *errors, *activity, *bends; /* of the lattice, with margins */
  i32 *own_errors;
  i32 *heights;
  const unsigned char *valid, *known; /* of the region */
  const i32 *taps, *core;             /* offsets */
  const i32 *stencil, *weights;
  i32 *cells; /* models */
  i64 *mixers;
  i32 *state; /* of the range coder: range, code, position */
  const unsigned char *data;
  const i32 *logits, *mixed, *rates;
  const unsigned char *eighths;
} Plane;

static inline i64 min(i64 a, i64 b) { return a < b ? a : b; }
static inline i64 max(i64 a, i64 b) { return a > b ? a : b; }
static inline i64 magnitude(i64 a) { return a < 0 ? -a : a; }

/* The range coder, in locals of whoever decodes (FORMAT.md 6). */
typedef struct {
  u32 range, code;
  i32 position;
} Coder;

static inline i32 next_byte(const Plane *s, Coder *c) {
  i32 at = c->position++;
  return at < s->n_data ? s->data[at] : 0;
}

static inline i32 split(const Plane *s, Coder *c, u32 p) {
  u32 bound = (c->range >> 16) * p;
  i32 bit = c->code < bound;
  c->code = bit ? c->code : c->code - bound;
  c->range = bit ? bound : c->range - bound;
  while (c->range >> 24 == 0) {
    c->code = (c->code << 8) | next_byte(s, c);
    c->range <<= 8;
  }
  return bit;
}

static inline i32 learned(const Plane *s, i32 cell, i32 bit) {
  i32 p = cell >> 8, count = cell & 255;
  i64 rate = s->rates[count];
  i32 change = bit ? (i32)(((i64)((1 << 22) - p) * rate) >> 16) : -(i32)((p * rate) >> 16);
  return cell + change * 256 + (count < 254);
}

static inline i32 bit_of(const Plane *s, Coder *c, i32 a) {
  i32 cell = s->cells[a];
  i32 bit = split(s, c, (cell >> 14) | 1);
  s->cells[a] = learned(s, cell, bit);
  return bit;
}

static inline i32 mean_bit(const Plane *s, Coder *c, i32 a, i32 b) {
  if (!s->is_mixed) return bit_of(s, c, a);
  i32 first = s->cells[a], second = s->cells[b];
  i32 bit = split(s, c, (((first >> 8) + (second >> 8)) >> 7) | 1);
  s->cells[a] = learned(s, first, bit);
  s->cells[b] = learned(s, second, bit);
  return bit;
}

static inline i32 mixed_bit(const Plane *s, Coder *c, i32 a, i32 b, i32 mixer) {
  if (!s->is_mixed) return bit_of(s, c, a);
  i32 first = s->cells[a], second = s->cells[b];
  i32 x = s->logits[first >> 20], y = s->logits[second >> 20];
  i64 *v = s->mixers + 2 * mixer;
  i64 sum = (v[0] * x + v[1] * y) >> 19;
  i32 m = s->mixed[min(max(sum, -352), 351) + 352];
  i32 bit = split(s, c, m);
  s->cells[a] = learned(s, first, bit);
  s->cells[b] = learned(s, second, bit);
  v[0] += ((32768 - m * x) >> 16) + (bit ? x : 0);
  v[1] += ((32768 - m * y) >> 16) + (bit ? y : 0);
  return bit;
}

static i64 raw(const Plane *s, Coder *c, i32 k) {
  i64 value = 0;
  for (; k > 0; k--) {
    c->range >>= 1;
    value *= 2;
    if (c->code >= c->range) {
      c->code -= c->range;
      value++;
    }
    while (c->range >> 24 == 0) {
      c->code = (c->code << 8) | next_byte(s, c);
      c->range <<= 8;
    }
  }
  return value;
}

static inline i64 steps(const Plane *s, i64 d, i32 f) {
  return ((min(d, 1LL << 40) >> s->shift) * s->inverse) >> (22 - f);
}

static inline i32 lg(const Plane *s, i64 v) {
  if (v < 4096) return s->eighths[v];
  if (v < 1 << 20) return s->eighths[v >> 8] + 64;
  if (v < 1 << 28) return s->eighths[v >> 16] + 128;
  return s->eighths[min(v >> 24, 4095)] + 192;
}

static inline i32 rho(const Plane *s, i64 d, i32 e) {
  return min((lg(s, d + e + 77) - lg(s, e + 77)) >> 2, 7);
}

static inline i32 mu(const Plane *s, i64 d, i32 e) {
  i64 g = max(e, 128), t = steps(s, magnitude(d), 2);
  i32 size = min((lg(s, 2 * t + g) - lg(s, g)) >> 2, 4);
  return d > 0 && t > 0 ? 4 + size : 4 - size;
}

/* Return |q| - 1 (P.7). */
static i64 decode_size(const Plane *s, Coder *c, i32 beta, i32 reach, i32 kappa, const i32 *ahead) {
  i32 first = 6179 + 14 * (8 * beta + reach), mixer = 11 + (beta >> 2), ones = 0;
  for (; ones < 14; ones++) {
    i32 beyond = 0, here = 0;
    for (i32 k = 0; k < 6; k++) {
      beyond += ahead[k] > ones;
      here += ahead[k] == ones;
    }
    i32 h = 11107 + 18 * (14 * beta + ones) + 3 * (i32)min(beyond, 5) + (i32)min(here, 2);
    if (!mixed_bit(s, c, first + ones, h, mixer)) break;
  }
  i64 upper = ones;
  if (ones == 14) {
    i32 n_bits = 0;
    while (n_bits < 31 && bit_of(s, c, 22899 + n_bits)) n_bits++;
    upper = 13 + (1LL << n_bits) + raw(s, c, n_bits);
  }
  i64 low = 0;
  i32 model = 22195 + 16 * beta + 4 * (i32)min(ones, 3);
  for (i32 k = 0; k < kappa && k < 2; k++) {
    i32 bit = bit_of(s, c, model);
    low = 2 * low + bit;
    if (k == 0) model += 1 + bit;
  }
  i32 rest = max(kappa - 2, 0);
  return (upper << kappa) + (low << rest) + raw(s, c, rest);
}

typedef struct {
  i64 p, w;
  i32 six[6]; /* the sorted core, then the heights at W and N */
} Sample;

/* Return the detail q (P.7). */
static inline i64 decode_detail(const Plane *s, Coder *c, const Sample *z, i32 e) {
  const i32 *six = z->six;
  i64 half = s->step >> 1, phi = z->p - 64 * z->w;
  i32 beta = min(max(((lg(s, e) - 24) >> 2) + 1, 0), 43);
  i32 up = 0, down = 0;
  for (i32 k = 0; k < 6; k++) {
    up += six[k] > z->w + half;
    down += six[k] < z->w - half;
  }
  i32 range = rho(s, steps(s, (i64)six[3] - six[0], 8), e);
  i32 side = min(steps(s, magnitude(phi), -3), 3), most = min(min(up, down), 3);
  if (!mean_bit(s, c, 4 * (8 * beta + range) + side,
                1408 + 4 * (7 * beta + 6 - up - down) + most)) {
    return 0;
  }
  i32 epsilon = (beta >= 7) + (beta >= 10) + (beta >= 13) + (beta >= 16);
  i32 slope = min((steps(s, 6 * magnitude(phi), -5) + 1) >> 1, 3);
  i32 sigma = phi > 0 ? 3 + slope : 3 - slope;
  i32 inner = mu(s, ((i64)six[1] + six[2]) * 32 - z->p, e);
  i32 outer = mu(s, ((i64)six[0] + six[3]) * 32 - z->p, e);
  i32 b = 2640 + 9 * (9 * (7 * epsilon + sigma) + inner) + outer;
  i32 is_up = mixed_bit(s, c, b, 5475 + 8 * (8 * (beta >> 2) + up) + down, beta >> 2);
  i64 room = is_up ? 64 * (i64)six[3] - z->p : z->p - 64 * (i64)six[0];
  i32 reach = rho(s, steps(s, max(room, 0), 2), e);
  i32 kappa = beta ? max(0, ((24 + 4 * (beta - 1)) >> 3) - 9) : 0;
  i32 ahead[6];
  for (i32 k = 0; k < 6; k++) {
    i64 distance = is_up ? six[k] - z->w : z->w - six[k];
    i64 t = distance > 0 ? steps(s, distance + half, 0) : 0;
    ahead[k] = t > 0 ? min((t - 1) >> kappa, 15) : -1;
  }
  i64 size = 1 + decode_size(s, c, beta, reach, kappa, ahead);
  return is_up ? size : -size;
}

static inline void sort(i32 *x, i32 a, i32 b) {
  i32 low = x[a] < x[b] ? x[a] : x[b], high = x[a] < x[b] ? x[b] : x[a];
  x[a] = low;
  x[b] = high;
}

static inline i64 bend(const i32 *v, i32 step) {
  return magnitude((i64)v[-3 * step] - v[-step] - v[step] + v[3 * step]);
}

/* Return D (P.6). */
static inline i64 distance_of(const Plane *s, i32 plane, i32 at, const Sample *z, i64 off) {
  const i32 *w = s->weights, *v = s->values + at, *bends = s->bends + at, *core = s->core;
  i32 up = s->pitch;
  i64 a = v[core[0]], b = v[core[1]], c = v[core[2]], d = v[core[3]];
  i64 bent, twist, lines;
  if (plane == HH) {
    bent = (i64)bends[core[0]] + bends[core[1]] + bends[core[2]] + bends[core[3]];
    twist = a + d - b - c;
    lines = bend(v - up, 1) + bend(v + up, 1) + bend(v - 1, up) + bend(v + 1, up);
  } else {
    i32 beside = plane == HL ? 1 : up;
    bent = (i64)bends[-beside] + bends[beside];
    twist = a + b - c - d;
    lines = bend(v, 1) + bend(v, up);
  }
  const i32 *six = z->six;
  i64 spread = (i64)six[3] - six[0];
  return 64 * (w[8] * bent + w[9] * spread + w[12] * magnitude(twist) + w[13] * lines) +
         w[10] * magnitude(((i64)six[1] + six[2]) * 32 - z->p) +
         w[11] * magnitude(((i64)six[0] + six[3]) * 32 - z->p) + w[14] * off;
}

/* Return what errors and activities add to E (P.6). */
static inline i64 total_of(const Plane *s, i32 plane, i32 at, const i32 *own, i32 n, i32 is_first) {
  const i32 *w = s->weights, *e = s->errors + at, *v = s->activity + at;
  i32 up = s->pitch;
  i64 total = w[15] + (i64)w[0] * own[-1] + (i64)w[1] * own[-2] + (i64)w[2] * own[-n] +
              (i64)w[3] * own[-n - 1] + (i64)w[4] * own[1 - n] + (i64)w[5] * own[-2 * n];
  if (!is_first) total += (i64)w[16] * v[-2 * up];
  if (plane == HL) {
    total += (i64)w[6] * (e[-up] + e[up]) + (i64)w[17] * v[up] +
             (i64)w[7] * (e[-up - 2] + e[2 - up] + e[up - 2] + e[up + 2]);
  } else if (plane == LH) {
    total += (i64)w[6] * (e[-1] + e[1] + e[-up - 1] + e[1 - up] + e[up - 1] + e[up + 1]) +
             (i64)w[7] * (e[-2 * up - 1] + e[1 - 2 * up] + e[2 * up - 1] + e[2 * up + 1]) +
             (i64)w[17] * (v[1] + v[up + 1]);
  }
  return total;
}

static inline i64 predicted(const Plane *s, i32 plane, const i32 *v) {
  i64 sum = 32;
  const i32 n = plane == LH ? 24 : 20;
  for (i32 k = 0; k < n; k++) sum += (i64)s->stencil[k] * v[s->taps[k]];
  return sum >> 6;
}

static inline void decode_row(const Plane *s, Coder *c, i32 plane, i32 i, i32 first, i32 place) {
  i32 n = s->n_cols + 3;
  i32 *own = s->own_errors + (i + 2) * n + 2;
  for (i32 j = 0; j < s->n_cols; j++, place += s->place_step) {
    i32 at = first + 2 * j;
    i32 *v = s->values + at;
    Sample z;
    z.p = predicted(s, plane, v);
    for (i32 k = 0; k < 4; k++) z.six[k] = v[s->core[k]];
    sort(z.six, 0, 1);
    sort(z.six, 2, 3);
    sort(z.six, 0, 2);
    sort(z.six, 1, 3);
    sort(z.six, 1, 2);
    i64 mean = 16 * ((i64)z.six[0] + z.six[1] + z.six[2] + z.six[3]);
    i64 off = magnitude(z.p - mean);
    if (s->is_clamped) z.p = min(max(z.p, 64 * (i64)z.six[0]), 64 * (i64)z.six[3]);
    z.p = min(max(z.p, 64 * (i64)s->z_min), 64 * (i64)s->z_max);
    z.w = (z.p + 32) >> 6;
    i32 is_known = s->known[place], is_valid = s->valid[place];
    i64 height = z.w;
    if (is_known) {
      height = s->heights[place];
    } else if (is_valid) {
      i64 total = total_of(s, plane, at, own + j, n, i == 0) +
                  steps(s, distance_of(s, plane, at, &z, off), -1);
      i32 e = min(total >> 6, (1 << 28) - 1);
      z.six[4] = v[-2];
      z.six[5] = v[-2 * s->pitch];
      i64 q = decode_detail(s, c, &z, e);
      height = min(max(z.w + q * s->step, s->z_min), s->z_max);
    }
    s->heights[place] = height;
    *v = height;
    i32 error = is_known || is_valid ? min(steps(s, magnitude(64 * height - z.p), -1), 32767) : 0;
    own[j] = error;
    s->errors[at] = error;
  }
}

static void fill_activity(const Plane *s, i32 i, i32 first) {
  const i32 *own = s->own_errors + (i + 2) * (s->n_cols + 3) + 2;
  for (i32 j = 0; j < s->n_cols; j++) {
    i32 *v = s->activity + first + 2 * j;
    i32 u = 0;
    if (i > 0) {
      const i32 *above = v - 2 * s->pitch;
      u = (j > 0 ? above[-2] : *above) + 2 * *above + (j < s->n_cols - 1 ? above[2] : *above);
    }
    *v = own[j - 1] + 2 * own[j] + own[j + 1] + ((3 * u) >> 4);
  }
}

static i32 core_mean(const Plane *s, i32 at) {
  const i32 *v = s->values + at;
  i64 sum = 2;
  for (i32 k = 0; k < 4; k++) sum += v[s->core[k]];
  return sum >> 2;
}

static inline void decode_rows(const Plane *s, i32 plane) {
  Coder c = {s->state[0], s->state[1], s->state[2]};
  i32 n = s->n_cols + 3;
  for (i32 i = 0; i < s->n_rows; i++) {
    i32 first = s->first + 2 * i * s->pitch, last = first + 2 * (s->n_cols - 1);
    i32 *own = s->own_errors + (i + 2) * n + 2;
    own[-1] = own[-2] = i > 0 ? own[-n] : 0;
    s->values[first - 2] = core_mean(s, first);
    s->values[last + 2] = core_mean(s, last);
    decode_row(s, &c, plane, i, first, s->place + i * s->place_row);
    own[s->n_cols] = own[s->n_cols - 1];
    fill_activity(s, i, first);
  }
  s->state[0] = c.range;
  s->state[1] = c.code;
  s->state[2] = c.position;
}

/* Decode a plane; the errors of its own in two rows above the first are 0 on entry. */
EXPORT("decodePlane")
void decode_plane(const Plane *s) {
  i32 last = s->first + 2 * (s->n_cols - 1), up = 2 * s->pitch;
  for (i32 at = s->first; at <= last; at += 2) s->values[at - up] = core_mean(s, at);
  s->values[s->first - up - 2] = core_mean(s, s->first);
  s->values[last - up + 2] = core_mean(s, last);
  if (s->plane == HH) {
    decode_rows(s, HH);
  } else if (s->plane == HL) {
    decode_rows(s, HL);
  } else {
    decode_rows(s, LH);
  }
}
