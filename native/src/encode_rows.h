/*
 * A lattice of method rapid, encoded (R.3 ... R.9): what rapid_unit.h decodes, whose predictions and classes these are.
 * Compiled for a set of instructions behind it.
 */
#include "encode.h"

/* Targets of a plane's row, less the origin and within 2^15 of it, where that is enough. */
static void ISA(take_goals)(const ISA(work) * w, const encoding *e, int plane, int32_t row) {
  const rapid_unit *u = w->u;
  const int32_t n = w->cols[plane], origin = u->origin;
  const ptrdiff_t step = 2 * e->col_step;
  const int32_t *RESTRICT from = e->job->target + (2 * row + (plane != HL)) * e->row_step + (plane != LH) * e->col_step;
  int32_t *RESTRICT to = e->goals;
  if (!e->is_plain) {
    for (int32_t j = 0; j < n; j++) to[j] = from[j * step];
    return;
  }
  const int32_t low = (int32_t)max_i64((int64_t)origin - 2 * LIMIT, INT32_MIN), high = (int32_t)min_i64((int64_t)origin + 2 * LIMIT, INT32_MAX);
  if (step == 2) {
    for (int32_t j = 0; j < n; j++) to[j] = min_i32(max_i32(from[2 * j], low), high) - origin;
  } else {
    for (int32_t j = 0; j < n; j++) to[j] = min_i32(max_i32(from[j * step], low), high) - origin;
  }
}

/* Multiply by 0 what is void. */
static void ISA(skip_voids)(const ISA(work) * w, int plane, int32_t row, int32_t *RESTRICT details) {
  const rapid_unit *u = w->u;
  const int32_t n = w->cols[plane];
  const ptrdiff_t step = 2 * u->valid_step;
  const uint8_t *RESTRICT valid = u->valid;
  if (!valid) return;
  valid += (2 * row + (plane != HL)) * u->valid_stride + (plane != LH) * u->valid_step;
  for (int32_t j = 0; j < n; j++) details[j] = valid[j * step] ? details[j] : 0;
}

/* Find the details of a predicted row of a narrow unit, and its heights. */
static void ISA(quantise_narrow)(const ISA(work) * w, const encoding *e, int plane, int32_t row, int32_t *RESTRICT details) {
  const rapid_unit *u = w->u;
  const int16_t *RESTRICT predicted = w->predicted, *RESTRICT sides = w->sides;
  const int32_t *RESTRICT goals = e->goals;
  int16_t *RESTRICT own = ISA(row_in)(w, w->planes[plane], row, HELD_ROWS);
  const int32_t n = w->cols[plane], step = u->step, half = step >> 1, low = u->low - u->origin, high = u->high - u->origin;
  if (step == 1) {
    for (int32_t j = 0; j < n; j++) details[j] = goals[j] - ((predicted[j] + 2) >> 2);
  } else {
    /* Numbers below 2^18: their quotient is at least 1 / step below a whole number, no rounding reaches it. */
    const int32_t steps = (1 << 16) / step + 1, offset = steps * step + half;
    const float divisor = (float)step;
    for (int32_t j = 0; j < n; j++) details[j] = (int32_t)((float)(goals[j] - ((predicted[j] + 2) >> 2) + offset) / divisor) - steps;
  }
  ISA(skip_voids)(w, plane, row, details);
  for (int32_t j = 0; j < n; j++) {
    own[j] = (int16_t)min_i32(max_i32(((predicted[j] + 2) >> 2) + details[j] * step, low), high);
    details[j] = (details[j] ^ sides[j]) - sides[j];
  }
}

static ALWAYS_INLINE int32_t ISA(detail_of)(int64_t goal, int64_t whole, int64_t step) {
  return (int32_t)clamp_i64(floor_div(goal - whole + (step >> 1), step), INT32_MIN + 1, INT32_MAX);
}

/* The same of any unit. */
static void ISA(quantise_wide)(const ISA(work) * w, const encoding *e, int plane, int32_t row, int32_t *RESTRICT details) {
  const rapid_unit *u = w->u;
  const int16_t *RESTRICT predicted = w->predicted, *RESTRICT sides = w->sides;
  int16_t *RESTRICT own = ISA(row_in)(w, w->planes[plane], row, HELD_ROWS);
  int32_t *RESTRICT heights = ISA(wide_row_in)(w, w->heights[plane], row);
  const int32_t n = w->cols[plane];
  for (int32_t j = 0; j < n; j++) {
    int64_t whole = shift_right((int64_t)predicted[j] * ((int64_t)1 << u->shift) + 2, 2) + u->origin;
    details[j] = ISA(detail_of)(e->goals[j], whole, u->step);
  }
  ISA(skip_voids)(w, plane, row, details);
  for (int32_t j = 0; j < n; j++) {
    int64_t whole = shift_right((int64_t)predicted[j] * ((int64_t)1 << u->shift) + 2, 2) + u->origin;
    heights[j] = (int32_t)clamp_i64(whole + (int64_t)details[j] * u->step, u->low, u->high);
    own[j] = (int16_t)clamp_i64(shift_right((int64_t)heights[j] - u->origin, u->shift), -LIMIT, LIMIT);
    details[j] = (details[j] ^ sides[j]) - sides[j];
  }
}

