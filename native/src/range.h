/* The range coder and its models (FORMAT §6): inline, as the loops of methods are made of it. */
#ifndef TWZ_RANGE_H
#define TWZ_RANGE_H

#include "internal.h"

/* A model in one number: P (22 bits) above c (8 bits). */
typedef uint32_t model;
#define MODEL(p, c) ((uint32_t)(p) << 8 | (uint32_t)(c))
#define FRESH_MODEL MODEL(1 << 21, 0)

typedef struct coder {
  uint32_t range, code;
  const uint8_t *bytes;
  size_t n, position;
  const int32_t *rates;
} coder;

static ALWAYS_INLINE uint32_t next_byte(coder *c) {
  size_t at = c->position++;
  return at < c->n ? c->bytes[at] : 0;
}

static inline void coder_start(coder *c, const uint8_t *bytes, size_t n, const int32_t *rates) {
  c->range = 0xFFFFFFFFu;
  c->code = 0;
  c->bytes = bytes;
  c->n = n;
  c->position = 0;
  c->rates = rates;
  for (int i = 0; i < 4; i++) c->code = c->code << 8 | next_byte(c);
}

static ALWAYS_INLINE void renormalise(coder *c) {
  while (c->range < 1u << 24) {
    c->code = c->code << 8 | next_byte(c);
    c->range <<= 8;
  }
}

static ALWAYS_INLINE int split(coder *c, uint32_t p) {
  uint32_t bound = (c->range >> 16) * p;
  int bit = c->code < bound;
  c->code = bit ? c->code : c->code - bound;
  c->range = bit ? bound : c->range - bound;
  renormalise(c);
  return bit;
}

static ALWAYS_INLINE model learned(const coder *c, model m, int bit) {
  uint32_t p = m >> 8, count = m & 255;
  uint64_t rate = (uint64_t)c->rates[count];
  p = bit ? p + (uint32_t)((((1u << 22) - p) * rate) >> 16) : p - (uint32_t)((p * rate) >> 16);
  return p << 8 | (count + (count < 254));
}

static ALWAYS_INLINE int adaptive_bit(coder *c, model *m) {
  model before = *m;
  int bit = split(c, (before >> 14) | 1);
  *m = learned(c, before, bit);
  return bit;
}

static inline uint64_t raw_bits(coder *c, int k) {
  uint64_t value = 0;
  for (; k > 0; k--) {
    c->range >>= 1;
    int bit = c->code >= c->range;
    if (bit) c->code -= c->range;
    value = value << 1 | (uint64_t)bit;
    renormalise(c);
  }
  return value;
}

/* magnitude(F, X, k) of §6.5. */
static inline int64_t magnitude(coder *c, model *unary, model *prefix, int k) {
  int u = 0;
  while (u < 14 && adaptive_bit(c, unary + u)) u++;
  if (u < 14) return ((int64_t)u << k) | (int64_t)raw_bits(c, k);
  int e = 0;
  while (e < 31 && adaptive_bit(c, prefix + e)) e++;
  int64_t r = (int64_t)raw_bits(c, e + k);
  return ((int64_t)14 << k) + (((int64_t)1 << (e + k)) | r) - ((int64_t)1 << k);
}

/* Is more read than there is? Nothing that follows counts: loops over rows end here. */
static inline int coder_is_cut(const coder *c) { return c->position > c->n + 3; }

/* Has all been read that there is, and no more? */
static inline twz_status coder_end(const coder *c, const char *name, twz_error *error) {
  REQUIRE(c->position == c->n + 3, error, "%s: %s", name,
          coder_is_cut(c) ? "the stream is cut" : "bytes are left over behind the stream");
  return TWZ_OK;
}

/* bin(s) of §6.6. */
static inline int bin_of(int64_t s) {
  static const int16_t THRESHOLDS[33] = {1,   2,   3,   4,   5,   6,   8,   10,  12,   16,   20,
                                         25,  32,  40,  51,  64,  81,  102, 128, 162,  204,  256,
                                         324, 408, 512, 648, 816, 1024, 1296, 1632, 2048, 2592, 3264};
  int low = 0, high = 33; /* how many are <= s */
  while (low < high) {
    int middle = (low + high) / 2;
    if (THRESHOLDS[middle] <= s) low = middle + 1; else high = middle;
  }
  return low;
}

/* Start values of models, as annexes write them: (v >> 4) 2^10 and 2 (v mod 16). */
static inline model started(uint32_t v) { return MODEL((v >> 4) << 10, 2 * (v & 15)); }

/*
 * Read a stencil that is told by its difference from `stencil`, which is changed (P.10, R.10); core: the taps
 * of the core, the missing one first; the magnitudes of two groups of 46 models. In rapid.c.
 */
twz_status read_changed_stencil(coder *c, model *models, int n_taps, const int *core, int16_t *stencil, twz_error *error);

#endif
