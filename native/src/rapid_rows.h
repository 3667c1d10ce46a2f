/*
 * Rows of method rapid (R.3, R.5 ... R.9): included once for each kind of NUMBER that sums of heights are.
 * Pointers are to a row's first sample, strides are those of the workspace.
 */

/* What a row is computed in. */
typedef struct NAMED(row) {
  NUMBER *predicted, *sum, *twist, *details;
  int32_t *least, *most, *expected, *whole, *contexts;
  NUMBER *packed_details; /* of valid samples, one behind the other */
  int32_t *packed_contexts;
} NAMED(row);

static ALWAYS_INLINE NUMBER NAMED(magnitude)(NUMBER a) { return a < 0 ? -a : a; }
static ALWAYS_INLINE NUMBER NAMED(least)(NUMBER a, NUMBER b) { return a < b ? a : b; }
static ALWAYS_INLINE NUMBER NAMED(most)(NUMBER a, NUMBER b) { return a > b ? a : b; }

static void NAMED(fill_bends)(int32_t n, ptrdiff_t s, const int32_t *RESTRICT a, int32_t *RESTRICT bends, int shift,
                              int32_t most) {
  IVDEP for (int32_t j = 0; j < n; j++) {
    const int32_t *at = a + j;
    NUMBER across = (NUMBER)at[-2] + at[2] - 4 * ((NUMBER)at[-1] + at[1]) + 6 * (NUMBER)at[0];
    NUMBER along = (NUMBER)at[-2 * s] + at[2 * s] - 4 * ((NUMBER)at[-s] + at[s]) + 6 * (NUMBER)at[0];
    NUMBER bend = (NAMED(magnitude)(across) + NAMED(magnitude)(along)) >> shift;
    bends[j] = (int32_t)NAMED(least)(bend, most);
  }
}

#define WEIGHTS(n_taps) \
  NUMBER w[n_taps]; \
  for (int k = 0; k < n_taps; k++) w[k] = weights[k]

static void NAMED(predict_hh)(int32_t n, ptrdiff_t s, const int32_t *RESTRICT a, const int32_t *RESTRICT own,
                              const int16_t *weights, NUMBER *RESTRICT predicted) {
  WEIGHTS(19);
  IVDEP for (int32_t j = 0; j < n; j++) {
    const int32_t *up = a + j - s, *at = a + j, *down = a + j + s, *low = a + j + 2 * s;
    NUMBER p = 32 + w[0] * up[-1] + w[1] * up[0] + w[2] * up[1] + w[3] * up[2];
    p += w[4] * at[-1] + w[5] * at[0] + w[6] * at[1] + w[7] * at[2];
    p += w[8] * down[-1] + w[9] * down[0] + w[10] * down[1] + w[11] * down[2];
    p += w[12] * low[-1] + w[13] * low[0] + w[14] * low[1] + w[15] * low[2];
    p += w[16] * own[j - s - 1] + w[17] * own[j - s] + w[18] * own[j - s + 1];
    predicted[j] = p >> 6;
  }
}

static void NAMED(predict_hl)(int32_t n, ptrdiff_t s, const int32_t *RESTRICT a, const int32_t *RESTRICT hh,
                              const int32_t *RESTRICT own, const int16_t *weights, NUMBER *RESTRICT predicted) {
  WEIGHTS(19);
  IVDEP for (int32_t j = 0; j < n; j++) {
    const int32_t *at = a + j, *h = hh + j, *up = hh + j - s;
    NUMBER p = 32 + w[0] * at[-1] + w[1] * at[0] + w[2] * at[1] + w[3] * at[2];
    p += w[4] * at[-s] + w[5] * at[1 - s] + w[6] * at[s] + w[7] * at[s + 1];
    p += w[8] * up[-1] + w[9] * up[0] + w[10] * up[1] + w[11] * h[-1] + w[12] * h[0];
    p += w[13] * h[1] + w[14] * up[-s] + w[15] * h[s];
    p += w[16] * own[j - s - 1] + w[17] * own[j - s] + w[18] * own[j - s + 1];
    predicted[j] = p >> 6;
  }
}

static void NAMED(predict_lh)(int32_t n, ptrdiff_t s, const int32_t *RESTRICT a, const int32_t *RESTRICT hh,
                              const int32_t *RESTRICT hl, const int32_t *RESTRICT own, const int16_t *weights,
                              NUMBER *RESTRICT predicted) {
  WEIGHTS(23);
  IVDEP for (int32_t j = 0; j < n; j++) {
    const int32_t *at = a + j, *down = a + j + s, *h = hh + j, *l = hl + j, *mine = own + j - s;
    NUMBER p = 32 + w[0] * at[-s] + w[1] * at[0] + w[2] * down[0] + w[3] * down[s];
    p += w[4] * at[-1] + w[5] * at[1] + w[6] * down[-1] + w[7] * down[1];
    p += w[8] * mine[-1] + w[9] * mine[0] + w[10] * mine[1] + w[11] * h[-2];
    p += w[12] * h[-1] + w[13] * h[0] + w[14] * h[1] + w[15] * h[-s - 1] + w[16] * h[-s];
    p += w[17] * h[s - 1] + w[18] * h[s] + w[19] * l[-1] + w[20] * l[0];
    p += w[21] * l[s - 1] + w[22] * l[s];
    predicted[j] = p >> 6;
  }
}
#undef WEIGHTS

/* What surrounds samples (R.6, R.7). */
#define FEATURES_OF_ROW \
  int32_t f[9]; \
  for (int k = 0; k < 9; k++) f[k] = features[k]; \
  NUMBER *RESTRICT sum = row->sum, *RESTRICT twist = row->twist; \
  int32_t *RESTRICT least = row->least, *RESTRICT most = row->most, *RESTRICT expected = row->expected

static void NAMED(look_around_hh)(int32_t n, ptrdiff_t s, const int32_t *RESTRICT a, const int32_t *RESTRICT error,
                                  const int32_t *RESTRICT bends, const int32_t *features, const NAMED(row) * row) {
  FEATURES_OF_ROW;
  IVDEP for (int32_t j = 0; j < n; j++) {
    const int32_t *at = a + j, *down = a + j + s;
    int32_t b = at[1], c = down[0], d = down[1];
    least[j] = min_i32(min_i32(at[0], b), min_i32(c, d));
    most[j] = max_i32(max_i32(at[0], b), max_i32(c, d));
    sum[j] = (NUMBER)at[0] + b + c + d;
    twist[j] = NAMED(magnitude)((NUMBER)at[0] + d - b - c);
    const int32_t *north = error + j - s;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] +
                  f[6] * (bends[j] + bends[j + 1] + bends[j + s] + bends[j + s + 1]);
  }
}

