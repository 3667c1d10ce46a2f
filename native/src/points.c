/* Heights at points: sorted by unit, so that each unit is decoded once, whatever the cache holds. */
#include <math.h>

#include "internal.h"

/*
 * Units whose bytes are asked for at a time, and are decoded with one another. A square of so many is one window: they
 * have most of the units above them in common.
 */
enum { SQUARE_BITS = 6, MOST_UNITS = 1 << SQUARE_BITS };

/* A point inside the level, with the number of its unit in Morton order. */
typedef struct located {
  uint64_t unit;
  size_t point;
} located;

/* A window of the units that points first ... end - 1 of the order lie in. */
typedef struct square {
  twz_window *window;
  size_t first, end;
} square;

struct twz_points {
  twz_file *file;
  twz_points_request asked; /* its level counts from the coarsest */
  uint32_t n_rows, n_cols;  /* of the level */
  located *order;
  size_t n_inside, n_done;  /* points in the order; of these, those that have heights */
  square squares[MOST_UNITS];
  size_t n_squares, first_square; /* those before have been decoded */
  size_t end_asked;               /* squares whose bytes have been asked for */
  size_t n_units, most_units;     /* of all squares */
  uint64_t n_bytes;               /* memory of all squares */
};

/* ---- Beginning ---- */

/* The sample at or before a place along an axis of n; for the nearest sample, that one. n: the place is not inside. */
static uint32_t sample_of(double at, uint32_t n, twz_interpolation interpolation) {
  if (interpolation == TWZ_BILINEAR) return at >= 0 && at <= n - 1 ? (uint32_t)at : n;
  if (!(at >= -0.5 && at < n - 0.5)) return n;
  if (at < 0) return 0;
  uint32_t before = (uint32_t)at;
  return before + (at - before >= 0.5);
}

/* The bits of a number at even places. */
static uint64_t spread(uint64_t v) {
  v = (v | v << 16) & 0x0000FFFF0000FFFFu;
  v = (v | v << 8) & 0x00FF00FF00FF00FFu;
  v = (v | v << 4) & 0x0F0F0F0F0F0F0F0Fu;
  v = (v | v << 2) & 0x3333333333333333u;
  return (v | v << 1) & 0x5555555555555555u;
}

static place unit_of(const twz_points *p, const located *one, uint32_t *row, uint32_t *col) {
  *row = sample_of(p->asked.rows[one->point], p->n_rows, p->asked.interpolation);
  *col = sample_of(p->asked.cols[one->point], p->n_cols, p->asked.interpolation);
  return unit_of_sample(&p->file->grid, p->asked.level, *row, *col);
}

/* Sort n points by unit, of which none is above `most`; returns where they are then. */
static located *sort_by_unit(located *from, located *to, size_t n, uint64_t most) {
  enum { BITS = 11, N_DIGITS = 1 << BITS };
  for (int shift = 0; shift < 64 && most >> shift; shift += BITS) {
    size_t starts[N_DIGITS] = {0}, at = 0;
    for (size_t i = 0; i < n; i++) starts[from[i].unit >> shift & (N_DIGITS - 1)]++;
    for (size_t d = 0; d < N_DIGITS; d++) {
      size_t n_here = starts[d];
      starts[d] = at;
      at += n_here;
    }
    for (size_t i = 0; i < n; i++) to[starts[from[i].unit >> shift & (N_DIGITS - 1)]++] = from[i];
    located *sorted = to;
    to = from;
    from = sorted;
  }
  return from;
}

/* Find the unit of each point, and sort them; those outside have no height. */
static twz_status locate(twz_points *p, twz_error *error) {
  const twz_allocator *a = &p->file->allocator;
  const size_t n = p->asked.n_points;
  if (n > SIZE_MAX / (2 * sizeof(located)) || n * 2 * sizeof(located) > p->file->max_bytes) {
    return twz_fail(error, TWZ_LIMIT, "%llu points, whose order takes more than %llu bytes of memory: ask for some at a time",
                    (unsigned long long)n, (unsigned long long)p->file->max_bytes);
  }
  located *both = twz_allocate(a, 2 * n * sizeof *both);
  if (!both) return twz_no_memory(error, 2 * n * sizeof *both);
  uint64_t most = 0;
  for (size_t i = 0; i < n; i++) {
    located *one = &both[p->n_inside];
    uint32_t row, col;
    one->point = i;
    p->asked.heights[i] = NAN;
    if (p->asked.valid) p->asked.valid[i] = 0;
    place unit = unit_of(p, one, &row, &col);
    if (row == p->n_rows || col == p->n_cols) continue;
    one->unit = spread(unit.row) << 1 | spread(unit.col);
    if (one->unit > most) most = one->unit;
    p->n_inside++;
  }
  located *sorted = sort_by_unit(both, both + n, p->n_inside, most);
  /* Half of the memory is enough from now on. */
  p->order = twz_allocate(a, p->n_inside * sizeof *both);
  if (p->order && p->n_inside) memcpy(p->order, sorted, p->n_inside * sizeof *both);
  twz_release(a, both);
  return p->order ? TWZ_OK : twz_no_memory(error, p->n_inside * sizeof *both);
}

