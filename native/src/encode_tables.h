/* The tables of a file as bytes, and back (docs/format-rapid.md, R.10), for terrainwave in Python. */
#ifndef TWZ_ENCODE_TABLES_H
#define TWZ_ENCODE_TABLES_H

#include "internal.h"

/* The arrays of `file_tables._code_tables`: whole numbers of 64 bits, row by row. */
typedef struct tables_job {
  size_t size;
  int64_t *state; /* of coding/rangecoder.py */
  uint8_t *stream;
  uint64_t n_stream;
  uint32_t *models;
  int64_t *stencils, *weights, *cut, *is_own, *codes;
  const int64_t *tap_kinds, *skipped, *trained_weights, *n_symbols, *rests, *trained;
  int32_t is_encoder, n_stencils, n_planes, n_taps, n_weights, n_features, n_tables, most_symbols, n_classes, singles;
  int64_t max_weight;
  int32_t status; /* 0, or as there what is wrong */
  int64_t which;
} tables_job;

PYTHON_API twz_status twz_python_code_tables(tables_job *job, twz_error *error);
#endif
