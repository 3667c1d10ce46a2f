/*
 * What fits sum up. All sums are of whole numbers up to 2^53 in doubles, exact in any order; other operations are single ones,
 * in the order of fit_stencils.py and fit_weights.py.
 */
#include "encode_fit.h"

#include "kernels.h"

static ALWAYS_INLINE double size_of(double value) { return value < 0 ? -value : value; }

/* 2^power, and the power of two above a positive number: as frexp. */
static double power_of_two(int32_t power) {
  uint64_t bits = (uint64_t)(power + 1023) << 52;
  double value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

static int32_t digits_of(double value) {
  uint64_t bits;
  memcpy(&bits, &value, sizeof bits);
  return value > 0 ? (int32_t)(bits >> 52) - 1022 : 0;
}

ALSO_AVX2 int64_t twz_python_gather_samples(const gather_job *job) {
  double *row = job->values;
  for (int64_t k = 0; k < job->n_places; k++) {
    const int32_t *at = job->heights + job->places[k];
    uint8_t is_valid = 1;
    for (int32_t tap = 0; job->valid && tap <= job->n_taps; tap++) is_valid &= job->valid[job->places[k] + job->offsets[tap]];
    if (!is_valid) continue;
    for (int32_t tap = 0; tap < FIT_COLUMNS; tap++) row[tap] = tap < job->n_taps ? at[job->offsets[tap]] : at[0];
    double mean = 0.25 * (row[job->core[0]] + row[job->core[1]] + row[job->core[2]] + row[job->core[3]]);
    for (int32_t tap = 0; tap < FIT_COLUMNS; tap++) {
      double value = nearest((row[tap] - mean) * job->factor);
      value = value > job->most ? job->most : value;
      row[tap] = value < -job->most ? -job->most : value;
    }
    for (int32_t tap = job->n_taps; tap < FIT_TAPS; tap++) row[tap] = 0;
    row += FIT_COLUMNS;
  }
  return (row - job->values) / FIT_COLUMNS;
}

void twz_python_errors_of(const double *values, int64_t n, int64_t step, const double *weights, int32_t n_sets, double whole, double unit,
                          double *errors) {
  find_kernels(TWZ_KERNELS_AUTO)->fit_errors(values, n, step, weights, n_sets, whole, unit, errors);
}

ALSO_AVX2 void twz_python_sums_of_bits(const double *values, int64_t n, int64_t step, const double *weights, int32_t n_sets, double whole,
                             double unit, const double *noises, double most, double *errors, int64_t *sums) {
  const row_kernels *kernels = find_kernels(TWZ_KERNELS_AUTO);
  for (int64_t begin = 0; begin < n; begin += FIT_BLOCK) {
    kernels->fit_errors(values + begin * step * FIT_COLUMNS, FIT_BLOCK, step, weights, n_sets, whole, unit, errors);
    for (int32_t set = 0; set < n_sets; set++) {
      int64_t sum = 0;
      for (int32_t k = 0; k < FIT_BLOCK; k++) {
        double error = errors[set * FIT_BLOCK + k], square = error * error + noises[set];
        float octaves = (float)((square < most ? square : most) * 4.0 + 1.0);
        int32_t bits;
        memcpy(&bits, &octaves, sizeof bits);
        sum += bits;
      }
      sums[set] += sum;
    }
  }
}

ALSO_AVX2 int32_t twz_python_products_of(const double *values, int64_t n, int64_t step, const double *roots, int32_t bits, double *products) {
  double largest = 0;
  for (int64_t k = 0; k < n; k++) {
    int32_t most = 0; /* roundings of products are in their order */
    for (int32_t tap = 0; tap < FIT_COLUMNS; tap++) {
      int32_t value = (int32_t)values[k * step * FIT_COLUMNS + tap];
      most = max_i32(most, value < 0 ? -value : value);
    }
    largest = most * roots[k] > largest ? most * roots[k] : largest;
  }
  int32_t shift = bits - max_i32(digits_of(largest), 0);
  const row_kernels *kernels = find_kernels(TWZ_KERNELS_AUTO);
  const int64_t n_first = min_i64(n, FIT_EXACT);
  double rest[FIT_TAPS * FIT_COLUMNS];
  kernels->fit_products(values, n_first, step, roots, power_of_two(shift), products);
  kernels->fit_products(values + n_first * step * FIT_COLUMNS, n - n_first, step, roots + n_first, power_of_two(shift), rest);
  for (int32_t tap = 0; tap < FIT_TAPS; tap++) {
    for (int32_t j = tap; j < FIT_COLUMNS; j++) products[tap * FIT_COLUMNS + j] += rest[tap * FIT_COLUMNS + j];
    for (int32_t j = 0; j < tap; j++) products[tap * FIT_COLUMNS + j] = products[j * FIT_COLUMNS + tap];
  }
  return shift;
}

ALSO_AVX2 void twz_python_solve(double *systems, int64_t n, double *solutions) {
  for (int64_t i = 0; i < n; i++, systems += FIT_TAPS * FIT_COLUMNS) {
    for (int32_t k = 0; k < FIT_TAPS; k++) {
      double row[FIT_COLUMNS];
      for (int32_t j = k; j < FIT_COLUMNS; j++) row[j] = systems[k * FIT_COLUMNS + j] / systems[k * FIT_COLUMNS + k];
      for (int32_t other = 0; other < FIT_TAPS; other++) {
        double *RESTRICT to = systems + other * FIT_COLUMNS;
        const double factor = to[k];
        for (int32_t j = k; j < FIT_COLUMNS; j++) to[j] = other == k ? row[j] : to[j] - factor * row[j];
      }
    }
    for (int32_t k = 0; k < FIT_TAPS; k++) solutions[i * FIT_TAPS + k] = systems[k * FIT_COLUMNS + FIT_TAPS];
  }
}

ALSO_AVX2 int64_t twz_python_rows_of(const int32_t *features, const int32_t *details, const uint8_t *is_coded, int64_t n, int64_t every, double unit,
                int64_t capacity, double *rows) {
  int64_t found = 0;
  for (int64_t turn = 0; turn < n / every; turn++) {
    int64_t at = turn * every + (turn * 40503 >> 4) % every; /* not always in the same column */
    if (!is_coded[at]) continue;
    rows[found] = 1;
    rows[capacity + found] = features[at] * unit;
    rows[2 * capacity + found] = features[n + at] * unit;
    rows[3 * capacity + found] = features[2 * n + at];
    rows[4 * capacity + found++] = size_of(details[at]);
  }
  return found;
}

void twz_python_weighed_products(const double *rows, int64_t n, const double *weights, double least, int32_t bits, double *parts, double *products) {
  double most[FIT_ROWS] = {0}, units[FIT_ROWS];
  for (int64_t k = 0; k < n; k++) {
    double expected = least;
    for (int32_t i = 0; i < FIT_FEATURES; i++) expected += weights[i] * rows[i * n + k];
    for (int32_t i = 0; i < FIT_ROWS; i++) {
      double part = parts[i * n + k] = rows[i * n + k] / expected;
      most[i] = part > most[i] ? part : most[i];
    }
  }
  for (int32_t i = 0; i < FIT_ROWS; i++) units[i] = power_of_two(bits - digits_of(most[i] > 0 ? most[i] : 1));
  for (int32_t i = 0; i < FIT_ROWS * FIT_ROWS; i++) products[i] = 0;
  for (int64_t k = 0; k < n; k++) {
    double own[FIT_ROWS];
    for (int32_t i = 0; i < FIT_ROWS; i++) own[i] = nearest(parts[i * n + k] * units[i]);
    for (int32_t i = 0; i < FIT_ROWS; i++) {
      for (int32_t j = 0; j < FIT_ROWS; j++) products[i * FIT_ROWS + j] += own[i] * own[j];
    }
  }
  for (int32_t i = 0; i < FIT_ROWS; i++) {
    for (int32_t j = 0; j < FIT_ROWS; j++) products[i * FIT_ROWS + j] = products[i * FIT_ROWS + j] / units[i] / units[j];
  }
}