static void NAMED(look_around_hl)(int32_t n, ptrdiff_t s, const int32_t *RESTRICT a, const int32_t *RESTRICT hh,
                                  const int32_t *RESTRICT error_hh, const int32_t *RESTRICT error,
                                  const int32_t *RESTRICT bends, const int32_t *features, const NAMED(row) * row) {
  FEATURES_OF_ROW;
  IVDEP for (int32_t j = 0; j < n; j++) {
    const int32_t *at = a + j, *h = hh + j, *up = hh + j - s;
    NUMBER across = (NUMBER)at[0] + at[1], along = (NUMBER)up[0] + h[0];
    least[j] = min_i32(min_i32(at[0], at[1]), min_i32(up[0], h[0]));
    most[j] = max_i32(max_i32(at[0], at[1]), max_i32(up[0], h[0]));
    sum[j] = across + along;
    twist[j] = NAMED(magnitude)(across - along);
    const int32_t *north = error + j - s, *e = error_hh + j, *e_up = error_hh + j - s;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] + f[6] * (bends[j] + bends[j + 1]) +
                  f[7] * (e_up[0] + e[0]) + f[8] * (e_up[-1] + e[-1] + e_up[1] + e[1]);
  }
}

static void NAMED(look_around_lh)(int32_t n, ptrdiff_t s, const int32_t *RESTRICT a, const int32_t *RESTRICT hh,
                                  const int32_t *RESTRICT error_hh, const int32_t *RESTRICT error_hl,
                                  const int32_t *RESTRICT error, const int32_t *RESTRICT bends, const int32_t *features,
                                  const NAMED(row) * row) {
  FEATURES_OF_ROW;
  IVDEP for (int32_t j = 0; j < n; j++) {
    const int32_t *at = a + j, *down = a + j + s, *h = hh + j;
    NUMBER across = (NUMBER)at[0] + down[0], along = (NUMBER)h[-1] + h[0];
    least[j] = min_i32(min_i32(at[0], down[0]), min_i32(h[-1], h[0]));
    most[j] = max_i32(max_i32(at[0], down[0]), max_i32(h[-1], h[0]));
    sum[j] = across + along;
    twist[j] = NAMED(magnitude)(across - along);
    const int32_t *north = error + j - s, *e = error_hh + j, *g = error_hl + j;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] + f[6] * (bends[j] + bends[j + s]) +
                  f[7] * (e[-1] + e[0] + g[-1] + g[0] + g[s - 1] + g[s]) + f[8] * (e[-s - 1] + e[-s] + e[s - 1] + e[s]);
  }
}
#undef FEATURES_OF_ROW

/* R.6, R.7: clamp predictions; fill whole, contexts. No branch, or compilers make no vectors. */
static void NAMED(fill_contexts)(int32_t n, const rapid_scale *c, const int32_t *f, const NAMED(row) * row) {
  NUMBER *RESTRICT predicted = row->predicted;
  const NUMBER *RESTRICT sum = row->sum, *RESTRICT twist = row->twist;
  const int32_t *RESTRICT least = row->least, *RESTRICT most = row->most;
  int32_t *RESTRICT expected = row->expected, *RESTRICT whole = row->whole, *RESTRICT contexts = row->contexts;
  const int32_t of_const = f[0], of_range = f[4], of_twist = f[5], most_range = c->most_range;
  const int range_shift = c->range_shift, side_shift = c->side_shift, end_shift = c->end_shift;
  const int32_t side_scale = c->side_scale, far_scale = c->far_scale;
  IVDEP for (int32_t j = 0; j < n; j++) {
    NUMBER low = least[j], high = most[j];
    NUMBER p = NAMED(least)(NAMED(most)(predicted[j], low * 64), high * 64);
    predicted[j] = p;
    whole[j] = (int32_t)((p + 32) >> 6);
    int32_t range = (int32_t)NAMED(least)((high - low) >> range_shift, most_range);
    int32_t bent = (int32_t)NAMED(least)(twist[j] >> range_shift, most_range);
    expected[j] = (expected[j] + of_const + of_range * range + of_twist * bent) >> 4;
  }
  int32_t first = 0; /* the first bin that has not been dealt with */
  if (c->is_fine) {
    IVDEP for (int32_t j = 0; j < n; j++) {
      int32_t bin = ISA(bin_of_e)(expected[j]);
      int32_t side = (int32_t)(predicted[j] - (NUMBER)whole[j] * 64);
      int32_t size = side < 0 ? -side : side;
      int32_t near = min_i32((size * side_scale) >> 16, 3);
      contexts[j] = (4 * bin + (near & -(int32_t)(bin < 16))) | ((side >> 31) & DOWN);
    }
    if (!c->is_by_reach) return;
    first = 16;
  }
  if (c->is_by_reach) {
    IVDEP for (int32_t j = 0; j < n; j++) {
      int32_t e = expected[j], bin = ISA(bin_of_e)(e); /* e is below 2^27: twelve times it fit */
      NUMBER side = sum[j] * 16 - predicted[j];
      NUMBER above = (NUMBER)most[j] * 64 - predicted[j], below = predicted[j] - (NUMBER)least[j] * 64;
      NUMBER far = side < 0 ? above : below;
      int32_t x = ((int32_t)NAMED(least)(far >> side_shift, (1 << 20) - 1) * far_scale) >> end_shift;
      int32_t reach = (x > 2 * e) + (x > 6 * e) + (x > 12 * e);
      int32_t context = (4 * bin + reach) | (int32_t)((side >> 31) & DOWN);
      contexts[j] = bin < first ? contexts[j] : context;
    }
    return;
  }
  IVDEP for (int32_t j = 0; j < n; j++) {
    int32_t e = expected[j];
    NUMBER side = sum[j] * 16 - predicted[j];
    int32_t x = ((int32_t)NAMED(least)(NAMED(magnitude)(side) >> side_shift, (1 << 20) - 1) * far_scale) >> end_shift;
    int32_t far = (x > e) + (4 * x > 11 * e) + (x > 6 * e);
    contexts[j] = (4 * ISA(bin_of_e)(e) + far) | (int32_t)((side >> 31) & DOWN);
  }
}

/* R.9: the raw bits of n details. */
static void NAMED(read_raw)(const int32_t *contexts, NUMBER *details, int32_t n, int64_t most, rapid_streams *z) {
  for (int32_t j = 0; j < n; j++) {
    int n_bits = ((contexts[j] & (DOWN - 1)) >> 3) - 8;
    int64_t detail = (int64_t)details[j];
    if (detail == -ZERO_SYMBOL) {
      uint64_t bits = ISA(take_raw)(z, 33);
      detail = (int64_t)(bits & 0xFFFFFFFFu) - (int64_t)(bits >> 32 << 32);
    } else if (n_bits > 0) {
      detail = detail * ((int64_t)1 << n_bits) + (int64_t)ISA(take_raw)(z, n_bits);
    } else {
      continue;
    }
    details[j] = (NUMBER)clamp_i64(detail, -most, most);
  }
}

/* Details of a row that are read without voids between them: the row's own, or those of its valid samples. */
typedef struct NAMED(span) {
  NUMBER *details;
  const int32_t *contexts;
  int32_t n;
  rapid_streams *streams;
  int has_raw;
} NAMED(span);

