/*
 * Any bytes as a .twz file: an error or heights, in bounded time and memory, and the same from all kernels.
 * libFuzzer's target; with TWZ_REPLAY a program that does the same with the files that it is given.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "mutate.h"
#include "terrainwave.h"

enum { SIDE = 90 };

typedef struct memory {
  const uint8_t *bytes;
  size_t n;
} memory;

static int fetch(void *source, size_t n, const twz_range *ranges, void *const *buffers) {
  const memory *m = source;
  for (size_t i = 0; i < n; i++) {
    if (ranges[i].offset > m->n || ranges[i].length > m->n - ranges[i].offset) abort(); /* never asked for */
    memcpy(buffers[i], m->bytes + ranges[i].offset, (size_t)ranges[i].length);
  }
  return 0;
}

/* A number that follows from all that was read. */
static uint64_t mix(uint64_t before, const void *bytes, size_t n) {
  const uint8_t *at = bytes;
  for (size_t i = 0; i < n; i++) before = (before ^ at[i]) * 1099511628211u;
  return before;
}

static uint64_t read_window(twz_file *file, int level, const twz_box *box, memory *source, uint64_t so_far) {
  static double heights[SIDE * SIDE]; /* room for each dtype */
  static uint8_t valid[SIDE * SIDE];
  twz_error error;
  twz_window *window;
  if (twz_window_new(file, level, box, &window, &error) != TWZ_OK) return mix(so_far, &error.status, sizeof error.status);
  twz_status status = twz_window_load(window, fetch, source, &error);
  if (status == TWZ_OK) status = twz_window_decode(window, NULL, &error);
  if (status == TWZ_OK) status = twz_window_read(window, heights, 0, valid, 0, &error);
  so_far = mix(so_far, &status, sizeof status);
  if (status == TWZ_OK) {
    size_t n = (size_t)box->n_rows * box->n_cols;
    so_far = mix(mix(so_far, heights, n * twz_file_info(file)->dtype_bytes), valid, n);
    if (twz_window_read_own(window, valid, 0, &error) == TWZ_OK) so_far = mix(so_far, valid, n);
    twz_block block;
    uint32_t size = twz_file_info(file)->block_size;
    memset(&block, 0, sizeof block);
    if (twz_window_block(window, box->row / size, box->col / size, &block, &error) == TWZ_OK) {
      so_far = mix(so_far, &block.error, sizeof block.error);
    }
  }
  twz_window_free(window);
  return so_far;
}

/* Heights at points of a level from one end to the other, and at its edges. */
static uint64_t read_points(twz_file *file, int level, const twz_level *size, memory *source, uint64_t so_far) {
  enum { N = 9 };
  double rows[N], cols[N], heights[N];
  twz_error error;
  twz_points *points;
  twz_points_request request = TWZ_POINTS_REQUEST;
  request.level = level;
  request.interpolation = level % 2 ? TWZ_NEAREST : TWZ_BILINEAR;
  request.n_points = N;
  request.rows = rows;
  request.cols = cols;
  request.heights = heights;
  for (int i = 0; i < N; i++) {
    rows[i] = (size->n_rows - 1) * (i / (N - 1.0));
    cols[i] = (size->n_cols - 1) * ((i * 5 % N) / (N - 1.0));
  }
  twz_status status = twz_points_new(file, &request, &points, &error);
  if (status == TWZ_OK) status = twz_points_read(points, fetch, source, NULL, &error);
  twz_points_free(points);
  so_far = mix(so_far, &status, sizeof status);
  return status == TWZ_OK ? mix(so_far, heights, sizeof heights) : so_far;
}

/* The same bytes in memory: nothing is read beyond them. What is wrong may be found elsewhere. */
static void read_borrowed(const uint8_t *bytes, size_t n) {
  twz_options options = TWZ_OPTIONS;
  options.max_bytes = (uint64_t)64 << 20;
  twz_file *file;
  twz_error error;
  if (twz_file_new(&options, n, &file, &error) != TWZ_OK) return;
  if (twz_file_borrow(file, bytes, &error) == TWZ_OK) {
    for (int level = 0; level < twz_file_info(file)->n_levels; level++) {
      twz_level size;
      twz_file_level(file, level, &size, &error);
      read_points(file, level, &size, NULL, 0);
    }
  }
  twz_file_free(file);
}

