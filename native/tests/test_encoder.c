/*
 * Tests of the encoder (src/encode.h) by itself: test_encoder [UNITS]. That its bytes are those of the Python package is
 * tested there (tests/codec/test_units_in_c.py). Here units of any heights are encoded by each kind of kernels, with memory
 * that sanitizers watch, and by allocators that fail.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "encode.h"
#include "encode_fit.h"
#include "encode_pyramid.h"
#include "kernels.h"

enum { MOST_SIDE = 90, MOST_Z = 1 << 29, N_KINDS = 3, N_SEEN = 5 };

static const twz_allocator PLAIN;
static int n_failed;

#define CHECK(condition)                                                             \
  do {                                                                               \
    if (!(condition)) {                                                              \
      fprintf(stderr, "%s:%d: not true: %s\n", __FILE__, __LINE__, #condition);      \
      n_failed++;                                                                    \
    }                                                                                \
  } while (0)

/* ---- Numbers by chance, the same on each run ---- */

static uint64_t state = 1;

static uint32_t below(uint32_t n) {
  state ^= state << 13;
  state ^= state >> 7;
  state ^= state << 17;
  return (uint32_t)((state >> 11) % n);
}

static int32_t between(int64_t low, int64_t high) {
  uint64_t span = (uint64_t)(high - low) + 1;
  return (int32_t)(low + (int64_t)(((uint64_t)below(1u << 31) << 20 | below(1u << 20)) % span));
}

/* ---- Tables and units ---- */

static encode_tables *new_tables(const twz_allocator *a, int is_harsh, twz_status *status) {
  static int64_t stencils[3 * N_LEVEL_CLASSES * N_TAPS], weights[3 * N_LEVEL_CLASSES * 4];
  static uint32_t freqs[N_TABLES * N_SYMBOLS], starts[N_TABLES * N_SYMBOLS];
  memset(freqs, 0, sizeof freqs);
  for (int i = 0; i < 3 * N_LEVEL_CLASSES; i++) {
    int64_t sum = 0;
    for (int k = 1; k < 12; k++) sum += stencils[N_TAPS * i + k] = is_harsh ? between(-20000, 20000) : between(-400, 700);
    stencils[N_TAPS * i] = 4096 - sum > INT16_MAX || 4096 - sum < -INT16_MAX ? 4096 : 4096 - sum;
    for (int k = 0; k < 4; k++) weights[4 * i + k] = between(0, is_harsh ? 516095 : 40000);
  }
  for (uint32_t t = 0; t < N_TABLES; t++) {
    uint32_t n = t < SINGLES ? PAIR_ESCAPE + 1 : SINGLE_ESCAPE + 1, left = SLOTS;
    for (uint32_t s = 0; s < n; s++) {
      uint32_t own = s + 1 == n ? left : t < SINGLES && s % 3 == 0 ? 0 : SLOTS / n;
      freqs[N_SYMBOLS * t + s] = own;
      starts[N_SYMBOLS * t + s] = SLOTS - left;
      left -= own;
    }
  }
  encode_tables *made;
  *status = encode_tables_new(a, 4, is_harsh ? 60 : 28, 0, stencils, weights, freqs, starts, &made, NULL);
  return made;
}

/* A job with arrays of its own, each as long as it must be. */
typedef struct drawn {
  encode_job job;
  int32_t *arrays[4];
  uint8_t *valid;
  int32_t *parent;
} drawn;

static int32_t drawn_side(int most) { return between(1, below(6) == 0 ? 3 : most); }