/* R.8: details number j ... n - 1 of a span, towards the side of their contexts. */
static void NAMED(read_one_by_one)(NAMED(span) * s, int32_t j, const uint32_t *slots) {
  rapid_streams *z = s->streams;
  uint32_t last = z->n_states - 1;
  size_t before = min_size(z->n_words_used, z->n_words);
  const uint8_t *words = z->words + 2 * before; /* a row takes at most a word a sample: PAYLOAD_SLACK */
  size_t k = z->n_symbols, n_taken = 0;
  int has_raw = s->has_raw;
  for (; j < s->n; j++) {
    uint32_t context = (uint32_t)s->contexts[j] & (DOWN - 1);
    uint32_t x = z->states[k & last], entry = slots[context << 11 | (x & (SLOTS - 1))];
    uint32_t next = (entry >> 6 & 4095) * (x >> 11) + (entry >> 18);
    /* Whether a word follows is hard to foresee: no branch. */
    uint32_t takes = next < 65536, word = load_u16(words + 2 * n_taken);
    z->states[k & last] = takes ? next << 16 | word : next;
    n_taken += takes;
    k++;
    uint32_t symbol = entry & 63;
    s->details[j] = (NUMBER)symbol - ZERO_SYMBOL;
    has_raw |= (symbol == 0) | (context >= FIRST_RAW);
  }
  s->has_raw = has_raw;
  z->n_symbols = k;
  z->n_words_used += n_taken;
}

#define READ_RAW NAMED(read_raw)
#if defined(READ_VECTORS) && defined(__wasm_simd128__)
#include "rapid_simd128.h"
#elif defined(READ_VECTORS)
#include "rapid_vectors.h"
#undef READ_RAW
#define READ_RAW ISA(read_raw_vectors)
#endif

/* Details first ... stop - 1 of a row; `valid` is at every step-th place, NULL: all are. */
static NAMED(span) NAMED(begin_span)(const NAMED(row) * row, int32_t first, int32_t stop, const uint8_t *valid, size_t step,
                                     rapid_streams *z) {
  NAMED(span) s = {row->details + first, row->contexts + first, stop - first, z, 0};
  if (!valid || ISA(count_valid)(valid + (size_t)first * step, s.n, step) == s.n) return s;
  int32_t n = 0;
  for (int32_t j = first; j < stop; j++) {
    row->packed_contexts[n] = row->contexts[j];
    n += valid[(size_t)j * step];
  }
  s.details = row->packed_details;
  s.contexts = row->packed_contexts;
  s.n = n;
  return s;
}

static void NAMED(end_span)(const NAMED(row) * row, int32_t first, int32_t stop, const uint8_t *valid, size_t step,
                            int64_t most, const NAMED(span) * s) {
  if (s->has_raw) READ_RAW(s->contexts, s->details, s->n, most, s->streams);
  if (s->details == row->details + first) return;
  int32_t n = 0;
  row->packed_details[s->n] = 0;
  for (int32_t j = first; j < stop; j++) {
    int is_valid = valid[(size_t)j * step];
    row->details[j] = row->packed_details[n] & -is_valid;
    n += is_valid;
  }
}

static void NAMED(read_span)(NAMED(span) * s, const uint32_t *slots) {
#ifdef READ_VECTORS
  if (s->streams->n_states == 8) {
    READ_VECTORS(s, 1, slots);
    return;
  }
#endif
  NAMED(read_one_by_one)(s, 0, slots);
}

static void NAMED(read_details)(const NAMED(row) * row, int32_t first, int32_t stop, const uint8_t *valid, size_t step,
                                const uint32_t *slots, int64_t most, rapid_streams *z) {
  NAMED(span) s = NAMED(begin_span)(row, first, stop, valid, step, z);
  NAMED(read_span)(&s, slots);
  NAMED(end_span)(row, first, stop, valid, step, most, &s);
}

/* R.6: heights and errors of samples first ... stop - 1 of a row. */
static void NAMED(finish_row)(const NAMED(row) * row, int32_t first, int32_t stop, const rapid_scale *c, int32_t *RESTRICT own,
                              int32_t *RESTRICT error) {
  const NUMBER *RESTRICT predicted = row->predicted, *RESTRICT details = row->details;
  const int32_t *RESTRICT whole = row->whole, *RESTRICT contexts = row->contexts;
  const NUMBER quantum = c->step, low = c->low, high = c->high;
  const int shift = c->log2;
  IVDEP for (int32_t j = first; j < stop; j++) {
    NUMBER change = details[j] * quantum;
    NUMBER height = contexts[j] & DOWN ? whole[j] - change : whole[j] + change;
    NUMBER held = NAMED(least)(NAMED(most)(height, low), high);
    own[j] = (int32_t)held;
    NUMBER distance = NAMED(magnitude)(held * 64 - predicted[j]) >> shift;
    error[j] = (int32_t)NAMED(least)(distance, (1 << 18) - 1);
  }
}

/* The errors of known samples, whose heights are there. */
static void NAMED(note_errors)(const NAMED(row) * row, int32_t first, int32_t stop, const rapid_scale *c, const int32_t *own,
                               int32_t *error) {
  for (int32_t j = first; j < stop; j++) {
    NUMBER distance = NAMED(magnitude)((NUMBER)own[j] * 64 - row->predicted[j]) >> c->log2;
    error[j] = (int32_t)NAMED(least)(distance, (1 << 18) - 1);
  }
}

/* ---- A unit ---- */

/* Where plane A lies: sample (i, j) at start + i * row_step + j * col_step. */
typedef struct NAMED(source) {
  const int32_t *start; /* NULL: a void unit's heights, 0 */
  ptrdiff_t row_step, col_step;
} NAMED(source);

/* A row of a plane of a lattice. */
typedef struct NAMED(part) {
  int32_t stride, n_rows, n_cols; /* of the lattice */
  int32_t known_rows[2], known_cols[2];
  int is_whole; /* stride 1 and no plane empty: rows of the region are stored as a whole */
} NAMED(part);

typedef struct NAMED(work) {
  rapid_unit *unit;
  NAMED(row) row;
  int32_t *coarse, *bends, *planes[3], *errors[3];
  int32_t *pairs[4]; /* of units whose heights fit 16 bits: a sample and the next one, of the planes and of A */
  ptrdiff_t stride;
  const int16_t (*stencils)[N_TAPS];
  const int32_t (*features)[9];
  int32_t *heights; /* of the region */
  const uint8_t *valid;
  ptrdiff_t pitch;
  uint8_t *known; /* of the region: lines and corners that are decoded */
  int32_t sizes[3][2]; /* rows and columns of the planes of the lattice */
  NAMED(source) source; /* of plane A */
  /* Arrays of planes hold so many rows from `base` on; rows of A before `loaded` are there, bends before `bent`. */
  int32_t capacity, base, loaded, bent;
  int32_t *line, *line_of;
  size_t *places;
  uint8_t *line_valid;
} NAMED(work);

static ALWAYS_INLINE ptrdiff_t NAMED(at)(const NAMED(work) * w, int32_t row) {
  return (row - w->base) * w->stride + MARGIN;
}

static ALWAYS_INLINE int32_t NAMED(inside)(const NAMED(work) * w, int32_t height) {
  const rapid_scale *c = &w->unit->scale;
  return (int32_t)clamp_i64((int64_t)height - c->origin, c->low, c->high);
}

/* A height less the origin, corrected (FORMAT §5.5). */
static ALWAYS_INLINE int32_t NAMED(correct)(const NAMED(work) * w, size_t at, int32_t height) {
  const rapid_scale *c = &w->unit->scale;
  return (int32_t)corrected(w->unit->job, at, height, c->low, c->high);
}