twz_status twz_points_new(twz_file *file, const twz_points_request *request, twz_points **points, twz_error *error) {
  twz_points_request asked = TWZ_POINTS_REQUEST;
  twz_level level;
  *points = NULL;
  TRY(take_sized(&asked, sizeof asked, request, "twz_points_request", error));
  TRY(twz_file_level(file, asked.level, &level, error));
  TRY(level_number(file, asked.level, &asked.level, error));
  if (asked.interpolation != TWZ_BILINEAR && asked.interpolation != TWZ_NEAREST) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "interpolation %d, expected TWZ_BILINEAR or TWZ_NEAREST", (int)asked.interpolation);
  }
  if (asked.n_points && (!asked.rows || !asked.cols || !asked.heights)) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "points without rows, columns or heights: twz_points_request needs all three");
  }
  twz_points *p = twz_allocate_zeros(&file->allocator, sizeof *p);
  if (!p) return twz_no_memory(error, sizeof *p);
  p->file = file;
  p->asked = asked;
  p->n_rows = level.n_rows;
  p->n_cols = level.n_cols;
  p->most_units = MOST_UNITS;
  twz_status status = locate(p, error);
  if (status == TWZ_OK) {
    *points = p;
  } else {
    twz_points_free(p);
  }
  return status;
}

static void free_squares(twz_points *p) {
  for (size_t i = 0; i < p->n_squares; i++) twz_window_free(p->squares[i].window);
  p->n_squares = p->first_square = p->end_asked = p->n_units = 0;
  p->n_bytes = 0;
}

void twz_points_free(twz_points *p) {
  if (!p) return;
  twz_file *f = p->file;
  free_squares(p);
  twz_release(&f->allocator, p->order);
  twz_release(&f->allocator, p);
}

/* ---- The next units ---- */

/* Points of one unit, from number `first` of the order on: returns the first that is none of them, and their samples. */
static size_t points_of_unit(const twz_points *p, size_t first, place *unit, twz_box *box) {
  uint32_t top = UINT32_MAX, left = UINT32_MAX, bottom = 0, right = 0, row, col;
  size_t i = first;
  for (; i < p->n_inside && p->order[i].unit == p->order[first].unit; i++) {
    *unit = unit_of(p, &p->order[i], &row, &col);
    top = min_u32(top, row);
    left = min_u32(left, col);
    bottom = max_u32(bottom, row);
    right = max_u32(right, col);
  }
  const twz_box found = {top, left, bottom - top + 1, right - left + 1};
  *box = found;
  return i;
}

/* Begin the window of a square of units, of which no more than `most` are taken. */
static twz_status begin_square(twz_points *p, size_t first, size_t most, twz_error *error) {
  place units[MOST_UNITS];
  twz_box boxes[MOST_UNITS];
  uint64_t top = UINT64_MAX, left = UINT64_MAX, bottom = 0, right = 0;
  size_t n = 0, end = first;
  while (n < most && end < p->n_inside && p->order[end].unit >> SQUARE_BITS == p->order[first].unit >> SQUARE_BITS) {
    twz_box *b = &boxes[n];
    end = points_of_unit(p, end, &units[n++], b);
    top = min_u64(top, b->row);
    left = min_u64(left, b->col);
    bottom = b->row + (uint64_t)b->n_rows > bottom ? b->row + (uint64_t)b->n_rows : bottom;
    right = b->col + (uint64_t)b->n_cols > right ? b->col + (uint64_t)b->n_cols : right;
  }
  const twz_box all = {(uint32_t)top, (uint32_t)left, (uint32_t)(bottom - top), (uint32_t)(right - left)};
  square *s = &p->squares[p->n_squares];
  s->first = first;
  s->end = end;
  TRY(sparse_window_new(p->file, p->asked.level, &all, &p->n_bytes, &s->window, error));
  p->n_squares++;
  p->n_units += n;
  for (size_t i = 0; i < n; i++) { /* bilinear heights are of the samples behind, too: a unit has those of its last cells */
    const twz_box *b = &boxes[i];
    window_want(s->window, units[i], b->row, b->col, (int64_t)b->row + b->n_rows + 1, (int64_t)b->col + b->n_cols + 1);
  }
  return TWZ_OK;
}

