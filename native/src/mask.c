/* Which samples are valid, and which are the raster's own (FORMAT §5.1, §5.2). */
#include "range.h"
#include "tables.h"

/* Bytes of the region with a margin of zeros, so that neighbours can be read without asking. */
typedef struct field {
  uint8_t *at; /* sample (0, 0) */
  size_t stride;
} field;

enum { MOST = 2 * 1024 + 4 }; /* samples of a region along an axis, or more (§2.4) */
enum { EDGE = 2, N_MODELS = 1296 };

static size_t field_bytes(const layer *out) {
  return (size_t)(out->rows.n + 2 * EDGE) * (size_t)(out->cols.n + 2 * EDGE);
}

/* A field; of one that will be filled the margin alone is made 0. */
static field take_field(scratch *s, const layer *out, int is_filled) {
  field f;
  size_t n = field_bytes(out);
  uint8_t *memory = scratch_take(s, n);
  f.stride = (size_t)(out->cols.n + 2 * EDGE);
  f.at = memory + EDGE * f.stride + EDGE;
  if (!is_filled) memset(memory, 0, n);
  for (int32_t r = -1; is_filled && r < out->rows.n; r++) memset(f.at + r * (ptrdiff_t)f.stride + out->cols.n, 0, 2 * EDGE);
  memset(memory, 0, f.stride * EDGE);
  memset(memory + n - f.stride * EDGE, 0, f.stride * EDGE);
  return f;
}

/* m samples of a parent's line of n, from number `from` on: outside of it the first or the last one. */
static void take_line(const uint8_t *line, int32_t n, int32_t from, int32_t m, uint8_t *to) {
  int32_t before = min_i32(max_i32(-from, 0), m), inside = min_i32(max_i32(n - from - before, 0), m - before);
  memset(to, line[0], (size_t)before);
  if (inside) memcpy(to + before, line + from + before, (size_t)inside);
  memset(to + before + inside, line[n - 1], (size_t)(m - before - inside));
}

/* The parent's column of the first even column of the region. */
static int32_t first_above(const layer *out, const parent *p) {
  return (int32_t)((int64_t)(((uint64_t)out->cols.first + 1) / 2) - p->first_col);
}

static void imply_voids(const layer *out, const parent *p, field implied) {
  if (!p->layer || (!p->is_void && !p->layer->valid)) return;
  uint8_t above[MOST], below[MOST];
  int32_t n = out->cols.n, odd = (int32_t)(out->cols.first & 1); /* 1: the first column lies between two of the parent's */
  int32_t n_pairs = (n - odd) / 2;
  for (int32_t r = 0; r < out->rows.n; r++) {
    uint8_t *RESTRICT row = implied.at + (size_t)r * implied.stride;
    if (p->is_void) {
      memset(row, 1, (size_t)n);
      continue;
    }
    uint32_t line = out->rows.first + (uint32_t)r;
    const uint8_t *valid = p->layer->valid + p->col;
    size_t pitch = (size_t)p->layer->cols.n;
    int32_t m = n_pairs + 2, from = first_above(out, p) - 1; /* from one before the first even column on */
    take_line(valid + pitch * (size_t)(p->row + line_above(line, 0, p->first_row, p->n_rows)), p->n_cols, from, m + 1, above);
    take_line(valid + pitch * (size_t)(p->row + line_above(line, 1, p->first_row, p->n_rows)), p->n_cols, from, m + 1, below);
    for (int32_t k = 0; k <= m; k++) above[k] &= below[k];
    const uint8_t *both = above + 1;
    if (odd) row[0] = !(both[-1] & both[0]);
    uint8_t *RESTRICT to = row + odd;
    for (int32_t k = 0; k < n_pairs; k++) { /* 0 and 1, without a branch: compilers make vectors */
      to[2 * k] = both[k] ^ 1;
      to[2 * k + 1] = (both[k] & both[k + 1]) ^ 1;
    }
    if (odd + 2 * n_pairs < n) row[n - 1] = !both[n_pairs];
  }
}

/* A range after n bits. By value, so that the coder stays in registers. */
typedef struct ones {
  uint32_t range;
  int32_t n;
} ones;

/*
 * Ones of models that have seen so many that they change no more: their p is 65533, and each takes 1, 2 or 3 of the
 * highest 16 bits of the range. Of n, those before a zero or before the range must be renormalised.
 */
static ones settled_ones(uint32_t range, uint32_t code, int32_t n) {
  enum { P = 65533, THIRD = 21845, MOST_SMALL = 256 }; /* MOST_SMALL times P is below 2^24 */
  uint32_t high = range >> 16, stop = code / P, left = (uint32_t)n;
  if (stop < MOST_SMALL) stop = MOST_SMALL;
  while (left && high > stop) {
    uint32_t each = (3 * high + 65535) >> 16, until = (each - 1) * THIRD;
    if (until < stop) until = stop;
    uint32_t taken = min_u32((high - until + each - 1) / each, left);
    high -= taken * each;
    left -= taken;
    range = (high + each) * P;
  }
  ones found = {range, n - (int32_t)left};
  return found;
}

