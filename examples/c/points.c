/*
 * Print heights at points of a .twz file: points FILE X Y [X Y ...], in the file's coordinates
 *
 *     cc points.c $(pkg-config --cflags --libs terrainwave) -o points
 *
 * The file is read into memory as a whole, and lent to the library. Ctrl-C ends a long call.
 */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <terrainwave.h>

static volatile sig_atomic_t is_ended;

static void end(int number) {
  (void)number;
  is_ended = 1;
}

/* Called by the library between pieces of work. */
static int report(void *context, uint64_t n_done, uint64_t n_all) {
  (void)context;
  if (n_all > 1000) fprintf(stderr, "\r%3d %%", (int)(100 * n_done / n_all));
  return is_ended;
}

static void *read_file(const char *path, size_t *n) {
  FILE *source = fopen(path, "rb");
  if (!source || fseek(source, 0, SEEK_END) != 0) return NULL;
  *n = (size_t)ftell(source);
  rewind(source);
  void *bytes = malloc(*n ? *n : 1);
  if (bytes && fread(bytes, 1, *n, source) != *n) {
    free(bytes);
    bytes = NULL;
  }
  fclose(source);
  return bytes;
}

/* Rows and columns of a point: the inverse of twz_info.transform, whose pixel (0, 0) has its centre at 0, 0 here. */
static int find_place(const twz_info *info, double x, double y, double *row, double *col) {
  const double *t = info->transform, whole = t[0] * t[4] - t[1] * t[3];
  if (whole == 0) return 0;
  *col = (t[4] * (x - t[2]) - t[1] * (y - t[5])) / whole - 0.5;
  *row = (t[0] * (y - t[5]) - t[3] * (x - t[2])) / whole - 0.5;
  return 1;
}

static twz_status print_heights(twz_file *file, size_t n, char **numbers, twz_error *error) {
  const twz_info *info = twz_file_info(file);
  double *places = malloc(3 * n * sizeof *places);
  if (!places) exit(1);
  twz_points_request request = TWZ_POINTS_REQUEST;
  request.n_points = n;
  request.rows = places;
  request.cols = places + n;
  request.heights = places + 2 * n;
  for (size_t i = 0; i < n; i++) {
    if (!find_place(info, atof(numbers[2 * i]), atof(numbers[2 * i + 1]), &places[i], &places[n + i])) exit(1);
  }
  twz_workers workers = TWZ_WORKERS;
  workers.report = report;
  twz_points *points;
  twz_status status = twz_points_new(file, &request, &points, error);
  if (status == TWZ_OK) status = twz_points_read(points, NULL, NULL, &workers, error); /* nothing is fetched */
  for (size_t i = 0; status == TWZ_OK && i < n; i++) {
    double raw = request.heights[i];
    if (raw == raw) {
      printf("%g\n", raw * info->scale + info->offset);
    } else {
      puts("-"); /* void, or outside */
    }
  }
  twz_points_free(points);
  free(places);
  return status;
}

int main(int n, char **arguments) {
  if (n < 4 || n % 2) {
    fprintf(stderr, "points FILE X Y [X Y ...]\n");
    return 2;
  }
  signal(SIGINT, end);
  size_t n_bytes = 0;
  void *bytes = read_file(arguments[1], &n_bytes);
  if (!bytes) {
    perror(arguments[1]);
    return 1;
  }
  twz_file *file;
  twz_error error;
  twz_status status = twz_file_new(NULL, n_bytes, &file, &error);
  if (status == TWZ_OK) status = twz_file_borrow(file, bytes, &error);
  if (status == TWZ_OK) status = print_heights(file, (size_t)(n - 2) / 2, arguments + 2, &error);
  if (status != TWZ_OK) fprintf(stderr, "%s: %s\n", arguments[1], error.text);
  twz_file_free(file);
  free(bytes); /* after the file */
  return status != TWZ_OK;
}