static twz_status begin_squares(twz_points *p, twz_error *error) {
  size_t first = p->n_done;
  while (p->n_units < p->most_units && first < p->n_inside) {
    TRY(begin_square(p, first, p->most_units - p->n_units, error));
    first = p->squares[p->n_squares - 1].end;
  }
  return TWZ_OK;
}

/* Bring the ranges of several windows into order: those that meet become one. */
static twz_status join_ranges(twz_range *ranges, size_t *n, twz_error *error) {
  size_t n_joined = 0;
  for (size_t i = 1; i < *n; i++) { /* few, and most of them in order */
    twz_range one = ranges[i];
    size_t k = i;
    for (; k > 0 && ranges[k - 1].offset > one.offset; k--) ranges[k] = ranges[k - 1];
    ranges[k] = one;
  }
  for (size_t i = 0; i < *n; i++) {
    twz_range *last = n_joined ? &ranges[n_joined - 1] : NULL;
    uint64_t end = ranges[i].offset + ranges[i].length;
    if (!last || last->offset + last->length <= ranges[i].offset) {
      ranges[n_joined++] = ranges[i];
      continue;
    }
    REQUIRE(last->is_page == ranges[i].is_page, error, "a page and a payload overlap at byte %llu", (unsigned long long)ranges[i].offset);
    if (end > last->offset + last->length) last->length = end - last->offset;
  }
  *n = n_joined;
  return TWZ_OK;
}

static twz_status need_of_squares(twz_points *p, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  if (p->n_squares == 0) TRY(begin_squares(p, error));
  *n = 0;
  for (size_t i = p->first_square; i < p->n_squares && (*n < capacity || p->file->memory); i++) {
    size_t n_more;
    TRY(twz_window_need(p->squares[i].window, *n ? ranges + *n : ranges, capacity - *n, &n_more, error));
    *n += n_more;
    p->end_asked = max_size(p->end_asked, i + 1);
  }
  return join_ranges(ranges, n, error);
}

twz_status twz_points_need(twz_points *p, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  *n = 0;
  if (capacity == 0 && !p->file->memory) return twz_fail(error, TWZ_BAD_ARGUMENT, "no room for a range");
  for (;;) {
    twz_status status = need_of_squares(p, ranges, capacity, n, error);
    if (status == TWZ_OK) return status;
    *n = 0;
    size_t n_units = p->n_units;
    free_squares(p);
    if (status != TWZ_LIMIT || n_units <= 1) return status;
    p->most_units = n_units / 2; /* fewer at a time take less memory */
  }
}

twz_status twz_points_feed(twz_points *p, uint64_t offset, const void *bytes, size_t n, twz_error *error) {
  if (p->end_asked == 0) return twz_fail(error, TWZ_BAD_ARGUMENT, "bytes before any were needed");
  for (size_t i = p->first_square; i < p->end_asked; i++) {
    TRY(twz_window_feed(p->squares[i].window, offset, bytes, n, error));
  }
  return TWZ_OK;
}

/* ---- Heights ---- */

/* The raw heights of one or two samples of a layer that follow each other. */
static twz_status raw_at(const heights *h, const layer *l, size_t at, size_t n, double *raw, twz_error *error) {
  union {
    uint8_t u8[2];
    uint16_t u16[2];
    int16_t i16[2];
    int32_t i32[2];
    float f32[2];
    double f64[2];
  } cells;
  TRY(write_raw(h, &cells, l, at, n, error));
  for (size_t i = 0; i < n; i++) {
    switch ((twz_dtype)h->dtype) {
      case TWZ_UINT8: raw[i] = cells.u8[i]; break;
      case TWZ_UINT16: raw[i] = cells.u16[i]; break;
      case TWZ_INT16: raw[i] = cells.i16[i]; break;
      case TWZ_INT32: raw[i] = cells.i32[i]; break;
      case TWZ_FLOAT32: raw[i] = (double)cells.f32[i]; break;
      case TWZ_FLOAT64: raw[i] = cells.f64[i]; break;
    }
  }
  return TWZ_OK;
}

