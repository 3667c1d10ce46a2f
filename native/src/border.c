/* What predictive and cdf97 share: samples that units share, and how start values of models are kept. */
#include "border.h"

static const int64_t MOST = (int64_t)1 << 30;

twz_status read_starts(const twz_file *f, const uint8_t *bytes, size_t n, model *models, size_t n_models, twz_error *error) {
  uint8_t *starts = twz_allocate(&f->allocator, 2 * n_models);
  if (!starts) return twz_no_memory(error, 2 * n_models);
  twz_status status = inflate_zlib(bytes, n, starts, 2 * n_models, &n, "a table of this library", error);
  for (size_t i = 0; status == TWZ_OK && i < n_models; i++) models[i] = started(load_u16(starts + 2 * i));
  twz_release(&f->allocator, starts);
  return status;
}

static size_t longest_line(const job *j) {
  int32_t n_own = max_i32(j->out->rows.n, j->out->cols.n), n_above = max_i32(j->parent.n_rows, j->parent.n_cols);
  return (size_t)max_i32(n_own, n_above) + 2 * LINE_EDGE;
}

size_t border_bytes(const job *j) {
  size_t n_region = (size_t)j->out->rows.n * (size_t)j->out->cols.n;
  return N_BORDER_MODELS * sizeof(model) + n_region + 17 * longest_line(j) + 5 * SCRATCH_ALIGN;
}

void border_start(border *b, const model *starts, scratch *s) {
  size_t n_region = (size_t)b->job->out->rows.n * (size_t)b->job->out->cols.n, n_line = longest_line(b->job);
  b->models = scratch_take(s, N_BORDER_MODELS * sizeof(model));
  memcpy(b->models, starts, N_BORDER_MODELS * sizeof(model));
  b->known = scratch_take(s, n_region);
  memset(b->known, 0, n_region);
  b->sums = (int64_t *)scratch_take(s, 8 * n_line) + LINE_EDGE;
  b->predicted = scratch_take(s, 8 * n_line);
  b->is_coded = scratch_take(s, n_line);
}

int64_t border_symbol(border *b, int pass, int64_t s) {
  int at = 36 * pass + bin_of(min_i64(s, 4095));
  if (!adaptive_bit(b->coder, b->models + at)) return 0;
  int64_t size = 1 + magnitude(b->coder, b->models + 180 + 14 * at, b->models + 2700 + 32 * pass, 0);
  return raw_bits(b->coder, 1) ? -size : size;
}

void border_put(border *b, size_t at, int64_t prediction, int64_t q) {
  int64_t most = 4 * MOST / b->step + 1;
  int64_t height = clamp_i64(prediction + clamp_i64(q, -most, most) * b->step, -MOST, MOST);
  b->job->out->heights[at] = (int32_t)corrected(b->job, at, height, -MOST, MOST);
  b->known[at] = 1;
}

/* Predicted by the mean of the four parent heights around. */
static void decode_corner(border *b, int32_t r, int32_t c) {
  const layer *out = b->job->out;
  const parent *p = &b->job->parent;
  size_t at = (size_t)r * (size_t)out->cols.n + (size_t)c;
  if (b->known[at]) return;
  uint32_t row = out->rows.first + (uint32_t)r, col = out->cols.first + (uint32_t)c;
  int32_t top = line_above(row, 0, p->first_row, p->n_rows), bottom = line_above(row, 1, p->first_row, p->n_rows);
  int32_t left = line_above(col, 0, p->first_col, p->n_cols), right = line_above(col, 1, p->first_col, p->n_cols);
  int64_t sum = (int64_t)parent_height(p, top, left) + parent_height(p, top, right) + parent_height(p, bottom, left) +
                parent_height(p, bottom, right);
  int is_coded = is_valid_at(out, at) && (b->are_inherited_coded || (row | col) % 2);
  border_put(b, at, shift_right(sum + 2, 2), is_coded ? border_symbol(b, 0, 16) : 0);
}