/* The first samples of each level and the last ones. */
static uint64_t read_all(const uint8_t *bytes, size_t n, twz_kernels kernels) {
  twz_options options = TWZ_OPTIONS;
  options.kernels = kernels;
  options.max_bytes = (uint64_t)64 << 20;
  options.cache_bytes = 1 << 20;
  twz_file *file;
  twz_error error;
  memory source = {bytes, n};
  uint64_t found = 14695981039346656037u;
  if (twz_file_new(&options, n, &file, &error) != TWZ_OK) return 0; /* kernels that are not here */
  twz_status status = twz_file_load(file, fetch, &source, &error);
  found = mix(found, &status, sizeof status);
  for (int level = 0; status == TWZ_OK && level < twz_file_info(file)->n_levels; level++) {
    twz_level size;
    twz_file_level(file, level, &size, &error);
    twz_box box = {0, 0, size.n_rows < SIDE ? size.n_rows : SIDE, size.n_cols < SIDE ? size.n_cols : SIDE};
    found = read_window(file, level, &box, &source, found);
    found = read_points(file, level, &size, &source, found);
    if (size.n_rows == box.n_rows && size.n_cols == box.n_cols) continue;
    box.row = size.n_rows - box.n_rows;
    box.col = size.n_cols - box.n_cols;
    found = read_window(file, level, &box, &source, found);
  }
  twz_file_free(file);
  return found ? found : 1;
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n) {
  uint64_t baseline = read_all(bytes, n, TWZ_KERNELS_BASELINE);
  read_borrowed(bytes, n);
  if (n < 35 || bytes[34] != TWZ_RAPID) return 0; /* other methods have one kind of kernels */
  uint64_t found = read_all(bytes, n, baseline & 1 ? TWZ_KERNELS_AVX2 : TWZ_KERNELS_AVX512);
  if (found && found != baseline) abort();
  return 0;
}

#if !defined(TWZ_REPLAY)
size_t LLVMFuzzerMutate(uint8_t *bytes, size_t n, size_t most);

/* Most inputs are made with the knowledge of what a file has; some without. */
size_t LLVMFuzzerCustomMutator(uint8_t *bytes, size_t n, size_t most, unsigned seed);
size_t LLVMFuzzerCustomMutator(uint8_t *bytes, size_t n, size_t most, unsigned seed) {
  size_t n_new = seed % 4 ? mutate_file(bytes, n, most, NULL, 0, seed, LLVMFuzzerMutate) : 0;
  return n_new ? n_new : LLVMFuzzerMutate(bytes, n, most);
}

size_t LLVMFuzzerCustomCrossOver(const uint8_t *bytes, size_t n, const uint8_t *other, size_t n_other, uint8_t *to, size_t most,
                                 unsigned seed);
size_t LLVMFuzzerCustomCrossOver(const uint8_t *bytes, size_t n, const uint8_t *other, size_t n_other, uint8_t *to, size_t most,
                                 unsigned seed) {
  if (n > most) return 0;
  memcpy(to, bytes, n);
  return mutate_file(to, n, most, other, n_other, seed, LLVMFuzzerMutate);
}
#else
int main(int n, char **arguments) {
  for (int i = 1; i < n; i++) {
    FILE *file = fopen(arguments[i], "rb");
    if (!file || fseek(file, 0, SEEK_END) != 0) return 1;
    long size = ftell(file);
    uint8_t *bytes = malloc(size > 0 ? (size_t)size : 1);
    rewind(file);
    if (!bytes || fread(bytes, 1, (size_t)size, file) != (size_t)size) return 1;
    fclose(file);
    LLVMFuzzerTestOneInput(bytes, (size_t)size);
    free(bytes);
  }
  return 0;
}
#endif
