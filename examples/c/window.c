/*
 * Read a window of a .twz file and print its heights: window FILE ROW COLUMN ROWS COLUMNS [LEVEL]
 *
 *     cc window.c $(pkg-config --cflags --libs terrainwave) -o window
 */
#include <stdio.h>
#include <stdlib.h>
#include <terrainwave.h>

/* Read the ranges of bytes that the library asks for. */
static int fetch(void *source, size_t n, const twz_range *ranges, void *const *buffers) {
  for (size_t i = 0; i < n; i++) {
    if (fseek(source, (long)ranges[i].offset, SEEK_SET) != 0) return 1;
    if (fread(buffers[i], 1, (size_t)ranges[i].length, source) != ranges[i].length) return 1;
  }
  return 0;
}

static double height_of(const twz_info *info, const void *heights, size_t i) {
  double raw = 0;
  switch (info->dtype) {
    case TWZ_UINT8: raw = ((const uint8_t *)heights)[i]; break;
    case TWZ_UINT16: raw = ((const uint16_t *)heights)[i]; break;
    case TWZ_INT16: raw = ((const int16_t *)heights)[i]; break;
    case TWZ_INT32: raw = ((const int32_t *)heights)[i]; break;
    case TWZ_FLOAT32: raw = ((const float *)heights)[i]; break;
    case TWZ_FLOAT64: raw = ((const double *)heights)[i]; break;
  }
  return raw * info->scale + info->offset;
}

static int failed(const char *path, const twz_error *error) {
  fprintf(stderr, "%s: %s\n", path, error->text);
  return 1;
}

/* Print heights row by row; void samples are "-". */
static twz_status print_window(twz_file *file, FILE *source, int level, const twz_box *box, twz_error *error) {
  const twz_info *info = twz_file_info(file);
  size_t n = (size_t)box->n_rows * box->n_cols;
  twz_window *window;
  twz_status status = twz_window_new(file, level, box, &window, error);
  if (status != TWZ_OK) return status;
  void *heights = malloc(n * info->dtype_bytes);
  uint8_t *valid = malloc(n);
  if (!heights || !valid) exit(1);
  status = twz_window_load(window, fetch, source, error);
  if (status == TWZ_OK) status = twz_window_decode(window, NULL, error);
  if (status == TWZ_OK) status = twz_window_read(window, heights, 0, valid, 0, error);
  for (size_t i = 0; status == TWZ_OK && i < n; i++) {
    if (valid[i]) {
      printf("%g", height_of(info, heights, i));
    } else {
      putchar('-');
    }
    putchar((i + 1) % box->n_cols ? ' ' : '\n');
  }
  free(heights);
  free(valid);
  twz_window_free(window);
  return status;
}

int main(int n, char **arguments) {
  if (n < 6) {
    fprintf(stderr, "window FILE ROW COLUMN ROWS COLUMNS [LEVEL]\n");
    return 2;
  }
  const char *path = arguments[1];
  uint32_t numbers[4];
  for (int i = 0; i < 4; i++) numbers[i] = (uint32_t)strtoul(arguments[2 + i], NULL, 10);
  const twz_box box = {numbers[0], numbers[1], numbers[2], numbers[3]};
  FILE *source = fopen(path, "rb");
  if (!source || fseek(source, 0, SEEK_END) != 0) {
    perror(path);
    return 1;
  }
  twz_file *file;
  twz_error error;
  if (twz_file_new(NULL, (uint64_t)ftell(source), &file, &error) != TWZ_OK) return failed(path, &error);
  twz_status status = twz_file_load(file, fetch, source, &error);
  if (status == TWZ_OK) status = print_window(file, source, n > 6 ? atoi(arguments[6]) : -1, &box, &error);
  twz_file_free(file);
  fclose(source);
  return status == TWZ_OK ? 0 : failed(path, &error);
}