static drawn draw_unit(void) {
  static const int32_t STEPS[] = {1, 1, 3, 5, 101, LIMIT, LIMIT + 2, 1 << 20, INT32_MAX};
  drawn d;
  memset(&d, 0, sizeof d);
  encode_job *j = &d.job;
  j->size = sizeof *j;
  j->n_rows = drawn_side(MOST_SIDE);
  j->n_cols = drawn_side(MOST_SIDE);
  j->level = between(0, 6);
  j->step = STEPS[below(sizeof STEPS / sizeof *STEPS)];
  int64_t relief = (int64_t)1 << below(30), middle = below(3) ? 0 : between(-MOST_Z / 2, MOST_Z / 2);
  int64_t low = max_i64(middle - relief / 2, -MOST_Z), high = min_i64(middle + relief / 2, MOST_Z - 1);
  j->z_min = (int32_t)max_i64(low - between(0, 1000), -MOST_Z);
  j->z_max = (int32_t)min_i64(high + between(0, 1000), MOST_Z - 1);
  size_t n = (size_t)j->n_rows * (size_t)j->n_cols;
  for (int i = 0; i < 4; i++) {
    d.arrays[i] = malloc(n * sizeof(int32_t));
    if (!d.arrays[i]) exit(2);
  }
  int has_voids = below(2) == 0, has_kept = below(3) == 0, is_root = below(3) == 0, is_smooth = below(2) == 0;
  d.valid = malloc(n);
  d.parent = malloc(n * sizeof(int32_t));
  if (!d.valid || !d.parent) exit(2);
  for (size_t i = 0; i < n; i++) {
    d.valid[i] = !has_voids || below(4) > 0;
    int64_t height = is_smooth ? middle + (int64_t)(i % (size_t)j->n_cols) * 3 : between(low, high);
    d.arrays[0][i] = d.valid[i] ? (int32_t)clamp_i64(height, low, high) : (int32_t)(between(0, INT32_MAX) * (below(2) ? 1 : -1));
    d.arrays[1][i] = below(2) ? FREE : between(low, high);
    if (has_kept && d.arrays[1][i] != FREE) d.arrays[0][i] = d.arrays[1][i];
    d.parent[i] = between(j->z_min, j->z_max);
  }
  j->target = d.arrays[0];
  if (has_voids) j->valid = d.valid;
  if (has_kept) {
    j->kept = d.arrays[1];
    j->added = d.arrays[2];
  }
  if (!is_root) {
    j->parent = d.parent;
    j->parent_rows = (j->n_rows + 1) / 2;
    j->parent_cols = (j->n_cols + 1) / 2;
    j->parent_stride = j->parent_cols;
    for (int i = 0; i < 4; i++) j->shared[i] = (int32_t)below(2);
  }
  j->out = d.arrays[3];
  return d;
}

static void free_unit(drawn *d) {
  for (int i = 0; i < 4; i++) free(d->arrays[i]);
  free(d->valid);
  free(d->parent);
}

/* Valid heights come back within the bound, kept ones exactly if a correction can say so. */
static void check_heights(const drawn *d) {
  const encode_job *j = &d->job;
  for (size_t i = 0; i < (size_t)j->n_rows * (size_t)j->n_cols; i++) {
    int is_own = !j->parent || (i / (size_t)j->n_cols) % 2 || (i % (size_t)j->n_cols) % 2;
    int64_t apart = abs_i64((int64_t)j->out[i] - j->target[i]);
    CHECK(j->out[i] >= j->z_min && j->out[i] <= j->z_max);
    if (is_own && (!j->valid || j->valid[i])) CHECK(apart <= j->step / 2);
    if (is_own && j->kept && j->kept[i] != FREE && (!j->valid || j->valid[i])) CHECK(apart == 0);
  }
}

/* Encode by all kinds of kernels; the same comes of it. */
static void test_kernels_agree(twz_encoder *const *encoders, const encode_tables *tables) {
  drawn d = draw_unit();
  size_t n = (size_t)d.job.n_rows * (size_t)d.job.n_cols;
  uint8_t *first = NULL;
  size_t n_first = 0;
  uint64_t of_heights = 0;
  for (int k = 0; k < N_KINDS; k++) {
    if (!encoders[k]) continue;
    memset(d.arrays[2], 0, n * sizeof(int32_t));
    memset(d.arrays[3], 0, n * sizeof(int32_t));
    CHECK(twz_python_encode(encoders[k], tables, &d.job, NULL) == TWZ_OK);
    check_heights(&d);
    uint64_t hash = 0;
    for (size_t i = 0; i < n; i++) hash = (hash >> 7 | hash << 57) ^ (uint32_t)d.arrays[3][i] ^ (uint64_t)(uint32_t)d.arrays[2][i] << 32;
    if (!first) {
      n_first = (size_t)d.job.n_payload;
      first = malloc(n_first);
      if (!first) exit(2);
      memcpy(first, d.job.payload, n_first);
      of_heights = hash;
    }
    CHECK(d.job.n_payload == n_first && memcmp(first, d.job.payload, n_first) == 0 && hash == of_heights);
  }
  free(first);
  free_unit(&d);
}