static void NAMED(take_class)(NAMED(work) * w, int32_t log2_stride) {
  const rapid_unit *u = w->unit;
  int which = min_i32(max_i32(u->tables->k_max - u->job->level + log2_stride, 0), 3);
  w->stencils = u->tables->stencils[which];
  w->features = u->tables->features[which];
}

static void NAMED(pair_row)(const NAMED(work) * w, int plane, ptrdiff_t at, int32_t n);

/* A row of plane A and what lies around it, mirrored where the lattice ends. */
static void NAMED(load_coarse)(NAMED(work) * w, int32_t row, int32_t n_rows, int32_t n_cols) {
  const rapid_scale *c = &w->unit->scale;
  const NAMED(source) *a = &w->source;
  int32_t n = (n_cols + 1) >> 1;
  const NUMBER low = c->low, high = c->high, origin = c->origin;
  const int32_t *from = a->start + (ISA(fold)(2 * row, n_rows) >> 1) * a->row_step;
  int32_t *RESTRICT to = w->coarse + NAMED(at)(w, row);
  if (a->col_step == 1) {
    IVDEP for (int32_t j = 0; j < n; j++) to[j] = (int32_t)NAMED(least)(NAMED(most)((NUMBER)from[j] - origin, low), high);
  } else {
    for (int32_t j = 0; j < n; j++) to[j] = NAMED(inside)(w, from[j * a->col_step]);
  }
  for (int32_t k = 1; k <= REACH_OUTSIDE; k++) {
    to[-k] = to[ISA(fold)(-2 * k, n_cols) >> 1];
    to[n - 1 + k] = to[ISA(fold)(2 * (n - 1 + k), n_cols) >> 1];
  }
  NAMED(pair_row)(w, 3, NAMED(at)(w, row), n);
}

/* Curvatures of a row of plane A, and one sample beyond it (R.7). */
static void NAMED(bend_coarse)(NAMED(work) * w, int32_t row, int32_t n_even, int32_t n) {
  const rapid_scale *c = &w->unit->scale;
  int32_t *bends = w->bends + NAMED(at)(w, row);
  if (row < n_even) {
    NAMED(fill_bends)(n, w->stride, w->coarse + NAMED(at)(w, row), bends, c->range_shift, c->most_range);
    bends[n] = bends[n - 1];
  } else {
    memcpy(bends, bends - w->stride, sizeof *bends * (size_t)(n + 1));
  }
}

/* Plane A goes to the region as it is read: inherited samples are clamped (R.2). */
static void NAMED(store_coarse)(NAMED(work) * w, int32_t stride, int32_t row, int32_t n) {
  const layer *l = w->unit->job->out;
  int32_t origin = w->unit->scale.origin;
  const int32_t *from = w->coarse + NAMED(at)(w, row);
  int32_t *to = w->heights + (l->rows.core + 2 * row * stride) * w->pitch + l->cols.core;
  for (int32_t j = 0; j < n; j++) to[(ptrdiff_t)2 * j * stride] = from[j] + origin;
}

/* A row of the region: n_even samples of one plane and n_odd of another in turns; a stride of 1. */
static void NAMED(store_row)(const NAMED(work) * w, int32_t row, const int32_t *RESTRICT even, int32_t n_even,
                             const int32_t *RESTRICT odd, int32_t n_odd) {
  const layer *l = w->unit->job->out;
  int32_t *RESTRICT to = w->heights + (ptrdiff_t)(l->rows.core + row) * w->pitch + l->cols.core;
  const int32_t origin = w->unit->scale.origin;
  int32_t j = 0;
#if defined(__wasm_simd128__)
  const v128_t origins = wasm_i32x4_splat(origin);
  for (; j + 4 <= n_odd; j += 4) {
    v128_t a = wasm_i32x4_add(wasm_v128_load(even + j), origins), b = wasm_i32x4_add(wasm_v128_load(odd + j), origins);
    wasm_v128_store(to + 2 * j, wasm_i32x4_shuffle(a, b, 0, 4, 1, 5));
    wasm_v128_store(to + 2 * j + 4, wasm_i32x4_shuffle(a, b, 2, 6, 3, 7));
  }
#endif
  IVDEP for (; j < n_odd; j++) {
    to[2 * j] = even[j] + origin;
    to[2 * j + 1] = odd[j] + origin;
  }
  if (n_even > n_odd) to[2 * n_odd] = even[n_odd] + origin;
}

static void NAMED(extend)(int32_t *row, int32_t n) {
  for (int32_t k = 0; k < REACH_OUTSIDE; k++) {
    row[-1 - k] = row[0];
    row[n + k] = row[n - 1];
  }
}

static void NAMED(fill_means)(NAMED(work) * w, int plane, int32_t row, int32_t from, int32_t n) {
  const int32_t *a = w->coarse + NAMED(at)(w, from);
  int32_t *to = w->planes[plane] + NAMED(at)(w, row);
  ptrdiff_t east = plane == LH ? 0 : 1, south = plane == HL ? 0 : w->stride;
  for (int32_t j = 0; j < n; j++) {
    /* Of HL and LH the same two samples twice: (2 (a + b) + 2) >> 2. */
    NUMBER sum = (NUMBER)a[j] + a[j + east] + a[j + south] + a[j + south + east];
    to[j] = (int32_t)((sum + 2) >> 2);
  }
  NAMED(extend)(to, n);
  NAMED(pair_row)(w, plane, NAMED(at)(w, row), n);
}

static int NAMED(is_empty)(const NAMED(work) * w, int plane) { return w->sizes[plane][0] == 0 || w->sizes[plane][1] == 0; }

/* Errors above the first rows are 0 and heights there are means (R.5). */
static void NAMED(begin_planes)(NAMED(work) * w) {
  for (int plane = HH; plane <= LH; plane++) {
    memset(w->errors[plane], 0, sizeof(int32_t) * (size_t)(MARGIN * w->stride));
    if (!NAMED(is_empty)(w, plane)) NAMED(fill_means)(w, plane, -1, 0, w->sizes[plane][1]);
  }
}

/* Rows that the lattice's row t of HH, row t - 1 of HL and row t - 2 of LH need: of A, its bends, of empty planes. */
static void NAMED(advance)(NAMED(work) * w, const NAMED(part) * p, int32_t t) {
  int32_t n_even = (p->n_rows + 1) >> 1, n = (p->n_cols + 1) >> 1, stop = min_i32(t + 4, n_even + MARGIN);
  if (stop - w->base > w->capacity) {
    int32_t first = t - 5;
    size_t n_bytes = sizeof(int32_t) * (size_t)((w->loaded - first) * w->stride);
    int32_t *arrays[12] = {w->coarse, w->bends, w->planes[0], w->planes[1], w->planes[2], w->errors[0], w->errors[1], w->errors[2],
                           w->pairs[0], w->pairs[1], w->pairs[2], w->pairs[3]};
    for (int i = 0; i < 12 && arrays[i]; i++) memmove(arrays[i], arrays[i] + (first - w->base) * w->stride, n_bytes);
    w->base = first;
  }
  for (; w->loaded < stop; w->loaded++) {
    int32_t row = w->loaded;
    NAMED(load_coarse)(w, row, p->n_rows, p->n_cols);
    if (!p->is_whole && row >= 0 && row < n_even) NAMED(store_coarse)(w, p->stride, row, n);
    for (int plane = HH; row > -MARGIN && plane <= LH; plane++) {
      if (!NAMED(is_empty)(w, plane)) continue; /* means, without errors */
      memset(w->errors[plane] + NAMED(at)(w, row - 1) - MARGIN, 0, sizeof(int32_t) * (size_t)w->stride);
      NAMED(fill_means)(w, plane, row - 1, row - 1, plane == HH ? max_i32(p->n_cols >> 1, 1) : 1);
    }
  }
  for (; w->bent <= min_i32(t + 1, n_even); w->bent++) NAMED(bend_coarse)(w, w->bent, n_even, n);
}

