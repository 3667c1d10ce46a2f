/* Errors of blocks, and symbols of samples that fits look at. */
#include "encode_measure.h"

#include "rapid.h"

enum { N_CLASSES = MOST_CLASS + 1, N_PAIR_SYMBOLS = PAIR_ESCAPE + 1, N_SINGLE_SYMBOLS = SINGLE_ESCAPE + 1,
  RAW_CLASS = 32, PAIR_LIMIT = 7, SIDE = 2 * PAIR_LIMIT + 1, SINGLE_LIMIT = 31 };

static ALWAYS_INLINE int32_t apart(int32_t a, int32_t b) {
  uint32_t x = (uint32_t)a - (uint32_t)b; /* heights of voids may wrap */
  return (int32_t)((int32_t)x < 0 ? 0 - x : x);
}

ALSO_AVX2 void twz_python_range_and_error(const int32_t *originals, const uint8_t *valid, const int32_t *decoded, int64_t original_cols, int64_t decoded_cols,
                     int32_t row, int32_t col, int32_t n_rows, int32_t n_cols, int32_t found[3]) {
  int32_t low = INT32_MAX, high = INT32_MIN, error = 0;
  for (ptrdiff_t i = row; i < (ptrdiff_t)row + n_rows; i++) {
    const int32_t *RESTRICT own = originals + i * original_cols + col, *RESTRICT other = decoded + i * decoded_cols + col;
    const uint8_t *RESTRICT is_valid = valid + i * original_cols + col;
    for (int32_t j = 0; j < n_cols; j++) {
      int32_t difference = apart(own[j], other[j]);
      low = min_i32(low, is_valid[j] ? own[j] : INT32_MAX);
      high = max_i32(high, is_valid[j] ? own[j] : INT32_MIN);
      error = max_i32(error, is_valid[j] ? difference : 0);
    }
  }
  found[0] = low;
  found[1] = high;
  found[2] = error;
}

/*
 * Distances of places are halved `shift` times, which is exact; a row of the surface follows from that above. Numbers are
 * those of block_stats.py; those of voids may wrap.
 */
#define DEVIATION(name, number, bits)                                                                                          \
  static ALSO_AVX2 int64_t name(const deviation_job *job) {                                                                              \
    const int32_t n = job->n_places, shift = job->shift, n_cells = (n - 1) >> shift, first = job->first_col >> shift;          \
    const int32_t last_row = (job->first_row + job->n_rows - 1 + (1 << shift) - 1) >> shift, last_col = (job->first_col + job->n_cols - 1 + (1 << shift) - 1) >> shift; \
    number *now = job->lines, *then = now + n, *RESTRICT upper = now + 2 * (ptrdiff_t)n, *RESTRICT rise = now + 3 * (ptrdiff_t)n; \
    number *RESTRICT surface = now + 4 * (ptrdiff_t)n, largest = 0;                                                            \
    for (int32_t row = -1; row < job->n_rows; row++) {                                                                         \
      int32_t place = job->first_row + max_i32(row, 0), part = place & ((1 << shift) - 1);                                     \
      if (row <= 0 || part == 0) {                                                                                             \
        const int32_t *from = job->heights + (ptrdiff_t)min_i32((place >> shift) + (row >= 0), last_row) * job->height_cols; \
        int32_t n_between = n_cells;                                                                                           \
        for (int32_t k = 0; k <= n_cells; k++) now[k] = (number)((from[min_i32(first + k, last_col)] - job->lowest) * ((int64_t)1 << shift)); \
        for (int i = 0; i < shift; i++, n_between *= 2) {                                                                      \
          for (int32_t k = 0; k < n_between; k++) {                                                                            \
            then[2 * k] = now[k];                                                                                              \
            then[2 * k + 1] = (number)((now[k] + now[k + 1]) >> 1);                                                            \
          }                                                                                                                    \
          then[2 * n_between] = now[n_between];                                                                                \
          number *other = now;                                                                                                 \
          now = then;                                                                                                          \
          then = other;                                                                                                        \
        }                                                                                                                      \
        for (int32_t k = 0; k < n; k++) {                                                                                      \
          number high = upper[k], low = now[k];                                                                                \
          rise[k] = low - high;                                                                                                \
          surface[k] = high * ((number)1 << shift) + (number)part * rise[k];                                                   \
          upper[k] = low;                                                                                                      \
        }                                                                                                                      \
      } else {                                                                                                                 \
        for (int32_t k = 0; k < n; k++) surface[k] += rise[k];                                                                 \
      }                                                                                                                        \
      if (row < 0) continue;                                                                                                   \
      const int32_t *RESTRICT own = job->originals + (ptrdiff_t)row * job->n_cols;                                             \
      const uint8_t *RESTRICT valid = job->valid + (ptrdiff_t)row * job->n_cols;                                               \
      const number *RESTRICT at = surface + (job->first_col & ((1 << shift) - 1));                                             \
      for (int32_t j = 0; j < job->n_cols; j++) {                                                                              \
        bits height = (bits)((uint64_t)own[j] - (uint64_t)job->lowest) << (2 * shift), below = (bits)at[j] - height;           \
        number deviation = (number)((number)below < 0 ? 0 - below : below);                                                    \
        deviation = valid[j] ? deviation : 0;                                                                                  \
        largest = largest > deviation ? largest : deviation;                                                                   \
      }                                                                                                                        \
    }                                                                                                                          \
    return largest;                                                                                                            \
  }