/* Symbols are counted, and what is known of samples is noted, without a byte beyond. */
static void test_counts(twz_encoder *encoder, const encode_tables *tables) {
  static int64_t counts[N_TABLES * N_SYMBOLS];
  drawn d = draw_unit();
  memset(d.arrays[2], 0, (size_t)d.job.n_rows * (size_t)d.job.n_cols * sizeof(int32_t));
  size_t n = 0;
  int32_t stride = 1;
  while (!d.job.parent && stride < max_i32(d.job.n_rows, d.job.n_cols) - 1) stride *= 2;
  if (!d.job.parent) stride /= 2;
  for (; stride; stride /= 2) {
    int32_t rows = (d.job.n_rows - 1) / stride + 1, cols = (d.job.n_cols - 1) / stride + 1, even = (cols + 1) / 2, odd = cols / 2;
    n += (size_t)(N_SEEN * (rows / 2 * (odd + odd % 2) + (rows + 1) / 2 * (odd + odd % 2) + rows / 2 * (even + even % 2)));
  }
  int32_t *seen = malloc((n ? n : 1) * sizeof *seen);
  if (!seen) exit(2);
  memset(counts, 0, sizeof counts);
  d.job.counts = counts;
  d.job.seen = seen;
  CHECK(twz_python_encode(encoder, tables, &d.job, NULL) == TWZ_OK);
  int64_t total = 0, n_coded = 0;
  for (int i = 0; i < N_TABLES * N_SYMBOLS; i++) total += counts[i];
  CHECK(total >= 0 && total <= 2 * (int64_t)n);
  for (size_t i = 0; i < n; i++) n_coded += seen[i] != 0;
  CHECK(n_coded <= (int64_t)n);
  free(seen);
  free_unit(&d);
}

/* ---- Masks ---- */

