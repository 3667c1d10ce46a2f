/* Method rapid (docs/format-rapid.md, R.n): tables of a file, and what its kernels are given. */
#ifndef TWZ_RAPID_H
#define TWZ_RAPID_H

#include "internal.h"

enum {
  N_CONTEXTS = 176,
  N_SYMBOLS = 63,
  SLOTS = 2048,
  N_CLASSES = 4,
  N_TAPS = 24,
  DOWN = 256,        /* of a context: the detail counts downwards */
  FIRST_RAW = 72,    /* contexts from here on have raw bits */
  ZERO_SYMBOL = 31,
  MARGIN = 4,        /* rows and columns around a plane */
  HELD_ROWS = 8,     /* of a plane: what rows that are decoded need of it; a power of two */
  REACH_OUTSIDE = 3, /* columns outside that hold samples */
  CORNER_ROW = 64,
  SHARED = 3         /* row of features of shared samples */
};

typedef struct rapid_tables {
  int k_max, is_by_reach;
  int64_t widest;                                /* largest sum of absolute weights (R.2) */
  int16_t stencils[N_CLASSES][3][N_TAPS];
  int32_t features[N_CLASSES][4][9];             /* scaled by the step (R.7) */
  uint32_t slots[N_CONTEXTS * SLOTS];            /* symbol, frequency << 6, (slot - first) << 18 */
  uint8_t expand[256][8];                        /* by mask of lanes: how many set bits are below each */
} rapid_tables;

/* What follows from the step and the range of heights. */
typedef struct rapid_scale {
  int32_t step, log2, is_fine, is_by_reach, side_shift, range_shift, most_range, side_scale, far_scale, end_shift;
  int64_t most_detail;
  int32_t low, high, origin; /* low and high less the origin */
} rapid_scale;

typedef struct rapid_streams {
  uint32_t states[8];
  uint32_t n_states;
  const uint8_t *words, *raw;
  size_t n_words, n_raw;
  size_t n_symbols, n_words_used, n_bits;
  const uint8_t (*expand)[8]; /* by mask: of each lane, which of the words read is its */
} rapid_streams;

typedef struct rapid_unit {
  const job *job;
  const rapid_tables *tables;
  rapid_scale scale;
  rapid_streams streams;
  scratch *scratch;
  int32_t n_turns; /* of the lattice of a group: until all rows that are wanted are there */
  int is_wide;  /* sums need 64 bits */
  int is_short; /* of a group: heights less the origin, which is the file's, fit 16 bits, and are kept as such */
} rapid_unit;

/* Decode a unit whose streams are set up. */
typedef twz_status (*rapid_decoder)(rapid_unit *u, twz_error *error);
/* Up to MOST_TOGETHER short ones of eight states, in turns. */
typedef twz_status (*rapid_groups_decoder)(rapid_unit *units, int n, twz_error *error);

#endif
