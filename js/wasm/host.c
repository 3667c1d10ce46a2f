/*
 * Functions that js/src/core.js calls: one file in an instance, and one window at a time. They return a twz_status, those
 * with `need` in their name the number of ranges, or a status less than 0. Sizes and offsets are doubles, which
 * hold them exactly: no BigInt crosses.
 */
#include <stdlib.h>

#include "host.h"

enum { MOST_RANGES = 1024 };

twz_file *file;
twz_error error;
twz_range ranges[MOST_RANGES];
uint8_t *given;
size_t n_given;
double told[3 * MOST_RANGES];
static twz_window *window;
static twz_box box;
static uint8_t *raw, *valid, *own; /* of rows of the window */
static size_t n_raw;

EXPORT(error_text) const char *error_text(void) { return error.text; }

/* Numbers that the last call told: three for each range, or those of its comment. */
EXPORT(numbers) const double *numbers(void) { return told; }

/* Room for n bytes of the file; NULL: there is none. */
EXPORT(room_for) uint8_t *room_for(size_t n) {
  if (n <= n_given) return given;
  free(given);
  given = malloc(n);
  n_given = given ? n : 0;
  return given;
}

int ranges_told(twz_status status, size_t n) {
  if (status != TWZ_OK) return -(int)status;
  for (size_t i = 0; i < n; i++) {
    told[3 * i] = (double)ranges[i].offset;
    told[3 * i + 1] = (double)ranges[i].length;
    told[3 * i + 2] = (double)ranges[i].is_page;
  }
  return (int)n;
}

/* ---- The file ---- */

EXPORT(begin_file) int begin_file(double size, double cache_bytes, double max_bytes) {
  twz_options options = TWZ_OPTIONS;
  options.cache_bytes = (uint64_t)cache_bytes;
  options.max_bytes = (uint64_t)max_bytes;
  return twz_file_new(&options, (uint64_t)size, &file, &error);
}

/* Give all memory back; another file may begin. */
EXPORT(end_file) void end_file(void) {
  twz_file_free(file);
  free(given);
  free(raw);
  free(valid);
  free(own);
  file = NULL;
  given = raw = valid = own = NULL;
  n_given = n_raw = 0;
}

EXPORT(file_need) int file_need(void) {
  size_t n;
  twz_status status = twz_file_need(file, ranges, MOST_RANGES, &n, &error);
  return ranges_told(status, n);
}

EXPORT(feed_file) int feed_file(double offset, size_t n) { return twz_file_feed(file, (uint64_t)offset, given, n, &error); }

/* Tell rows, columns, levels, block size, dtype, bytes of it, method, features, max_error, effective_bound, whether there is
 * nodata and which, where the metadata are and their length, least and greatest raw height, how far rounding to quanta moved them,
 * and the side of the bound. */
EXPORT(describe) void describe(void) {
  const twz_info *i = twz_file_info(file);
  const double all[] = {i->n_rows, i->n_cols, i->n_levels, i->block_size, i->dtype, (double)i->dtype_bytes,
                        i->method, i->features, i->max_error, i->effective_bound, i->has_nodata, i->nodata,
                        (double)(uintptr_t)i->metadata, (double)i->metadata_length, i->raw_min, i->raw_max, i->raw_rho,
                        i->bound_side};
  memcpy(told, all, sizeof all);
}

/* ---- A window ---- */

EXPORT(begin_window) int begin_window(int level, uint32_t row, uint32_t col, uint32_t n_rows, uint32_t n_cols) {
  twz_box wanted = {row, col, n_rows, n_cols};
  box = wanted;
  return twz_window_new(file, level, &box, &window, &error);
}

/* Keep so many bytes of decoded units from now on. */
EXPORT(limit_cache) void limit_cache(double n_bytes) { file->cache_bytes = (uint64_t)n_bytes; }

EXPORT(end_window) void end_window(void) {
  twz_window_free(window);
  window = NULL;
}

EXPORT(window_need) int window_need(void) {
  size_t n;
  twz_status status = twz_window_need(window, ranges, MOST_RANGES, &n, &error);
  return ranges_told(status, n);
}

EXPORT(feed_window) int feed_window(double offset, size_t n) {
  return twz_window_feed(window, (uint64_t)offset, given, n, &error);
}

EXPORT(decode_window) int decode_window(void) { return twz_window_decode(window, NULL, &error); }

/* Read n rows of a decoded window from a row of it on. Tell where heights and validity are, until the next call, and if
 * `is_exact` the validity in the full grid, without fills. */
EXPORT(read_rows) int read_rows(uint32_t row, uint32_t n_rows, int is_exact) {
  twz_box part = {box.row + row, box.col, n_rows, box.n_cols};
  size_t n = (size_t)n_rows * box.n_cols, size = twz_file_info(file)->dtype_bytes;
  if (n > n_raw) {
    free(raw);
    free(valid);
    free(own);
    raw = malloc(n * size);
    valid = malloc(n);
    own = malloc(n);
    n_raw = raw && valid && own ? n : 0;
    if (n_raw == 0) return twz_no_memory(&error, n * size);
  }
  TRY(twz_window_read_part(window, &part, raw, 0, valid, 0, &error));
  if (is_exact) TRY(twz_window_read_own_part(window, &part, own, 0, &error));
  told[0] = (double)(uintptr_t)raw;
  told[1] = (double)(uintptr_t)valid;
  told[2] = (double)(uintptr_t)own;
  return TWZ_OK;
}

/* Tell the error of a block of the window's level, in raw units; TWZ_NOT_READY: more of the index is needed first. */
EXPORT(block_error) int block_error(uint32_t row, uint32_t col) {
  twz_block block;
  TRY(twz_window_block(window, row, col, &block, &error));
  told[0] = (double)block.error * (double)file->header.quantum_num / (double)file->header.quantum_den;
  return TWZ_OK;
}