/* Make a row readable beside it, and above and below the plane. */
static void NAMED(surround)(NAMED(work) * w, int plane, int32_t row, int32_t n_rows, int32_t n) {
  ptrdiff_t start = NAMED(at)(w, row);
  NAMED(extend)(w->planes[plane] + start, n);
  NAMED(extend)(w->errors[plane] + start, n);
  NAMED(pair_row)(w, plane, start, n);
  int32_t *arrays[3] = {w->planes[plane], w->errors[plane], w->pairs[plane]};
  for (int i = 0; i < 2 + w->unit->is_short; i++) {
    int32_t *at = arrays[i] + start;
    size_t n_bytes = sizeof(int32_t) * (size_t)(n + 2 * REACH_OUTSIDE);
    for (int32_t k = 1; row == 0 && k <= 3; k++) memcpy(at - k * w->stride - REACH_OUTSIDE, at - REACH_OUTSIDE, n_bytes);
    for (int32_t k = 1; row == n_rows - 1 && k <= 2; k++) memcpy(at + k * w->stride - REACH_OUTSIDE, at - REACH_OUTSIDE, n_bytes);
  }
}

/* A row between its prediction and its heights: samples first ... stop - 1 have symbols. */
typedef struct NAMED(span_of_row) {
  int32_t n, first, stop;
  ptrdiff_t start, step; /* of its samples in the region */
  int32_t *own, *error;
} NAMED(span_of_row);

#ifdef READ_VECTORS
/* Row `at` of pairs of plane A (3) or another one, of a unit whose heights fit 16 bits. */
static void NAMED(pair_row)(const NAMED(work) * w, int plane, ptrdiff_t at, int32_t n) {
  if (!w->unit->is_short) return;
  const int32_t *RESTRICT from = (plane == 3 ? w->coarse : w->planes[plane]) + at;
  int32_t *RESTRICT to = w->pairs[plane] + at;
  IVDEP for (int32_t j = -REACH_OUTSIDE; j < n + REACH_OUTSIDE; j++) {
    to[j] = (int32_t)(((uint32_t)from[j] & 65535) | (uint32_t)from[j + 1] << 16);
  }
}

/* Predict a row by products of pairs; returns 0 where heights do not fit 16 bits. */
static int NAMED(predict_short)(const NAMED(work) * w, int plane, int32_t n, ptrdiff_t at, const int16_t *v) {
  if (!w->unit->is_short) return 0;
  const ptrdiff_t s = w->stride;
  const int32_t *a = w->pairs[3] + at, *hh = w->pairs[HH] + at, *hl = w->pairs[HL] + at, *own = w->pairs[plane] + at - s;
  if (plane == HH) {
    const ISA(pair_of_taps) t[10] = {
        {a - s - 1, v[0], v[1]}, {a - s + 1, v[2], v[3]}, {a - 1, v[4], v[5]}, {a + 1, v[6], v[7]},
        {a + s - 1, v[8], v[9]}, {a + s + 1, v[10], v[11]}, {a + 2 * s - 1, v[12], v[13]}, {a + 2 * s + 1, v[14], v[15]},
        {own - 1, v[16], v[17]}, {own + 1, v[18], 0}};
    ISA(predict_pairs)(n, t, 10, w->row.predicted);
  } else if (plane == HL) {
    const ISA(pair_of_taps) t[12] = {
        {a - 1, v[0], v[1]}, {a + 1, v[2], v[3]}, {a - s, v[4], v[5]}, {a + s, v[6], v[7]}, {hh - s - 1, v[8], v[9]},
        {hh - s + 1, v[10], 0}, {hh - 1, v[11], v[12]}, {hh + 1, v[13], 0}, {hh - 2 * s, v[14], 0}, {hh + s, v[15], 0},
        {own - 1, v[16], v[17]}, {own + 1, v[18], 0}};
    ISA(predict_pairs)(n, t, 12, w->row.predicted);
  } else {
    const ISA(pair_of_taps) t[14] = {
        {a - s, v[0], 0}, {a - 1, v[4], v[1]}, {a + 1, v[5], 0}, {a + s - 1, v[6], v[2]}, {a + s + 1, v[7], 0},
        {a + 2 * s, v[3], 0}, {own - 1, v[8], v[9]}, {own + 1, v[10], 0}, {hh - 2, v[11], v[12]}, {hh, v[13], v[14]},
        {hh - s - 1, v[15], v[16]}, {hh + s - 1, v[17], v[18]}, {hl - 1, v[19], v[20]}, {hl + s - 1, v[21], v[22]}};
    ISA(predict_pairs)(n, t, 14, w->row.predicted);
  }
  return 1;
}
#else
static void NAMED(pair_row)(const NAMED(work) * w, int plane, ptrdiff_t at, int32_t n) {
  (void)w, (void)plane, (void)at, (void)n;
}
static int NAMED(predict_short)(const NAMED(work) * w, int plane, int32_t n, ptrdiff_t at, const int16_t *v) {
  (void)w, (void)plane, (void)at, (void)n, (void)v;
  return 0;
}
#endif

static void NAMED(begin_row)(NAMED(work) * w, const NAMED(part) * p, int plane, int32_t i, int32_t n, NAMED(span_of_row) * r) {
  const rapid_unit *u = w->unit;
  const rapid_scale *c = &u->scale;
  const layer *l = u->job->out;
  const NAMED(row) *row = &w->row;
  ptrdiff_t at = NAMED(at)(w, i), s = w->stride;
  const int16_t *weights = w->stencils[plane];
  const int32_t *f = w->features[plane];
  int32_t *own = w->planes[plane] + at, *error = w->errors[plane] + at;
  const int32_t *coarse = w->coarse + at, *hh = w->planes[HH] + at, *hl = w->planes[HL] + at, *bends = w->bends + at;
  const int32_t *error_hh = w->errors[HH] + at, *error_hl = w->errors[HL] + at;
  if (!NAMED(predict_short)(w, plane, n, at, weights)) {
    if (plane == HH) NAMED(predict_hh)(n, s, coarse, own, weights, row->predicted);
    if (plane == HL) NAMED(predict_hl)(n, s, coarse, hh, own, weights, row->predicted);
    if (plane == LH) NAMED(predict_lh)(n, s, coarse, hh, hl, own, weights, row->predicted);
  }
  if (plane == HH) NAMED(look_around_hh)(n, s, coarse, error, bends, f, row);
  if (plane == HL) NAMED(look_around_hl)(n, s, coarse, hh, error_hh, error, bends, f, row);
  if (plane == LH) NAMED(look_around_lh)(n, s, coarse, hh, error_hh, error_hl, error, bends, f, row);
  NAMED(fill_contexts)(n, c, f, row);
  int32_t lattice_row = 2 * i + (plane == HL ? 0 : 1), col = plane == LH ? 0 : 1;
  ptrdiff_t start = (l->rows.core + (ptrdiff_t)lattice_row * p->stride) * w->pitch + l->cols.core + (ptrdiff_t)col * p->stride;
  ptrdiff_t step = 2 * (ptrdiff_t)p->stride;
  int32_t first = min_i32((p->known_cols[0] + 1 - col) >> 1, n);
  int32_t stop = max_i32(n - ((p->known_cols[1] + 1 - ((p->n_cols - 1 - col) & 1)) >> 1), first);
  if (lattice_row < p->known_rows[0] || lattice_row >= p->n_rows - p->known_rows[1]) first = stop = n;
  int32_t *heights = w->heights + start;
  for (int32_t j = 0; j < first; j++) own[j] = NAMED(inside)(w, heights[j * step]);
  for (int32_t j = stop; j < n; j++) own[j] = NAMED(inside)(w, heights[j * step]);
  r->n = n;
  r->first = first;
  r->stop = stop;
  r->start = start;
  r->step = step;
  r->own = own;
  r->error = error;
}

