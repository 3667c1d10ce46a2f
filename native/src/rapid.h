/* Method rapid (docs/format-rapid.md, R.n): tables of a file, and what its kernels are given. */
#ifndef TWZ_RAPID_H
#define TWZ_RAPID_H

#include "internal.h"

enum {
  HH, HL, LH,
  LIMIT = 8191,          /* of samples of planes */
  MARGIN = 4,            /* rows and columns outside of a plane */
  N_TAPS = 24,
  N_LEVEL_CLASSES = 4,
  SLOT_BITS = 12,
  SLOTS = 1 << SLOT_BITS,
  N_TABLES = 128,
  SINGLES = 64,          /* tables of single samples: from here on */
  NO_PAIR = 63, NO_SINGLE = 127, ESCAPED = 126,
  MOST_CLASS = 59,
  HIDDEN = 255,          /* class of what is not coded */
  PAIR_ESCAPE = 225, SINGLE_ESCAPE = 63, NO_DETAILS = 112, NO_DETAIL = 31,
  MOST_STATES = 32,
  FIRST_STATE = 1 << 16,
  MOST_BANDS = 4,
  STRIP = 8              /* rows of a plane that are coded together */
};

/* The slots of the symbol of no detail. */
typedef struct rapid_rest {
  uint16_t first, n;
} rapid_rest;

typedef struct rapid_tables {
  uint32_t slots[N_TABLES << SLOT_BITS]; /* symbol, (frequency - 1) << 8, place among the symbol's slots << 20; of a large page */
  rapid_rest rests[N_TABLES];
  int k_max, cut; /* pairs of classes below the cut have symbols */
  int16_t stencils[N_LEVEL_CLASSES][3][N_TAPS];
  int32_t weights[N_LEVEL_CLASSES][3][4];
  uint8_t take[256][16], put[256][16]; /* by which of eight pairs are two singles: where entries come from, and go to */
  uint8_t expand[256][8];              /* by mask of lanes: how many set bits are below each */
} rapid_tables;

/* Streams of a band. */
typedef struct rapid_stream {
  uint32_t states[MOST_STATES];
  const uint8_t *words, *words_end, *raw;
  size_t n_raw, n_bits;
} rapid_stream;

/* What is added to expected magnitudes: (of_range, of_bend) >> shift, of_near, constant. */
typedef struct rapid_weights {
  int32_t constant, of_range, of_bend, of_near, shift;
} rapid_weights;

/* A lattice, and the unit that it is of. */
typedef struct rapid_unit {
  const rapid_tables *tables;
  scratch *scratch;
  int32_t step, z_min, z_max;  /* of the file */
  int32_t low, high;           /* of the unit's heights */
  int32_t most_detail;
  int is_narrow, shift, n_states, n_bands;
  int is_encoded;              /* predictions are not settled: an encoder does (encode.h) */
  rapid_stream bands[MOST_BANDS];

  int32_t n_rows, n_cols;
  int level_class;
  int32_t origin;              /* what planes' heights are less */
  /* The parent's samples, from the first one on: one of the two. */
  const int32_t *parent;
  const int16_t *short_parent; /* less parent_origin */
  int32_t parent_origin;
  ptrdiff_t parent_stride;
  const uint8_t *valid;        /* of the lattice; NULL: all are valid */
  ptrdiff_t valid_stride, valid_step;
  const int32_t *corrections;  /* of the lattice, so far apart; NULL: none */
  ptrdiff_t corrections_stride, corrections_step;
  int known[4];                /* sides that are shared: top, left, bottom, right */
  int32_t rows[2], cols[2];    /* which heights are wanted, from the first one up to, not with, the second */

  /* Where they go: heights and `add`, in 32 bits or 16. */
  void *out;
  ptrdiff_t out_stride;        /* in heights */
  int is_short;
  uint32_t add;
  int is_part;                 /* found: not all strips were needed */
} rapid_unit;

/* Strips of a lattice of so many rows, and the first one of a band. */
static inline int32_t rapid_strips(int32_t n_rows) { return (n_rows / 2 + 1 + STRIP - 1) / STRIP; }
static inline int32_t rapid_band(int32_t n_rows, int band, int n_bands) { return band * rapid_strips(n_rows) / n_bands; }

/* The first strip that is read for rows of a lattice from one on: HL needs HH from two rows above on (R.5). */
static inline int rapid_first_band(int32_t n_rows, int32_t row, int n_bands) {
  int band = 0, strip = max_i32(row / 2 - 2, 0) / STRIP;
  while (strip >= rapid_band(n_rows, band + 1, n_bands)) band++;
  return band;
}

/* How many bands the payload of a unit has, if it is sound. */
int rapid_bands(const twz_file *f, const uint8_t *payload, size_t n);

/* The weights of a plane for features of shifted heights. */
void weigh_rapid(const rapid_unit *u, int plane, rapid_weights *made);

/* Decode the details and heights of a lattice. */
typedef twz_status (*rapid_decoder)(rapid_unit *u, twz_error *error);

#endif
