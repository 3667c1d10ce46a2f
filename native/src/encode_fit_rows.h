/* Sums of samples that fits look at (encode_fit.h), compiled for a set of instructions. */
#include "encode_fit.h"

static void ISA(fit_errors)(const double *values, int64_t n, int64_t step, const double *weights, int32_t n_sets, double whole, double unit,
                            double *errors) {
  double taps[FIT_COLUMNS][FIT_BLOCK], sums[FIT_BLOCK];
  for (int64_t begin = 0; begin < n; begin += FIT_BLOCK) {
    for (int32_t k = 0; k < FIT_BLOCK; k++) {
      for (int32_t tap = 0; tap < FIT_COLUMNS; tap++) taps[tap][k] = values[(begin + k) * step * FIT_COLUMNS + tap];
    }
    for (int32_t set = 0; set < n_sets; set++) {
      const double *own = weights + (ptrdiff_t)set * FIT_TAPS;
      double *RESTRICT to = errors + set * n + begin;
      for (int32_t k = 0; k < FIT_BLOCK; k++) sums[k] = own[0] * taps[0][k];
      for (int32_t tap = 1; tap < FIT_TAPS; tap++) {
        for (int32_t k = 0; k < FIT_BLOCK; k++) sums[k] += own[tap] * taps[tap][k];
      }
      for (int32_t k = 0; k < FIT_BLOCK; k++) to[k] = (taps[FIT_TAPS][k] * whole - sums[k]) * unit;
    }
  }
}

/* The upper triangle alone. */
static void ISA(fit_products)(const double *values, int64_t n, int64_t step, const double *roots, double unit, double *products) {
  enum { SAMPLES = 4, PIECE = 8, WIDTH = 32 };
  double all[FIT_TAPS][WIDTH] = {{0}}, rows[SAMPLES][WIDTH] = {{0}};
  for (int64_t begin = 0; begin < n; begin += SAMPLES) {
    for (int64_t i = 0; i < SAMPLES; i++) {
      const double *RESTRICT row = values + (begin + i) * step * FIT_COLUMNS;
      for (int32_t tap = 0; tap < FIT_COLUMNS; tap++) rows[i][tap] = nearest(row[tap] * roots[begin + i] * unit);
    }
    for (int32_t tap = 0; tap < FIT_TAPS; tap++) {
      const double a = rows[0][tap], b = rows[1][tap], c = rows[2][tap], d = rows[3][tap];
      double *RESTRICT to = all[tap];
      for (int32_t j = tap & -PIECE; j < WIDTH; j++) to[j] += a * rows[0][j] + b * rows[1][j] + (c * rows[2][j] + d * rows[3][j]);
    }
  }
  for (int32_t tap = 0; tap < FIT_TAPS; tap++) {
    for (int32_t j = tap; j < FIT_COLUMNS; j++) products[tap * FIT_COLUMNS + j] = all[tap][j];
  }
}
