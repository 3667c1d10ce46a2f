#include "terrainwave.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
static double cpu(void) { struct timespec t; clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t); return t.tv_sec + 1e-9 * t.tv_nsec; }
static unsigned char *bytes; static long size;
static int fetch(void *s, size_t n, const twz_range *r, void *const *b) { for (size_t i = 0; i < n; i++) memcpy(b[i], bytes + r[i].offset, r[i].length); return 0; }
int main(int ac, char **av) {
  FILE *f = fopen(av[1], "rb"); fseek(f, 0, SEEK_END); size = ftell(f); rewind(f); bytes = malloc(size); if (fread(bytes, 1, size, f) != size) return 1;
  int runs = atoi(av[2]); double tot[99]; double N = 0;
  for (int k = 0; k < runs; k++) {
    double t0 = cpu(); twz_options o = TWZ_OPTIONS; o.cache_bytes = 0; if (ac > 3) o.kernels = atoi(av[3]); twz_error e; twz_file *file; twz_window *w;
    if (twz_file_new(&o, size, &file, &e) || twz_file_load(file, fetch, 0, &e)) { puts(e.text); return 1; }
    const twz_info *i = twz_file_info(file); N = (double)i->n_rows * i->n_cols; void *out = malloc(N * i->dtype_bytes);
    if (twz_window_new(file, i->n_levels - 1, NULL, &w, &e) || twz_window_load(w, fetch, 0, &e) || twz_window_decode(w, NULL, &e) || twz_window_read(w, out, i->n_cols * i->dtype_bytes, NULL, 0, &e)) { puts(e.text); return 1; }
    twz_window_free(w); twz_file_free(file); free(out); tot[k] = cpu() - t0;
  }
  for (int a = 0; a < runs; a++) for (int b = a + 1; b < runs; b++) if (tot[b] < tot[a]) { double x = tot[a]; tot[a] = tot[b]; tot[b] = x; }
  printf("today %s: min %.2f median %.2f ns/sample\n", av[1], 1e9 * tot[0] / N, 1e9 * tot[runs / 2] / N);
}