/* Pairs of ones of models a and b, which may be the same one: as settled_ones. */
static ALWAYS_INLINE ones unsettled_ones(uint32_t range, uint32_t code, model *a, model *b, int is_same, int32_t n, const coder *c) {
  model x = *a, y = *b;
  int32_t i = 0;
  for (; i + 2 <= n; i += 2) {
    model after = learned(c, x, 1);
    if (is_same) y = after;
    uint32_t bound = (range >> 16) * ((x >> 14) | 1);
    bound = (bound >> 16) * ((y >> 14) | 1);
    if (code >= bound || bound < 1u << 24) break;
    range = bound;
    y = learned(c, y, 1);
    x = is_same ? y : after;
  }
  *a = x;
  if (!is_same) *b = y;
  ones found = {range, i};
  return found;
}

static ones ones_in_turns(uint32_t range, uint32_t code, model *a, model *b, int32_t n, const coder *c) {
  const model settled = MODEL((1 << 22) - 255, 254);
  if (*a == settled && *b == settled) return settled_ones(range, code, n);
  return a == b ? unsettled_ones(range, code, a, a, 1, n, c) : unsettled_ones(range, code, a, b, 0, n, c);
}

/*
 * Ones from column `first` on, behind a one, where contexts and K repeat each other two by two: mostly none is a zero.
 * Returns the column where they end, or that is to be read for itself.
 */
static ALWAYS_INLINE int32_t read_ones(coder *c, model *models, const uint16_t *contexts, const uint8_t *k, int32_t first,
                                       int32_t n) {
  uint64_t pattern, other;
  memcpy(&pattern, contexts + first, sizeof pattern);
  if (pattern >> 32 != (pattern & 0xFFFFFFFFu) || k[first] == 1 || k[first + 1] == 1 || k[first] != k[first + 2]) return first;
  int32_t stop = first + 4;
  for (; stop + 4 <= n; stop += 4) {
    memcpy(&other, contexts + stop, sizeof other);
    if (other != pattern) break;
  }
  if (stop > n) return first;
  int skipped = k[first] != 0, step = 1 + (skipped || k[first + 1]);
  if (skipped && k[first + 1]) return stop;
  model *a = &models[contexts[first + skipped]], *b = step == 2 ? a : &models[contexts[first + 1]];
  int32_t n_coded = (stop - first) / step;
  ones read = ones_in_turns(c->range, c->code, a, b, n_coded, c);
  c->range = read.range;
  return read.n == n_coded ? stop : first + skipped + step * read.n;
}

/* §5.2: a map, where K is 0; without a section these bits are 1. */
static twz_status decode_map(const twz_file *f, const layer *out, field known, const reader *section, field map,
                             twz_error *error) {
  model models[N_MODELS];
  for (int i = 0; i < N_MODELS; i++) models[i] = FRESH_MODEL;
  ptrdiff_t s = (ptrdiff_t)map.stride;
  const int32_t n = out->cols.n;
  coder start, c; /* c is in registers, as no function is given its place */
  coder_start(&start, section->bytes, section->n, f->rates);
  c = start;
  uint16_t contexts[MOST + 4] = {0};
  for (int32_t row = 0; row < out->rows.n && !(section->bytes && coder_is_cut(&c)); row++) {
    uint8_t *RESTRICT v = map.at + row * s;
    const uint8_t *RESTRICT above = v - s, *RESTRICT k = known.at + row * s;
    if (!section->bytes || !memchr(k, 0, (size_t)n)) {
      for (int32_t col = 0; col < n; col++) v[col] = k[col] != 1;
      continue;
    }
    for (int32_t col = 0; col < n; col++) { /* all but the bit to the left */
      int bits = 4 * above[col] + 2 * above[col - 1] + above[col + 1];
      contexts[col] = (uint16_t)(81 * bits + 27 * k[col + 1] + 9 * k[col + s] + 3 * k[col + s + 1] + k[col + s - 1]);
    }
    int west = 0;
    for (int32_t col = 0; col < n; col++) {
      int32_t next = west ? read_ones(&c, models + 81 * 8, contexts, k, col, n) : col;
      for (; col < next; col++) v[col] = 1;
      if (col == n) break;
      west = k[col] ? k[col] != 1 : foreseen_bit(&c, &models[81 * 8 * west + contexts[col]]);
      v[col] = (uint8_t)west;
    }
  }
  if (!section->bytes) return TWZ_OK;
  start = c;
  return coder_end(&start, "a map of own samples", error);
}

