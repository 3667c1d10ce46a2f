/* Samples that units share (P.3 of format-predictive.md, FORMAT §7.3), as predictive and cdf97 code them. */
#ifndef TWZ_BORDER_H
#define TWZ_BORDER_H

#include "range.h"

enum { N_BORDER_MODELS = 2860, LINE_EDGE = 2 /* places on both sides of the sums of a line */ };

/* Decodes them; all but the last four fields are given. */
typedef struct border {
  const job *job;
  coder *coder;
  int32_t step;
  int are_inherited_coded; /* samples of even row and column, too */
  /* Make the predictions of a line from the sums of its parent's lines before and after it. */
  void (*predict)(int64_t *sums, int32_t length, int64_t *predicted);
  model *models;
  uint8_t *known;             /* of the region: which samples are decoded */
  int64_t *sums, *predicted;  /* of a line */
  uint8_t *is_coded;
} border;

size_t border_bytes(const job *j);
void border_start(border *b, const model *starts, scratch *s);
int64_t border_symbol(border *b, int pass, int64_t s);
/* Rebuild the height at a place of the region. */
void border_put(border *b, size_t at, int64_t prediction, int64_t q);
void decode_border(border *b);

/* Inflate start values of models, as annexes write them. */
twz_status read_starts(const twz_file *f, const uint8_t *bytes, size_t n, model *models, size_t n_models, twz_error *error);

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

#endif