static ALWAYS_INLINE int16_t ISA(level_with)(const rapid_unit *u, int64_t height) {
  return (int16_t)clamp_i64(shift_right(height - u->origin, u->shift), -LIMIT, LIMIT);
}

/* A sample on a line that units share. */
static void ISA(code_on_line)(const ISA(work) * w, const encoding *e, int plane, int32_t row, int32_t j, ptrdiff_t first, ptrdiff_t step,
                              int32_t n, int32_t k, int32_t *details) {
  const rapid_unit *u = w->u;
  int is_turned;
  int64_t whole = ISA(predict_on_line)(u, first, step, n, k, &is_turned);
  ptrdiff_t of_row = 2 * row + (plane != HL), of_col = 2 * j + (plane != LH);
  int32_t detail = 0;
  if (!u->valid || u->valid[of_row * u->valid_stride + of_col * u->valid_step]) {
    detail = ISA(detail_of)(e->job->target[of_row * e->row_step + of_col * e->col_step], whole, u->step);
  }
  details[j] = is_turned ? -detail : detail;
  int32_t height = (int32_t)clamp_i64(whole + (int64_t)detail * u->step, u->low, u->high);
  ISA(wide_row_in)(w, w->heights[plane], row)[j] = height;
  ISA(row_in)(w, w->planes[plane], row, HELD_ROWS)[j] = ISA(level_with)(u, height);
}

/* Correct the heights of a row: find what is missing to those that are kept. */
static void ISA(correct_row)(const ISA(work) * w, const encoding *e, int plane, int32_t row) {
  const rapid_unit *u = w->u;
  int16_t *own = ISA(row_in)(w, w->planes[plane], row, HELD_ROWS);
  int32_t *heights = ISA(wide_row_in)(w, w->heights[plane], row);
  for (int32_t j = 0; j < w->cols[plane]; j++) {
    ptrdiff_t place = (2 * row + (plane != HL)) * e->row_step + (2 * j + (plane != LH)) * e->col_step;
    int64_t height = u->is_narrow ? (int64_t)own[j] + u->origin : heights[j];
    heights[j] = correct_height(e->job, place, height, u->low, u->high);
    own[j] = ISA(level_with)(u, heights[j]);
  }
}

/* Find the details of a row, and settle its heights. */
static void ISA(encode_row)(const ISA(work) * w, const encoding *e, int plane, int32_t row) {
  const rapid_unit *u = w->u;
  const int32_t n = w->cols[plane];
  int32_t *details = e->details[plane] + (ptrdiff_t)row * (n + n % 2);
  int16_t *own = ISA(row_in)(w, w->planes[plane], row, HELD_ROWS);
  ISA(predict_row)(w, plane, row);
  ISA(take_goals)(w, e, plane, row);
  if (u->is_narrow && e->is_plain) ISA(quantise_narrow)(w, e, plane, row, details); else ISA(quantise_wide)(w, e, plane, row, details);
  if (n % 2) details[n] = 0;
  for (int32_t j = 0; ISA(is_line)(w, plane, row) && j < n; j++) {
    ISA(code_on_line)(w, e, plane, row, j, row * u->parent_stride, 1, w->a_cols, j, details);
  }
  for (int side = 1; plane == LH && side < 4; side += 2) {
    int32_t j = side == 1 ? 0 : n - 1;
    if (u->known[side]) ISA(code_on_line)(w, e, plane, row, j, j, u->parent_stride, w->a_rows, row, details);
  }
  if (e->job->added) ISA(correct_row)(w, e, plane, row);
  for (int k = 1; k <= MARGIN; k++) {
    own[-k] = own[0];
    own[n - 1 + k] = own[n - 1];
  }
}

