/* Quanta of raw heights, and fills of voids. Numbers are whole, or doubles by single operations in a fixed order. */
#include "encode_pyramid.h"

/* To the nearest whole number, ties to even, as sums are rounded by default; what is as large as 2^52 is whole. */
static ALWAYS_INLINE double round_to_even(double x) {
  const double large = 4503599627370496.0; /* 2^52 */
  double above = (x + large) - large, below = (x - large) + large;
  return x >= 0 && x < large ? above : x < 0 && x > -large ? below : x;
}

/* What is beyond 64 bits is no height: the lowest number stands for it, as on x86. */
static ALWAYS_INLINE int64_t whole_of(double x) {
  return x >= -9223372036854775808.0 && x < 9223372036854775808.0 ? (int64_t)x : INT64_MIN;
}

static ALWAYS_INLINE int32_t less_base(int64_t number, int64_t base) { return (int32_t)(uint32_t)((uint64_t)number - (uint64_t)base); }

#define QUANTISE(type)                                                                                               \
  do {                                                                                                               \
    const type *from = raw;                                                                                          \
    for (size_t row = 0; row < n_rows; row++, from += raw_stride, valid += valid_stride, quanta += n_cols) {         \
      for (size_t i = 0; is_own && i < n_cols; i++) quanta[i] = valid[i] ? less_base((int64_t)from[i], base) : 0;    \
      for (size_t i = 0; !is_own && i < n_cols; i++) {                                                               \
        quanta[i] = !valid[i] ? 0 : less_base(is_whole ? floor_div((int64_t)from[i], numerator)                      \
                                                       : whole_of(round_to_even((double)from[i] * by / over)), base); \
      }                                                                                                              \
    }                                                                                                                \
  } while (0)

ALSO_AVX2 void twz_python_quantise(int type, const void *raw, ptrdiff_t raw_stride, const uint8_t *valid, ptrdiff_t valid_stride, size_t n_rows, size_t n_cols,
                      int is_whole, int64_t numerator, int64_t denominator, int64_t base, int32_t *RESTRICT quanta) {
  const double by = (double)denominator, over = (double)numerator;
  const int is_own = is_whole && numerator == 1 && type < RAW_F4; /* integers less the base */
  switch (type) {
    case RAW_I1: QUANTISE(int8_t); break;
    case RAW_U1: QUANTISE(uint8_t); break;
    case RAW_I2: QUANTISE(int16_t); break;
    case RAW_U2: QUANTISE(uint16_t); break;
    case RAW_I4: QUANTISE(int32_t); break;
    case RAW_U4: QUANTISE(uint32_t); break;
    case RAW_I8: QUANTISE(int64_t); break;
    case RAW_F4: is_whole = 0; QUANTISE(float); break;
    default: is_whole = 0; QUANTISE(double); break;
  }
}

#define DEQUANTISE(type)                                                                         \
  do {                                                                                           \
    type *to = heights;                                                                          \
    for (size_t i = 0; i < n; i++) {                                                             \
      int64_t height = (quanta[i] + base) * numerator;                                           \
      if (denominator != 1) height = whole_of(round_to_even((double)height / (double)denominator)); \
      to[i] = (type)clamp_i64(height, low, high);                                                \
    }                                                                                            \
  } while (0)

ALSO_AVX2 void twz_python_dequantise(int type, const int32_t *quanta, size_t n, int64_t numerator, int64_t denominator, int64_t base, int64_t low,
                        int64_t high, void *heights) {
  float *singles = heights;
  double *doubles = heights;
  switch (type) {
    case RAW_I1: DEQUANTISE(int8_t); break;
    case RAW_U1: DEQUANTISE(uint8_t); break;
    case RAW_I2: DEQUANTISE(int16_t); break;
    case RAW_U2: DEQUANTISE(uint16_t); break;
    case RAW_I4: DEQUANTISE(int32_t); break;
    case RAW_U4: DEQUANTISE(uint32_t); break;
    case RAW_I8: DEQUANTISE(int64_t); break;
    case RAW_F4:
      for (size_t i = 0; i < n; i++) singles[i] = (float)((double)((quanta[i] + base) * numerator) / (double)denominator);
      break;
    default:
      for (size_t i = 0; i < n; i++) doubles[i] = (double)((quanta[i] + base) * numerator) / (double)denominator;
      break;
  }
}

ALSO_AVX2 void twz_python_push(const int32_t *fine, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col, int64_t *lines,
                  int32_t to_rows, int32_t to_cols, int32_t *values, uint8_t *known) {
  int64_t *RESTRICT parts = lines, *RESTRICT shares = lines + n_cols;
  for (int32_t i = 0; i < to_rows; i++) {
    int32_t row = 2 * i + first_row;
    const int32_t *above = fine + (ptrdiff_t)max_i32(row - 1, 0) * n_cols, *here = fine + (ptrdiff_t)row * n_cols;
    const int32_t *below = fine + (ptrdiff_t)min_i32(row + 1, n_rows - 1) * n_cols;
    for (int32_t k = 0; k < n_cols; k++) {
      int has_a = above[k] != UNKNOWN_HEIGHT, has_b = here[k] != UNKNOWN_HEIGHT, has_c = below[k] != UNKNOWN_HEIGHT;
      parts[k] = (has_a ? (int64_t)above[k] : 0) + (has_c ? (int64_t)below[k] : 0) + 2 * (has_b ? (int64_t)here[k] : 0);
      shares[k] = has_a + has_c + 2 * has_b;
    }
    for (int32_t j = 0; j < to_cols; j++) {
      int32_t at = 2 * j + first_col, left = max_i32(at - 1, 0), right = min_i32(at + 1, n_cols - 1);
      int64_t total = parts[left] + 2 * parts[at] + parts[right], weight = shares[left] + 2 * shares[at] + shares[right];
      int64_t mean = weight == 16 ? shift_right(total, 4) : weight > 0 ? floor_div(total, weight) : 0;
      values[(ptrdiff_t)i * to_cols + j] = (int32_t)mean;
      known[(ptrdiff_t)i * to_cols + j] = weight > 0;
    }
  }
}

ALSO_AVX2 void twz_python_pull(const int32_t *coarse, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col, int32_t to_rows,
                  int32_t to_cols, const uint8_t *known, int32_t *values) {
  for (int32_t i = 0; i < to_rows; i++) {
    int32_t row = i + first_row;
    const int32_t *above = coarse + (ptrdiff_t)(row >> 1) * n_cols, *below = coarse + (ptrdiff_t)min_i32((row + 1) >> 1, n_rows - 1) * n_cols;
    const uint8_t *is_known = known + (ptrdiff_t)i * to_cols;
    int32_t *to = values + (ptrdiff_t)i * to_cols;
    for (int32_t j = 0; j < to_cols; j++) {
      int32_t col = j + first_col, left = col >> 1, right = min_i32((col + 1) >> 1, n_cols - 1);
      int64_t total = (int64_t)above[left] + above[right] + below[left] + below[right];
      to[j] = is_known[j] ? to[j] : (int32_t)shift_right(total + 2, 2);
    }
  }
}
