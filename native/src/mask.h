/* Lattices of a mask while it is decoded (FORMAT §5.2), by the kernels of mask_rows.h. */
#ifndef TWZ_MASK_H
#define TWZ_MASK_H

#include "encode_mask.h"

/*
 * Planes: the parent's samples (A), then odd rows and columns (ODD_BOTH), odd columns (ODD_COLS), odd rows (ODD_ROWS). Before a sample is
 * read, its byte is its context: its four neighbours, and more if it is implied void.
 */
enum { A, ODD_BOTH, ODD_COLS, ODD_ROWS, N_PLANES };
enum { OWN = 1, VALID = 2, UNKNOWN = 4, IMPLIED = 16, NONE = 0, ALL = 15 };
enum { MASK_GROUP = 32, LEFT = 8, N_AT_ONCE = 4096, N_AHEAD = 32 };
enum { MOST = 2 * 1024 + 4 }; /* samples of a region along an axis, or more (§2.4) */
/* Models (§5.2). */
enum { CORNER = 48, FILL = 49, GROUPS = 50, N_MODELS = 62, N_GROUP_SETS = 7 };
enum { MASK_SLOT_BITS = 12, N_SLOTS = 1 << MASK_SLOT_BITS, STATE_START = 1 << 16, MASK_STATES = 4 };

typedef struct bits {
  mask_job *job; /* of an encoder: it notes what a decoder reads, of samples that it knows. NULL: a decoder's */
  const uint8_t *truth;
  ptrdiff_t own_step; /* of a lattice's samples in the region */
  const uint8_t *words; /* some more than there are may be read: PAYLOAD_SLACK */
  size_t n_words, at;
  uint32_t states[MASK_STATES], n_read, mask; /* mask: one less than there are states */
  uint16_t ones[N_MODELS];
  int is_short;
} bits;

/* Samples that wait until many are read at once. */
typedef struct list {
  uint8_t models[N_AT_ONCE + MOST], bits[N_AT_ONCE + MOST];
  uint8_t *places[N_AT_ONCE + MOST];
  int32_t n;
} list;

/* The parent's samples, the first of them at (row, col) of the region's first even row and column. */
typedef struct above {
  const uint8_t *own, *valid; /* NULL: all */
  size_t pitch;
  int32_t n_rows, n_cols, row, col;
  int is_void;
} above;

typedef struct lattice {
  int32_t n_rows, n_cols, p, q; /* p, q: 1 if the first row, column is odd */
  int32_t rows[N_PLANES], cols[N_PLANES];
  size_t pitch, size;
  uint8_t *planes, *groups, *kinds, *opened, *cells;
  uint8_t all, any; /* bits of all cells, of any; once they are decoded */
  uint8_t *truth; /* of an encoder: own samples, in the places of a plane's */
  list *list;
} lattice;

#endif
