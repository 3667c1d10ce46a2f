/* Which samples are valid, and which are the raster's own (FORMAT §5.1, §5.2, §5.4). */
#include "range.h"
#include "tables.h"

/* Bytes of the region with a margin of zeros, so that neighbours can be read without asking. */
typedef struct field {
  uint8_t *at; /* sample (0, 0) */
  size_t stride;
} field;

enum { MOST = 2 * 1024 + 4 }; /* samples of a region along an axis, or more (§2.4) */
enum { EDGE = 2, N_MASK_MODELS = 576, N_FILL_MODELS = 1296 };

static size_t field_bytes(const layer *out) {
  return (size_t)(out->rows.n + 2 * EDGE) * (size_t)(out->cols.n + 2 * EDGE);
}

static field take_field(scratch *s, const layer *out) {
  field f;
  size_t n = field_bytes(out);
  uint8_t *memory = scratch_take(s, n);
  memset(memory, 0, n);
  f.stride = (size_t)(out->cols.n + 2 * EDGE);
  f.at = memory + EDGE * f.stride + EDGE;
  return f;
}

static void imply_voids(const layer *out, const parent *p, field implied) {
  if (!p->layer || (!p->is_void && !p->layer->valid)) return;
  uint8_t both[MOST];
  int32_t n = out->cols.n, odd = (int32_t)(out->cols.first & 1); /* 1: the first column lies between two of the parent's */
  for (int32_t r = 0; r < out->rows.n; r++) {
    uint8_t *RESTRICT row = implied.at + (size_t)r * implied.stride;
    if (p->is_void) {
      memset(row, 1, (size_t)out->cols.n);
      continue;
    }
    uint32_t line = out->rows.first + (uint32_t)r;
    const uint8_t *valid = p->layer->valid + p->col;
    size_t pitch = (size_t)p->layer->cols.n;
    const uint8_t *above = valid + pitch * (size_t)(p->row + line_above(line, 0, p->first_row, p->n_rows));
    const uint8_t *below = valid + pitch * (size_t)(p->row + line_above(line, 1, p->first_row, p->n_rows));
    int32_t n_pairs = (n - odd) / 2;
    for (int32_t k = 0; k < n_pairs + 2; k++) {
      int32_t at = line_above(out->cols.first + (uint32_t)(odd + 2 * k), 0, p->first_col, p->n_cols);
      both[k] = above[at] & below[at];
    }
    if (odd) {
      int32_t left = line_above(out->cols.first, 0, p->first_col, p->n_cols);
      row[0] = !(above[left] & below[left] & both[0]);
    }
    uint8_t *RESTRICT to = row + odd;
    for (int32_t k = 0; k < n_pairs; k++) {
      to[2 * k] = !both[k];
      to[2 * k + 1] = !(both[k] & both[k + 1]);
    }
    if (odd + 2 * n_pairs < n) row[n - 1] = !both[n_pairs];
  }
}

/* §5.2: valid from the samples that are not implied void. */
static twz_status decode_plain(const twz_file *f, const layer *out, field implied, const reader *section, field valid,
                               twz_error *error) {
  model models[N_MASK_MODELS];
  for (int i = 0; i < N_MASK_MODELS; i++) models[i] = MODEL((uint32_t)twz_mask_starts[i] << 14, 2);
  coder start, c; /* c is in registers, as no function is given its place */
  coder_start(&start, section->bytes, section->n, f->rates);
  c = start;
  ptrdiff_t s = (ptrdiff_t)valid.stride;
  for (int32_t row = 0; row < out->rows.n; row++) {
    uint8_t *v = valid.at + row * s;
    const uint8_t *m = implied.at + row * s;
    for (int32_t col = 0; col < out->cols.n; col++, v++, m++) {
      if (*m) continue;
      int near = 32 * v[-1] + 16 * v[-s] + 8 * v[-s - 1] + 4 * v[1 - s] + 2 * v[-2] + v[-2 * s];
      int far = m[2 * s] + m[2] + m[s - 1] + m[s + 1];
      *v = (uint8_t)foreseen_bit(&c, &models[(near * 3 + m[s] + m[1]) * 3 + min_i32(far, 2)]);
    }
  }
  start = c;
  return coder_end(&start, "a mask", error);
}