/* A line that begins at `start`, of samples `step` apart whose predictions are made: even places, then odd ones. */
static void decode_line(border *b, size_t start, size_t step, int32_t length, int are_even_coded) {
  const int64_t *p = b->predicted;
  const int32_t *heights = b->job->out->heights;
  for (int32_t i = 0; i < length; i++) b->is_coded[i] = !b->known[start + (size_t)i * step];
  for (int parity = 0; parity < 2; parity++) {
    int64_t last = 0, before = 0;
    for (int32_t i = parity; i < length; i += 2) {
      size_t at = start + (size_t)i * step;
      if (!b->is_coded[i]) continue;
      int64_t correction = 0, near = last + before;
      if (parity) {
        int64_t left = heights[at - step] - p[i - 1];
        int64_t right = i + 1 < length ? heights[at + step] - p[i + 1] : left;
        correction = shift_right(left + right, 1);
        near = (2 * abs_i64(left - correction) + 2 * abs_i64(right - correction)) / b->step + last;
      }
      int64_t bend = i > 0 && i < length - 1 ? abs_i64(p[i - 1] - 2 * p[i] + p[i + 1]) : 0, q = 0;
      if (is_valid_at(b->job->out, at) && (are_even_coded || parity)) {
        q = border_symbol(b, parity, 4 * near + min_i64(8 * bend / b->step, 1024));
      }
      border_put(b, at, p[i] + correction, q);
      before = last;
      last = min_i64(abs_i64(q), 255);
    }
  }
}

/* Rows (columns) of the core near sides that are shared. */
static void decode_lines(border *b, const shared_lines *lines, int are_rows) {
  const layer *out = b->job->out;
  const parent *p = &b->job->parent;
  const axis *across = are_rows ? &out->rows : &out->cols, *along = are_rows ? &out->cols : &out->rows;
  uint32_t first_across = are_rows ? p->first_row : p->first_col, first_along = are_rows ? p->first_col : p->first_row;
  int32_t n_across = are_rows ? p->n_rows : p->n_cols, n_along = are_rows ? p->n_cols : p->n_rows, done = -1;
  int32_t from = line_above(along->core_first, 0, first_along, n_along);
  size_t pitch = (size_t)out->cols.n, core = (size_t)along->core;
  for (int side = 0; side < lines->n_sides; side++) {
    for (int32_t line = max_i32(lines->first[side], done + 1); line <= lines->last[side] && !coder_is_cut(b->coder); line++) {
      uint32_t number = across->first + (uint32_t)line;
      int32_t before = line_above(number, 0, first_across, n_across), after = line_above(number, 1, first_across, n_across);
      for (int32_t k = 0; k < (along->n_core + 1) >> 1; k++) {
        b->sums[k] = are_rows ? (int64_t)parent_height(p, before, from + k) + parent_height(p, after, from + k)
                              : (int64_t)parent_height(p, from + k, before) + parent_height(p, from + k, after);
      }
      b->predict(b->sums, along->n_core, b->predicted);
      size_t start = are_rows ? (size_t)line * pitch + core : core * pitch + (size_t)line;
      decode_line(b, start, are_rows ? 1 : pitch, along->n_core, b->are_inherited_coded || number % 2);
      done = line;
    }
  }
}

void decode_border(border *b) {
  int32_t rings = b->job->file->grid.rings;
  shared_lines rows, cols;
  find_shared_lines(&rows, &b->job->out->rows, rings);
  find_shared_lines(&cols, &b->job->out->cols, rings);
  for (int side = 0; side < rows.n_sides; side++) {
    for (int other = 0; other < cols.n_sides; other++) {
      for (int32_t r = rows.first[side]; r <= rows.last[side]; r++) {
        for (int32_t c = cols.first[other]; c <= cols.last[other]; c++) decode_corner(b, r, c);
      }
    }
  }
  decode_lines(b, &rows, 1);
  decode_lines(b, &cols, 0);
}
