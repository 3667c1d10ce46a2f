/* Method rapid, compiled for a set of instructions: ISA(name) names what is its own. */
#include "border.h"
#include "kernels.h"

#if defined(__AVX2__) && defined(TWZ_HAVE_X86)
#include <immintrin.h>
#endif

#if defined(__clang__) && defined(TWZ_SANITIZED)
#define IVDEP /* checks stand in the way of vectors */
#elif defined(__clang__)
#define IVDEP _Pragma("clang loop vectorize(assume_safety) interleave(disable)")
#elif defined(__GNUC__)
#define IVDEP _Pragma("GCC ivdep")
#elif defined(_MSC_VER)
#define IVDEP __pragma(loop(ivdep))
#else
#define IVDEP
#endif

enum { HH, HL, LH, A };

/* Whole-sample symmetry about 0 and n - 1, repeated until inside (R.5). */
static int32_t ISA(fold)(int32_t i, int32_t n) {
  if (n == 1) return 0;
  int32_t period = 2 * (n - 1), inside = (i % period + period) % period;
  return min_i32(inside, period - inside);
}

/* The bin of e: 2 lg e + its second bit - 10, out of the exponent of a float (R.7); e is below 2^27. */
static ALWAYS_INLINE int32_t ISA(bin_of_e)(int32_t e) {
  float number = (float)(max_i32(e, 32) & ~7); /* 24 bits: exact */
  int32_t bits;
  memcpy(&bits, &number, 4);
  return min_i32((bits >> 22) - 264, 43);
}

/* The next n <= 33 raw bits, the first one lowest; whatever lies behind their end (R.1). */
static ALWAYS_INLINE uint64_t ISA(take_raw)(rapid_streams *z, int n) {
  uint64_t held = load_u64(z->raw + min_size(z->n_bits >> 3, z->n_raw)) >> (z->n_bits & 7);
  z->n_bits += (size_t)n;
  return held & (((uint64_t)1 << n) - 1);
}

/* How many of n samples, each step-th one, are valid: without voids there is less to do. */
static int32_t ISA(count_valid)(const uint8_t *valid, int32_t n, size_t step) {
  int32_t n_valid = 0;
  if (step == 2) {
    for (int32_t j = 0; j < n; j++) n_valid += valid[2 * j];
  } else {
    for (int32_t j = 0; j < n; j++) n_valid += valid[(size_t)j * step];
  }
  return n_valid;
}

/* Contexts of valid samples among n, one behind the other; returns how many. */
static ALWAYS_INLINE int32_t ISA(pack_plain)(const int32_t *contexts, const uint8_t *valid, size_t step, int32_t n, int32_t *packed) {
  int32_t n_packed = 0;
  for (int32_t j = 0; j < n; j++) {
    packed[n_packed] = contexts[j];
    n_packed += valid[(size_t)j * step];
  }
  return n_packed;
}

#define NUMBER int64_t
#define PREDICT_IVDEP /* clang would make no vectors of 64-bit products, and say so */
#define NAMED(name) ISA(wide_##name)
#include "rapid_rows.h"
#undef NUMBER
#undef NAMED
#undef PREDICT_IVDEP

#define NUMBER int32_t
#define PREDICT_IVDEP IVDEP
#define NAMED(name) ISA(narrow_##name)
#include "rapid_rows.h"
#undef NAMED

#if defined(__AVX2__) && defined(TWZ_HAVE_X86)
#define SHORT
#define NAMED(name) ISA(short_##name)
#include "rapid_rows.h"
#define DECODE_SHORT NAMED(decode)
#define DECODE_GROUPS NAMED(decode_groups)
#else
#define DECODE_SHORT NULL
#define DECODE_GROUPS NULL
#endif

static twz_status ISA(decode_unit_rapid)(rapid_unit *u, twz_error *error) {
  return u->is_wide ? ISA(wide_decode)(u, error) : ISA(narrow_decode)(u, error);
}