/* What a mask's bits say, and what a decoder would know of it: own samples are those given, all of them valid. */
static void test_mask(twz_encoder *encoder) {
  mask_job j;
  memset(&j, 0, sizeof j);
  j.size = sizeof j;
  j.n_rows = drawn_side(MOST_SIDE);
  j.n_cols = drawn_side(MOST_SIDE);
  j.is_finest = (int32_t)below(2);
  j.has_above = (int32_t)below(2);
  if (j.has_above) {
    j.p = (int32_t)below(2);
    j.q = (int32_t)below(2);
    j.above_row = (int32_t)below(2);
    j.above_rows = j.above_row + (j.n_rows + 1 - j.p) / 2 + (int32_t)below(2);
    j.above_cols = (j.n_cols + 1 - j.q) / 2 + (int32_t)below(2);
    j.above_rows = max_i32(j.above_rows, 1);
    j.above_cols = max_i32(j.above_cols, 1);
  }
  size_t n = (size_t)j.n_rows * (size_t)j.n_cols, n_above = (size_t)j.above_rows * (size_t)j.above_cols;
  uint8_t *bytes[7];
  j.capacity = 3 * (n + 32);
  const size_t sizes[7] = {n, n, n, j.capacity, j.capacity, n_above, n_above};
  uint32_t density = below(100);
  for (int i = 0; i < 7; i++) {
    bytes[i] = malloc(sizes[i] ? sizes[i] : 1);
    if (!bytes[i]) exit(2);
    for (size_t k = 0; k < sizes[i]; k++) bytes[i][k] = below(100) < density;
  }
  for (size_t k = 0; k < n_above; k++) bytes[6][k] |= bytes[5][k];
  for (size_t k = 0; k < n; k++) {
    int32_t row = (int32_t)(k / (size_t)j.n_cols), col = (int32_t)(k % (size_t)j.n_cols);
    int is_known = j.has_above && (row + j.p) % 2 == 0 && (col + j.q) % 2 == 0;
    if (is_known) bytes[0][k] = bytes[5][((row - j.p) / 2 + j.above_row) * j.above_cols + (col - j.q) / 2];
    bytes[1][k] |= bytes[0][k];
  }
  j.own = bytes[0];
  j.mask = bytes[1];
  j.cells = bytes[2];
  j.models = bytes[3];
  j.bits = bytes[4];
  if (j.has_above) {
    j.own_above = bytes[5];
    j.valid_above = bytes[6];
  }
  CHECK(twz_python_encode_mask(encoder, &j, NULL) == TWZ_OK);
  CHECK(j.n_bits <= j.capacity);
  for (uint64_t i = 0; i < j.n_bits; i++) CHECK(j.bits[i] <= 1 && j.models[i] < 62);
  uint32_t freqs[62], states[4] = {FIRST_STATE, FIRST_STATE, FIRST_STATE, FIRST_STATE};
  for (int i = 0; i < 62; i++) freqs[i] = 1 + below(SLOTS - 1);
  uint8_t *words = malloc(2 * (size_t)j.n_bits + 1);
  if (!words) exit(2);
  CHECK(twz_python_mask_words(j.models, j.bits, j.n_bits, freqs, below(2) ? 4 : 1, states, words) <= j.n_bits);
  for (int i = 0; i < 4; i++) CHECK(states[i] >= FIRST_STATE);
  if (j.n_bits > 1) {
    j.capacity = j.n_bits - 1;
    j.n_bits = 0;
    CHECK(twz_python_encode_mask(encoder, &j, NULL) == TWZ_BAD_ARGUMENT);
  }
  j.size--;
  CHECK(twz_python_encode_mask(encoder, &j, NULL) == TWZ_BAD_ARGUMENT);
  free(words);
  for (int i = 0; i < 7; i++) free(bytes[i]);
}

/* ---- Quanta and fills ---- */

