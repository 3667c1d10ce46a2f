/*
 * Vectors of 16-bit samples for kernels of method rapid: of x86 with 128, 256 or 512 bits, of WebAssembly, of whatever
 * GCC and clang have for others, or one sample at a time. Sums are of 32 bits, of all LANES samples.
 */
#if defined(TWZ_HAVE_X86) || defined(__SSE2__)
#include <immintrin.h>
#if defined(__AVX512VBMI2__)
#define VECTOR __m512i
#define V(name) _mm512_##name
#define V_SI(name) _mm512_##name##_si512
#define LOAD(at) _mm512_loadu_si512(at)
#define STORE(at, v) _mm512_storeu_si512(at, v)
#define ABOVE(a, b) _mm512_movm_epi16(_mm512_cmpgt_epi16_mask(a, b))
#define ADD_DOT(sum, a, b) _mm512_dpwssd_epi32(sum, a, b)
#else
#if defined(__AVX2__)
#define VECTOR __m256i
#define V(name) _mm256_##name
#define V_SI(name) _mm256_##name##_si256
#else
#define VECTOR __m128i
#define V(name) _mm_##name
#define V_SI(name) _mm_##name##_si128
#endif
#define LOAD(at) V_SI(loadu)((const VECTOR *)(const void *)(at))
#define STORE(at, v) V_SI(storeu)((VECTOR *)(void *)(at), v)
#define ABOVE(a, b) V(cmpgt_epi16)(a, b)
#define ADD_DOT(sum, a, b) V(add_epi32)(sum, V(madd_epi16)(a, b))
#endif
#define LANES ((int)sizeof(VECTOR) / 2)
#define SPLAT(x) V(set1_epi16)((int16_t)(x))
#define ADD(a, b) V(add_epi16)(a, b)
#define SUB(a, b) V(sub_epi16)(a, b)
#define MUL(a, b) V(mullo_epi16)(a, b)
#define LEAST(a, b) V(min_epi16)(a, b)
#define MOST(a, b) V(max_epi16)(a, b)
#define XOR(a, b) V_SI(xor)(a, b)
#define QUARTER(a) V(srai_epi16)(a, 2)
/* Even samples, and odd ones. */
typedef struct ISA(sums) { VECTOR even, odd; } ISA(sums);
typedef VECTOR ISA(tap_weights);
#define TWO_WEIGHTS(a, b) V(set1_epi32)((int32_t)((uint32_t)(uint16_t)(a) | (uint32_t)(uint16_t)(b) << 16))
#define NO_SUMS {V_SI(setzero)(), V_SI(setzero)()}
#define ADD_TAPS(sums, at, w) ((sums).even = ADD_DOT((sums).even, LOAD(at), w), (sums).odd = ADD_DOT((sums).odd, LOAD((at) + 1), w))
static ALWAYS_INLINE VECTOR ISA(quarters)(ISA(sums) s) {
  VECTOR even = V(srai_epi32)(s.even, 10), odd = V(srai_epi32)(s.odd, 10);
  return V(unpacklo_epi16)(V(packs_epi32)(even, even), V(packs_epi32)(odd, odd));
}

