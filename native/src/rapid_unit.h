/* Method rapid, compiled for a set of instructions: ISA(name) names what is its own. */
#include "border.h"
#include "kernels.h"

#if defined(__AVX2__) && defined(TWZ_HAVE_X86)
#define HAS_AVX2
#define HAS_VECTORS
#include <immintrin.h>
#elif defined(__wasm_simd128__)
#define HAS_SIMD128
#define HAS_VECTORS
#include <wasm_simd128.h>
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

/* ---- Details (R.8, R.9) ---- */

/* The raw bits of n details; `most` is below 2^31. */
static void ISA(read_raw)(const int32_t *contexts, int32_t *details, int32_t n, int64_t most, rapid_streams *z) {
  for (int32_t j = 0; j < n; j++) {
    int n_bits = ((contexts[j] & (DOWN - 1)) >> 3) - 8;
    int64_t detail = details[j];
    if (detail == -ZERO_SYMBOL) {
      uint64_t bits = ISA(take_raw)(z, 33);
      detail = (int64_t)(bits & 0xFFFFFFFFu) - (int64_t)(bits >> 32 << 32);
    } else if (n_bits > 0) {
      detail = detail * ((int64_t)1 << n_bits) + (int64_t)ISA(take_raw)(z, n_bits);
    } else {
      continue;
    }
    details[j] = (int32_t)clamp_i64(detail, -most, most);
  }
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

/* And their details back, 0 for voids; behind the last one is another. */
static ALWAYS_INLINE void ISA(unpack_plain)(const int32_t *packed, const uint8_t *valid, size_t step, int32_t n, int32_t *details) {
  for (int32_t j = 0; j < n; j++) {
    int is_valid = valid[(size_t)j * step];
    details[j] = *packed & -is_valid;
    packed += is_valid;
  }
}

/* Details of a row that are read without voids between them: the row's own, or those of its valid samples. */
typedef struct ISA(span) {
  int32_t *details;
  const int32_t *contexts;
  int32_t n;
  rapid_streams *streams;
  int has_raw;
} ISA(span);

/* Details number j ... n - 1 of a span, towards the side of their contexts. */
static void ISA(read_one_by_one)(ISA(span) * s, int32_t j, const uint32_t *slots) {
  rapid_streams *z = s->streams;
  uint32_t last = z->n_states - 1;
  size_t before = min_size(z->n_words_used, z->n_words);
  const uint8_t *words = z->words + 2 * before; /* a row takes at most a word a sample: PAYLOAD_SLACK */
  size_t k = z->n_symbols, n_taken = 0;
  int has_raw = s->has_raw;
  for (; j < s->n; j++) {
    uint32_t context = (uint32_t)s->contexts[j] & (DOWN - 1);
    uint32_t x = z->states[k & last], entry = slots[context << 11 | (x & (SLOTS - 1))];
    uint32_t next = (entry >> 6 & 4095) * (x >> 11) + (entry >> 18);
    /* Whether a word follows is hard to foresee: no branch. */
    uint32_t takes = next < 65536, word = load_u16(words + 2 * n_taken);
    z->states[k & last] = takes ? next << 16 | word : next;
    n_taken += takes;
    k++;
    uint32_t symbol = entry & 63;
    s->details[j] = (int32_t)symbol - ZERO_SYMBOL;
    has_raw |= (symbol == 0) | (context >= FIRST_RAW);
  }
  s->has_raw = has_raw;
  z->n_symbols = k;
  z->n_words_used += n_taken;
}

#ifdef HAS_VECTORS
/* Two taps side by side: where the row of pairs begins, and their weights. */
typedef struct ISA(pair_of_taps) {
  const int32_t *at;
  int16_t first, second;
} ISA(pair_of_taps);
#endif

#if defined(HAS_AVX2)
#include "rapid_vectors.h"
#elif defined(HAS_SIMD128)
#include "rapid_simd128.h"
#else
#define READ_RAW ISA(read_raw)
#define PACK ISA(pack_plain)
#define UNPACK ISA(unpack_plain)
#endif

#ifdef HAS_VECTORS
/* Read spans of n >= 1 units in turns: each step waits for the one before it in its own stream. */
static void ISA(read_vectors)(ISA(span) * s, int n, const uint32_t *slots) {
  ISA(span) *spans[MOST_TOGETHER] = {s}; /* the longest first */
  ISA(lanes) l[MOST_TOGETHER];
  for (int k = 1; k < n; k++) {
    int i = k;
    for (; i > 0 && spans[i - 1]->n < s[k].n; i--) spans[i] = spans[i - 1];
    spans[i] = &s[k];
  }
  ISA(begin_lanes)(&l[0], spans[0]->streams);
  for (int k = 1; k < n; k++) ISA(begin_lanes)(&l[k], spans[k]->streams);
  int32_t j = 0;
  if (n > 3) j = ISA(read_in_turns)(l, spans, 4, j, slots);
  if (n > 2) j = ISA(read_in_turns)(l, spans, 3, j, slots);
  if (n > 1) j = ISA(read_in_turns)(l, spans, 2, j, slots);
  ISA(read_in_turns)(l, spans, 1, j, slots);
}
#endif

static void ISA(read_span)(ISA(span) * s, const uint32_t *slots) {
#ifdef HAS_VECTORS
  if (s->streams->n_states == 8) {
    ISA(read_vectors)(s, 1, slots);
    return;
  }
#endif
  ISA(read_one_by_one)(s, 0, slots);
}

#if defined(TWZ_SANITIZED)
#define SMALL /* compilers would take minutes */
#elif defined(HAS_SIMD128)
#define SMALL /* few units are not short, and every page loads the module */
#pragma clang attribute push(__attribute__((minsize)), apply_to = function)
#endif
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
#ifdef HAS_SIMD128
#undef SMALL
#pragma clang attribute pop
#endif

#ifdef HAS_VECTORS
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