DEVIATION(deviation_of_32, int32_t, uint32_t)
DEVIATION(deviation_of_64, int64_t, uint64_t)

int64_t twz_python_largest_deviation(const deviation_job *job, int is_short) { return is_short ? deviation_of_32(job) : deviation_of_64(job); }

static ALWAYS_INLINE uint8_t class_of(int32_t expected) {
  int32_t value = max_i32(expected, 1), bits;
  float sparse = (float)(value & ~(value >> 2)); /* no rounding reaches the two top bits */
  memcpy(&bits, &sparse, sizeof bits);
  return (uint8_t)min_i32((bits >> 22) - 254, MOST_CLASS);
}

static ALWAYS_INLINE int single_of(int32_t value) {
  return value < -SINGLE_LIMIT || value > SINGLE_LIMIT ? SINGLE_ESCAPE : value + SINGLE_LIMIT;
}

ALSO_AVX2 void twz_python_count_seen(const int32_t *features, const int32_t *details, const uint8_t *is_coded, size_t n, const int32_t *weights, int least_cut,
                int most_cut, int64_t *pairs, int64_t *singles, int64_t *escaped) {
  enum { PIECE = 256 };
  const int32_t *ranges = features, *bends = features + n, *near = features + 2 * n;
  for (size_t begin = 0; begin < n; begin += PIECE) {
    int32_t expected[PIECE], m = (int32_t)min_size(PIECE, n - begin);
    uint8_t of_pairs[PIECE / 2], of_singles[PIECE];
    for (int32_t k = 0; k < m; k++) {
      int32_t both = weights[1] * ranges[begin + (size_t)k] + weights[2] * bends[begin + (size_t)k];
      expected[k] = (both >> weights[4]) + weights[3] * near[begin + (size_t)k] + weights[0];
    }
    for (int32_t k = 0; k < m; k++) of_singles[k] = class_of(expected[k]);
    for (int32_t k = 0; k < m / 2; k++) of_pairs[k] = class_of((expected[2 * k] >> 1) + (expected[2 * k + 1] >> 1));
    for (int32_t k = 0; k < m; k += 2) {
      const int32_t *two = details + begin + k;
      const uint8_t *coded = is_coded + begin + k;
      size_t own = of_pairs[k / 2];
      if (!coded[0] && !coded[1]) continue;
      if ((int)own < most_cut) {
        int has_symbol = two[0] >= -PAIR_LIMIT && two[0] <= PAIR_LIMIT && two[1] >= -PAIR_LIMIT && two[1] <= PAIR_LIMIT;
        pairs[own * N_PAIR_SYMBOLS + (size_t)(has_symbol ? (two[0] + PAIR_LIMIT) * SIDE + two[1] + PAIR_LIMIT : PAIR_ESCAPE)]++;
        for (int j = 0; j < 2 && !has_symbol; j++) escaped[own * N_SINGLE_SYMBOLS + (size_t)single_of(two[j])]++;
      }
      for (int j = 0; j < 2 && (int)own >= least_cut; j++) {
        size_t single = of_singles[k + j];
        int n_bits = max_i32((int)single - RAW_CLASS, 0) >> 1;
        if (coded[j]) singles[(own * N_CLASSES + single) * N_SINGLE_SYMBOLS + (size_t)single_of((int32_t)shift_right(two[j], n_bits))]++;
      }
    }
  }
}