/* What is known of the samples of a strip, and their details: five arrays of all rows of the plane, from `seen` on. */
static void ISA(note_strip)(const ISA(work) * w, const encoding *e, int plane, int32_t strip, int32_t *seen) {
  const rapid_unit *u = w->u;
  int32_t first, last;
  ISA(rows_of_strip)(w, plane, strip, &first, &last);
  const int32_t n = w->cols[plane], width = n + n % 2;
  const ptrdiff_t size = (ptrdiff_t)w->rows[plane] * width;
  for (int32_t row = first; row < last; row++) {
    const int16_t *ranges = ISA(row_in)(w, w->ranges, row, HELD_ROWS), *over = ISA(row_in)(w, w->ranges, row - 1, HELD_ROWS);
    const int16_t *bends = ISA(row_in)(w, w->bends, row, HELD_ROWS), *under = ISA(row_in)(w, w->bends, row + 1, HELD_ROWS);
    const int16_t *hh = ISA(row_in)(w, w->near[HH], row, HELD_ROWS), *above = ISA(row_in)(w, w->near[HH], row - 1, HELD_ROWS);
    const int16_t *hl = ISA(row_in)(w, w->near[HL], row, HELD_ROWS), *below = ISA(row_in)(w, w->near[HL], row + 1, HELD_ROWS);
    int32_t *to = seen + (ptrdiff_t)row * width, *details = e->details[plane] + (ptrdiff_t)row * width;
    for (int32_t j = 0; j < width; j++) {
      int32_t k = min_i32(j, n - 1), near = 0, range = ranges[k], bend = bends[k];
      if (plane == HH) {
        bend += bends[k + 1] + under[k] + under[k + 1];
      } else if (plane == HL) {
        range += over[k];
        bend += bends[k + 1];
        near = above[k] + hh[k];
      } else {
        range += ranges[k - 1];
        bend += under[k];
        near = hh[k - 1] + hh[k] + hl[k - 1] + hl[k] + below[k - 1] + below[k];
      }
      ptrdiff_t place = (2 * row + (plane != HL)) * u->valid_stride + (2 * k + (plane != LH)) * u->valid_step;
      to[j] = range;
      to[size + j] = bend;
      to[2 * size + j] = near;
      to[3 * size + j] = details[j];
      to[4 * size + j] = j < n && (!u->valid || u->valid[place]);
    }
  }
}

static void ISA(log_strip)(const ISA(work) * w, encoding *e, int plane, int32_t strip, symbol_log *l) {
  int32_t first, last, n = w->cols[plane], n_pairs = (n + 1) / 2;
  ISA(rows_of_strip)(w, plane, strip, &first, &last);
  if (plane != LH && last == w->rows[plane]) ISA(forget)(w, plane, last);
  if (first >= last || n == 0) return;
  ISA(class_strip)(w, plane, first, last);
  const int32_t *details = e->details[plane] + (ptrdiff_t)first * 2 * n_pairs;
  twz_log_pairs(e, l, w->pairs, w->singles, details, n_pairs * (last - first));
  for (int32_t row = first; plane != LH && row < last; row++) {
    const int32_t *RESTRICT from = e->details[plane] + (ptrdiff_t)row * 2 * n_pairs;
    int16_t *RESTRICT near = ISA(row_in)(w, w->near[plane], row, HELD_ROWS);
    for (int32_t j = 0; j < n; j++) near[j] = (int16_t)min_i32(from[j] < 0 ? -from[j] : from[j], MOST_NEAR);
    near[-1] = near[n] = near[n + 1] = 0;
  }
}

static twz_status ISA(encode_lattice)(rapid_unit *u, encoding *e, twz_error *error) {
  ISA(work) work, *w = &work;
  TRY(ISA(begin)(w, u, error));
  const int32_t n_strips = rapid_strips(u->n_rows);
  int32_t done[3] = {0, 0, 0};
  for (int32_t end = STRIP, loaded = -2; end <= STRIP * n_strips; end += STRIP) {
    for (; loaded < w->a_rows + 2 && loaded < end + 3; loaded++) ISA(load_row)(w, loaded);
    /* Each plane is a row ahead of the next one, which sees it. */
    for (int p = HH; p <= LH; p++) {
      for (; done[p] < min_i32(end + 1 - p, w->rows[p]); done[p]++) {
        if (w->cols[p]) ISA(encode_row)(w, e, p, done[p]);
        if (p != HH) ISA(store_row)(w, 2 * done[p] + (p == LH));
      }
    }
  }
  if (e->n_bands == 0) e->n_bands = twz_bands_for(e, w->rows, w->cols);
  int32_t *seen = e->seen;
  w->loaded = -2;
  w->looked = -1;
  for (int32_t strip = 0, band = 0; strip < n_strips; strip++) {
    const int32_t end = STRIP * strip + STRIP;
    for (; band + 1 < e->n_bands && strip >= rapid_band(u->n_rows, band + 1, e->n_bands); start_band(e, ++band)) {
      for (int p = HH; p <= HL; p++) ISA(forget)(w, p, STRIP * strip - 1);
    }
    for (; w->loaded < w->a_rows + 2 && w->loaded < end + 3; w->loaded++) ISA(load_row)(w, w->loaded);
    for (; w->looked <= w->a_rows && w->looked <= end; w->looked++) ISA(look)(w, w->looked);
    int32_t *to = seen;
    for (int p = HH; p <= LH; p++) {
      ISA(log_strip)(w, e, p, strip, &e->logs[band]);
      if (!seen || min_i32(w->rows[p], w->cols[p]) < LEAST_SIDE) continue;
      ISA(note_strip)(w, e, p, strip, to);
      to += (ptrdiff_t)(N_FEATURES + 2) * w->rows[p] * (w->cols[p] + w->cols[p] % 2);
    }
    e->seen = to;
  }
  return TWZ_OK;
}
