/* Distances in steps and logarithms, which predictive (P.5, P.6) and cdf97 (FORMAT §7.7) share. */
#ifndef TWZ_STEPS_H
#define TWZ_STEPS_H

#include "internal.h"

typedef struct step_scale {
  int shift;       /* k: the smallest with n >> k < 4096 */
  int64_t inverse; /* I */
} step_scale;

static inline step_scale step_scale_of(int32_t n) {
  step_scale s = {0, 0};
  while (n >> s.shift >= 4096) s.shift++;
  s.inverse = ((int64_t)1 << 22) / (n >> s.shift);
  return s;
}

/* steps(d, f): about d / n in 1/2^f. */
static ALWAYS_INLINE int64_t steps(const step_scale *s, int64_t d, int f) {
  return ((min_i64(d, (int64_t)1 << 40) >> s->shift) * s->inverse) >> (22 - f);
}

/* By v below 4096: the greatest g with 2^g <= v^8, 0 for 0. */
typedef struct eighths {
  uint8_t of[4096];
} eighths;

static inline void fill_eighths(eighths *e) {
  static const int THRESHOLDS[7] = {4467, 4871, 5312, 5793, 6317, 6889, 7513}; /* 2^(12 + i/8), rounded up */
  e->of[0] = 0;
  for (int v = 1; v < 4096; v++) {
    int log2 = bit_length((uint64_t)v) - 1, more = 0;
    while (more < 7 && v << (12 - log2) >= THRESHOLDS[more]) more++;
    e->of[v] = (uint8_t)(8 * log2 + more);
  }
}

static ALWAYS_INLINE int lg(const eighths *e, int64_t v) {
  if (v < 4096) return v <= 0 ? 0 : e->of[v];
  if (v < 1 << 20) return e->of[v >> 8] + 64;
  if (v < 1 << 28) return e->of[v >> 16] + 128;
  return e->of[min_i64(v >> 24, 4095)] + 192;
}

#endif