static void test_pyramid(void) {
  static const size_t SIZES[] = {1, 1, 2, 2, 4, 4, 8, 4, 8};
  static const double ODD[] = {0.0, -0.0, 5e-324, -0.5, 1.5, 2.5, 1e300, -1e300, 9007199254740993.0, 4503599627370495.5};
  int32_t n_rows = drawn_side(20), n_cols = drawn_side(20);
  size_t n = (size_t)n_rows * (size_t)n_cols;
  for (int type = RAW_I1; type <= RAW_F8; type++) {
    uint8_t *raw = malloc(n * SIZES[type]), *valid = malloc(n);
    int32_t *quanta = malloc(n * sizeof *quanta);
    if (!raw || !valid || !quanta) exit(2);
    for (size_t i = 0; i < n * SIZES[type]; i++) raw[i] = (uint8_t)below(256);
    for (size_t i = 0; type == RAW_F8 && i < n; i++) memcpy(raw + 8 * i, &ODD[below(10)], 8);
    for (size_t i = 0; i < n; i++) valid[i] = below(4) > 0; /* of floats of any bits: NaN, infinities */
    for (int is_whole = 0; is_whole < 2; is_whole++) {
      twz_python_quantise(type, raw, (ptrdiff_t)n, valid, (ptrdiff_t)n, 1, n, is_whole, 1 + below(1000), 1 + below(1000), between(-1000, 1000), quanta);
      for (size_t i = 0; i < n; i++) CHECK(valid[i] || quanta[i] == 0);
    }
    free(raw);
    free(valid);
    free(quanta);
  }
  int32_t first_row = n_rows > 1 ? (int32_t)below(2) : 0, first_col = n_cols > 1 ? (int32_t)below(2) : 0;
  int32_t to_rows = (n_rows - first_row + 1) / 2, to_cols = (n_cols - first_col + 1) / 2;
  int32_t below_rows = 2 * n_rows - 1 - first_row, below_cols = 2 * n_cols - 1 - first_col;
  below_rows = max_i32(below_rows, 1);
  below_cols = max_i32(below_cols, 1);
  size_t n_to = (size_t)to_rows * (size_t)to_cols, n_below = (size_t)below_rows * (size_t)below_cols;
  int32_t *fine = malloc(n * sizeof *fine), *values = malloc(n_to * sizeof *values), *filled = malloc(n_below * sizeof *filled);
  uint8_t *known = malloc(n_to), *is_known = malloc(n_below);
  int64_t *lines = malloc(2 * (size_t)n_cols * sizeof *lines);
  if (!fine || !values || !filled || !known || !is_known || !lines) exit(2);
  for (size_t i = 0; i < n; i++) fine[i] = below(3) ? between(-MOST_Z, MOST_Z) : UNKNOWN_HEIGHT;
  twz_python_push(fine, n_rows, n_cols, first_row, first_col, lines, to_rows, to_cols, values, known);
  for (size_t i = 0; i < n_to; i++) CHECK(known[i] <= 1 && (known[i] || values[i] == 0));
  for (size_t i = 0; i < n_below; i++) {
    is_known[i] = (uint8_t)below(2);
    filled[i] = 7;
  }
  twz_python_pull(fine, n_rows, n_cols, first_row, first_col, below_rows, below_cols, is_known, filled);
  for (size_t i = 0; i < n_below; i++) CHECK(!is_known[i] || filled[i] == 7);
  free(fine);
  free(values);
  free(filled);
  free(known);
  free(is_known);
  free(lines);
}

/* ---- Allocators that fail ---- */

typedef struct failing {
  size_t n_left, n_held;
} failing;

