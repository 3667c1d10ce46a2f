/* What an encoder measures: errors of blocks, and symbols of samples that fits look at; see encode.h. */
#ifndef TWZ_ENCODE_MEASURE_H
#define TWZ_ENCODE_MEASURE_H

#include "internal.h"

/* Lowest and highest valid height, and the largest error of one, of part of a window: to `found`. */
PYTHON_API void twz_python_range_and_error(const int32_t *originals, const uint8_t *valid, const int32_t *decoded, int64_t original_cols, int64_t decoded_cols,
                     int32_t row, int32_t col, int32_t n_rows, int32_t n_cols, int32_t found[3]);

/* A window of a raster, and the samples of a block around it. */
typedef struct deviation_job {
  const int32_t *heights, *originals;
  const uint8_t *valid;
  int32_t height_rows, height_cols, n_rows, n_cols, shift, first_row, first_col, n_places;
  int64_t lowest;
  void *lines;                   /* zeros: 5 rows of n_places, of 32 bits where that is enough */
} deviation_job;

/* The largest deviation of valid samples from a block's surface, times 4^shift. */
PYTHON_API int64_t twz_python_largest_deviation(const deviation_job *job, int is_short);

/* Count the symbols of n samples, an even number; as details.count_seen. */
PYTHON_API void twz_python_count_seen(const int32_t *features, const int32_t *details, const uint8_t *is_coded, size_t n, const int32_t *weights, int least_cut,
                int most_cut, int64_t *pairs, int64_t *singles, int64_t *escaped);

#endif