static const uint8_t *NAMED(valid_of)(const NAMED(work) * w, const NAMED(span_of_row) * r) {
  return w->valid ? w->valid + r->start : NULL;
}

static void NAMED(read_row)(NAMED(work) * w, const NAMED(span_of_row) * r) {
  if (r->first >= r->stop) return;
  rapid_unit *u = w->unit;
  NAMED(read_details)(&w->row, r->first, r->stop, NAMED(valid_of)(w, r), (size_t)r->step, u->tables->slots, u->scale.most_detail, &u->streams);
}

static void NAMED(end_row)(NAMED(work) * w, const NAMED(part) * p, int plane, int32_t i, const NAMED(span_of_row) * r) {
  const rapid_scale *c = &w->unit->scale;
  NAMED(finish_row)(&w->row, r->first, r->stop, c, r->own, r->error);
  if (w->unit->job->corrections) {
    for (int32_t j = r->first; j < r->stop; j++) r->own[j] = NAMED(correct)(w, (size_t)(r->start + j * r->step), r->own[j]);
    NAMED(note_errors)(&w->row, r->first, r->stop, c, r->own, r->error);
  }
  int32_t *heights = w->heights + r->start;
  for (int32_t j = r->first; !p->is_whole && j < r->stop; j++) heights[j * r->step] = r->own[j] + c->origin;
  NAMED(note_errors)(&w->row, 0, r->first, c, r->own, r->error);
  NAMED(note_errors)(&w->row, r->stop, r->n, c, r->own, r->error);
  NAMED(surround)(w, plane, i, w->sizes[plane][0], r->n);
  if (!p->is_whole || plane == HH) return;
  ptrdiff_t at = NAMED(at)(w, i);
  const int32_t *even = plane == HL ? w->coarse : w->planes[LH], *odd = w->planes[plane == HL ? HL : HH];
  NAMED(store_row)(w, 2 * i + (plane == LH), even + at, (p->n_cols + 1) >> 1, odd + at, p->n_cols >> 1);
}

static void NAMED(begin_lattice)(NAMED(work) * w, const NAMED(source) * a, NAMED(part) * p) {
  int32_t n_even = (p->n_rows + 1) >> 1, n = (p->n_cols + 1) >> 1;
  p->is_whole = p->stride == 1 && p->n_rows > 1 && p->n_cols > 1;
  const int32_t sizes[3][2] = {{p->n_rows >> 1, p->n_cols >> 1}, {n_even, p->n_cols >> 1}, {p->n_rows >> 1, n}};
  memcpy(w->sizes, sizes, sizeof sizes);
  w->source = *a;
  w->base = w->loaded = -MARGIN;
  w->bent = 0;
  NAMED(advance)(w, p, 0);
  NAMED(begin_planes)(w);
}

static void NAMED(decode_lattice)(NAMED(work) * w, const NAMED(source) * a, NAMED(part) * p, int32_t n_turns) {
  NAMED(begin_lattice)(w, a, p);
  for (int32_t t = 0; t < n_turns; t++) {
    NAMED(advance)(w, p, t);
    for (int plane = HH; plane <= LH; plane++) {
      int32_t i = t - plane;
      if (i < 0 || i >= w->sizes[plane][0] || w->sizes[plane][1] == 0) continue;
      NAMED(span_of_row) r;
      NAMED(begin_row)(w, p, plane, i, w->sizes[plane][1], &r);
      NAMED(read_row)(w, &r);
      NAMED(end_row)(w, p, plane, i, &r);
    }
  }
}

/* ---- Shared samples (R.3) ---- */

/* Decode a row of n samples at w->places, which is predicted in w->row. */
static void NAMED(decode_places)(NAMED(work) * w, int32_t n) {
  if (n == 0) return;
  rapid_unit *u = w->unit;
  const rapid_scale *c = &u->scale;
  memset(w->row.expected, 0, sizeof(int32_t) * (size_t)n);
  NAMED(fill_contexts)(n, c, w->features[SHARED], &w->row);
  for (int32_t j = 0; w->valid && j < n; j++) w->line_valid[j] = w->valid[w->places[j]];
  NAMED(read_details)(&w->row, 0, n, w->valid ? w->line_valid : NULL, 1, u->tables->slots, c->most_detail, &u->streams);
  NAMED(finish_row)(&w->row, 0, n, c, w->line_of, w->row.least); /* its errors are nobody's */
  for (int32_t j = 0; j < n; j++) {
    w->heights[w->places[j]] = NAMED(correct)(w, w->places[j], w->line_of[j]) + c->origin;
    w->known[w->places[j]] = 1;
  }
}

static void NAMED(set)(NAMED(work) * w, int32_t j, int32_t least, int32_t most, NUMBER sum, NUMBER predicted, NUMBER twist) {
  w->row.least[j] = least;
  w->row.most[j] = most;
  w->row.sum[j] = sum;
  w->row.predicted[j] = predicted;
  w->row.twist[j] = NAMED(magnitude)(twist);
}

static int32_t NAMED(above)(const NAMED(work) * w, int32_t row, int32_t col) {
  return NAMED(inside)(w, parent_height(&w->unit->job->parent, row, col));
}