/* Samples are in their memory and their range, and each kind of kernels sums them up alike. */
static void test_fit(void) {
  enum { SIDE = 40, EDGE = 5, N_SETS = 3, ALL = FIT_TAPS * FIT_COLUMNS };
  static const twz_kernels KINDS[N_KINDS] = {TWZ_KERNELS_BASELINE, TWZ_KERNELS_AVX2, TWZ_KERNELS_AVX512};
  const int32_t n_taps = 16 + 4 * (int32_t)below(3), step = between(1, 3);
  const size_t n_places = FIT_BLOCK * (size_t)between(1, 3) * (size_t)step, n = n_places / (size_t)step;
  int32_t *heights = malloc(SIDE * SIDE * sizeof *heights);
  uint8_t *valid = malloc(SIDE * SIDE), *coded = malloc(n_places);
  int64_t *places = malloc(n_places * sizeof *places), offsets[FIT_COLUMNS] = {0}, sums[N_SETS] = {0};
  double *values = malloc(n_places * FIT_COLUMNS * sizeof *values), *roots = malloc(n * sizeof *roots);
  double *errors = malloc(N_SETS * n * sizeof *errors), weights[N_SETS * FIT_TAPS], products[2][ALL], noises[N_SETS] = {0, 1, 2};
  for (int i = 0; i < SIDE * SIDE; i++) heights[i] = below(20) ? between(-3000, 3000) : between(INT32_MIN, INT32_MAX);
  for (int i = 0; i < SIDE * SIDE; i++) valid[i] = below(50) != 0;
  for (int i = 0; i < n_taps; i++) offsets[i] = between(-EDGE, EDGE) * SIDE + between(-EDGE, EDGE);
  for (size_t i = 0; i < n_places; i++) places[i] = between(EDGE, SIDE - EDGE - 1) * SIDE + between(EDGE, SIDE - EDGE - 1);
  gather_job job = {heights, valid, places, offsets, (int64_t)n_places, n_taps, {0, 1, 2, n_taps - 1}, 64.0 / between(1, 9), 131072, values};
  int64_t n_valid = twz_python_gather_samples(&job);
  CHECK(n_valid >= 0 && n_valid <= (int64_t)n_places);
  job.valid = NULL;
  CHECK(twz_python_gather_samples(&job) == (int64_t)n_places);
  for (size_t i = 0; i < n_places * FIT_COLUMNS; i++) CHECK(values[i] >= -131072 && values[i] <= 131072 && values[i] == (double)(int32_t)values[i]);
  for (int i = 0; i < N_SETS * FIT_TAPS; i++) weights[i] = i < FIT_TAPS ? 0 : between(-20000, 20000);
  for (size_t i = 0; i < n; i++) roots[i] = 1.0 / between(1, 1000);
  twz_python_errors_of(values, (int64_t)n, step, weights, N_SETS, 4096, 1.0 / 262144, errors);
  for (size_t i = 0; i < n; i++) CHECK(errors[i] == values[i * (size_t)step * FIT_COLUMNS + FIT_TAPS] / 64);
  double *others = malloc(N_SETS * n * sizeof *others);
  int32_t shift = twz_python_products_of(values, (int64_t)n, step, roots, 20, products[0]);
  for (int k = 0; k < N_KINDS; k++) {
    const row_kernels *kernels = find_kernels(KINDS[k]);
    if (!kernels) continue;
    kernels->fit_errors(values, (int64_t)n, step, weights, N_SETS, 4096, 1.0 / 262144, others);
    CHECK(memcmp(errors, others, N_SETS * n * sizeof *errors) == 0);
    kernels->fit_products(values, (int64_t)n, step, roots, shift < 0 ? 1.0 / (1 << -shift) : 1 << shift, products[1]);
    for (int i = 0; i < ALL; i++) CHECK(i % FIT_COLUMNS < i / FIT_COLUMNS || products[0][i] == products[1][i]);
  }
  twz_python_sums_of_bits(values, (int64_t)n, step, weights, N_SETS, 4096, 1.0 / 262144, noises, 16777216, others, sums);
  CHECK(sums[1] >= (int64_t)n * (127 << 23) && sums[2] >= (int64_t)n * (127 << 23));
  /* A system of the unit matrix has its last column as its solution. */
  for (int i = 0; i < ALL; i++) products[0][i] = i % FIT_COLUMNS == i / FIT_COLUMNS ? 1 : i % FIT_COLUMNS == FIT_TAPS ? i : 0;
  twz_python_solve(products[0], 1, weights);
  for (int i = 0; i < FIT_TAPS; i++) CHECK(weights[i] == i * FIT_COLUMNS + FIT_TAPS);
  for (int i = 0; i < FIT_FEATURES; i++) weights[i] = i;
  const int64_t m = (int64_t)n / 4, every = between(1, 3);
  const size_t capacity = (size_t)(m / every);
  double *rows = malloc((capacity + 1) * FIT_ROWS * sizeof *rows), *parts = malloc((capacity + 1) * FIT_ROWS * sizeof *parts);
  for (int64_t i = 0; i < m; i++) coded[i] = below(9) != 0;
  for (int64_t i = 0; i < SIDE * SIDE; i++) heights[i] = between(0, 1 << 20);
  int64_t n_rows = twz_python_rows_of(heights, heights + 3 * m, coded, m, every, 0.25, (int64_t)capacity, rows);
  CHECK(n_rows >= 0 && n_rows <= (int64_t)capacity);
  for (size_t i = 0; i < capacity * FIT_ROWS; i++) rows[i] = between(0, 1 << 20);
  twz_python_weighed_products(rows, (int64_t)capacity, weights, 0.2, 18, parts, products[0]);
  for (int i = 0; i < FIT_ROWS * FIT_ROWS; i++) CHECK(products[0][i] == products[0][i % FIT_ROWS * FIT_ROWS + i / FIT_ROWS]);
  free(heights), free(valid), free(coded), free(places), free(values), free(roots), free(errors), free(others), free(rows), free(parts);
}

static void *fail_later(void *context, size_t n_bytes) {
  failing *f = context;
  if (f->n_left == 0) return NULL;
  f->n_left--;
  f->n_held++;
  return malloc(n_bytes);
}

