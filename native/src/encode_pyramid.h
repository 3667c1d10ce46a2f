/* Quanta of raw heights, and fills of voids on coarse levels, as src/terrainwave/grid/convert.py makes them; see encode.h. */
#ifndef TWZ_ENCODE_PYRAMID_H
#define TWZ_ENCODE_PYRAMID_H

#include "internal.h"

/* Types of raw heights: numpy's kind and size. */
enum { RAW_I1, RAW_U1, RAW_I2, RAW_U2, RAW_I4, RAW_U4, RAW_I8, RAW_F4, RAW_F8 };
#define UNKNOWN_HEIGHT INT32_MIN

/* Quanta of raw heights, 0 where not valid: rounded to the grid, ties to even, but for integers on their own grid. Strides in samples. */
PYTHON_API void twz_python_quantise(int type, const void *raw, ptrdiff_t raw_stride, const uint8_t *valid, ptrdiff_t valid_stride, size_t n_rows, size_t n_cols,
                      int is_whole, int64_t numerator, int64_t denominator, int64_t base, int32_t *RESTRICT quanta);
/* Heights of n quanta: whole ones from `low` to `high`, ties to even, or rounded to doubles and then to their own type. */
PYTHON_API void twz_python_dequantise(int type, const int32_t *quanta, size_t n, int64_t numerator, int64_t denominator, int64_t base, int64_t low,
                        int64_t high, void *heights);
/* Average what is known of a level around samples of the level above. `lines`: two rows as wide as `fine`. */
PYTHON_API void twz_python_push(const int32_t *fine, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col, int64_t *lines,
                  int32_t to_rows, int32_t to_cols, int32_t *values, uint8_t *known);
/* Give samples that are not known the mean of those around them on the level above. */
PYTHON_API void twz_python_pull(const int32_t *coarse, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col, int32_t to_rows,
                  int32_t to_cols, const uint8_t *known, int32_t *values);

#endif