#elif defined(__wasm_simd128__)
#include <wasm_simd128.h>
#define VECTOR v128_t
#define LANES 8
#define LOAD(at) wasm_v128_load(at)
#define STORE(at, v) wasm_v128_store(at, v)
#define SPLAT(x) wasm_i16x8_splat((int16_t)(x))
#define ADD(a, b) wasm_i16x8_add(a, b)
#define SUB(a, b) wasm_i16x8_sub(a, b)
#define MUL(a, b) wasm_i16x8_mul(a, b)
#define LEAST(a, b) wasm_i16x8_min(a, b)
#define MOST(a, b) wasm_i16x8_max(a, b)
#define XOR(a, b) wasm_v128_xor(a, b)
#define QUARTER(a) wasm_i16x8_shr(a, 2)
#define ABOVE(a, b) wasm_i16x8_gt(a, b)
typedef struct ISA(sums) { v128_t even, odd; } ISA(sums);
typedef v128_t ISA(tap_weights);
#define TWO_WEIGHTS(a, b) wasm_i32x4_splat((int32_t)((uint32_t)(uint16_t)(a) | (uint32_t)(uint16_t)(b) << 16))
#define NO_SUMS {wasm_i32x4_const_splat(0), wasm_i32x4_const_splat(0)}
#define ADD_DOT(sum, a, b) wasm_i32x4_add(sum, wasm_i32x4_dot_i16x8(a, b))
#define ADD_TAPS(sums, at, w) ((sums).even = ADD_DOT((sums).even, LOAD(at), w), (sums).odd = ADD_DOT((sums).odd, LOAD((at) + 1), w))
static ALWAYS_INLINE v128_t ISA(quarters)(ISA(sums) s) {
  v128_t both = wasm_i16x8_narrow_i32x4(wasm_i32x4_shr(s.even, 10), wasm_i32x4_shr(s.odd, 10));
  return wasm_i16x8_shuffle(both, both, 0, 4, 1, 5, 2, 6, 3, 7);
}

#else
#if defined(__ARM_NEON)
#include <arm_neon.h>
#define VECTOR int16x8_t
#define LANES 8
#define LOAD(at) vld1q_s16(at)
#define STORE(at, v) vst1q_s16(at, v)
#define SPLAT(x) vdupq_n_s16((int16_t)(x))
#define ADD(a, b) vaddq_s16(a, b)
#define SUB(a, b) vsubq_s16(a, b)
#define MUL(a, b) vmulq_s16(a, b)
#define LEAST(a, b) vminq_s16(a, b)
#define MOST(a, b) vmaxq_s16(a, b)
#define XOR(a, b) veorq_s16(a, b)
#define QUARTER(a) vshrq_n_s16(a, 2)
#define ABOVE(a, b) vreinterpretq_s16_u16(vcgtq_s16(a, b))
typedef struct ISA(sums) { int32x4_t low, high; } ISA(sums);
#define NO_SUMS {vdupq_n_s32(0), vdupq_n_s32(0)}
static ALWAYS_INLINE void ISA(add_tap)(ISA(sums) *s, const int16_t *at, int16_t w) {
  s->low = vmlal_n_s16(s->low, vld1_s16(at), w);
  s->high = vmlal_n_s16(s->high, vld1_s16(at + 4), w);
}
static ALWAYS_INLINE int16x8_t ISA(quarters)(ISA(sums) s) {
  return vcombine_s16(vqmovn_s32(vshrq_n_s32(s.low, 10)), vqmovn_s32(vshrq_n_s32(s.high, 10)));
}
#else
#define VECTOR int32_t
#define LANES 1
#define LOAD(at) ((int32_t)*(at))
#define STORE(at, v) (*(at) = (int16_t)(v))
#define SPLAT(x) ((int32_t)(x))
#define ADD(a, b) ((a) + (b))
#define SUB(a, b) ((a) - (b))
#define MUL(a, b) ((a) * (b))
#define LEAST(a, b) min_i32(a, b)
#define MOST(a, b) max_i32(a, b)
#define XOR(a, b) ((a) ^ (b))
#define QUARTER(a) ((a) >> 2)
#define ABOVE(a, b) (-(int32_t)((a) > (b)))
typedef int32_t ISA(sums);
#define NO_SUMS 0
static ALWAYS_INLINE void ISA(add_tap)(ISA(sums) *s, const int16_t *at, int16_t w) { *s += *at * w; }
static ALWAYS_INLINE int32_t ISA(quarters)(ISA(sums) s) { return s >> 10; }
#endif
typedef struct ISA(tap_weights) { int16_t first, second; } ISA(tap_weights);
#define TWO_WEIGHTS(a, b) ((ISA(tap_weights)){a, b})
#define ADD_TAPS(sums, at, w) (ISA(add_tap)(&(sums), at, (w).first), ISA(add_tap)(&(sums), (at) + 1, (w).second))
#endif
#define TWICE(a) ADD(a, a)
#define ABS(a) MOST(a, SUB(SPLAT(0), a))