static void NAMED(decode_corners)(NAMED(work) * w, const shared_lines *rows, const shared_lines *cols) {
  const job *j = w->unit->job;
  const layer *l = j->out;
  int32_t n = 0;
  for (int side = 0; side < rows->n_sides; side++) {
    for (int other = 0; other < cols->n_sides; other++) {
      for (int32_t r = rows->first[side]; r <= rows->last[side]; r++) {
        for (int32_t c = cols->first[other]; c <= cols->last[other]; c++) {
          size_t at = (size_t)r * (size_t)w->pitch + (size_t)c;
          if (w->known[at]) continue;
          w->known[at] = 1;
          uint32_t row = l->rows.first + (uint32_t)r, col = l->cols.first + (uint32_t)c;
          int32_t top = line_above(row, 0, j->parent.first_row, j->parent.n_rows);
          int32_t bottom = line_above(row, 1, j->parent.first_row, j->parent.n_rows);
          int32_t left = line_above(col, 0, j->parent.first_col, j->parent.n_cols);
          int32_t right = line_above(col, 1, j->parent.first_col, j->parent.n_cols);
          int32_t p = NAMED(above)(w, top, left), q = NAMED(above)(w, top, right);
          if ((row | col) % 2 == 0) {
            w->heights[at] = p + w->unit->scale.origin;
            continue;
          }
          int32_t x = NAMED(above)(w, bottom, left), y = NAMED(above)(w, bottom, right);
          NUMBER sum = (NUMBER)p + q + x + y;
          NAMED(set)(w, n, min_i32(min_i32(p, q), min_i32(x, y)), max_i32(max_i32(p, q), max_i32(x, y)), sum, 16 * sum,
                     (NUMBER)p - q - x + y);
          w->places[n++] = at;
          if (n == CORNER_ROW) {
            NAMED(decode_places)(w, n);
            n = 0;
          }
        }
      }
    }
  }
  NAMED(decode_places)(w, n);
}

/* Samples of places outside, each side one, and a second one after (R.3). line[k + 1] is index k. */
static void NAMED(extend_line)(NUMBER *line, int32_t n) {
  line[0] = line[1 + min_i32(1, n - 1)];
  line[n + 1] = line[1 + max_i32(n - 2, 0)];
  line[n + 2] = line[1 + max_i32(n - 3, 0)];
}

/* A line from `start` on, every step-th sample; its parent's lines are `before` and `after`, from `from` on. */
static void NAMED(decode_line)(NAMED(work) * w, size_t start, size_t step, int32_t length, int is_odd, int is_row,
                               int32_t before, int32_t after, int32_t from) {
  int32_t n = (length + 1) >> 1, origin = w->unit->scale.origin, m = 0;
  NUMBER *line = (NUMBER *)w->line;
  for (int32_t k = 0; k < n; k++) {
    line[k + 1] = is_row ? NAMED(above)(w, before, from + k) : NAMED(above)(w, from + k, before);
  }
  if (is_odd) {
    for (int32_t k = 0; k < n; k++) {
      line[k + 1] += is_row ? NAMED(above)(w, after, from + k) : NAMED(above)(w, from + k, after);
    }
    NAMED(extend_line)(line, n);
    for (int32_t k = 0; k < n; k++) {
      size_t at = start + 2 * (size_t)k * step;
      if (w->known[at]) continue;
      int32_t u = is_row ? NAMED(above)(w, before, from + k) : NAMED(above)(w, from + k, before);
      NUMBER t = line[k + 1];
      int32_t v = (int32_t)(t - u);
      NAMED(set)(w, m, min_i32(u, v), max_i32(u, v), 2 * t, 32 * t, line[k] - 2 * t + line[k + 2]);
      w->places[m++] = at;
    }
    NAMED(decode_places)(w, m);
  } else {
    for (int32_t k = 0; k < n; k++) {
      size_t at = start + 2 * (size_t)k * step;
      if (w->known[at]) continue;
      w->known[at] = 1;
      w->heights[at] = (int32_t)line[k + 1] + origin;
    }
  }
  for (int32_t k = 0; k < n; k++) line[k + 1] = (NUMBER)w->heights[start + 2 * (size_t)k * step] - origin;
  NAMED(extend_line)(line, n);
  m = 0;
  for (int32_t k = 0; 2 * k + 1 < length; k++) {
    size_t at = start + (2 * (size_t)k + 1) * step;
    if (w->known[at]) continue;
    int32_t a = (int32_t)line[k], b = (int32_t)line[k + 1], c = (int32_t)line[k + 2], d = (int32_t)line[k + 3];
    NUMBER middle = (NUMBER)b + c;
    NAMED(set)(w, m, min_i32(min_i32(a, b), min_i32(c, d)), max_i32(max_i32(a, b), max_i32(c, d)), 2 * middle,
               4 * (9 * middle - a - d), (NUMBER)a - b - c + d);
    w->places[m++] = at;
  }
  NAMED(decode_places)(w, m);
}

static void NAMED(decode_shared)(NAMED(work) * w) {
  const job *j = w->unit->job;
  const parent *p = &j->parent;
  const axis *rows = &j->out->rows, *cols = &j->out->cols;
  int32_t rings = j->file->grid.rings;
  shared_lines of_rows, of_cols;
  find_shared_lines(&of_rows, rows, rings);
  find_shared_lines(&of_cols, cols, rings);
  memset(w->known, 0, (size_t)rows->n * (size_t)cols->n);
  NAMED(decode_corners)(w, &of_rows, &of_cols);
  int32_t done = -1; /* lines of both sides may be the same: those behind the last one are new */
  for (int side = 0; side < of_rows.n_sides; side++) {
    for (int32_t r = max_i32(of_rows.first[side], done + 1); r <= of_rows.last[side]; r++) {
      uint32_t row = rows->first + (uint32_t)r;
      NAMED(decode_line)(w, (size_t)r * (size_t)w->pitch + (size_t)cols->core, 1, cols->n_core, row & 1, 1,
                         line_above(row, 0, p->first_row, p->n_rows), line_above(row, 1, p->first_row, p->n_rows),
                         line_above(cols->core_first, 0, p->first_col, p->n_cols));
      done = r;
    }
  }
  done = -1;
  for (int side = 0; side < of_cols.n_sides; side++) {
    for (int32_t c = max_i32(of_cols.first[side], done + 1); c <= of_cols.last[side]; c++) {
      uint32_t col = cols->first + (uint32_t)c;
      NAMED(decode_line)(w, (size_t)rows->core * (size_t)w->pitch + (size_t)c, (size_t)w->pitch, rows->n_core, col & 1, 0,
                         line_above(col, 0, p->first_col, p->n_cols), line_above(col, 1, p->first_col, p->n_cols),
                         line_above(rows->core_first, 0, p->first_row, p->n_rows));
      done = c;
    }
  }
}

/* ---- Units ---- */

/* Decode what units share, and find the lattice that is left. */
static void NAMED(begin_group)(NAMED(work) * w, NAMED(source) * a, NAMED(part) * p) {
  const job *j = w->unit->job;
  const layer *l = j->out;
  NAMED(take_class)(w, 0);
  NAMED(decode_shared)(w);
  int32_t known = j->file->grid.rings + 1;
  const NAMED(part) found = {1, l->rows.n_core, l->cols.n_core, {l->rows.shared[0] ? known : 0, l->rows.shared[1] ? known : 0},
                             {l->cols.shared[0] ? known : 0, l->cols.shared[1] ? known : 0}, 0};
  *p = found;
  const parent *up = &j->parent;
  ptrdiff_t pitch = up->layer->cols.n;
  ptrdiff_t row = up->row + (ptrdiff_t)(l->rows.core_first / 2 - up->first_row);
  ptrdiff_t col = up->col + (ptrdiff_t)(l->cols.core_first / 2 - up->first_col);
  a->start = up->layer->heights + row * pitch + col;
  a->row_step = pitch;
  a->col_step = 1;
}

