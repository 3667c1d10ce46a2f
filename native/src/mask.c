/* Which samples are valid, and which are the raster's own (FORMAT §5.1, §5.2). */
#include "kernels.h"
#include "mask.h"
#include "tables.h"

static twz_status start_bits(bits *b, const reader *section, twz_error *error) {
  const uint8_t *at = section->bytes + 1;
  int sets = section->bytes[0], n_states = sets & 128 ? MASK_STATES : 1, group_set = sets >> 4 & 7;
  size_t n_freqs = group_set == N_GROUP_SETS ? N_MODELS : 0, n_head = 1 + n_freqs + 4 * (size_t)n_states;
  REQUIRE(section->n >= n_head && (section->n - n_head) % 2 == 0, error, "a mask of %llu bytes", (unsigned long long)section->n);
  REQUIRE(!n_freqs || sets % 16 == 0, error, "a mask with frequencies of its own and set %d", sets % 16);
  memset(b, 0, sizeof *b);
  for (int i = 0; i < n_states; i++) b->states[i] = load_u32(at + n_freqs + 4 * i);
  b->mask = (uint32_t)n_states - 1;
  b->words = section->bytes + n_head;
  b->n_words = (section->n - n_head) / 2;
  if (n_freqs) {
    for (int i = 0; i < N_MODELS; i++) b->ones[i] = (uint16_t)(16 * at[i] + 8);
  } else {
    memcpy(b->ones, twz_mask_samples[sets & 15], sizeof twz_mask_samples[0]);
    memcpy(b->ones + FILL, twz_mask_groups[group_set], sizeof twz_mask_groups[0]);
  }
  return TWZ_OK;
}

static twz_status end_bits(const bits *b, twz_error *error) {
  int is_end = !b->is_short && b->at == b->n_words;
  for (uint32_t i = 0; i <= b->mask; i++) is_end &= b->states[i] == STATE_START;
  REQUIRE(is_end, error, "a mask does not end where its section does");
  return TWZ_OK;
}

/* Keep a bit of all cells as bytes of the region; NULL where all are 1. */
static twz_status keep(const twz_file *f, const lattice *l, uint8_t bit, uint8_t **to, twz_error *error) {
  const uint8_t *RESTRICT cells = l->cells;
  size_t n = (size_t)l->n_rows * (size_t)l->n_cols;
  if (l->all & bit) return TWZ_OK;
  uint8_t *RESTRICT bytes = twz_allocate(&f->allocator, n);
  if (!bytes) return twz_no_memory(error, n);
  for (size_t i = 0; i < n; i++) bytes[i] = (cells[i] & bit) != 0;
  *to = bytes;
  return TWZ_OK;
}

/* Is one of the parent heights 0 in such a field of the parent's layer? */
static int has_zero(const parent *p, const uint8_t *bytes) {
  if (!bytes) return 0;
  bytes += (size_t)p->row * (size_t)p->layer->cols.n + (size_t)p->col;
  for (int32_t r = 0; r < p->n_rows; r++) {
    if (memchr(bytes + (size_t)r * (size_t)p->layer->cols.n, 0, (size_t)p->n_cols)) return 1;
  }
  return 0;
}

/* Memory of a lattice of n_rows and n_cols; `coarser` that of a root block's coarser ones. */
static twz_status take_memory(lattice *l, int is_root, int has_truth, uint8_t **coarser, scratch *s, twz_error *error) {
  size_t n_cells = (size_t)l->n_rows * (size_t)l->n_cols, most_rows = (size_t)l->n_rows / 2 + 1, most_cols = (size_t)l->n_cols / 2 + 1;
  size_t n_groups = most_rows * (most_cols / MASK_GROUP + 1), n_coarser = is_root ? most_rows * most_cols : 0;
  l->pitch = LEFT + (most_cols / MASK_GROUP + 1) * MASK_GROUP;
  l->size = (most_rows + 2) * l->pitch;
  size_t n_truth = has_truth ? N_PLANES * l->size : 0;
  size_t n_bytes = N_PLANES * l->size + n_truth + 3 * (n_groups + 1) + n_cells + n_coarser + 1 + sizeof(list);
  TRY(scratch_reserve(s, n_bytes + 8 * SCRATCH_ALIGN, error));
  l->planes = scratch_take(s, N_PLANES * l->size);
  l->truth = scratch_take(s, n_truth);
  l->groups = scratch_take(s, n_groups);
  l->kinds = scratch_take(s, n_groups + 1);
  l->opened = scratch_take(s, n_groups + 1);
  l->cells = scratch_take(s, n_cells);
  l->list = scratch_take(s, sizeof(list));
  *coarser = scratch_take(s, n_coarser + 1);
  return TWZ_OK;
}