/* The height of a point in a layer, by operations in the order of read/window_reader.py: its numbers are equal. */
static twz_status height_of(const twz_points *p, const layer *l, size_t point, double *height, int *is_valid, twz_error *error) {
  const twz_points_request *asked = &p->asked;
  const uint8_t *valid = asked->is_own && l->own ? l->own : l->valid;
  uint32_t top = sample_of(asked->rows[point], p->n_rows, asked->interpolation);
  uint32_t left = sample_of(asked->cols[point], p->n_cols, asked->interpolation);
  size_t width = (size_t)l->cols.n, at = (size_t)(top - l->rows.first) * width + (left - l->cols.first);
  double raw[2];
  if (asked->interpolation == TWZ_NEAREST) {
    TRY(raw_at(&p->file->heights, l, at, 1, raw, error));
    *is_valid = !valid || valid[at];
    *height = raw[0];
    return TWZ_OK;
  }
  const double down = asked->rows[point] - top, across = asked->cols[point] - left;
  const double row_weights[2] = {1 - down, down}, col_weights[2] = {1 - across, across};
  const size_t n = left + 1 < p->n_cols ? 2 : 1; /* the last sample is its own neighbour, without weight */
  double total = 0;
  *is_valid = 1;
  for (int i = 0; i < 2; i++) {
    if (i && top + 1 < p->n_rows) at += width;
    TRY(raw_at(&p->file->heights, l, at, n, raw, error));
    for (size_t k = 0; k < 2; k++) {
      size_t cell = k < n ? k : 0;
      double weight = row_weights[i] * col_weights[k];
      int is_there = !valid || valid[at + cell];
      total += (is_there ? raw[cell] : 0.0) * weight;
      *is_valid &= is_there || !(weight > 0);
    }
  }
  *height = total;
  return TWZ_OK;
}

/* Fill the heights of points first ... end - 1 of the order, which lie in decoded units. */
static twz_status fill_heights(const twz_points *p, const square *s, twz_error *error) {
  const unit *u = NULL;
  for (size_t i = s->first; i < s->end; i++) {
    const located *one = &p->order[i];
    uint32_t row, col;
    if (i == s->first || one->unit != p->order[i - 1].unit) u = window_unit(s->window, unit_of(p, one, &row, &col));
    if (u->is_void) continue;
    double height;
    int is_valid;
    TRY(height_of(p, &u->layers[p->asked.level - u->first_level], one->point, &height, &is_valid, error));
    if (!is_valid) continue;
    p->asked.heights[one->point] = height;
    if (p->asked.valid) p->asked.valid[one->point] = 1;
  }
  return TWZ_OK;
}

twz_status twz_points_decode(twz_points *p, const twz_workers *workers, size_t *n_left, twz_error *error) {
  *n_left = p->n_inside - p->n_done;
  if (*n_left == 0) return TWZ_OK;
  twz_workers own = TWZ_WORKERS;
  if (workers) TRY(take_sized(&own, sizeof own, workers, "twz_workers", error));
  twz_workers untold = own;
  untold.report = NULL;
  size_t n_none;
  if (p->file->memory) TRY(twz_points_need(p, NULL, 0, &n_none, error));
  if (p->n_squares == 0) return twz_fail(error, TWZ_NOT_READY, "bytes of the points are missing: need, fetch and feed first");
  for (; p->first_square < p->n_squares; p->first_square++) {
    square *s = &p->squares[p->first_square];
    TRY(report(&own, p->asked.n_points - *n_left, p->asked.n_points, error));
    TRY(twz_window_decode(s->window, &untold, error));
    TRY(fill_heights(p, s, error));
    twz_window_free(s->window);
    s->window = NULL;
    p->n_done = s->end;
    *n_left = p->n_inside - p->n_done;
  }
  free_squares(p);
  return TWZ_OK;
}

static twz_status points_need(void *p, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  return twz_points_need(p, ranges, capacity, n, error);
}
static twz_status points_feed(void *p, uint64_t offset, const void *bytes, size_t n, twz_error *error) {
  return twz_points_feed(p, offset, bytes, n, error);
}

twz_status twz_points_read(twz_points *p, twz_fetch fetch, void *source, const twz_workers *workers, twz_error *error) {
  for (size_t n_left = p->n_inside - p->n_done; n_left > 0;) {
    TRY(load_all(&p->file->allocator, points_need, points_feed, p, fetch, source, error));
    TRY(twz_points_decode(p, workers, &n_left, error));
  }
  return TWZ_OK;
}