/* R.4. */
static void NAMED(decode_root)(NAMED(work) * w) {
  rapid_unit *u = w->unit;
  const rapid_scale *c = &u->scale;
  const layer *l = u->job->out;
  int32_t stride = 1, log2 = 0;
  while (stride < max_i32(l->rows.n_core, l->cols.n_core) - 1) {
    stride *= 2;
    log2++;
  }
  int64_t range = (int64_t)c->high - c->low;
  int n_bits = bit_length((uint64_t)(range / c->step));
  int32_t half = c->step >> 1;
  for (int32_t i = 0; i < l->rows.n_core; i += stride) {
    for (int32_t j = 0; j < l->cols.n_core; j += stride) {
      size_t at = (size_t)(l->rows.core + i) * (size_t)w->pitch + (size_t)(l->cols.core + j);
      int32_t height = (int32_t)shift_right((int64_t)c->low + c->high, 1);
      if (!w->valid || w->valid[at]) {
        int64_t index = (int64_t)ISA(take_raw)(&u->streams, n_bits);
        height = (int32_t)min_i64(c->low + index * c->step + half, c->high);
      }
      w->heights[at] = NAMED(correct)(w, at, height);
    }
  }
  for (; stride > 1; log2--) {
    NAMED(source) a = {w->heights + l->rows.core * w->pitch + l->cols.core, stride * w->pitch, stride};
    stride /= 2;
    NAMED(part) p = {stride, (l->rows.n_core - 1) / stride + 1, (l->cols.n_core - 1) / stride + 1, {0, 0}, {0, 0}, 0};
    NAMED(take_class)(w, log2 - 1);
    NAMED(decode_lattice)(w, &a, &p, ((p.n_rows + 1) >> 1) + 2);
  }
}

/* Lay out the memory of a unit. */
static twz_status NAMED(begin)(NAMED(work) * w, rapid_unit *u, twz_error *error) {
  const layer *l = u->job->out;
  size_t n_even = (size_t)(l->rows.n_core + 1) / 2, n = (size_t)(l->cols.n_core + 1) / 2;
  size_t stride = (n + 2 * MARGIN + 15) / 16 * 16, n_held = min_size(n_even + 2 * MARGIN, HELD_ROWS), n_plane = n_held * stride;
  size_t n_row = (n_even > n ? n_even : n) + CORNER_ROW + 2 * MARGIN;
  size_t n_region = (size_t)l->rows.n * (size_t)l->cols.n;
  size_t n_planes = u->is_short ? 12 : 8;
  size_t bytes = n_planes * n_plane * 4 + n_row * (6 * sizeof(NUMBER) + 7 * 4 + sizeof(size_t) + 1) + n_region;
  TRY(scratch_reserve(u->scratch, bytes + 24 * SCRATCH_ALIGN, error));
  memset(w, 0, sizeof *w);
  w->unit = u;
  w->stride = (ptrdiff_t)stride;
  w->capacity = (int32_t)n_held;
  w->heights = l->heights;
  w->valid = l->valid;
  w->pitch = l->cols.n;
  scratch *s = u->scratch;
  w->coarse = scratch_take(s, n_plane * 4);
  w->bends = scratch_take(s, n_plane * 4);
  for (int i = 0; i < 3; i++) w->planes[i] = scratch_take(s, n_plane * 4);
  for (int i = 0; i < 3; i++) w->errors[i] = scratch_take(s, n_plane * 4);
  for (int i = 0; u->is_short && i < 4; i++) w->pairs[i] = scratch_take(s, n_plane * 4);
  NUMBER **numbers[4] = {&w->row.predicted, &w->row.sum, &w->row.twist, &w->row.details};
  int32_t **whole[5] = {&w->row.least, &w->row.most, &w->row.expected, &w->row.whole, &w->row.contexts};
  for (int i = 0; i < 4; i++) *numbers[i] = scratch_take(s, n_row * sizeof(NUMBER));
  for (int i = 0; i < 5; i++) *whole[i] = scratch_take(s, n_row * 4);
  w->row.packed_details = scratch_take(s, n_row * sizeof(NUMBER));
  w->row.packed_contexts = scratch_take(s, n_row * 4);
  w->line = scratch_take(s, n_row * sizeof(NUMBER));
  w->line_of = scratch_take(s, n_row * 4);
  w->places = scratch_take(s, n_row * sizeof(size_t));
  w->line_valid = scratch_take(s, n_row);
  w->known = scratch_take(s, n_region);
  return TWZ_OK;
}

static twz_status NAMED(decode)(rapid_unit *u, twz_error *error) {
  NAMED(work) w;
  TRY(NAMED(begin)(&w, u, error));
  if (u->job->parent.layer) {
    NAMED(source) a;
    NAMED(part) p;
    NAMED(begin_group)(&w, &a, &p);
    NAMED(decode_lattice)(&w, &a, &p, u->n_turns);
  } else {
    NAMED(decode_root)(&w);
  }
  return TWZ_OK;
}

#ifdef READ_VECTORS
/* Groups row by row: symbols of one are read while those of the others wait for theirs. */
static twz_status NAMED(decode_groups)(rapid_unit *units, int n_units, twz_error *error) {
  NAMED(work) works[MOST_TOGETHER];
  NAMED(part) parts[MOST_TOGETHER];
  int32_t n_turns = 0;
  for (int k = 0; k < n_units; k++) {
    NAMED(source) a;
    TRY(NAMED(begin)(&works[k], &units[k], error));
    NAMED(begin_group)(&works[k], &a, &parts[k]);
    NAMED(begin_lattice)(&works[k], &a, &parts[k]);
    n_turns = max_i32(n_turns, units[k].n_turns);
  }
  for (int32_t t = 0; t < n_turns; t++) {
    for (int k = 0; k < n_units; k++) {
      if (t < units[k].n_turns) NAMED(advance)(&works[k], &parts[k], t);
    }
    for (int plane = HH; plane <= LH; plane++) {
      NAMED(span_of_row) rows[MOST_TOGETHER];
      NAMED(span) spans[MOST_TOGETHER];
      int32_t i = t - plane;
      int which[MOST_TOGETHER], n = 0; /* units that have such a row */
      for (int k = 0; k < n_units; k++) {
        const int32_t *size = works[k].sizes[plane];
        if (t >= units[k].n_turns || i < 0 || i >= size[0] || size[1] == 0) continue;
        NAMED(begin_row)(&works[k], &parts[k], plane, i, size[1], &rows[n]);
        spans[n] = NAMED(begin_span)(&works[k].row, rows[n].first, rows[n].stop, NAMED(valid_of)(&works[k], &rows[n]),
                                     (size_t)rows[n].step, &units[k].streams);
        which[n++] = k;
      }
      if (n) READ_VECTORS(spans, n, units[0].tables->slots);
      for (int m = 0; m < n; m++) {
        int k = which[m];
        NAMED(end_span)(&works[k].row, rows[m].first, rows[m].stop, NAMED(valid_of)(&works[k], &rows[m]), (size_t)rows[m].step,
                        units[k].scale.most_detail, &spans[m]);
        NAMED(end_row)(&works[k], &parts[k], plane, i, &rows[m]);
      }
    }
  }
  return TWZ_OK;
}
#endif
#undef READ_RAW