twz_status decode_validity(const twz_file *f, layer *out, const parent *p, int is_finest, const reader *section,
                           int *has_valid, scratch *s, twz_error *error) {
  *has_valid = 1;
  if (!section->bytes && !(p->layer && (p->is_void || has_zero(p, p->layer->valid) || has_zero(p, p->layer->own)))) {
    return TWZ_OK; /* all valid, all own */
  }
  lattice l;
  memset(&l, 0, sizeof l);
  l.n_rows = out->rows.n;
  l.n_cols = out->cols.n;
  l.p = (int)(out->rows.first & 1);
  l.q = (int)(out->cols.first & 1);
  uint8_t *coarser;
  TRY(take_memory(&l, !p->layer, 0, &coarser, s, error));
  bits memory, *b = section->bytes ? &memory : NULL;
  if (b) TRY(start_bits(b, section, error));
  if (p->layer) {
    size_t pitch = (size_t)p->layer->cols.n, first = (size_t)p->row * pitch + (size_t)p->col;
    const uint8_t *valid = p->layer->valid, *own = p->layer->own ? p->layer->own : valid;
    above a = {own ? own + first : NULL, valid ? valid + first : NULL, pitch, p->n_rows, p->n_cols, 0, 0, p->is_void};
    a.row = (int32_t)((int64_t)(((uint64_t)out->rows.first + 1) / 2) - p->first_row);
    a.col = (int32_t)((int64_t)(((uint64_t)out->cols.first + 1) / 2) - p->first_col);
    f->kernels->decode_mask(&l, &a, b, coarser, is_finest);
  } else {
    f->kernels->decode_mask(&l, NULL, b, coarser, is_finest);
  }
  if (!is_finest) TRY(keep(f, &l, OWN, &out->own, error));
  if (b) TRY(end_bits(b, error));
  const uint8_t valid = is_finest ? OWN : VALID;
  *has_valid = (l.any & valid) != 0;
  return keep(f, &l, valid, &out->valid, error);
}

twz_status encode_validity(mask_job *job, const row_kernels *kernels, scratch *s, twz_error *error) {
  lattice l;
  bits b;
  uint8_t *coarser;
  int is_sound = job->n_rows >= 1 && job->n_cols >= 1 && job->n_rows <= MOST - 4 && job->n_cols <= MOST - 4;
  if (job->size != sizeof *job || !is_sound) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "a mask of %d rows and %d columns, by a job of %llu bytes", job->n_rows, job->n_cols,
                    (unsigned long long)job->size);
  }
  memset(&l, 0, sizeof l);
  memset(&b, 0, sizeof b);
  l.n_rows = job->n_rows;
  l.n_cols = job->n_cols;
  l.p = job->p;
  l.q = job->q;
  b.job = job;
  b.truth = job->own;
  b.own_step = 1;
  bits *noted = job->own || job->section ? &b : NULL;
  if (job->section) {
    reader section = {job->section, (size_t)job->n_section, 0};
    TRY(start_bits(&b, &section, error));
  }
  TRY(take_memory(&l, !job->has_above, job->own != NULL, &coarser, s, error));
  if (job->has_above) {
    above a = {job->own_above, job->valid_above, (size_t)job->above_cols, job->above_rows, job->above_cols, job->above_row, job->above_col, 0};
    kernels->decode_mask(&l, &a, noted, coarser, job->is_finest);
  } else {
    kernels->decode_mask(&l, NULL, noted, coarser, job->is_finest);
  }
  if (job->section) TRY(end_bits(&b, error));
  memcpy(job->cells, l.cells, (size_t)l.n_rows * (size_t)l.n_cols);
  if (job->is_full) return twz_fail(error, TWZ_BAD_ARGUMENT, "room for %llu bits, too few", (unsigned long long)job->capacity);
  return TWZ_OK;
}

uint64_t twz_python_mask_words(const uint8_t *models, const uint8_t *values, uint64_t n, const uint32_t *freqs, uint32_t n_states,
                          uint32_t *states, uint8_t *words) {
  uint64_t at = n;
  for (uint64_t i = n; i > 0; i--) {
    uint32_t freq = freqs[models[i - 1]], own = values[i - 1] ? freq : N_SLOTS - freq, before = values[i - 1] ? 0 : freq;
    uint32_t *x = states + ((i - 1) & (n_states - 1));
    if (*x >= (uint64_t)own << (32 - MASK_SLOT_BITS)) {
      at--;
      words[2 * at] = (uint8_t)*x;
      words[2 * at + 1] = (uint8_t)(*x >> 8);
      *x >>= 16;
    }
    *x = (*x / own << MASK_SLOT_BITS) + *x % own + before;
  }
  return at;
}
