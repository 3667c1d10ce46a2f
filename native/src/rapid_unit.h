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

enum { HH, HL, LH };

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

#define NUMBER int64_t
#define NAMED(name) ISA(wide_##name)
#include "rapid_rows.h"
#undef NUMBER
#undef NAMED

#define NUMBER int32_t
#define NAMED(name) ISA(narrow_##name)

#if defined(__AVX2__) && defined(TWZ_HAVE_X86)
/*
 * Eight states at once (R.8): symbol number k is of state k mod 8. Lanes from the first sample's state on;
 * of the last samples less than eight are active.
 */
static ALWAYS_INLINE __m256i ISA(step)(__m256i x, __m256i active, const int32_t *contexts, int32_t *details,
                                       const uint32_t *slots, const uint8_t **words, const rapid_streams *z,
                                       __m256i *has_raw) {
  __m256i c = _mm256_and_si256(_mm256_maskload_epi32(contexts, active), _mm256_set1_epi32(DOWN - 1));
  __m256i slot = _mm256_or_si256(_mm256_slli_epi32(c, 11), _mm256_and_si256(x, _mm256_set1_epi32(SLOTS - 1)));
  __m256i entry = _mm256_i32gather_epi32((const int *)slots, slot, 4);
  __m256i symbol = _mm256_and_si256(entry, _mm256_set1_epi32(63));
  __m256i frequency = _mm256_and_si256(_mm256_srli_epi32(entry, 6), _mm256_set1_epi32(4095));
  __m256i next = _mm256_add_epi32(_mm256_mullo_epi32(frequency, _mm256_srli_epi32(x, 11)), _mm256_srli_epi32(entry, 18));
  _mm256_maskstore_epi32(details, active, _mm256_sub_epi32(symbol, _mm256_set1_epi32(ZERO_SYMBOL)));
  __m256i raw = _mm256_or_si256(_mm256_cmpgt_epi32(c, _mm256_set1_epi32(FIRST_RAW - 1)),
                                _mm256_cmpeq_epi32(symbol, _mm256_setzero_si256()));
  *has_raw = _mm256_or_si256(*has_raw, _mm256_and_si256(raw, active));
  __m256i takes = _mm256_and_si256(_mm256_cmpeq_epi32(_mm256_srli_epi32(next, 16), _mm256_setzero_si256()), active);
  unsigned mask = (unsigned)_mm256_movemask_ps(_mm256_castsi256_ps(takes));
#if defined(__AVX512VBMI2__) && defined(__AVX512VL__)
  (void)z;
  __m256i word = _mm256_cvtepu16_epi32(_mm_maskz_expandloadu_epi16((__mmask8)mask, *words));
#else
  __m256i word = _mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i *)*words));
  __m256i order = _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)z->expand[mask]));
  word = _mm256_permutevar8x32_epi32(word, order);
#endif
  *words += 2 * (unsigned)_mm_popcnt_u32(mask);
  next = _mm256_blendv_epi8(next, _mm256_or_si256(_mm256_slli_epi32(next, 16), word), takes);
  return _mm256_blendv_epi8(x, next, active);
}

/* A span of details to be read, without voids, of eight states. */
typedef struct ISA(span) {
  int32_t *details;
  const int32_t *contexts;
  int32_t n;
  rapid_streams *streams;
  int has_raw;
} ISA(span);
#define span ISA(span)

/* Where a stream is: its states, the first sample's first, the words taken, and which samples have raw bits. */
typedef struct ISA(lanes) {
  __m256i x, raw;
  const uint8_t *words, *at;
} ISA(lanes);

static ALWAYS_INLINE __m256i ISA(rotated)(const rapid_streams *z, int sign) {
  const __m256i lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
  int rotation = sign * (int)(z->n_symbols & 7);
  return _mm256_and_si256(_mm256_add_epi32(lanes, _mm256_set1_epi32(rotation)), _mm256_set1_epi32(7));
}

static ALWAYS_INLINE void ISA(begin_lanes)(ISA(lanes) * l, const rapid_streams *z) {
  l->x = _mm256_permutevar8x32_epi32(_mm256_loadu_si256((const __m256i *)z->states), ISA(rotated)(z, 1));
  l->raw = _mm256_setzero_si256();
  l->words = l->at = z->words + 2 * min_size(z->n_words_used, z->n_words); /* a row takes a word a sample: PAYLOAD_SLACK */
}

/* Samples j ... n - 1 of a span, and its end. */
static ALWAYS_INLINE void ISA(end_lanes)(ISA(lanes) * l, span *s, int32_t j, const uint32_t *slots) {
  const __m256i lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), all = _mm256_set1_epi32(-1);
  rapid_streams *z = s->streams;
  for (; j + 8 <= s->n; j += 8) l->x = ISA(step)(l->x, all, s->contexts + j, s->details + j, slots, &l->at, z, &l->raw);
  if (j < s->n) {
    __m256i active = _mm256_cmpgt_epi32(_mm256_set1_epi32(s->n - j), lanes);
    l->x = ISA(step)(l->x, active, s->contexts + j, s->details + j, slots, &l->at, z, &l->raw);
  }
  _mm256_storeu_si256((__m256i *)z->states, _mm256_permutevar8x32_epi32(l->x, ISA(rotated)(z, -1)));
  s->has_raw = !_mm256_testz_si256(l->raw, l->raw);
  z->n_words_used += (size_t)(l->at - l->words) / 2;
  z->n_symbols += (size_t)s->n;
}

/* Read one span or two, of two units, in turns: each step waits for the one before it in its own stream. */
static void ISA(read_vectors)(span *s, int n, const uint32_t *slots) {
  const __m256i all = _mm256_set1_epi32(-1);
  ISA(lanes) a, b;
  int32_t j = 0;
  ISA(begin_lanes)(&a, s->streams);
  if (n == 2) {
    ISA(begin_lanes)(&b, s[1].streams);
    for (; j + 8 <= min_i32(s[0].n, s[1].n); j += 8) {
      a.x = ISA(step)(a.x, all, s[0].contexts + j, s[0].details + j, slots, &a.at, s[0].streams, &a.raw);
      b.x = ISA(step)(b.x, all, s[1].contexts + j, s[1].details + j, slots, &b.at, s[1].streams, &b.raw);
    }
    ISA(end_lanes)(&b, &s[1], j, slots);
  }
  ISA(end_lanes)(&a, &s[0], j, slots);
}
#define READ_VECTORS ISA(read_vectors)
#endif

#include "rapid_rows.h"

#ifdef READ_VECTORS
#define DECODE_PAIR NAMED(decode_pair)
#else
#define DECODE_PAIR NULL
#endif

static twz_status ISA(decode_unit_rapid)(rapid_unit *u, twz_error *error) {
  return u->is_wide ? ISA(wide_decode)(u, error) : ISA(narrow_decode)(u, error);
}
