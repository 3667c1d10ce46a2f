/* Rows of method rapid, for sums of heights that fit 32 bits and for those that don't (R.2). */

typedef int i32;
typedef unsigned u32;
typedef unsigned char u8;

#define EXPORT(name) __attribute__((export_name(name)))
static inline i32 min(i32 a, i32 b) { return a < b ? a : b; }
static inline i32 max(i32 a, i32 b) { return a > b ? a : b; }
static inline i32 magnitude(i32 a) { return a < 0 ? -a : a; }
static inline double least_of(double a, double b) { return a < b ? a : b; }
static inline double most_of(double a, double b) { return a > b ? a : b; }

/* Locals, which stores to rows cannot change. */
#define COPY(Type, to, from, n)                                                             \
  Type to[n];                                                                               \
  _Pragma("clang loop unroll(full)") for (i32 k = 0; k < n; k++) to[k] = from[k]

/* The bin of e >= 32: 2 lg e + its second bit - 10, out of the exponent of a float (R.7). */
static inline i32 bin_of(i32 e) {
  union { float number; i32 bits; } float_of = {(float)(e & ~7)}; /* 24 bits: exact */
  return e < 32 ? 0 : min((float_of.bits >> 22) - 264, 43);
}

/* The next n <= 24 raw bits, the first one lowest; four zeros lie behind the n_raw bytes. */
static inline u32 read_bits(const u8 *raw, i32 n_raw, i32 *used, i32 n) {
  u32 held;
  __builtin_memcpy(&held, raw + min((i32)((u32)used[2] >> 3), n_raw), 4);
  held >>= used[2] & 7;
  used[2] += n;
  return held & ((1u << n) - 1);
}

#define ROWS _Pragma("clang loop vectorize(assume_safety)")
#define NUMBER i32
#define NAMED(name) name
#define SUFFIX ""
#define LARGE
#define LEAST min
#define MOST max
#define MAGNITUDE magnitude
#define SHIFTED(x, n) ((x) >> (n))
#include "rapid-rows.h"

#define ROWS _Pragma("clang loop vectorize(disable) unroll(disable)") /* else twice as large */
#define NUMBER double
#define NAMED(name) name##_wide
#define SUFFIX "Wide"
#define LARGE (double)
#define LEAST least_of
#define MOST most_of
#define MAGNITUDE __builtin_fabs
#define SHIFTED(x, n) __builtin_floor((x) * (1.0 / (1u << (n))))
#include "rapid-rows.h"

/* Write the first n of a row to every step-th place of `out`. */
EXPORT("storeRow")
void store_row(i32 n, const i32 *from, i32 *out, i32 step, i32 origin) {
  for (i32 j = 0; j < n; j++) out[j * step] = from[j] + origin;
}
