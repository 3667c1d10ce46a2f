/* Lines that units share: which they are (P.3 of format-predictive.md, FORMAT §7.3). */
#ifndef TWZ_BORDER_H
#define TWZ_BORDER_H

#include "internal.h"

/* The region's lines near each shared side of an axis, of one side or two. */
typedef struct shared_lines {
  int n_sides;
  int32_t first[2], last[2];
} shared_lines;

static inline void find_shared_lines(shared_lines *l, const axis *a, int32_t rings) {
  l->n_sides = 0;
  for (int i = 0; i < 2; i++) {
    if (!a->shared[i]) continue;
    int32_t side = i ? a->core + a->n_core - 1 : a->core;
    l->first[l->n_sides] = max_i32(side - rings, 0);
    l->last[l->n_sides++] = min_i32(side + rings, a->n - 1);
  }
}

/* The parent's line at or before (after) a line of the level, counted from the first parent height. */
static inline int32_t line_above(uint32_t line, int is_after, uint32_t first, int32_t n) {
  uint32_t at = (uint32_t)(((uint64_t)line + (is_after ? 1u : 0u)) >> 1);
  return min_i32((int32_t)(at - first), n - 1);
}

#endif
