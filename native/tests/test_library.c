/*
 * Tests of the library with the files it is given: test_library FILE ... What files decode to is held against the
 * conformance set elsewhere (CMakeLists.txt); here ways to the same heights are compared, and what must fail fails.
 */
#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "internal.h"

static int n_failed;
static const char *path;

#define CHECK(condition) \
  do { \
    if (!(condition)) { \
      fprintf(stderr, "%s:%d: %s: not true: %s\n", __FILE__, __LINE__, path ? path : "", #condition); \
      n_failed++; \
    } \
  } while (0)

/* ---- A file in memory ---- */

typedef struct memory {
  uint8_t *bytes;
  size_t n;
  size_t n_fetches, n_fetched;
  int is_broken;
} memory;

static int fetch(void *source, size_t n, const twz_range *ranges, void *const *buffers) {
  memory *m = source;
  m->n_fetches++;
  for (size_t i = 0; i < n; i++) {
    CHECK(i == 0 || ranges[i].offset >= ranges[i - 1].offset + ranges[i - 1].length);
    CHECK(ranges[i].length > 0 && ranges[i].offset + ranges[i].length <= m->n);
    CHECK(ranges[i].is_page <= 1);
    memcpy(buffers[i], m->bytes + ranges[i].offset, (size_t)ranges[i].length);
    m->n_fetched += (size_t)ranges[i].length;
  }
  return m->is_broken;
}

static memory read_memory(const char *name) {
  memory m = {NULL, 0, 0, 0, 0};
  FILE *file = fopen(name, "rb");
  if (!file || fseek(file, 0, SEEK_END) != 0) exit(2);
  m.n = (size_t)ftell(file);
  rewind(file);
  m.bytes = malloc(m.n);
  if (!m.bytes || fread(m.bytes, 1, m.n, file) != m.n) exit(2);
  fclose(file);
  return m;
}

static twz_file *open_memory(memory *m, const twz_options *options) {
  twz_file *file;
  twz_error error;
  if (twz_file_new(options, m->n, &file, &error) != TWZ_OK) return NULL;
  CHECK(twz_file_info(file) == NULL);
  CHECK(twz_file_load(file, fetch, m, &error) == TWZ_OK);
  CHECK(twz_file_info(file) != NULL);
  return file;
}

/* Heights and validity of a box; the caller frees them. */
typedef struct raster {
  uint8_t *heights, *valid;
  size_t n_bytes, n;
} raster;

static twz_status read_raster(twz_file *file, memory *m, int level, const twz_box *box, const twz_workers *workers,
                              raster *r, twz_error *error) {
  twz_level size;
  twz_window *window;
  memset(r, 0, sizeof *r);
  TRY(twz_file_level(file, level, &size, error));
  r->n = box ? (size_t)box->n_rows * box->n_cols : (size_t)size.n_rows * size.n_cols;
  r->n_bytes = r->n * twz_file_info(file)->dtype_bytes;
  TRY(twz_window_new(file, level, box, &window, error));
  twz_status status = twz_window_load(window, fetch, m, error);
  if (status == TWZ_OK) status = twz_window_decode(window, workers, error);
  r->heights = malloc(r->n_bytes);
  r->valid = malloc(r->n);
  if (status == TWZ_OK) status = twz_window_read(window, r->heights, 0, r->valid, 0, error);
  twz_window_free(window);
  return status;
}

static void free_raster(raster *r) {
  free(r->heights);
  free(r->valid);
}

static int is_same(const raster *a, const raster *b) {
  return a->n == b->n && memcmp(a->heights, b->heights, a->n_bytes) == 0 && memcmp(a->valid, b->valid, a->n) == 0;
}

/* ---- Ways to the same heights ---- */

static uint32_t random_state = 1;
static uint32_t below(uint32_t n) { /* a number below n */
  random_state = random_state * 1664525u + 1013904223u;
  return (uint32_t)(((uint64_t)random_state * n) >> 32);
}

static size_t n_overlaps;
static size_t n_parts; /* units of which only a part was decoded */
static size_t n_lent;  /* payloads that were not copied */

static void count_parts(const twz_file *file) {
  for (size_t i = 0; i < file->units.n_slots; i++) {
    for (entry *e = file->units.slots[i]; e; e = e->next) {
      const layer *l = &((unit *)e)->layers[0];
      const part all = {0, 0, l->rows.n, l->cols.n};
      n_parts += !part_has(l->ready, all);
    }
  }
}

static void windows_are_parts_of_the_whole(memory *m) {
  twz_file *file = open_memory(m, NULL), *other = NULL;
  size_t width = twz_file_info(file)->dtype_bytes;
  for (int level = 0; level < twz_file_info(file)->n_levels; level++) {
    raster whole, part;
    twz_level size;
    CHECK(twz_file_level(file, level, &size, NULL) == TWZ_OK);
    CHECK(read_raster(file, m, level, NULL, NULL, &whole, NULL) == TWZ_OK);
    for (int i = 0; i < 20; i++) {
      if (i % 4 == 0) { /* of a file just opened, and of one that has some units or some rows of them */
        twz_file_free(other);
        other = open_memory(m, NULL);
      }
      twz_box b;
      b.row = below(size.n_rows);
      b.col = below(size.n_cols);
      b.n_rows = 1 + below(size.n_rows - b.row);
      b.n_cols = 1 + below(size.n_cols - b.col);
      CHECK(read_raster(other, m, level - twz_file_info(file)->n_levels, &b, NULL, &part, NULL) == TWZ_OK);
      count_parts(other);
      int same = 1;
      for (uint32_t row = 0; row < b.n_rows; row++) {
        size_t from = (size_t)(b.row + row) * size.n_cols + b.col, to = (size_t)row * b.n_cols;
        same &= memcmp(whole.heights + from * width, part.heights + to * width, b.n_cols * width) == 0;
        same &= memcmp(whole.valid + from, part.valid + to, b.n_cols) == 0;
      }
      CHECK(same);
      free_raster(&part);
    }
    free_raster(&whole);
  }
  twz_file_free(file);
  twz_file_free(other);
}

/* Each kind of kernels, caches of several sizes and several threads decode to the same. */
static void all_ways_agree(memory *m, twz_pool *pool) {
  twz_file *first = open_memory(m, NULL);
  for (int way = 0; way < 6; way++) {
    twz_options options = TWZ_OPTIONS;
    if (way < 3) options.kernels = (twz_kernels)(TWZ_KERNELS_BASELINE + way);
    if (way == 3) options.cache_bytes = 0;
    if (way == 4) options.cache_bytes = 30000;
    twz_file *file = open_memory(m, &options);
    if (!file) continue; /* kernels that this processor has not */
    for (int level = twz_file_info(file)->n_levels - 1; level >= 0; level--) {
      raster a, b;
      CHECK(read_raster(first, m, level, NULL, NULL, &a, NULL) == TWZ_OK);
      CHECK(read_raster(file, m, level, NULL, way == 5 ? twz_pool_workers(pool) : NULL, &b, NULL) == TWZ_OK);
      CHECK(is_same(&a, &b));
      CHECK(file->cached_bytes <= file->cache_bytes);
      free_raster(&a);
      free_raster(&b);
    }
    twz_file_free(file);
  }
  twz_file_free(first);
}

/* Bytes may come one by one, and more of them than were asked for. */
static void bytes_may_come_in_any_portions(memory *m) {
  for (size_t portion = 1; portion <= m->n; portion = portion * 7 + 2) {
    twz_file *file;
    twz_error error;
    twz_range range;
    size_t n;
    CHECK(twz_file_new(NULL, m->n, &file, &error) == TWZ_OK);
    while (twz_file_need(file, &range, 1, &n, &error) == TWZ_OK && n > 0) {
      size_t given = min_size(portion, m->n - (size_t)range.offset);
      CHECK(twz_file_feed(file, range.offset, m->bytes + range.offset, given, &error) == TWZ_OK);
    }
    CHECK(twz_file_info(file) != NULL);
    twz_window *window;
    CHECK(twz_window_new(file, -1, NULL, &window, &error) == TWZ_OK);
    CHECK(twz_window_decode(window, NULL, &error) == TWZ_NOT_READY);
    while (twz_window_need(window, &range, 1, &n, &error) == TWZ_OK && n > 0) {
      CHECK(twz_window_feed(window, 0, m->bytes, m->n, &error) == TWZ_OK); /* the whole file */
    }
    CHECK(twz_window_decode(window, NULL, &error) == TWZ_OK);
    twz_window_free(window);
    twz_file_free(file);
  }
}

/* ---- Several threads with one file ---- */

#if !defined(_WIN32)
#include <pthread.h>

static void lock_mutex(void *mutex) { pthread_mutex_lock(mutex); }
static void unlock_mutex(void *mutex) { pthread_mutex_unlock(mutex); }

typedef struct reading {
  twz_file *file;
  const memory *source;
  const raster *whole;
  twz_level size;
  int n_wrong[8]; /* by worker */
} reading;

static void read_a_part(void *argument, size_t index, size_t worker) {
  reading *r = argument;
  memory own = *r->source; /* counts of fetches are its own */
  raster part;
  twz_box b;
  b.row = (uint32_t)(index * 7) % r->size.n_rows;
  b.col = (uint32_t)(index * 13) % r->size.n_cols;
  b.n_rows = 1 + (uint32_t)(index * 5) % (r->size.n_rows - b.row);
  b.n_cols = 1 + (uint32_t)(index * 3) % (r->size.n_cols - b.col);
  size_t width = twz_file_info(r->file)->dtype_bytes;
  r->n_wrong[worker] += read_raster(r->file, &own, -1, &b, NULL, &part, NULL) != TWZ_OK;
  for (uint32_t row = 0; row < b.n_rows; row++) {
    size_t from = (size_t)(b.row + row) * r->size.n_cols + b.col;
    r->n_wrong[worker] += memcmp(r->whole->heights + from * width, part.heights + (size_t)row * b.n_cols * width, b.n_cols * width) != 0;
  }
  free_raster(&part);
}

static void threads_may_share_a_file(memory *m, twz_pool *pool) {
  pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
  raster whole;
  twz_file *plain = open_memory(m, NULL);
  CHECK(read_raster(plain, m, -1, NULL, NULL, &whole, NULL) == TWZ_OK);
  twz_options options = TWZ_OPTIONS;
  options.locks.context = &mutex;
  options.locks.lock = lock_mutex;
  options.locks.unlock = unlock_mutex;
  options.cache_bytes = 40000; /* units come and go */
  reading r = {.file = open_memory(m, &options), .source = m, .whole = &whole};
  CHECK(twz_file_level(r.file, -1, &r.size, NULL) == TWZ_OK);
  const twz_workers *workers = twz_pool_workers(pool);
  workers->run(workers->context, 60, read_a_part, &r);
  for (int i = 0; i < 8; i++) CHECK(r.n_wrong[i] == 0);
  twz_file_free(r.file);
  twz_file_free(plain);
  free_raster(&whole);
}
#endif

static void a_window_in_the_cache_needs_no_bytes(memory *m) {
  twz_file *file = open_memory(m, NULL);
  raster a, b;
  CHECK(read_raster(file, m, -1, NULL, NULL, &a, NULL) == TWZ_OK);
  size_t n = m->n_fetches;
  CHECK(read_raster(file, m, -1, NULL, NULL, &b, NULL) == TWZ_OK);
  CHECK(m->n_fetches == n && is_same(&a, &b));
  free_raster(&a);
  free_raster(&b);
  twz_file_free(file);
}

/* What the cache counts is what it holds: all of it comes back when it is emptied. */
static size_t n_sized; /* bytes that are held */

static void *sized_allocate(void *context, size_t n) {
  max_align_t *memory = malloc(sizeof(max_align_t) + n);
  (void)context;
  if (!memory) return NULL;
  *(size_t *)(void *)memory = n;
  n_sized += n;
  return memory + 1;
}

static void sized_release(void *context, void *memory) {
  max_align_t *start = (max_align_t *)memory - 1;
  (void)context;
  n_sized -= *(size_t *)(void *)start;
  free(start);
}

static void the_cache_counts_what_it_holds(memory *m) {
  twz_options options = TWZ_OPTIONS;
  options.allocator.allocate = sized_allocate;
  options.allocator.release = sized_release;
  options.cache_bytes = 40000;
  twz_file *file = open_memory(m, &options);
  twz_level size;
  CHECK(twz_file_level(file, -1, &size, NULL) == TWZ_OK);
  for (int i = 0; i < 20; i++) {
    raster part;
    twz_box b = {below(size.n_rows), below(size.n_cols), 1, 1};
    b.n_rows += below(min_u32(size.n_rows - b.row, 60));
    b.n_cols += below(min_u32(size.n_cols - b.col, 60));
    CHECK(read_raster(file, m, -1, &b, NULL, &part, NULL) == TWZ_OK);
    free_raster(&part);
    CHECK(file->cached_bytes <= file->cache_bytes);
  }
  size_t before = n_sized, counted = (size_t)file->cached_bytes;
  file->cache_bytes = 0;
  while (file->units.n > 0) cache_leave(file, cache_take(file, file->newest->entry.at, &(part){0, 0, 0, 0}));
  CHECK(counted == before - n_sized && file->cached_bytes == 0);
  twz_file_free(file);
  CHECK(n_sized == 0);
}

/* The list of the cache has units that nobody uses: windows of many units take no time to look for one. */
static void units_in_use_are_in_no_list(memory *m) {
  twz_options options = TWZ_OPTIONS;
  options.cache_bytes = 1000;
  twz_file *file = open_memory(m, &options);
  twz_window *window;
  CHECK(twz_window_new(file, -1, NULL, &window, NULL) == TWZ_OK);
  CHECK(twz_window_load(window, fetch, m, NULL) == TWZ_OK);
  CHECK(twz_window_decode(window, NULL, NULL) == TWZ_OK);
  CHECK(file->units.n > 0 && file->newest == NULL && file->oldest == NULL);
  twz_window_free(window);
  CHECK(file->cached_bytes <= file->cache_bytes);
  twz_file_free(file);
}

/* Heights are written at any address and any distance of rows. */
static void rows_may_lie_anywhere(memory *m) {
  twz_file *file = open_memory(m, NULL);
  raster r;
  twz_window *window;
  twz_level size;
  CHECK(read_raster(file, m, -1, NULL, NULL, &r, NULL) == TWZ_OK);
  CHECK(twz_file_level(file, -1, &size, NULL) == TWZ_OK);
  CHECK(twz_window_new(file, -1, NULL, &window, NULL) == TWZ_OK && twz_window_load(window, fetch, m, NULL) == TWZ_OK);
  CHECK(twz_window_decode(window, NULL, NULL) == TWZ_OK);
  size_t width = size.n_cols * twz_file_info(file)->dtype_bytes, stride = width + 3;
  uint8_t *rows = malloc(size.n_rows * stride + 1);
  for (int is_up = 0; is_up < 2; is_up++) { /* from the last row on, too */
    uint8_t *start = rows + 1 + (is_up ? (size.n_rows - 1) * stride : 0);
    CHECK(twz_window_read(window, start, is_up ? -(ptrdiff_t)stride : (ptrdiff_t)stride, NULL, 0, NULL) == TWZ_OK);
    for (size_t row = 0; row < size.n_rows; row++) {
      size_t line = is_up ? size.n_rows - 1 - row : row;
      CHECK(memcmp(rows + 1 + line * stride, r.heights + row * width, width) == 0);
    }
  }
  free(rows);
  free_raster(&r);
  twz_window_free(window);
  twz_file_free(file);
}

/* A window that is decoded into the caller's memory is what it is when it is decoded and read, wherever rows lie. */
static void windows_may_be_decoded_into_memory(memory *m, twz_pool *pool) {
  twz_file *file = open_memory(m, NULL), *other = NULL;
  size_t width = twz_file_info(file)->dtype_bytes;
  for (int i = 0; i < 12; i++) {
    if (i % 3 == 0) { /* of a file just opened, and of one that has some units */
      twz_file_free(other);
      other = open_memory(m, NULL);
    }
    twz_level size;
    int level = i % 4 == 3 ? -2 : -1;
    if (twz_file_level(file, level, &size, NULL) != TWZ_OK) continue;
    twz_box b = {i < 2 ? 0 : below(size.n_rows), i < 2 ? 0 : below(size.n_cols), size.n_rows, size.n_cols};
    b.n_rows = i < 2 ? size.n_rows : 1 + below(size.n_rows - b.row);
    b.n_cols = i < 2 ? size.n_cols : 1 + below(size.n_cols - b.col);
    raster r;
    CHECK(read_raster(file, m, level, &b, NULL, &r, NULL) == TWZ_OK);
    size_t line = b.n_cols * width, stride = line + (i % 2 ? 3 : 0), shift = (size_t)(i % 2);
    uint8_t *rows = malloc(b.n_rows * stride + 8), *valid = malloc(r.n);
    memset(rows, 0xA5, b.n_rows * stride + 8);
    twz_window *window;
    twz_error error;
    CHECK(twz_window_new(other, level, &b, &window, NULL) == TWZ_OK);
    CHECK(twz_window_decode_into(window, NULL, rows, 0, NULL, 0, &error) == TWZ_NOT_READY);
    CHECK(twz_window_load(window, fetch, m, NULL) == TWZ_OK);
    const twz_workers *workers = i % 3 == 2 ? twz_pool_workers(pool) : NULL;
    CHECK(twz_window_decode_into(window, workers, rows + shift, (ptrdiff_t)stride, i % 2 ? NULL : valid, 0, NULL) == TWZ_OK);
    int is_right = i % 2 || memcmp(valid, r.valid, r.n) == 0;
    for (size_t row = 0; row < b.n_rows; row++) {
      is_right &= memcmp(rows + shift + row * stride, r.heights + row * line, line) == 0;
      for (size_t k = line; k < stride; k++) is_right &= rows[shift + row * stride + k] == 0xA5; /* nothing else is written */
    }
    CHECK(is_right);
    CHECK(twz_window_decode(window, NULL, &error) == TWZ_BAD_ARGUMENT && error.text[0]);
    CHECK(twz_window_read(window, rows, 0, NULL, 0, &error) == TWZ_NOT_READY);
    twz_window_free(window);
    free(rows);
    free(valid);
    free_raster(&r);
  }
  twz_file_free(file);
  twz_file_free(other);
}

/* ---- Points ---- */

/* The numbers of a raster, by its type. */
static double raw_of(const twz_info *info, const uint8_t *heights, size_t i) {
  switch (info->dtype) {
    case TWZ_UINT8: return heights[i];
    case TWZ_UINT16: return ((const uint16_t *)(const void *)heights)[i];
    case TWZ_INT16: return ((const int16_t *)(const void *)heights)[i];
    case TWZ_INT32: return ((const int32_t *)(const void *)heights)[i];
    case TWZ_FLOAT32: return (double)((const float *)(const void *)heights)[i];
    case TWZ_FLOAT64: return ((const double *)(const void *)heights)[i];
  }
  return NAN;
}

/* The height of a point by the samples of the whole level, as terrainwave.h says it; NAN: there is none. */
static double height_by_samples(const twz_info *info, const twz_level *size, const raster *r, const uint8_t *counts, double row, double col,
                                twz_interpolation interpolation) {
  if (interpolation == TWZ_NEAREST) {
    double top = row + 0.5, left = col + 0.5;
    if (!(top >= 0 && top < size->n_rows && left >= 0 && left < size->n_cols)) return NAN;
    size_t at = (size_t)top * size->n_cols + (size_t)left;
    return counts[at] ? raw_of(info, r->heights, at) : (double)NAN;
  }
  if (!(row >= 0 && row <= size->n_rows - 1 && col >= 0 && col <= size->n_cols - 1)) return NAN;
  size_t top = (size_t)row, left = (size_t)col;
  double total = 0;
  for (size_t i = 0; i < 4; i++) {
    size_t line = min_size(top + i / 2, size->n_rows - 1), at = line * size->n_cols + min_size(left + i % 2, size->n_cols - 1);
    double down = row - (double)top, across = col - (double)left, weight = (i / 2 ? down : 1 - down) * (i % 2 ? across : 1 - across);
    if (!counts[at] && weight > 0) return NAN;
    total += (counts[at] ? raw_of(info, r->heights, at) : 0) * weight;
  }
  return total;
}

/* A place along an axis of n samples: on one, between two, at either end, outside, not a number. */
static double random_place(uint32_t n) {
  static const double OUTSIDE[] = {-0.5, -0.25, -1, -1e300, (double)INFINITY, -(double)INFINITY, (double)NAN};
  uint32_t way = below(20), sample = below(n);
  if (way < 7) return OUTSIDE[way];
  if (way < 9) return sample;
  if (way == 9) return n - 1;
  if (way == 10) return n - 0.5;
  if (way == 11) return n - 1 + 0.25;
  return sample + below(1000) / 1000.0;
}

enum { N_POINTS = 400 };
typedef struct places {
  double rows[N_POINTS], cols[N_POINTS], heights[N_POINTS];
  uint8_t valid[N_POINTS];
} places;

static size_t n_between; /* heights of points that were compared */

static void heights_at_points_are_those_of_samples(memory *m, twz_pool *pool) {
  static places all;
  twz_file *first = open_memory(m, NULL);
  const twz_info *info = twz_file_info(first);
  for (int way = 0; way < 16; way++) {
    int level = way % 4 ? -1 - (int)below((uint32_t)info->n_levels) : -1;
    twz_level size;
    raster r;
    twz_window *window;
    CHECK(twz_file_level(first, level, &size, NULL) == TWZ_OK && read_raster(first, m, level, NULL, NULL, &r, NULL) == TWZ_OK);
    uint8_t *own = malloc(r.n);
    CHECK(twz_window_new(first, level, NULL, &window, NULL) == TWZ_OK && twz_window_load(window, fetch, m, NULL) == TWZ_OK);
    CHECK(twz_window_decode(window, NULL, NULL) == TWZ_OK && twz_window_read_own(window, own, 0, NULL) == TWZ_OK);
    twz_window_free(window);
    twz_points_request asked = TWZ_POINTS_REQUEST;
    asked.level = level;
    asked.interpolation = way & 1 ? TWZ_NEAREST : TWZ_BILINEAR;
    asked.is_own = way >> 1 & 1;
    asked.n_points = 1 + below(N_POINTS);
    asked.rows = all.rows;
    asked.cols = all.cols;
    asked.heights = all.heights;
    asked.valid = way % 5 ? all.valid : NULL;
    for (size_t i = 0; i < asked.n_points; i++) {
      all.rows[i] = random_place(size.n_rows);
      all.cols[i] = random_place(size.n_cols);
    }
    twz_options options = TWZ_OPTIONS;
    if (way & 4) options.cache_bytes = 0;
    twz_file *file = open_memory(m, &options);
    twz_points *points;
    CHECK(twz_points_new(file, &asked, &points, NULL) == TWZ_OK);
    twz_workers alone = TWZ_WORKERS;
    const twz_workers *workers = way % 3 == 0 ? NULL : way % 3 == 1 ? &alone : twz_pool_workers(pool);
    if (way & 8) { /* by hand, one range at a time, with all bytes */
      for (size_t n_left = 1; n_left > 0;) {
        twz_range range;
        size_t n;
        while (twz_points_need(points, &range, 1, &n, NULL) == TWZ_OK && n > 0) CHECK(twz_points_feed(points, 0, m->bytes, m->n, NULL) == TWZ_OK);
        if (twz_points_decode(points, workers, &n_left, NULL) != TWZ_OK) break;
      }
    } else {
      CHECK(twz_points_read(points, fetch, m, workers, NULL) == TWZ_OK);
      CHECK(twz_points_read(points, NULL, NULL, workers, NULL) == TWZ_OK); /* nothing is left */
    }
    int is_right = 1;
    for (size_t i = 0; i < asked.n_points; i++) {
      double expected = height_by_samples(info, &size, &r, asked.is_own ? own : r.valid, all.rows[i], all.cols[i], asked.interpolation);
      is_right &= isnan(expected) ? isnan(all.heights[i]) : expected == all.heights[i];
      is_right &= !asked.valid || all.valid[i] == !isnan(expected);
      n_between += (size_t)!isnan(expected);
    }
    CHECK(is_right);
    twz_points_free(points);
    twz_file_free(file);
    free(own);
    free_raster(&r);
  }
  twz_file_free(first);
}

/* However many points lie in a unit, and however little is kept, it is decoded once, and its payload read once. */
static void units_of_points_are_read_once(memory *m) {
  twz_file *whole = open_memory(m, NULL), *file;
  twz_options options = TWZ_OPTIONS;
  twz_level size;
  raster r;
  CHECK(twz_file_level(whole, -1, &size, NULL) == TWZ_OK && read_raster(whole, m, -1, NULL, NULL, &r, NULL) == TWZ_OK);
  free_raster(&r);
  twz_file_free(whole);
  const size_t n = 20000;
  double *numbers = malloc(3 * n * sizeof *numbers);
  for (size_t i = 0; i < n; i++) {
    numbers[i] = below(size.n_rows);
    numbers[n + i] = below(size.n_cols);
  }
  twz_points_request asked = TWZ_POINTS_REQUEST;
  asked.n_points = n;
  asked.rows = numbers;
  asked.cols = numbers + n;
  asked.heights = numbers + 2 * n;
  options.cache_bytes = 0;
  file = open_memory(m, &options);
  twz_points *points;
  size_t before = m->n_fetched;
  CHECK(twz_points_new(file, &asked, &points, NULL) == TWZ_OK && twz_points_read(points, fetch, m, NULL, NULL) == TWZ_OK);
  CHECK(m->n_fetched - before <= m->n); /* no byte twice */
  twz_points_free(points);
  twz_file_free(file);
  free(numbers);
}

/* Points in more units than fit the memory that is allowed are read some at a time; no unit at all is refused. */
static void points_keep_to_their_memory(memory *m) {
  twz_options options = TWZ_OPTIONS;
  twz_file *file = open_memory(m, NULL), *small;
  static places all, same;
  twz_level size;
  CHECK(twz_file_level(file, -1, &size, NULL) == TWZ_OK);
  for (int i = 0; i < N_POINTS; i++) {
    all.rows[i] = below(size.n_rows);
    all.cols[i] = below(size.n_cols);
  }
  twz_points_request asked = TWZ_POINTS_REQUEST;
  asked.n_points = N_POINTS;
  asked.rows = all.rows;
  asked.cols = all.cols;
  asked.heights = all.heights;
  twz_points *points;
  CHECK(twz_points_new(file, &asked, &points, NULL) == TWZ_OK && twz_points_read(points, fetch, m, NULL, NULL) == TWZ_OK);
  twz_points_free(points);
  asked.heights = same.heights;
  twz_status status = TWZ_LIMIT;
  for (options.max_bytes = 500; status == TWZ_LIMIT; options.max_bytes += 1 + options.max_bytes / 4) {
    small = open_memory(m, &options);
    twz_error error;
    status = twz_points_new(small, &asked, &points, &error);
    if (status == TWZ_OK) status = twz_points_read(points, fetch, m, NULL, &error);
    CHECK(status == TWZ_OK || (status == TWZ_LIMIT && error.text[0]));
    twz_points_free(points);
    twz_file_free(small);
  }
  CHECK(status == TWZ_OK && memcmp(all.heights, same.heights, sizeof all.heights) == 0);
  twz_file_free(file);
}

/* ---- Files in memory, limits, reports ---- */

/* A file that was borrowed gives the same, and asks for no bytes. Its payloads are where they were. */
static void borrowed_files_need_no_bytes(memory *m) {
  twz_file *file = open_memory(m, NULL), *lent;
  CHECK(twz_file_new(NULL, m->n, &lent, NULL) == TWZ_OK && twz_file_borrow(lent, m->bytes, NULL) == TWZ_OK);
  size_t before = m->n_fetches;
  for (int level = 0; level < twz_file_info(lent)->n_levels; level++) {
    raster a, b;
    twz_window *window;
    twz_range range;
    size_t n = 1;
    CHECK(read_raster(lent, NULL, level, NULL, NULL, &b, NULL) == TWZ_OK);
    CHECK(m->n_fetches == before);
    CHECK(read_raster(file, m, level, NULL, NULL, &a, NULL) == TWZ_OK && is_same(&a, &b));
    before = m->n_fetches;
    CHECK(twz_window_new(lent, level, NULL, &window, NULL) == TWZ_OK);
    CHECK(twz_window_need(window, &range, 1, &n, NULL) == TWZ_OK && n == 0);
    twz_window_free(window);
    CHECK(twz_window_new(lent, level, NULL, &window, NULL) == TWZ_OK);
    CHECK(twz_window_decode_into(window, NULL, b.heights, 0, b.valid, 0, NULL) == TWZ_OK && is_same(&a, &b)); /* not loaded */
    twz_window_free(window);
    free_raster(&a);
    free_raster(&b);
  }
  CHECK(twz_file_check(lent, NULL, NULL, NULL, NULL) == TWZ_OK);
  double place[2] = {0, 0}, height = -1;
  twz_points_request asked = TWZ_POINTS_REQUEST;
  asked.n_points = 1;
  asked.rows = place;
  asked.cols = place + 1;
  asked.heights = &height;
  twz_points *points;
  size_t n_left = 1;
  CHECK(twz_points_new(lent, &asked, &points, NULL) == TWZ_OK && twz_points_decode(points, NULL, &n_left, NULL) == TWZ_OK);
  CHECK(n_left == 0 && (isnan(height) || height >= -1e9));
  twz_points_free(points);
  CHECK(m->n_fetches == before);
  twz_file_free(lent);
  twz_file_free(file);
}

/* A limit holds at once, and for what is decoded later. */
static void the_cache_can_be_limited(memory *m) {
  twz_file *file = open_memory(m, NULL);
  raster r;
  CHECK(read_raster(file, m, -1, NULL, NULL, &r, NULL) == TWZ_OK);
  free_raster(&r);
  uint64_t all = file->cached_bytes;
  CHECK(all > 0);
  twz_file_limit_cache(file, all - 1);
  CHECK(file->cached_bytes < all);
  twz_file_limit_cache(file, 0);
  CHECK(file->cached_bytes == 0 && file->units.n == 0);
  CHECK(read_raster(file, m, -1, NULL, NULL, &r, NULL) == TWZ_OK);
  free_raster(&r);
  CHECK(file->cached_bytes == 0);
  twz_file_free(file);
}

typedef struct told {
  uint64_t n_calls, n_before_end, last, all;
  int is_monotonous;
} told;

static int listen(void *context, uint64_t n_done, uint64_t n_all) {
  told *t = context;
  t->is_monotonous &= n_done >= t->last && n_done <= n_all && (t->n_calls == 0 || n_all == t->all);
  t->last = n_done;
  t->all = n_all;
  return ++t->n_calls > t->n_before_end;
}

static size_t n_reports, n_ended;

/* Each long call tells how far it is, and ends where it is told to; what can go on gives the same in the end. */
static void long_calls_report_and_can_be_ended(memory *m, twz_pool *pool) {
  static places all, same;
  twz_file *whole = open_memory(m, NULL);
  raster expected;
  twz_level size;
  CHECK(read_raster(whole, m, -1, NULL, NULL, &expected, NULL) == TWZ_OK && twz_file_level(whole, -1, &size, NULL) == TWZ_OK);
  for (int i = 0; i < N_POINTS; i++) {
    all.rows[i] = below(size.n_rows);
    all.cols[i] = below(size.n_cols);
  }
  twz_points_request asked = TWZ_POINTS_REQUEST;
  asked.n_points = N_POINTS;
  asked.rows = all.rows;
  asked.cols = all.cols;
  asked.heights = all.heights;
  twz_points *points;
  CHECK(twz_points_new(whole, &asked, &points, NULL) == TWZ_OK && twz_points_read(points, fetch, m, NULL, NULL) == TWZ_OK);
  twz_points_free(points);
  for (int way = 0; way < 8; way++) {
    told t = {0, way & 1 ? (uint64_t)way / 2 : UINT64_MAX, 0, 0, 1};
    twz_workers workers = TWZ_WORKERS;
    if (way & 2) workers = *twz_pool_workers(pool);
    workers.report_context = &t;
    workers.report = listen;
    twz_error error;
    twz_file *file = open_memory(m, NULL);
    raster r;
    twz_window *window;
    memset(&r, 0, sizeof r);
    r.n = expected.n;
    r.n_bytes = expected.n_bytes;
    r.heights = malloc(r.n_bytes);
    r.valid = malloc(r.n);
    CHECK(twz_window_new(file, -1, NULL, &window, NULL) == TWZ_OK && twz_window_load(window, fetch, m, NULL) == TWZ_OK);
    twz_status status = twz_window_decode(window, &workers, &error);
    CHECK(t.is_monotonous && (status == TWZ_OK || (status == TWZ_CANCELLED && error.text[0] && t.n_calls == t.n_before_end + 1)));
    n_ended += status == TWZ_CANCELLED;
    t.n_before_end = UINT64_MAX;
    t.last = t.n_calls = 0;
    if (status == TWZ_CANCELLED) CHECK(twz_window_read(window, r.heights, 0, NULL, 0, NULL) == TWZ_NOT_READY);
    CHECK(twz_window_decode(window, &workers, NULL) == TWZ_OK);
    CHECK(twz_window_read(window, r.heights, 0, r.valid, 0, NULL) == TWZ_OK && is_same(&r, &expected));
    twz_window_free(window);
    n_reports += t.n_calls;
    twz_file_limit_cache(file, 0);
    t = (told){0, way & 1 ? (uint64_t)way / 2 : UINT64_MAX, 0, 0, 1};
    CHECK(twz_window_new(file, -1, NULL, &window, NULL) == TWZ_OK && twz_window_load(window, fetch, m, NULL) == TWZ_OK);
    status = twz_window_decode_into(window, &workers, r.heights, 0, NULL, 0, NULL);
    CHECK(t.is_monotonous && (status == TWZ_OK || status == TWZ_CANCELLED));
    twz_window_free(window);
    t = (told){0, way & 1 ? (uint64_t)way / 2 : UINT64_MAX, 0, 0, 1};
    status = twz_file_check(file, fetch, m, &workers, NULL);
    CHECK(t.is_monotonous && status == (t.n_calls > t.n_before_end ? TWZ_CANCELLED : TWZ_OK));
    CHECK(t.n_calls > 0 && (way & 1 || t.last > 0));
    n_ended += status == TWZ_CANCELLED;
    asked.heights = same.heights;
    t = (told){0, way & 1 ? (uint64_t)way / 2 : UINT64_MAX, 0, 0, 1};
    CHECK(twz_points_new(file, &asked, &points, NULL) == TWZ_OK);
    status = twz_points_read(points, fetch, m, &workers, NULL);
    CHECK(t.is_monotonous && (status == TWZ_OK || status == TWZ_CANCELLED));
    t.n_before_end = UINT64_MAX;
    CHECK(twz_points_read(points, fetch, m, &workers, NULL) == TWZ_OK);
    CHECK(memcmp(all.heights, same.heights, sizeof all.heights) == 0);
    twz_points_free(points);
    twz_file_free(file);
    free_raster(&r);
  }
  free_raster(&expected);
  twz_file_free(whole);
}

static const crc_tables *tables(void) {
  static crc_tables t;
  crc_tables_fill(&t);
  return &t;
}

static size_t n_roots;

/* The root of heights is that which digests state; a file with other digests is refused, with a right checksum, too. */
static void roots_agree(memory *m) {
  char stated[TWZ_ROOT_SIZE], root[TWZ_ROOT_SIZE];
  twz_file *file = open_memory(m, NULL), *lent;
  twz_error error;
  CHECK(twz_file_stated_root(file, fetch, m, stated, NULL) == TWZ_OK);
  CHECK(twz_file_root(file, fetch, m, NULL, root, NULL) == TWZ_OK && strlen(root) == TWZ_ROOT_SIZE - 1);
  CHECK(twz_file_new(NULL, m->n, &lent, NULL) == TWZ_OK);
  CHECK(twz_file_root(lent, NULL, NULL, NULL, root, NULL) == TWZ_NOT_READY);
  CHECK(twz_file_borrow(lent, m->bytes, NULL) == TWZ_OK);
  char same[TWZ_ROOT_SIZE];
  CHECK(twz_file_root(lent, NULL, NULL, NULL, root, NULL) == TWZ_OK);
  CHECK(twz_file_stated_root(lent, NULL, NULL, same, NULL) == TWZ_OK && strcmp(same, stated) == 0);
  int has_digests = (twz_file_info(lent)->features & DIGESTS) != 0;
  twz_file_free(lent);
  twz_file_free(file);
  CHECK(strcmp(stated, has_digests ? root : "") == 0);
  if (!has_digests) return;
  n_roots++;
  uint32_t n = load_u32(m->bytes + m->n - 4);
  memory other = {malloc(m->n), m->n, 0, 0, 0};
  for (uint32_t i = 0; i < n; i++) {
    memcpy(other.bytes, m->bytes, m->n);
    uint8_t *digests = other.bytes + m->n - DIGESTS_TAIL - n * (size_t)DIGEST_SIZE;
    digests[i * DIGEST_SIZE + 5] ^= 4;
    uint32_t crc = crc32_of(tables(), digests, n * (size_t)DIGEST_SIZE);
    for (int k = 0; k < 4; k++) other.bytes[m->n - 8 + (size_t)k] = (uint8_t)(crc >> 8 * k);
    file = open_memory(&other, NULL);
    CHECK(twz_file_check(file, fetch, &other, NULL, &error) == TWZ_CORRUPT && strstr(error.text, "digest"));
    twz_file_free(file);
  }
  free(other.bytes);
}

/* ---- What must fail ---- */

/* A window that is refused is refused again, and holds no units. */
static void a_refused_window_holds_nothing(memory *m) {
  uint64_t step = 0;
  for (uint64_t most = 400;; most += step) {
    twz_file *file = open_memory(m, NULL);
    step = file->info.n_rows * (uint64_t)file->info.n_cols / 4 + 200;
    raster r;
    twz_box first = {0, 0, min_u32(2 * file->info.block_size, file->info.n_rows), 1}; /* the cache has some units */
    CHECK(read_raster(file, m, -1, &first, NULL, &r, NULL) == TWZ_OK);
    free_raster(&r);
    file->max_bytes = most;
    twz_window *window;
    if (twz_window_new(file, -1, NULL, &window, NULL) == TWZ_OK) {
      twz_status status = twz_window_load(window, fetch, m, NULL);
      for (int i = 0; i < 3 && status != TWZ_OK; i++) {
        CHECK(status == TWZ_LIMIT);
        status = twz_window_load(window, fetch, m, NULL);
        CHECK(status == TWZ_LIMIT);
      }
      twz_window_free(window);
      for (size_t i = 0; i < file->units.n_slots; i++) {
        for (entry *e = file->units.slots[i]; e; e = e->next) CHECK(((unit *)e)->n_users == 0);
      }
      twz_file_free(file);
      if (status == TWZ_OK) return;
    } else {
      twz_file_free(file);
    }
  }
}

typedef struct counter {
  size_t n_left, n_held;
} counter;

static void *counted_allocate(void *context, size_t n) {
  counter *c = context;
  if (c->n_left == 0) return NULL;
  c->n_left--;
  c->n_held++;
  return malloc(n);
}

static void counted_release(void *context, void *memory) {
  ((counter *)context)->n_held--;
  free(memory);
}

/* Of a borrowed file payloads are not copied, but for those at its end, which a decoder may read past. */
static void borrowed_payloads_are_not_copied(memory *m) {
  size_t n_held[2], n_borrowed = 0;
  uint8_t *exact = malloc(m->n); /* nothing of this program follows it */
  memcpy(exact, m->bytes, m->n);
  for (int is_lent = 0; is_lent < 2; is_lent++) {
    counter c = {SIZE_MAX, 0};
    twz_options options = TWZ_OPTIONS;
    options.allocator.context = &c;
    options.allocator.allocate = counted_allocate;
    options.allocator.release = counted_release;
    twz_file *file;
    twz_window *window;
    CHECK(twz_file_new(&options, m->n, &file, NULL) == TWZ_OK);
    CHECK((is_lent ? twz_file_borrow(file, exact, NULL) : twz_file_load(file, fetch, m, NULL)) == TWZ_OK);
    CHECK(twz_window_new(file, -1, NULL, &window, NULL) == TWZ_OK && twz_window_load(window, fetch, m, NULL) == TWZ_OK);
    n_held[is_lent] = c.n_held;
    for (size_t i = 0; i < file->segments.n_slots && is_lent; i++) {
      for (entry *e = file->segments.slots[i]; e; e = e->next) {
        const segment *s = (const segment *)e;
        for (int k = 0; k < s->n_keys; k++) {
          n_borrowed += s->payloads[k].length && s->payloads[k].offset + s->payloads[k].length + PAYLOAD_SLACK <= m->n;
        }
      }
    }
    CHECK(twz_window_decode(window, NULL, NULL) == TWZ_OK);
    twz_window_free(window);
    twz_file_free(file);
  }
  CHECK(n_held[0] - n_held[1] == n_borrowed);
  n_lent += n_borrowed;
  free(exact);
}

/* Heights at points all over the finest level; m NULL: of a file in memory. */
static twz_status sample_points(twz_file *file, memory *m, twz_error *error) {
  static places all;
  twz_level size;
  TRY(twz_file_level(file, -1, &size, error));
  twz_points_request asked = TWZ_POINTS_REQUEST;
  asked.n_points = N_POINTS;
  asked.rows = all.rows;
  asked.cols = all.cols;
  asked.heights = all.heights;
  for (int i = 0; i < N_POINTS; i++) {
    all.rows[i] = below(size.n_rows);
    all.cols[i] = below(size.n_cols);
  }
  twz_points *points;
  twz_file_limit_cache(file, 0);
  TRY(twz_points_new(file, &asked, &points, error));
  twz_status status = twz_points_read(points, fetch, m, NULL, error);
  twz_points_free(points);
  return status;
}

static twz_status sample_borrowed(memory *m, const twz_options *options, twz_error *error) {
  twz_file *file;
  TRY(twz_file_new(options, m->n, &file, error));
  twz_status status = twz_file_borrow(file, m->bytes, error);
  if (status == TWZ_OK) status = sample_points(file, NULL, error);
  if (status == TWZ_OK) status = twz_file_check(file, NULL, NULL, NULL, error);
  twz_file_free(file);
  return status;
}

/* Wherever memory ends, that is said, and all of it comes back. */
static void no_memory_is_an_error(memory *m) {
  twz_status status = TWZ_NO_MEMORY;
  for (size_t n = 0; status == TWZ_NO_MEMORY && n < 5000; n += 1 + n / 16) {
    counter c = {n, 0};
    twz_options options = TWZ_OPTIONS;
    options.allocator.context = &c;
    options.allocator.allocate = counted_allocate;
    options.allocator.release = counted_release;
    twz_file *file;
    twz_error error;
    raster r = {NULL, NULL, 0, 0};
    status = twz_file_new(&options, m->n, &file, &error);
    if (status == TWZ_OK) status = twz_file_load(file, fetch, m, &error);
    if (status == TWZ_OK) status = read_raster(file, m, -1, NULL, NULL, &r, &error);
    if (status == TWZ_OK) status = sample_points(file, m, &error);
    if (status == TWZ_OK) status = sample_borrowed(m, &options, &error);
    CHECK(status == TWZ_OK || (status == TWZ_NO_MEMORY && error.status == TWZ_NO_MEMORY && error.text[0]));
    free_raster(&r);
    twz_file_free(file);
    CHECK(c.n_held == 0);
  }
  CHECK(status == TWZ_OK);
}

static void own_samples_of_parts_are_those_of_the_window(memory *m) {
  twz_file *file = open_memory(m, NULL);
  for (int level = 0; level < twz_file_info(file)->n_levels; level++) {
    twz_window *window = NULL;
    twz_level size;
    CHECK(twz_file_level(file, level, &size, NULL) == TWZ_OK && twz_window_new(file, level, NULL, &window, NULL) == TWZ_OK);
    CHECK(twz_window_load(window, fetch, m, NULL) == TWZ_OK && twz_window_decode(window, NULL, NULL) == TWZ_OK);
    size_t n = (size_t)size.n_rows * size.n_cols;
    uint8_t *whole = malloc(n), *cut = malloc(n);
    twz_box part = {size.n_rows / 3, size.n_cols / 4, size.n_rows / 2 + 1 - size.n_rows / 3, size.n_cols - size.n_cols / 4};
    twz_status status = twz_window_read_own(window, whole, 0, NULL);
    CHECK(twz_window_read_own_part(window, &part, cut, 0, NULL) == status);
    for (uint32_t row = 0; status == TWZ_OK && row < part.n_rows; row++) {
      CHECK(memcmp(cut + (size_t)row * part.n_cols, whole + (size_t)(part.row + row) * size.n_cols + part.col, part.n_cols) == 0);
    }
    part.n_rows = size.n_rows + 1;
    CHECK(twz_window_read_own_part(window, &part, cut, 0, NULL) != TWZ_OK);
    free(whole);
    free(cut);
    twz_window_free(window);
  }
  twz_file_free(file);
}

static void calls_that_are_wrong_say_so(memory *m) {
  twz_file *file = open_memory(m, NULL);
  twz_level size;
  twz_error error;
  twz_window *window;
  int n = twz_file_info(file)->n_levels;
  CHECK(twz_file_level(file, n, &size, &error) == TWZ_BAD_ARGUMENT);
  CHECK(twz_file_level(file, -n - 1, &size, &error) == TWZ_BAD_ARGUMENT);
  CHECK(twz_file_level(file, -n, &size, &error) == TWZ_OK);
  const twz_box boxes[] = {{0, 0, 0, 1}, {0, 0, 1, 0}, {0, 0, size.n_rows + 1, 1}, {size.n_rows, 0, 1, 1},
                           {0, 1, 1, size.n_cols}, {UINT32_MAX, 0, 2, 1}, {0, 0, UINT32_MAX, UINT32_MAX}};
  for (size_t i = 0; i < sizeof boxes / sizeof *boxes; i++) {
    CHECK(twz_window_new(file, 0, &boxes[i], &window, &error) == TWZ_BAD_ARGUMENT && window == NULL);
  }
  CHECK(twz_window_new(file, 0, NULL, &window, &error) == TWZ_OK);
  uint8_t byte;
  twz_box part = {0, 0, 1, 1};
  CHECK(twz_window_read_part(window, &part, NULL, 0, &byte, 0, &error) == TWZ_NOT_READY);
  m->is_broken = 1;
  twz_status status = twz_window_load(window, fetch, m, &error);
  CHECK(status == TWZ_FETCH_FAILED || (status == TWZ_OK && !twz_file_info(file)->has_valid));
  m->is_broken = 0;
  CHECK(twz_window_load(window, fetch, m, &error) == TWZ_OK); /* a window outlives a failed fetch */
  CHECK(twz_window_decode(window, NULL, &error) == TWZ_OK);
  part.row = size.n_rows;
  CHECK(twz_window_read_part(window, &part, NULL, 0, &byte, 0, &error) == TWZ_BAD_ARGUMENT);
  twz_block block;
  CHECK(twz_window_block(window, 0, 0, &block, &error) == TWZ_OK);
  CHECK(twz_window_block(window, 1, 0, &block, &error) == TWZ_BAD_ARGUMENT); /* level 0 has one */
  twz_window_free(window);
  double place[2] = {0, 0}, height;
  twz_points_request asked = TWZ_POINTS_REQUEST;
  twz_points *points;
  size_t n_left = 1;
  CHECK(twz_points_new(file, &asked, &points, &error) == TWZ_OK); /* no points */
  CHECK(twz_points_decode(points, NULL, &n_left, &error) == TWZ_OK && n_left == 0);
  twz_points_free(points);
  asked.n_points = 1;
  CHECK(twz_points_new(file, &asked, &points, &error) == TWZ_BAD_ARGUMENT && points == NULL);
  asked.rows = asked.cols = place;
  asked.heights = &height;
  asked.level = n;
  CHECK(twz_points_new(file, &asked, &points, &error) == TWZ_BAD_ARGUMENT && points == NULL);
  asked.level = 0;
  asked.interpolation = (twz_interpolation)2;
  CHECK(twz_points_new(file, &asked, &points, &error) == TWZ_BAD_ARGUMENT && points == NULL);
  asked.interpolation = TWZ_NEAREST;
  asked.size = 0;
  CHECK(twz_points_new(file, &asked, &points, &error) == TWZ_BAD_ARGUMENT && points == NULL);
  CHECK(strcmp(error.text, "twz_points_request.size is 0, expected sizeof(twz_points_request): begin with its macro") == 0);
  asked.size = sizeof asked;
  CHECK(twz_points_new(file, &asked, &points, &error) == TWZ_OK);
  CHECK(twz_points_decode(points, NULL, &n_left, &error) == TWZ_NOT_READY && n_left == 1);
  CHECK(twz_points_feed(points, 0, m->bytes, m->n, &error) == TWZ_BAD_ARGUMENT);
  twz_range range;
  size_t n_needed;
  CHECK(twz_points_need(points, &range, 0, &n_needed, &error) == TWZ_BAD_ARGUMENT);
  m->is_broken = 1;
  twz_file_limit_cache(file, 0);
  status = twz_points_read(points, fetch, m, NULL, &error);
  CHECK(status == TWZ_FETCH_FAILED || (status == TWZ_OK && !twz_file_info(file)->has_valid));
  m->is_broken = 0;
  CHECK(twz_points_read(points, fetch, m, NULL, &error) == TWZ_OK); /* points outlive a failed fetch */
  twz_points_free(points);
  twz_workers none = {0};
  CHECK(twz_window_new(file, 0, NULL, &window, &error) == TWZ_OK && twz_window_load(window, fetch, m, &error) == TWZ_OK);
  CHECK(twz_window_decode(window, &none, &error) == TWZ_BAD_ARGUMENT && strstr(error.text, "twz_workers.size is 0"));
  twz_window_free(window);
  twz_file_free(file);
  twz_options options = TWZ_OPTIONS;
  options.size = 0;
  CHECK(twz_file_new(&options, m->n, &file, &error) == TWZ_BAD_ARGUMENT && file == NULL);
  options.size = sizeof options;
  options.max_bytes = 500;
  file = open_memory(m, &options);
  raster r;
  CHECK(read_raster(file, m, -1, NULL, NULL, &r, &error) == TWZ_LIMIT);
  free_raster(&r);
  twz_file_free(file);
}

/* Segments that lie over each other are refused before anything is fetched for them: ranges never overlap (twz_fetch). */
static void ranges_do_not_overlap(memory *m) {
  for (int are_pages = 0; are_pages < 2; are_pages++) {
    twz_file *file = open_memory(m, NULL);
    segment *top = (segment *)table_find(&file->segments, (place){-1, 0, 0});
    section_place *payload = NULL;
    child_place *child = NULL;
    int is_changed = 0;
    for (int i = 0; i < top->n_keys && !are_pages && !is_changed; i++) {
      if (payload && top->payloads[i].length) {
        is_changed = 1;
        top->payloads[i].offset = payload->offset + payload->length - 1;
      }
      if (top->payloads[i].length) payload = &top->payloads[i];
    }
    for (int i = 0; i < top->n_heads && are_pages && !is_changed; i++) {
      if (child && top->children[i].page_length) {
        is_changed = 1;
        top->children[i].page = child->page + 1;
      }
      if (top->children[i].page_length) child = &top->children[i];
    }
    twz_window *window;
    CHECK(twz_window_new(file, -1, NULL, &window, NULL) == TWZ_OK);
    CHECK(!is_changed || twz_window_load(window, fetch, m, NULL) == TWZ_CORRUPT);
    n_overlaps += (size_t)is_changed;
    twz_window_free(window);
    twz_file_free(file);
  }
}

static void tags_are_found_by_number(memory *m) {
  twz_file *file = open_memory(m, NULL);
  for (int band = 0; band < 2; band++) {
    const json_value *tags = json_member(file->json.root, band ? "band_tags" : "tags");
    const char *key, *value;
    size_t n = 0;
    for (const json_value *tag = tags ? tags->first : NULL; tag; tag = tag->next, n++) {
      CHECK(twz_file_tag(file, band, n, &key, &value) && key == tag->key && value == tag->string);
    }
    CHECK(!twz_file_tag(file, band, n, &key, &value));
  }
  twz_file_free(file);
}

/* No file that was cut or changed is read as if it were whole: all bytes are under a checksum. */
static void damage_is_noticed(memory *m) {
  uint8_t *whole = m->bytes;
  size_t n = m->n, step = n / 200 + 1;
  for (size_t i = 0; i < 2 * n; i += step) {
    memory damaged = {malloc(n), n, 0, 0, 0};
    memcpy(damaged.bytes, whole, n);
    if (i < n) damaged.bytes[i] ^= (uint8_t)(1 << (i % 8)); else damaged.n = i - n;
    twz_file *file;
    twz_error error = {0};
    twz_status status = twz_file_new(NULL, damaged.n, &file, &error);
    if (status == TWZ_OK) status = twz_file_load(file, fetch, &damaged, &error);
    for (int level = 0; status == TWZ_OK && level < twz_file_info(file)->n_levels; level++) {
      raster r;
      status = read_raster(file, &damaged, level, NULL, NULL, &r, &error);
      free_raster(&r);
    }
    /* Bytes of meshes and digests are not looked at. */
    const twz_info *info = file ? twz_file_info(file) : NULL;
    int has_more = info && (strcmp(info->mesh_name, "none") != 0 || file->header.features & DIGESTS);
    CHECK(status == TWZ_CORRUPT || status == TWZ_UNSUPPORTED || (status == TWZ_OK && has_more && i < n));
    CHECK(status == TWZ_OK || error.text[0]);
    twz_file_free(file);
    free(damaged.bytes);
  }
}

/* ---- Files of other bytes ---- */

static void mend_header(memory *m) {
  uint32_t crc = crc32_of(tables(), m->bytes, 124);
  for (int i = 0; i < 4; i++) m->bytes[124 + i] = (uint8_t)(crc >> (8 * i));
}

static twz_status opened(memory *m, twz_error *error) {
  twz_file *file;
  twz_status status = twz_file_new(NULL, m->n, &file, error);
  if (status == TWZ_OK) status = twz_file_load(file, fetch, m, error);
  twz_file_free(file);
  return status;
}

/* The status of opening a file with another number of `width` bytes in its header, whose checksum is made right. */
static twz_status opened_with(const memory *m, size_t offset, uint64_t value, size_t width, int is_right, twz_error *error) {
  memory changed = {malloc(m->n), m->n, 0, 0, 0};
  memcpy(changed.bytes, m->bytes, m->n);
  for (size_t i = 0; i < width; i++) changed.bytes[offset + i] = (uint8_t)(value >> (8 * i));
  if (is_right) mend_header(&changed);
  twz_status status = opened(&changed, error);
  free(changed.bytes);
  return status;
}

static twz_status check_file(memory *m) {
  twz_file *file = open_memory(m, NULL);
  twz_status status = twz_file_check(file, fetch, m, NULL, NULL);
  twz_file_free(file);
  return status;
}

static void ranges_of_heights_are_limited(const memory *m) {
  static const struct { int64_t low, high; int is_good; } CASES[] = {
      {-(1 << 29), (1 << 29) - 1, 1}, {-(1 << 29), 1 << 29, 0}, {-(1 << 30), 1 << 30, 0}, {-(1 << 30), -1, 1}, {0, (1 << 30) - 1, 1}, {0, 1 << 30, 0}};
  for (size_t i = 0; i < sizeof CASES / sizeof *CASES; i++) {
    uint64_t both = (uint32_t)(CASES[i].low & UINT32_MAX) | (uint64_t)(CASES[i].high & UINT32_MAX) << 32;
    CHECK(opened_with(m, 68, both, 8, 1, NULL) == (CASES[i].is_good ? TWZ_OK : TWZ_CORRUPT));
  }
}

/* Another version has a checksum of its own; another number before the checksum of ours is damage. */
static void a_damaged_version_is_no_other_one(const memory *m) {
  for (uint64_t version = 0; version < 256; version++) {
    if (version == FORMAT_VERSION) continue;
    CHECK(opened_with(m, 8, version, 1, 0, NULL) == TWZ_CORRUPT);
    CHECK(opened_with(m, 8, version, 1, 1, NULL) == TWZ_UNSUPPORTED);
  }
  twz_error error;
  opened_with(m, 8, 1, 1, 1, &error);
  CHECK(strcmp(error.text, "found format version 1, expected 2: made by a development build: compress the raster again") == 0);
}

/* What a minor version may add (FORMAT §12.1): bits that are refused, and optional sections that are ignored. */
static void additions_are_refused_or_ignored(memory *m) {
  uint32_t features = load_u32(m->bytes + 12);
  for (int bit = 5; bit < 32; bit++) CHECK(opened_with(m, 12, features | 1u << bit, 4, 1, NULL) == TWZ_UNSUPPORTED);

  static const uint8_t SECTIONS[] = {'n', 'o', 'n', 'e', 3, 0, 0, 0, 0, 0, 0, 0, 'a', 'b', 'c', 'v', 'o', 'i', 'd', 0, 0, 0, 0, 0, 0, 0, 0};
  const size_t n_more = sizeof SECTIONS, size = HEADER_SIZE + n_more, old_size = load_u16(m->bytes + 10);
  const size_t page = old_size + load_u32(m->bytes + 76) + load_u32(m->bytes + 108);
  if (load_u64(m->bytes + page + 4) != 0) return; /* pages of several segments say where others lie */
  memory more = {malloc(m->n - old_size + size), m->n - old_size + size, 0, 0, 0};
  memcpy(more.bytes, m->bytes, HEADER_SIZE);
  memcpy(more.bytes + HEADER_SIZE, SECTIONS, n_more);
  memcpy(more.bytes + size, m->bytes + old_size, m->n - old_size);
  uint32_t crc = crc32_of(tables(), SECTIONS + 12, 3);
  for (int i = 0; i < 4; i++) more.bytes[HEADER_SIZE + 8 + i] = (uint8_t)(crc >> (8 * i));
  for (int i = 0; i < 8; i++) more.bytes[16 + i] = (uint8_t)((uint64_t)more.n >> (8 * i));
  more.bytes[10] = (uint8_t)size;
  more.bytes[11] = (uint8_t)(size >> 8);
  mend_header(&more);
  CHECK(opened(&more, NULL) == TWZ_OK && check_file(&more) == TWZ_OK);

  static const size_t WRONG[] = {4, 8, 12, 19}; /* a length, a checksum, a content, the length of the last section */
  for (size_t i = 0; i < sizeof WRONG / sizeof *WRONG; i++) {
    more.bytes[HEADER_SIZE + WRONG[i]] ^= 1;
    CHECK(opened(&more, NULL) == TWZ_CORRUPT);
    more.bytes[HEADER_SIZE + WRONG[i]] ^= 1;
  }
  memcpy(more.bytes + HEADER_SIZE + 15, SECTIONS, 4); /* one name twice */
  CHECK(opened(&more, NULL) == TWZ_CORRUPT);
  free(more.bytes);
}

/* Streams of a unit of rapid of one state and no words: no strip is decoded after the one that needs the first. */
static void cut_strips_end_where_they_are_cut(twz_file *file) {
  enum { SIZE = 257 };
  uint8_t payload[8 + PAYLOAD_SLACK] = {0, 0, 0, 0, 0x00, 0x00, 0x00, 0xFF}; /* wide, no shift, no words, no raw bits */
  static int32_t above[(SIZE + 1) / 2 * ((SIZE + 1) / 2)], heights[SIZE * SIZE];
  layer up = {.heights = above}, l = {.heights = heights, .ready = {0, 0, SIZE, SIZE}};
  up.rows.n = up.cols.n = (SIZE + 1) / 2;
  l.rows.n = l.cols.n = SIZE;
  for (size_t k = 0; k < SIZE * SIZE; k++) heights[k] = INT32_MIN;
  const job j = {.file = file, .level = 1, .out = &l, .parent = {.layer = &up}};
  const reader bytes = {payload, 8, 0};
  scratch s = {.allocator = &file->allocator};
  twz_error error;
  CHECK(decode_rapid(&j, &bytes, &s, &error) == TWZ_CORRUPT && strstr(error.text, "cut"));
  size_t n_left = 0;
  for (size_t k = 0; k < SIZE * SIZE; k++) n_left += heights[k] == INT32_MIN;
  CHECK(n_left > SIZE * SIZE / 2);
  scratch_free(&s);
}

/* A root that is cut at once: what lies below the first rows is not decoded. */
static void cut_streams_end_where_they_are_cut(memory *m) {
  twz_file *file = open_memory(m, NULL);
  if (file->header.method == TWZ_RAPID) cut_strips_end_where_they_are_cut(file);
  const int method = file->header.method, is_cdf97 = method == TWZ_CDF97;
  if (is_cdf97 || method == TWZ_PREDICTIVE) {
    static const uint8_t PAYLOADS[3][4] = {{2, 0}, {4, 1, 0}, {0}}; /* residuals, raw heights; predictive */
    static const size_t SIZES[3] = {2, 3, 1};
    const place root = {-1, 0, 0};
    layer l = {0};
    unit_axes(&file->grid, root, 0, &l.rows, &l.cols);
    size_t n = (size_t)l.rows.n * (size_t)l.cols.n;
    l.heights = malloc(n * sizeof *l.heights);
    const job j = {.file = file, .key = root, .out = &l};
    scratch s = {.allocator = &file->allocator};
    for (int i = is_cdf97 ? 0 : 2; i < (is_cdf97 ? 2 : 3); i++) {
      const reader bytes = {PAYLOADS[i], SIZES[i], 0};
      const int32_t untouched = INT32_MIN;
      for (size_t k = 0; k < n; k++) l.heights[k] = untouched;
      twz_status status = is_cdf97 ? decode_cdf97(&j, &bytes, &s, NULL) : decode_predictive(&j, &bytes, &s, NULL);
      CHECK(status == TWZ_CORRUPT);
      if (i == 1) continue; /* bits of raw heights are few: the stream ends by itself */
      size_t n_left = 0;
      for (size_t k = 0; k < n; k++) n_left += l.heights[k] == untouched;
      CHECK(l.rows.n < 4 || n_left > n / 2);
    }
    free(l.heights);
    scratch_free(&s);
  }
  twz_file_free(file);
}

/* ---- Parts that need no file ---- */

static void checksums_are_those_of_the_format(void) {
  CHECK(crc32_of(tables(), (const uint8_t *)"123456789", 9) == 0xCBF43926u); /* FORMAT §1.3 */
  CHECK(crc32_of(tables(), NULL, 0) == 0);
}

/* The number in a text as json.c reads it; NAN: refused. */
static double number_of(const char *text) {
  char whole[2000];
  twz_allocator plain = {0};
  json_document d = {&plain, NULL, NULL};
  snprintf(whole, sizeof whole, "{\"x\":%s}", text);
  double x = json_parse(&d, whole, strlen(whole), NULL) == TWZ_OK ? json_number(json_member(d.root, "x")) : NAN;
  json_free(&d);
  return x;
}

static void numbers_are_the_nearest_ones(void) {
  static const char *const HARD[] = {"0.1", "1e22", "1e23", "9007199254740993", "9007199254740992.99999", "4.9e-324", "2.4703282292062327e-324",
                                     "2.4703282292062328e-324", "2.2250738585072011e-308", "2.2250738585072014e-308", "1.7976931348623157e308",
                                     "123456789012345678901234567890", "0.000001e-300", "-0.0", "6.0221409e+23", "0e999999999",
                                     "0.50000000000000011102230246251565404236316680908203125", "8.98846567431158e307"};
  for (size_t i = 0; i < sizeof HARD / sizeof *HARD; i++) CHECK(number_of(HARD[i]) == strtod(HARD[i], NULL));
  for (int i = 0; i < 30000; i++) { /* whatever digits and exponents */
    char text[1100];
    int n = 0;
    uint32_t most = i % 16 ? 25 : 1000; /* digits after the point: at times more than are kept */
    if (below(2)) text[n++] = '-';
    n += snprintf(text + n, sizeof text - (size_t)n, "%u", 1 + below(9));
    for (uint32_t k = below(25); k > 0; k--) text[n++] = (char)('0' + below(10));
    text[n++] = '.';
    for (uint32_t k = 1 + below(most); k > 0; k--) text[n++] = (char)('0' + below(10));
    snprintf(text + n, sizeof text - (size_t)n, "e%d", (int)below(620) - 330);
    double x = strtod(text, NULL), y = number_of(text);
    if (isinf(x) ? !isnan(y) : x != y) {
      fprintf(stderr, "%s: %.17g instead of %.17g\n", text, y, x);
      n_failed++;
    }
  }
  /* Half way between 1 and the next double, and hardly more, by digits that are not kept. */
  char half[1100] = "1.00000000000000011102230246251565404236316680908203125";
  size_t n_half = strlen(half);
  memset(half + n_half, '0', 1000);
  CHECK(number_of(half) == 1);
  half[n_half + 999] = '1';
  CHECK(number_of(half) == 1 + DBL_EPSILON);
  /* Half way from the greatest double to 2^1024: from here on numbers are not finite. */
  static const char BEYOND[] =
      "1797693134862315807937289714053034150799341327100378269361737789804449682927647509466490179775872070963"
      "3028641669288791094655554785194040263065748867150582068190890200070838367627385484581771153176447573027"
      "0069855571366959622842914819860834936475292719074168444365510704342711559699508093042880177904174497792";
  char near[400];
  memcpy(near, BEYOND, sizeof BEYOND);
  CHECK(isnan(number_of(near)));
  near[307] = '8'; /* instead of 9 */
  CHECK(number_of(near) == DBL_MAX);
  strcat(near, ".99999e0");
  CHECK(number_of(near) == DBL_MAX);
  CHECK(number_of("1.797693134862315807e308") == DBL_MAX && isnan(number_of("1.7976931348623158079373e308")));
  char long_one[1900] = "0.";
  memset(long_one + 2, '0', 1800);
  strcpy(long_one + 1802, "5e1800");
  CHECK(number_of(long_one) == 0.5);
  memset(long_one + 2, '5', 1800);
  CHECK(number_of(long_one) == strtod(long_one, NULL) || isinf(strtod(long_one, NULL)));
  static const char *const WRONG[] = {"01", "1.", ".5", "-", "+1", "1e", "1e400", "-1e999999999999999999999", "NaN", "Infinity", "0x1", "1 1"};
  for (size_t i = 0; i < sizeof WRONG / sizeof *WRONG; i++) CHECK(isnan(number_of(WRONG[i])));
}

static void escapes_are_the_characters_they_name(void) {
  static const char TEXT[] = "{\"a\": \"\\u0041\\u00e9\\u20AC\\ud83d\\uDE00\\u007f\\u0080\\u07ff\\u0800\\n\\\\\"}";
  twz_allocator plain = {0};
  json_document d = {&plain, NULL, NULL};
  CHECK(json_parse(&d, TEXT, strlen(TEXT), NULL) == TWZ_OK);
  CHECK(strcmp(json_member(d.root, "a")->string,
               "A\xc3\xa9\xe2\x82\xac\xf0\x9f\x98\x80\x7f\xc2\x80\xdf\xbf\xe0\xa0\x80\n\\") == 0);
  json_free(&d);
}

static void texts_are_checked(void) {
  static const struct { const char *text; int is_good; } CASES[] = {
      {"{}", 1}, {" { } ", 1}, {"{\"a\":[1,{\"b\":null}],\"c\":\"\\u00e9\\ud83d\\ude00\"}", 1}, {"[]", 0}, {"{", 0}, {"{\"a\"}", 0},
      {"{\"a\":1,}", 0}, {"{\"a\":1,\"a\":2}", 0}, {"{\"a\":{\"b\":1,\"b\":1}}", 0}, {"{\"a\":1,\"\\u0061\":2}", 0}, {"{\"a\":\"\\ud800\"}", 0},
      {"{\"a\":\"\x01\"}", 0}, {"{\"a\":\"\\x\"}", 0}, {"{\"a\":\"\xff\"}", 0}, {"{\"a\":\"\xc0\x80\"}", 0}, {"{\"a\":\"\xed\xa0\x80\"}", 0},
      {"{\"a\":\"\xf4\x90\x80\x80\"}", 0}, {"{\"a\":\"\xf4\x8f\xbf\xbf\"}", 1}, {"{\"a\":truex}", 0}, {"{\"a\":tru}", 0}, {"{}{}", 0}, {"", 0},
      {"{\"a\":[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]}", 1}, {"{\"a\":[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]}", 0}, {"{\"a\":\"b", 0}, {"{\"a\":\"b\\", 0}};
  twz_allocator plain = {0};
  for (size_t i = 0; i < sizeof CASES / sizeof *CASES; i++) {
    json_document d = {&plain, NULL, NULL};
    int is_good = json_parse(&d, CASES[i].text, strlen(CASES[i].text), NULL) == TWZ_OK;
    json_free(&d);
    if (is_good != CASES[i].is_good) {
      fprintf(stderr, "case %u: %s\n", (unsigned)i, CASES[i].text);
      n_failed++;
    }
  }
}

int main(int n, char **files) {
  twz_pool *pool;
  CHECK(twz_pool_new(3, &pool, NULL) == TWZ_OK);
  CHECK(twz_version() == TWZ_VERSION_MAJOR * 10000 + TWZ_VERSION_MINOR * 100 + TWZ_VERSION_PATCH);
  char numbers[40];
  snprintf(numbers, sizeof numbers, "%d.%d.%d", TWZ_VERSION_MAJOR, TWZ_VERSION_MINOR, TWZ_VERSION_PATCH);
  CHECK(strncmp(TWZ_VERSION, numbers, strlen(numbers)) == 0);
  checksums_are_those_of_the_format();
  numbers_are_the_nearest_ones();
  escapes_are_the_characters_they_name();
  texts_are_checked();
  for (int i = 1; i < n; i++) {
    path = files[i];
    memory m = read_memory(path);
    windows_are_parts_of_the_whole(&m);
    all_ways_agree(&m, pool);
    bytes_may_come_in_any_portions(&m);
#if !defined(_WIN32)
    threads_may_share_a_file(&m, pool);
#endif
    a_window_in_the_cache_needs_no_bytes(&m);
    the_cache_counts_what_it_holds(&m);
    units_in_use_are_in_no_list(&m);
    rows_may_lie_anywhere(&m);
    windows_may_be_decoded_into_memory(&m, pool);
    heights_at_points_are_those_of_samples(&m, pool);
    units_of_points_are_read_once(&m);
    points_keep_to_their_memory(&m);
    borrowed_files_need_no_bytes(&m);
    borrowed_payloads_are_not_copied(&m);
    the_cache_can_be_limited(&m);
    long_calls_report_and_can_be_ended(&m, pool);
    roots_agree(&m);
    a_refused_window_holds_nothing(&m);
    a_damaged_version_is_no_other_one(&m);
    additions_are_refused_or_ignored(&m);
    cut_streams_end_where_they_are_cut(&m);
    if (strstr(path, "store-int16-segments")) ranges_of_heights_are_limited(&m);
    ranges_do_not_overlap(&m);
    tags_are_found_by_number(&m);
    CHECK(check_file(&m) == TWZ_OK);
    no_memory_is_an_error(&m);
    own_samples_of_parts_are_those_of_the_window(&m);
    calls_that_are_wrong_say_so(&m);
    damage_is_noticed(&m);
    free(m.bytes);
  }
  CHECK(n == 1 || (n_parts > 100 && n_overlaps > 10 && n_between > 10000 && n_lent > 100 && n_reports > 100 && n_ended > 100 && n_roots > 0));
  twz_pool_free(pool);
  if (n_failed) fprintf(stderr, "%d checks failed\n", n_failed);
  return n_failed != 0;
}
