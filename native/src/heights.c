/* Quanta to raw heights (FORMAT §2.3, §5.3), and which quanta would become nodata (§5.1). */
#include <math.h>

#include "kernels.h"

/* What a float dtype makes of a number. */
static double rounded_to(int dtype, double x) { return dtype == TWZ_FLOAT32 ? (double)(float)x : x; }

/* The whole number nearest to x, ties to even, of |x| below 2^63. */
static int64_t nearest_even(double x) {
  if (x >= 4503599627370496.0 || x <= -4503599627370496.0) return (int64_t)x; /* 2^52: whole already */
  int64_t whole = (int64_t)x;
  whole -= (double)whole > x;
  double rest = x - (double)whole;
  return whole + (rest > 0.5 || (rest == 0.5 && (whole & 1)));
}

/* P, which the header's limits keep in 64 bits (§4.1). */
static int64_t product(const heights *h, int64_t k) { return (h->base + k) * (int64_t)h->num; }

static int64_t integer_of(const heights *h, int64_t k) {
  int64_t p = product(h, k);
  if (h->den != 1) p = nearest_even((double)p / (double)h->den);
  int64_t low, high;
  dtype_range(h->dtype, &low, &high);
  return clamp_i64(p, low, high);
}

double raw_of_quantum(const heights *h, int64_t k) {
  if (!h->is_float) return (double)integer_of(h, k);
  return rounded_to(h->dtype, (double)product(h, k) / (double)h->den);
}

/* The first quantum number from z_min on whose raw height is >= (is_above: >) nodata. */
static int32_t first_reaching(const heights *h, int is_above) {
  int64_t low = h->z_min, high = (int64_t)h->z_max + 1;
  while (low < high) { /* raw heights never fall */
    int64_t middle = floor_div(low + high, 2);
    double raw = raw_of_quantum(h, middle);
    if (is_above ? raw > h->nodata : raw >= h->nodata) {
      high = middle;
    } else {
      low = middle + 1;
    }
  }
  return (int32_t)low;
}

void heights_init(heights *h, const row_kernels *kernels, const header *of, int has_nodata, double nodata) {
  memset(h, 0, sizeof *h);
  h->kernels = kernels;
  h->dtype = of->dtype;
  h->is_float = dtype_is_float(of->dtype);
  h->base = of->base;
  h->num = of->quantum_num;
  h->den = of->quantum_den;
  h->z_min = of->z_min;
  h->z_max = of->z_max;
  h->step = of->step;
  h->is_cdf53 = of->method == TWZ_CDF53;
  /* One more on each side: where samples move from nodata. */
  h->is_short = of->method == TWZ_RAPID && (int64_t)h->z_max - h->z_min <= 65533;
  h->origin = h->is_short ? (int32_t)shift_right((int64_t)h->z_min + h->z_max + 1, 1) : 0;
  h->has_nodata = has_nodata;
  h->nodata = has_nodata ? rounded_to(of->dtype, nodata) : h->is_float ? NAN : 0;
  h->integer_nodata = h->is_float ? 0 : (int64_t)h->nodata;
  h->is_exact = h->num <= ((uint64_t)1 << 53) / (magnitude_of(h->base) + ((uint64_t)1 << 31)); /* doubles hold every product */
  int64_t low, high;
  dtype_range(h->dtype, &low, &high);
  int is_small = h->base > -((int64_t)1 << 31) && h->base < (int64_t)1 << 31;
  h->is_sum = !h->is_float && h->num == 1 && h->den == 1 && is_small && product(h, (int64_t)h->z_min - 1) >= low &&
              product(h, (int64_t)h->z_max + 1) <= high; /* moved heights lie one beyond */
  h->first = 0;
  h->last = -1;
  if (has_nodata && isfinite(h->nodata) && h->z_min <= h->z_max) {
    int32_t first = first_reaching(h, 0), last = first_reaching(h, 1) - 1;
    if (first <= last) {
      h->first = first;
      h->last = last;
    }
  }
}

/* C.6: steps to quanta. A void one may lie anywhere. */
static int32_t quantum_of_steps(const heights *h, int32_t steps, int is_valid) {
  int64_t k = clamp_i64((int64_t)steps * h->step, h->z_min, h->z_max);
  if (is_valid && k >= h->first && k <= h->last) k = h->last >= h->z_max ? (int64_t)h->first - 1 : (int64_t)h->last + 1;
  return (int32_t)k;
}

int32_t quantum_at(const heights *h, const layer *l, size_t at) {
  return h->is_cdf53 ? quantum_of_steps(h, l->heights[at], is_valid_at(l, at)) : height_at(l, at);
}

/* First the plain cases, which compilers make vectors of: integers of quantum 1, floats of exact products. */
static void write_plain(const heights *h, void *out, const int32_t *quanta, size_t n) {
  if (h->is_sum) {
    h->kernels->write_sums(h->dtype, out, quanta, n, (uint32_t)h->base);
    return;
  }
  if (h->is_float && h->is_exact) {
    h->kernels->write_products(h->dtype, out, quanta, n, (double)h->base, (double)h->num, (double)h->den);
    return;
  }
  for (size_t i = 0; i < n; i++) {
    if (h->is_float) {
      double raw = raw_of_quantum(h, quanta[i]);
      if (h->dtype == TWZ_FLOAT32) {
        ((float *)out)[i] = (float)raw;
      } else {
        ((double *)out)[i] = raw;
      }
      continue;
    }
    int64_t raw = integer_of(h, quanta[i]);
    switch (h->dtype) {
      case TWZ_UINT8: ((uint8_t *)out)[i] = (uint8_t)raw; break;
      case TWZ_UINT16: ((uint16_t *)out)[i] = (uint16_t)raw; break;
      case TWZ_INT16: ((int16_t *)out)[i] = (int16_t)raw; break;
      default: ((int32_t *)out)[i] = (int32_t)raw; break;
    }
  }
}

