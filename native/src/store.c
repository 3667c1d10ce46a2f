/* Method store (FORMAT §8). */
#include "internal.h"

static int is_inherited(const layer *l, const parent *p, int32_t row, int32_t col) {
  return p->layer && (l->rows.first + (uint32_t)row) % 2 == 0 && (l->cols.first + (uint32_t)col) % 2 == 0;
}

twz_status decode_store(const job *j, const reader *bytes, twz_error *error) {
  const header *h = &j->file->header;
  layer *l = j->out;
  size_t n_cols = (size_t)l->cols.n, n_stored = 0;
  for (int32_t r = 0; r < l->rows.n; r++) {
    for (int32_t c = 0; c < l->cols.n; c++) {
      n_stored += is_valid_at(l, (size_t)r * n_cols + (size_t)c) && !is_inherited(l, &j->parent, r, c);
    }
  }
  REQUIRE(bytes->n >= 5, error, "a payload of store of %llu bytes", (unsigned long long)bytes->n);
  int64_t low = (int32_t)load_u32(bytes->bytes);
  size_t n_bits = bytes->bytes[4];
  REQUIRE(n_bits <= 31, error, "%llu bits a sample, more than 31", (unsigned long long)n_bits);
  REQUIRE(bytes->n == 5 + (n_bits * n_stored + 7) / 8, error, "a payload of store of %llu bytes instead of %llu",
          (unsigned long long)bytes->n, (unsigned long long)(5 + (n_bits * n_stored + 7) / 8));
  const uint8_t *at = bytes->bytes + 5;
  uint64_t held = 0;
  size_t n_held = 0;
  int64_t half = (h->step - 1) / 2;
  for (int32_t r = 0; r < l->rows.n; r++) {
    for (int32_t c = 0; c < l->cols.n; c++) {
      size_t i = (size_t)r * n_cols + (size_t)c;
      if (is_inherited(l, &j->parent, r, c)) {
        int32_t row = (int32_t)((l->rows.first + (uint32_t)r) / 2 - j->parent.first_row);
        int32_t col = (int32_t)((l->cols.first + (uint32_t)c) / 2 - j->parent.first_col);
        l->heights[i] = parent_height(&j->parent, row, col);
      } else if (!is_valid_at(l, i)) {
        l->heights[i] = 0;
      } else {
        while (n_held < n_bits) {
          held = held << 8 | *at++;
          n_held += 8;
        }
        n_held -= n_bits;
        int64_t index = (int64_t)(held >> n_held & (((uint64_t)1 << n_bits) - 1));
        l->heights[i] = (int32_t)clamp_i64(h->z_min + (low + index) * h->step + half, h->z_min, h->z_max);
      }
    }
  }
  return TWZ_OK;
}
