/*
 * The encoder of method rapid, for Python's package (native/python/shim.c): no part of the library's interface. Bytes and
 * heights are those of src/terrainwave/codec/rapid: integers, and single divisions of floats that are exact.
 */
#ifndef TWZ_ENCODE_H
#define TWZ_ENCODE_H

#include "encode_mask.h"
#include "rapid.h"

enum { N_SYMBOLS = 256, N_FEATURES = 3, LEAST_SIDE = 10 };

/* Tables of a file. */
typedef struct encode_tables {
  twz_allocator allocator;
  rapid_tables *rapid;                     /* without slots */
  /* Of a symbol, those of symbols before it << 13, and at most so many bits as it costs << 26. */
  uint32_t freqs[N_TABLES * N_SYMBOLS];
} encode_tables;

enum { FREQ_BITS = 13, FREQ_MASK = (1 << FREQ_BITS) - 1, COST_SHIFT = 2 * FREQ_BITS };

/* A unit that is encoded. Arrays have n_rows * n_cols samples, row by row. */
typedef struct encode_job {
  size_t size;                   /* of this struct */
  int32_t level, step, z_min, z_max, n_rows, n_cols;
  int32_t shared[4];             /* top, left, bottom, right */
  int32_t parent_rows, parent_cols;
  int64_t parent_stride;         /* in samples */
  const int32_t *parent;         /* NULL: a root block */
  const int32_t *target;
  const uint8_t *valid;          /* NULL: all are */
  const int32_t *kept;           /* heights that come back, FREE where any does; with `added`, or NULL */
  int32_t *added;                /* corrections: zeros before; NULL: there are none */
  int32_t *out;                  /* heights as they are decoded */
  int64_t *counts;               /* of N_TABLES * N_SYMBOLS: add up symbols instead of making a payload; or NULL */
  int32_t *seen;                 /* of each lattice and plane of LEAST_SIDE samples: features, details, which are coded; or NULL */
  const uint8_t *payload;        /* made; belongs to the encoder, until it encodes again. Decoded: PAYLOAD_SLACK behind it */
  uint64_t n_payload;
  int32_t shift;                 /* of its heights in planes */
} encode_job;

#define FREE INT32_MIN
#define MAX_CORRECTION INT32_MAX

/* Symbols and raw bits of a band, as they are coded. */
typedef struct symbol_log {
  uint32_t *entries;             /* symbol, table << 8, state << 16 */
  size_t n_entries;
  uint8_t *raw;                  /* the last byte has bits 0 where none is written */
  size_t n_bits;
} symbol_log;

/* What the lattices of a unit have in common. */
typedef struct encoding {
  const encode_tables *tables;
  const encode_job *job;
  ptrdiff_t row_step, col_step;  /* of a lattice in the arrays of the job */
  int is_plain;                  /* targets lie so near that details are found in 32 bits */
  int32_t *details[3];           /* of a lattice: pairs of a row are side by side, an odd end is 0 */
  int32_t *goals;                /* of a row of a plane */
  int32_t *more;                 /* numbers of pairs of a list */
  int32_t *seen;
  int n_bands;                   /* 0: as many as details ask for */
  symbol_log logs[MOST_BANDS];
} encoding;

typedef struct twz_encoder twz_encoder;

/* Encode a lattice: its details, heights, and symbols. */
typedef twz_status (*rapid_encoder)(rapid_unit *u, encoding *e, twz_error *error);
/* A height with its correction, which is found where one is kept. */
static inline int32_t correct_height(const encode_job *job, ptrdiff_t place, int64_t height, int32_t low, int32_t high) {
  int32_t goal = job->kept[place];
  if (goal != FREE && clamp_i64(height, low, high) != goal) {
    job->added[place] = (int32_t)clamp_i64(goal - height, -MAX_CORRECTION, MAX_CORRECTION);
  }
  return (int32_t)clamp_i64(height + job->added[place], low, high);
}
/* Begin the log of a band, behind that of the band before. */
void start_band(encoding *e, int band);
/* Return how many bands a group should have, by about how many bits its details take. */
int twz_bands_for(const encoding *e, const int32_t *rows, const int32_t *cols);
/* Log the details of n pairs. */
void twz_log_pairs(encoding *e, symbol_log *l, const uint8_t *pairs, const uint8_t *singles, const int32_t *details, int32_t n);

/* has_slots: for decoders, too. `weights`, `stencils`: as Tables has them, shapes (4, 3, 4) and (4, 3, 24); freqs, starts: (N_TABLES, N_SYMBOLS). */
twz_status encode_tables_new(const twz_allocator *a, int32_t k_max, int32_t cut, int32_t has_slots, const int64_t *stencils, const int64_t *weights,
                             const uint32_t *freqs, const uint32_t *starts, encode_tables **made, twz_error *error);
void encode_tables_free(encode_tables *t);
/* Memory for one thread. */
twz_status encoder_new(const twz_allocator *a, twz_kernels kernels, twz_encoder **made, twz_error *error);
void encoder_free(twz_encoder *e);
/* Encode a unit: heights to job->out, bytes to job->payload. */
PYTHON_API twz_status twz_python_encode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error);

/* Decode a payload, of a unit without a target, by tables with slots. */
PYTHON_API twz_status twz_python_decode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error);

PYTHON_API twz_status twz_python_encode_mask(twz_encoder *encoder, mask_job *job, twz_error *error);

#endif