/* §5.4: a map, where K is 0; without a section these bits are 1. */
static twz_status decode_map(const twz_file *f, const layer *out, field known, const reader *section, field map,
                             twz_error *error) {
  model models[N_FILL_MODELS];
  for (int i = 0; i < N_FILL_MODELS; i++) models[i] = FRESH_MODEL;
  ptrdiff_t s = (ptrdiff_t)map.stride;
  const int32_t n = out->cols.n;
  for (int32_t row = 0; !section->bytes && row < out->rows.n; row++) {
    uint8_t *v = map.at + row * s;
    const uint8_t *k = known.at + row * s;
    for (int32_t col = 0; col < n; col++) v[col] = k[col] != 1;
  }
  if (!section->bytes) return TWZ_OK;
  coder start, c; /* c is in registers, as no function is given its place */
  coder_start(&start, section->bytes, section->n, f->rates);
  c = start;
  uint16_t contexts[MOST];
  for (int32_t row = 0; row < out->rows.n; row++) {
    uint8_t *RESTRICT v = map.at + row * s;
    const uint8_t *RESTRICT above = v - s, *RESTRICT k = known.at + row * s;
    for (int32_t col = 0; col < n; col++) { /* all but the bit to the left */
      int bits = 4 * above[col] + 2 * above[col - 1] + above[col + 1];
      contexts[col] = (uint16_t)(81 * bits + 27 * k[col + 1] + 9 * k[col + s] + 3 * k[col + s + 1] + k[col + s - 1]);
    }
    int west = 0;
    for (int32_t col = 0; col < n; col++) {
      west = k[col] ? k[col] != 1 : foreseen_bit(&c, &models[81 * 8 * west + contexts[col]]);
      v[col] = (uint8_t)west;
    }
  }
  start = c;
  return coder_end(&start, "a map of own samples", error);
}

/* K of own samples: inherited ones are as the parent's, others void where that is implied. */
static void know_own(const layer *out, const parent *p, field implied, field known) {
  const int32_t n = out->cols.n, odd = (int32_t)(out->cols.first % 2);
  int16_t places[MOST]; /* parent's columns */
  for (int32_t c = odd; p->layer && c < n; c += 2) {
    places[c] = (int16_t)line_above(out->cols.first + (uint32_t)c, 0, p->first_col, p->n_cols);
  }
  for (int32_t r = 0; r < out->rows.n; r++) {
    uint8_t *k = known.at + (size_t)r * known.stride;
    memcpy(k, implied.at + (size_t)r * implied.stride, (size_t)out->cols.n);
    uint32_t row = out->rows.first + (uint32_t)r;
    if (!p->layer || row % 2) continue;
    int32_t above = line_above(row, 0, p->first_row, p->n_rows);
    const uint8_t *own = p->is_void ? NULL : p->layer->own ? p->layer->own : p->layer->valid;
    if (own) own += (size_t)(p->row + above) * (size_t)p->layer->cols.n + (size_t)p->col;
    int is_own = !p->is_void;
    for (int32_t c = odd; c < n; c += 2) {
      if (own) is_own = own[places[c]] != 0;
      k[c] = is_own ? 2 : 1;
    }
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
      to[c] = void_row[c] ? 1 : beside ? 2 : 0;
    }
  }
}

/* Keep a field as bytes of the region; NULL where all are 1. */
static twz_status keep_field(const twz_file *f, const layer *out, field from, uint8_t **to, int *n_set, twz_error *error) {
  size_t n_rows = (size_t)out->rows.n, n_cols = (size_t)out->cols.n, n = 0;
  for (size_t r = 0; r < n_rows; r++) {
    for (size_t c = 0; c < n_cols; c++) n += from.at[r * from.stride + c];
  }
  *n_set = n == 0 ? 0 : n == n_rows * n_cols ? 2 : 1;
  if (*n_set == 2) return TWZ_OK;
  *to = twz_allocate(&f->allocator, n_rows * n_cols);
  if (!*to) return twz_no_memory(error, n_rows * n_cols);
  for (size_t r = 0; r < n_rows; r++) memcpy(*to + r * n_cols, from.at + r * from.stride, n_cols);
  return TWZ_OK;
}

twz_status decode_validity(const twz_file *f, layer *out, const parent *p, int is_finest, const reader *mask,
                           const reader *own, int *has_valid, scratch *s, twz_error *error) {
  *has_valid = 1;
  int has_fills = (f->header.features & FILLS) != 0;
  int parent_has_void = p->layer && (p->is_void || p->layer->valid || p->layer->own);
  if (!mask->bytes && !own->bytes && !parent_has_void) return TWZ_OK; /* all valid, all own */
  TRY(scratch_reserve(s, 4 * (field_bytes(out) + SCRATCH_ALIGN), error));
  field implied = take_field(s, out), valid = take_field(s, out);
  imply_voids(out, p, implied);
  int n_valid, n_own;
  if (!has_fills) {
    if (mask->bytes) {
      TRY(decode_plain(f, out, implied, mask, valid, error));
    } else {
      for (int32_t r = 0; r < out->rows.n; r++) {
        for (int32_t c = 0; c < out->cols.n; c++) {
          size_t at = (size_t)r * valid.stride + (size_t)c;
          valid.at[at] = !implied.at[at];
        }
      }
    }
  } else {
    field known = take_field(s, out), own_map = take_field(s, out);
    know_own(out, p, implied, known);
    if (is_finest) {
      TRY(decode_map(f, out, known, mask, valid, error));
    } else {
      TRY(decode_map(f, out, known, own, own_map, error));
      know_valid(out, implied, own_map, known);
      TRY(decode_map(f, out, known, mask, valid, error));
      TRY(keep_field(f, out, own_map, &out->own, &n_own, error));
    }
  }
  TRY(keep_field(f, out, valid, &out->valid, &n_valid, error));
  *has_valid = n_valid > 0;
  return TWZ_OK;
}