/* K of own samples: inherited ones are as the parent's, others void where that is implied. */
static void know_own(const layer *out, const parent *p, field implied, field known) {
  const int32_t n = out->cols.n, odd = (int32_t)(out->cols.first & 1), n_pairs = (n - odd) / 2;
  uint8_t own[MOST]; /* of the parent's columns */
  const uint8_t *all = !p->layer || p->is_void ? NULL : p->layer->own ? p->layer->own : p->layer->valid;
  memset(own, !p->is_void, sizeof own);
  for (int32_t r = 0; r < out->rows.n; r++) {
    uint8_t *k = known.at + (size_t)r * known.stride;
    const uint8_t *is_implied = implied.at + (size_t)r * implied.stride;
    memcpy(k, is_implied, (size_t)n);
    uint32_t row = out->rows.first + (uint32_t)r;
    if (!p->layer || row % 2) continue;
    size_t above = (size_t)(p->row + line_above(row, 0, p->first_row, p->n_rows)) * (size_t)p->layer->cols.n;
    if (all) take_line(all + above + p->col, p->n_cols, first_above(out, p), n_pairs + 1, own);
    uint8_t *RESTRICT to = k + odd;
    const uint8_t *RESTRICT from = is_implied + odd;
    for (int32_t j = 0; j < n_pairs; j++) {
      to[2 * j] = (uint8_t)(1 + own[j]);
      to[2 * j + 1] = from[2 * j + 1];
    }
    if (odd + 2 * n_pairs < n) to[2 * n_pairs] = (uint8_t)(1 + own[n_pairs]);
  }
}

/* K of masks of coarse levels: samples beside own ones are valid. */
static void know_valid(const layer *out, field implied, field own, field known) {
  ptrdiff_t s = (ptrdiff_t)own.stride;
  const int32_t n = out->cols.n;
  for (int32_t r = 0; r < out->rows.n; r++) {
    const uint8_t *RESTRICT void_row = implied.at + r * s, *RESTRICT own_row = own.at + r * s;
    uint8_t *RESTRICT to = known.at + r * s;
    for (int32_t c = 0; c < n; c++) {
      const uint8_t *o = own_row + c;
      uint8_t beside = o[0] | o[-1] | o[1] | o[-s] | o[s] | o[-s - 1] | o[1 - s] | o[s - 1] | o[s + 1];
      to[c] = (uint8_t)(void_row[c] + 2 * (beside & (void_row[c] ^ 1)));
    }
  }
}

/* Keep a field as bytes of the region; NULL where all are 1. */
static twz_status keep_field(const twz_file *f, const layer *out, field from, uint8_t **to, int *n_set, twz_error *error) {
  size_t n_rows = (size_t)out->rows.n, n_cols = (size_t)out->cols.n;
  int has_0 = 0, has_1 = 0;
  for (size_t r = 0; r < n_rows && !(has_0 && has_1); r++) {
    has_0 |= memchr(from.at + r * from.stride, 0, n_cols) != NULL;
    has_1 |= memchr(from.at + r * from.stride, 1, n_cols) != NULL;
  }
  *n_set = !has_1 ? 0 : has_0 ? 1 : 2;
  if (*n_set == 2) return TWZ_OK;
  *to = twz_allocate(&f->allocator, n_rows * n_cols);
  if (!*to) return twz_no_memory(error, n_rows * n_cols);
  for (size_t r = 0; r < n_rows; r++) memcpy(*to + r * n_cols, from.at + r * from.stride, n_cols);
  return TWZ_OK;
}

/* Is one of the parent heights 0 in such a field of the parent's layer? */
static int has_zero(const parent *p, const uint8_t *bytes) {
  if (!bytes) return 0;
  bytes += (size_t)p->row * (size_t)p->layer->cols.n + (size_t)p->col;
  for (int32_t r = 0; r < p->n_rows; r++) {
    if (memchr(bytes + (size_t)r * (size_t)p->layer->cols.n, 0, (size_t)p->n_cols)) return 1;
  }
  return 0;
}

twz_status decode_validity(const twz_file *f, layer *out, const parent *p, int is_finest, const reader *mask,
                           const reader *own, int *has_valid, scratch *s, twz_error *error) {
  *has_valid = 1;
  if (!mask->bytes && !own->bytes && !(p->layer && (p->is_void || has_zero(p, p->layer->valid) || has_zero(p, p->layer->own)))) {
    return TWZ_OK; /* all valid, all own */
  }
  TRY(scratch_reserve(s, 4 * (field_bytes(out) + SCRATCH_ALIGN), error));
  field implied = take_field(s, out, 0), valid = take_field(s, out, 1);
  field known = take_field(s, out, 1), own_map = take_field(s, out, 1);
  imply_voids(out, p, implied);
  int n_valid, n_own;
  know_own(out, p, implied, known);
  if (!is_finest) {
    TRY(decode_map(f, out, known, own, own_map, error));
    know_valid(out, implied, own_map, known);
    TRY(keep_field(f, out, own_map, &out->own, &n_own, error));
  }
  TRY(decode_map(f, out, known, mask, valid, error));
  TRY(keep_field(f, out, valid, &out->valid, &n_valid, error));
  *has_valid = n_valid > 0;
  return TWZ_OK;
}
