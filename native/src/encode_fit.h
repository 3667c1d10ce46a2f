/* Sums that fits of stencils and weights need, as fit_stencils.py and fit_weights.py make them; see encode.h. */
#ifndef TWZ_ENCODE_FIT_H
#define TWZ_ENCODE_FIT_H

#include "internal.h"

enum { FIT_TAPS = 24, FIT_COLUMNS = FIT_TAPS + 1, FIT_FEATURES = 4, FIT_ROWS = FIT_FEATURES + 1, FIT_BLOCK = 32, FIT_EXACT = 8192 };

/* Nearest whole number of one below 2^51, halves to even. */
static ALWAYS_INLINE double nearest(double value) {
  const double big = 6755399441055744.0; /* 1.5 * 2^52: sums have no digits below 1 */
  return (value + big) - big;
}

/* Samples at places in windows: taps less the core's mean, times a factor, and what they are to predict. */
typedef struct gather_job {
  const int32_t *heights;
  const uint8_t *valid;          /* NULL where all are */
  const int64_t *places, *offsets; /* offsets of taps, then that of the sample, which is 0 */
  int64_t n_places;
  int32_t n_taps, core[4];
  double factor, most;
  double *values;                /* n_places rows of FIT_COLUMNS */
} gather_job;

/* The number of rows: of places where the sample and all its taps are valid. */
PYTHON_API int64_t twz_python_gather_samples(const gather_job *job);

/*
 * Errors of sets of FIT_TAPS weights in n rows, each the `step`-th, times `unit`: n_sets rows of them. A multiple of
 * FIT_BLOCK rows, here and below.
 */
PYTHON_API void twz_python_errors_of(const double *values, int64_t n, int64_t step, const double *weights, int32_t n_sets, double whole, double unit, double *errors);

/* Add the bits of (4 (the least of error^2 + noise and `most`) + 1) as a float, by set; `errors` has room for a block of each. */
PYTHON_API void twz_python_sums_of_bits(const double *values, int64_t n, int64_t step, const double *weights, int32_t n_sets, double whole,
                                        double unit, const double *noises, double most, double *errors, int64_t *sums);

/*
 * FIT_TAPS rows of FIT_COLUMNS products of samples times `roots`, scaled to `bits` bits, at most 20; returns by how many. Sums of
 * the first FIT_EXACT samples and of the rest, at most as many, are exact; their sum is rounded once.
 */
PYTHON_API int32_t twz_python_products_of(const double *values, int64_t n, int64_t step, const double *roots, int32_t bits, double *products);

/* The solutions of n systems of FIT_TAPS rows of FIT_COLUMNS by elimination; the systems change. */
PYTHON_API void twz_python_solve(double *systems, int64_t n, double *solutions);

/* Features in steps, and sizes of details, of one of each `every` of n samples: FIT_ROWS rows of `capacity`. The number of them. */
PYTHON_API int64_t twz_python_rows_of(const int32_t *features, const int32_t *details, const uint8_t *is_coded, int64_t n, int64_t every, double unit,
                int64_t capacity, double *rows);

/* FIT_ROWS rows of as many products of n samples, by what is expected of them; `parts` has room for FIT_ROWS rows of n. */
PYTHON_API void twz_python_weighed_products(const double *rows, int64_t n, const double *weights, double least, int32_t bits, double *parts, double *products);

#endif