static void release(void *context, void *memory) {
  failing *f = context;
  f->n_held--;
  free(memory);
}

static void test_no_memory(void) {
  drawn d = draw_unit();
  for (size_t n = 0, is_done = 0; !is_done; n++) {
    failing f = {n, 0};
    const twz_allocator allocator = {.context = &f, .allocate = fail_later, .release = release};
    twz_encoder *encoder;
    twz_status status;
    memset(d.arrays[2], 0, (size_t)d.job.n_rows * (size_t)d.job.n_cols * sizeof(int32_t));
    encode_tables *tables = new_tables(&allocator, 0, &status);
    if (status == TWZ_OK) status = encoder_new(&allocator, TWZ_KERNELS_AUTO, &encoder, NULL); else encoder = NULL;
    if (status == TWZ_OK) status = twz_python_encode(encoder, tables, &d.job, NULL);
    CHECK(status == TWZ_OK || status == TWZ_NO_MEMORY);
    if (status == TWZ_NO_MEMORY && encoder) { /* it can be used again */
      f.n_left = 100;
      memset(d.arrays[2], 0, (size_t)d.job.n_rows * (size_t)d.job.n_cols * sizeof(int32_t));
      CHECK(twz_python_encode(encoder, tables, &d.job, NULL) == TWZ_OK);
      check_heights(&d);
    }
    is_done = status == TWZ_OK;
    CHECK(n < 20);
    encoder_free(encoder);
    encode_tables_free(tables);
    CHECK(f.n_held == 0);
  }
  free_unit(&d);
}

static void test_wrong_jobs(twz_encoder *encoder, const encode_tables *tables) {
  drawn d = draw_unit();
  const encode_job sound = d.job;
#define REFUSED(field, value)                                                  \
  d.job = sound;                                                               \
  d.job.field = value;                                                         \
  CHECK(twz_python_encode(encoder, tables, &d.job, NULL) == TWZ_BAD_ARGUMENT)
  REFUSED(size, sizeof sound - 8);
  REFUSED(n_rows, 0);
  REFUSED(n_cols, -1);
  REFUSED(n_rows, 1 << 20);
  REFUSED(step, 0);
  REFUSED(z_min, INT32_MIN);
  REFUSED(z_max, INT32_MAX);
  REFUSED(z_max, sound.z_min - 1);
  free_unit(&d);
}

int main(int n_arguments, char **arguments) {
  static const twz_kernels KINDS[N_KINDS] = {TWZ_KERNELS_BASELINE, TWZ_KERNELS_AVX2, TWZ_KERNELS_AVX512};
  twz_encoder *encoders[N_KINDS];
  int n_units = n_arguments > 1 ? atoi(arguments[1]) : 1000;
  for (int k = 0; k < N_KINDS; k++) CHECK(encoder_new(&PLAIN, KINDS[k], &encoders[k], NULL) == TWZ_OK || !encoders[k]);
  for (int is_harsh = 0; is_harsh < 2; is_harsh++) {
    twz_status status;
    encode_tables *tables = new_tables(&PLAIN, is_harsh, &status);
    CHECK(status == TWZ_OK);
    for (int i = 0; i < n_units; i++) test_kernels_agree(encoders, tables);
    for (int i = 0; i < n_units / 4; i++) test_counts(encoders[0], tables);
    for (int i = 0; i < n_units; i++) test_mask(encoders[0]);
    for (int i = 0; i < n_units / 4; i++) test_pyramid();
    for (int i = 0; i < n_units / 4; i++) test_fit();
    for (int i = 0; i < 3; i++) test_wrong_jobs(encoders[0], tables);
    encode_tables_free(tables);
  }
  for (int i = 0; i < 10; i++) test_no_memory();
  for (int k = 0; k < N_KINDS; k++) encoder_free(encoders[k]);
  if (n_failed) fprintf(stderr, "%d checks failed\n", n_failed);
  return n_failed != 0;
}
