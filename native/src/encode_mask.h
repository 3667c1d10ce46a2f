/* The encoder of masks, which is the decoder's text (mask.c); see encode.h. */
#ifndef TWZ_ENCODE_MASK_H
#define TWZ_ENCODE_MASK_H

#include "internal.h"

/* Validity of a unit's samples that is encoded (mask.c). Arrays of 0 and 1, row by row. */
typedef struct mask_job {
  size_t size;
  int32_t n_rows, n_cols, p, q;          /* p, q: 1 if the first row, column is odd */
  int32_t is_finest, has_above;
  int32_t above_rows, above_cols, above_row, above_col; /* of the parent's sample at the first even row and column */
  const uint8_t *own_above, *valid_above; /* NULL: all 1 */
  const uint8_t *own, *mask;             /* own NULL: note nothing, all is own that is not implied to be void */
  const uint8_t *section;                /* decoded instead, PAYLOAD_SLACK behind it; or NULL */
  uint64_t n_section;
  uint8_t *cells;                        /* filled: own + 2 * valid; on the finest level of valid ones nothing */
  uint8_t *models, *bits;                /* filled: what is coded, in order */
  uint64_t capacity, n_bits;
  int32_t is_full;
} mask_job;

struct row_kernels;
twz_status encode_validity(mask_job *job, const struct row_kernels *kernels, scratch *s, twz_error *error);
/* Code bits, the last one first, to the end of `words`, which are n; return where the first one is. */
PYTHON_API uint64_t twz_python_mask_words(const uint8_t *models, const uint8_t *values, uint64_t n, const uint32_t *freqs, uint32_t n_states,
                          uint32_t *states, uint8_t *words);
#endif