/* The bits of what void samples hold; the NaN is the quiet one. */
static void void_bits(const heights *h, uint8_t *bits) {
  size_t size = dtype_size(h->dtype);
  if (h->dtype == TWZ_FLOAT32) {
    float x = (float)h->nodata;
    uint32_t nan = 0x7FC00000u;
    memcpy(bits, h->nodata != h->nodata ? (void *)&nan : (void *)&x, 4);
  } else if (h->dtype == TWZ_FLOAT64) {
    uint64_t nan = (uint64_t)0x7FF8 << 48;
    memcpy(bits, h->nodata != h->nodata ? (const void *)&nan : (const void *)&h->nodata, 8);
  } else {
    int32_t whole = (int32_t)h->integer_nodata;
    int16_t half = (int16_t)whole;
    uint8_t byte = (uint8_t)whole;
    memcpy(bits, size == 4 ? (void *)&whole : size == 2 ? (void *)&half : (void *)&byte, size);
  }
}

/* A loop for each size, without branches: compilers make vectors of it. */
#define WRITE_VOID(type)                                                         \
  do {                                                                           \
    type value, *to = out;                                                       \
    memcpy(&value, bits, sizeof value);                                          \
    if (valid) {                                                                 \
      for (size_t i = 0; i < n; i++) to[i] = valid[i] ? to[i] : value;           \
    } else {                                                                     \
      for (size_t i = 0; i < n; i++) to[i] = value;                              \
    }                                                                            \
  } while (0)

static void write_void(const heights *h, void *out, const uint8_t *valid, size_t n) {
  uint8_t bits[8];
  void_bits(h, bits);
  switch (dtype_size(h->dtype)) {
    case 1: WRITE_VOID(uint8_t); break;
    case 2: WRITE_VOID(uint16_t); break;
    case 4: WRITE_VOID(uint32_t); break;
    default: WRITE_VOID(uint64_t); break;
  }
}

void fill_voids(const heights *h, void *out, const layer *l, size_t at, size_t n) {
  if (l->valid) write_void(h, out, l->valid + at, n);
}

/* §5.3: numbers of heights in their order grow by the remainders. */
static twz_status add_remainders(const heights *h, void *out, const uint8_t *valid, const int64_t *remainders,
                                 size_t n, twz_error *error) {
  for (size_t i = 0; i < n; i++) {
    if (valid && !valid[i]) continue;
    int is_finite;
    if (h->dtype == TWZ_FLOAT64) {
      const uint64_t most = ((uint64_t)1 << 63) - 1;
      uint64_t bits;
      memcpy(&bits, (uint8_t *)out + 8 * i, 8);
      uint64_t number = (bits >> 63 ? bits ^ most : bits) + (uint64_t)remainders[i];
      bits = number >> 63 ? number ^ most : number;
      memcpy((uint8_t *)out + 8 * i, &bits, 8);
      is_finite = (bits >> 52 & 2047) != 2047;
    } else {
      uint32_t most = h->is_float ? 0x7FFFFFFFu : 0, bits;
      memcpy(&bits, (uint8_t *)out + 4 * i, 4);
      uint32_t number = (bits >> 31 ? bits ^ most : bits) + (uint32_t)remainders[i];
      bits = number >> 31 ? number ^ most : number;
      memcpy((uint8_t *)out + 4 * i, &bits, 4);
      is_finite = !h->is_float || (bits >> 23 & 255) != 255;
    }
    REQUIRE(is_finite, error, "remainders make a height that is not finite");
  }
  return TWZ_OK;
}

twz_status write_raw(const heights *h, void *out, const layer *l, size_t at, size_t n, twz_error *error) {
  enum { PIECE = 1024 };
  int32_t piece[PIECE];
  size_t size = dtype_size(h->dtype);
  if ((uintptr_t)out % size) { /* loops write numbers: not where none may lie */
    double aligned[PIECE];
    for (size_t i = 0; i < n; i += PIECE) {
      size_t stop = min_size(n - i, PIECE);
      TRY(write_raw(h, aligned, l, at + i, stop, error));
      memcpy((uint8_t *)out + i * size, aligned, stop * size);
    }
    return TWZ_OK;
  }
  if (!l) {
    write_void(h, out, NULL, n);
    return TWZ_OK;
  }
  const uint8_t *valid = l->valid ? l->valid + at : NULL;
  int is_whole = !l->shorts && !h->is_cdf53, are_halves = l->shorts && h->is_sum && dtype_size(h->dtype) == 2;
  if (is_whole) write_plain(h, out, l->heights + at, n);
  if (are_halves) h->kernels->add_shorts(out, l->shorts + at, n, (uint32_t)h->base + (uint32_t)l->origin);
  for (size_t i = 0; !is_whole && !are_halves && i < n; i += PIECE) {
    size_t stop = min_size(n - i, PIECE);
    if (l->shorts) {
      h->kernels->widen(piece, l->shorts + at + i, stop, l->origin);
    } else {
      for (size_t k = 0; k < stop; k++) piece[k] = quantum_of_steps(h, l->heights[at + i + k], !valid || valid[i + k]);
    }
    write_plain(h, (uint8_t *)out + i * size, piece, stop);
  }
  if (l->remainders) TRY(add_remainders(h, out, valid, l->remainders + at, n, error));
  if (valid) write_void(h, out, valid, n);
  return TWZ_OK;
}
