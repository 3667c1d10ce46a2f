/* Planes of a mask, row by row (FORMAT §5.2): compiled for each set of instructions (kernels.h). */
#include "mask.h"

static ALWAYS_INLINE uint8_t read_bit(uint32_t *state, uint32_t ones, const uint8_t **word) {
  uint32_t slot = *state % N_SLOTS, is_one = slot < ones, n_slots = is_one ? ones : N_SLOTS - ones;
  uint32_t x = n_slots * (*state >> MASK_SLOT_BITS) + slot - (is_one ? 0 : ones), filled = x << 16 | load_u16(*word), is_low = x < STATE_START;
  *state = is_low ? filled : x;
  *word += 2 * is_low;
  return (uint8_t)is_one;
}

/* With 1 state or MASK_STATES, which are in registers: the next sample's first. */
static ALWAYS_INLINE void read_by_states(bits *b, const uint8_t *RESTRICT models, uint8_t *RESTRICT to, int32_t n, const uint32_t n_states) {
  uint32_t states[MASK_STATES];
  for (uint32_t k = 0; k < n_states; k++) states[k] = b->states[(b->n_read + k) % n_states];
  for (int32_t i = 0; i < n;) {
    if (b->at > b->n_words) {
      b->is_short = 1;
      b->at = b->n_words;
    }
    const uint8_t *first = b->words + 2 * b->at, *word = first;
    int32_t stop = min_i32(i + N_AHEAD, n);
    for (; i + MASK_STATES <= stop; i += MASK_STATES) {
      for (uint32_t k = 0; k < MASK_STATES; k++) to[i + (int32_t)k] = read_bit(&states[k % n_states], b->ones[models[i + (int32_t)k]], &word);
    }
    for (uint32_t k = 0; k < MASK_STATES - 1 && i < stop; k++, i++) to[i] = read_bit(&states[k % n_states], b->ones[models[i]], &word);
    b->at += (size_t)(word - first) / 2;
  }
  for (uint32_t k = 0; k < n_states; k++) b->states[(b->n_read + k) % n_states] = states[k];
  b->n_read += (uint32_t)n;
}

/* Append what is coded. */
static void note_bits(mask_job *job, const uint8_t *models, const uint8_t *values, int32_t n) {
  if ((uint64_t)n > job->capacity - job->n_bits) {
    job->is_full = 1;
    return;
  }
  memcpy(job->models + job->n_bits, models, (size_t)n);
  memcpy(job->bits + job->n_bits, values, (size_t)n);
  job->n_bits += (uint64_t)n;
}

static void read_bits(bits *b, const uint8_t *models, uint8_t *to, int32_t n) {
  if (b->job) {
    note_bits(b->job, models, to, n);
  } else {
    if (b->mask) read_by_states(b, models, to, n, MASK_STATES); else read_by_states(b, models, to, n, 1);
  }
}

static uint8_t *plane_row(const lattice *l, int plane, int32_t row) {
  return l->planes + (size_t)plane * l->size + (size_t)(row + 1) * l->pitch + LEFT;
}

/* A, with one sample more on each side; outside of the parent its border. */
static void take_above(const lattice *l, const above *a) {
  for (int32_t i = -1; i <= l->rows[A]; i++) {
    size_t start = (size_t)min_i32(max_i32(a->row + i, 0), a->n_rows - 1) * a->pitch;
    uint8_t *RESTRICT to = plane_row(l, A, i);
    const uint8_t *RESTRICT own = a->own ? a->own + start : NULL, *RESTRICT valid = a->valid ? a->valid + start : NULL;
    int32_t before = min_i32(a->col, 1), after = min_i32(a->n_cols - a->col - l->cols[A], 1); /* are there such columns? */
    int32_t first = -before, n = l->cols[A] + before + after;
    if (a->is_void) {
      memset(to + first, IMPLIED, (size_t)n);
    } else if (!own) {
      memset(to + first, OWN, (size_t)n);
    } else {
      const uint8_t *from = own + a->col + first;
      memcpy(to + first, from, (size_t)n);
      if (valid) {
        from = valid + a->col + first;
        for (int32_t j = 0; j < n; j++) to[first + j] = (uint8_t)(to[first + j] | (from[j] ^ 1) * IMPLIED);
      }
    }
    if (!before) to[-1] = to[0];
    if (!after) to[l->cols[A]] = to[l->cols[A] - 1];
  }
}

/* Repeat the border of ODD_BOTH outside. */
static void frame(const lattice *l) {
  int32_t n_rows = l->rows[ODD_BOTH], n_cols = l->cols[ODD_BOTH];
  for (int32_t i = 0; i < n_rows; i++) {
    uint8_t *row = plane_row(l, ODD_BOTH, i);
    row[-1] = row[0];
    row[n_cols] = row[n_cols - 1];
  }
  memcpy(plane_row(l, ODD_BOTH, -1) - 1, plane_row(l, ODD_BOTH, 0) - 1, (size_t)n_cols + 2);
  memcpy(plane_row(l, ODD_BOTH, n_rows) - 1, plane_row(l, ODD_BOTH, n_rows - 1) - 1, (size_t)n_cols + 2);
}

/* `kept`: 255, or 1 of neighbours whose voids imply nothing. */
static ALWAYS_INLINE void fill_contexts(uint8_t *RESTRICT to, int32_t n, const uint8_t *a, const uint8_t *b, const uint8_t *c,
                                        const uint8_t *d, uint8_t kept) {
  for (int32_t k = 0; k < n; k++) {
    to[k] = (uint8_t)(a[k] | b[k] << 1 | (c[k] & kept) << 2 | (d[k] & kept) << 3);
  }
}

static void row_contexts(const lattice *l, int plane, int32_t i, uint8_t *to) {
  int32_t n = l->cols[plane];
  const uint8_t *north, *west, *south, *east;
  if (plane == ODD_BOTH) {
    north = plane_row(l, A, i - l->p) - l->q;
    south = plane_row(l, A, i - l->p + 1) - l->q;
    fill_contexts(to, n, north, north + 1, south, south + 1, 255);
  } else if (plane == ODD_COLS) {
    west = plane_row(l, A, i) - l->q;
    north = l->rows[ODD_BOTH] ? plane_row(l, ODD_BOTH, i - 1 + l->p) : west;
    south = l->rows[ODD_BOTH] ? plane_row(l, ODD_BOTH, i + l->p) : west + 1;
    fill_contexts(to, n, west, west + 1, north, south, 1);
  } else {
    north = plane_row(l, A, i - l->p);
    south = plane_row(l, A, i - l->p + 1);
    west = l->cols[ODD_BOTH] ? plane_row(l, ODD_BOTH, i) - 1 + l->q : north;
    east = l->cols[ODD_BOTH] ? west + 1 : south;
    fill_contexts(to, n, north, south, west, east, 1);
  }
}

/* The kind of a group's bit, or -1; *is_mixed: some samples have neighbours that do not agree. */
static ALWAYS_INLINE int kind_of(const uint8_t *contexts, uint8_t *is_mixed) {
  static const uint64_t FIFTEENS = 0x0F0F0F0F0F0F0F0Fu;
  uint64_t words[MASK_GROUP / 8];
  memcpy(words, contexts, sizeof words);
  *is_mixed = 0;
  if (!((words[0] ^ FIFTEENS) | (words[1] ^ FIFTEENS) | (words[2] ^ FIFTEENS) | (words[3] ^ FIFTEENS))) return 0;
  uint8_t n_none = 0, n_all = 0, n_implied = 0;
  for (int k = 0; k < MASK_GROUP; k++) {
    n_none = (uint8_t)(n_none + (contexts[k] == NONE));
    n_all = (uint8_t)(n_all + (contexts[k] == ALL));
    n_implied = (uint8_t)(n_implied + (contexts[k] >= IMPLIED));
  }
  int n = n_none + n_all;
  *is_mixed = n + n_implied < MASK_GROUP;
  if (n == 0) return -1;
  if (*is_mixed) return n < MASK_GROUP / 2 ? 2 : 3;
  return 1;
}

static void read_list(const lattice *l, bits *b) {
  list *s = l->list;
  for (int32_t k = 0; b->job && k < s->n; k++) s->bits[k] = l->truth[s->places[k] - l->planes];
  read_bits(b, s->models, s->bits, s->n);
  for (int32_t k = 0; k < s->n; k++) *s->places[k] = s->bits[k];
  s->n = 0;
}

/* Note the samples of a group that are read: all that are not implied, or those whose neighbours do not agree. */
static void list_group(list *s, uint8_t *contexts, int is_open, int base) {
  uint8_t low = is_open ? NONE : NONE + 1, width = is_open ? 16 : 14, *RESTRICT models = s->models;
  uint8_t **RESTRICT places = s->places;
  size_t n = (size_t)s->n;
  for (int word = 0; word < MASK_GROUP; word += 8, contexts += 8) {
    uint64_t all;
    memcpy(&all, contexts, sizeof all);
    if (!is_open && (all == 0 || all == 0x0F0F0F0F0F0F0F0Fu)) continue;
    for (int k = 0; k < 8; k++) {
      uint8_t context = contexts[k];
      models[n] = (uint8_t)(base + context);
      places[n] = contexts + k;
      n += (uint8_t)(context - low) < width;
    }
  }
  s->n = (int32_t)n;
}

/* Put own samples of a row of a plane where its contexts are; behind them contexts say that nothing is coded. */
static void take_truth(const lattice *l, int plane, int32_t i, const bits *b) {
  int32_t n = l->cols[plane], row = 2 * i + (plane == ODD_COLS ? l->p : 1 - l->p), col = plane == ODD_ROWS ? l->q : 1 - l->q;
  const uint8_t *from = b->truth + row * b->own_step * b->job->n_cols + col * b->own_step;
  uint8_t *to = l->truth + (plane_row(l, plane, i) - l->planes);
  for (int32_t j = 0; j < n; j++) to[j] = from[2 * j * b->own_step];
}

/* Is a sample of a group unlike its four neighbours, which agree? */
static uint8_t is_unlike(const uint8_t *contexts, const uint8_t *truth) {
  int found = 0;
  for (int k = 0; k < MASK_GROUP; k++) found |= ((contexts[k] == NONE) & truth[k]) | ((contexts[k] == ALL) & (truth[k] ^ 1));
  return (uint8_t)found;
}

static void decode_plane(const lattice *l, int plane, bits *b) {
  int32_t n_rows = l->rows[plane], n_cols = l->cols[plane], n_groups = (n_cols + MASK_GROUP - 1) / MASK_GROUP, n_kinds = 0;
  for (int32_t i = 0; i < n_rows; i++) {
    uint8_t *row = plane_row(l, plane, i);
    row_contexts(l, plane, i, row);
    memset(row + n_cols, IMPLIED, (size_t)(n_groups * MASK_GROUP - n_cols));
    if (b && b->job) take_truth(l, plane, i, b);
    for (int32_t k = 0; b && k < n_groups; k++) {
      uint8_t is_mixed;
      int kind = kind_of(row + k * MASK_GROUP, &is_mixed);
      l->groups[i * n_groups + k] = (uint8_t)(is_mixed | (kind >= 0) << 1);
      l->kinds[n_kinds] = (uint8_t)(GROUPS + 4 * (plane - 1) + kind);
      if (b->job) l->opened[n_kinds] = is_unlike(row + k * MASK_GROUP, l->truth + (row - l->planes) + k * MASK_GROUP);
      n_kinds += kind >= 0;
    }
  }
  if (b) read_bits(b, l->kinds, l->opened, n_kinds);
  const uint8_t *opened = l->opened;
  l->list->n = 0;
  for (int32_t i = 0; i < n_rows; i++) {
    uint8_t *RESTRICT row = plane_row(l, plane, i);
    for (int32_t k = 0; b && k < n_groups; k++) {
      int is_mixed = l->groups[i * n_groups + k] & 1, has_bit = l->groups[i * n_groups + k] >> 1;
      int is_open = has_bit && *opened;
      opened += has_bit;
      if (is_open || is_mixed) list_group(l->list, row + k * MASK_GROUP, is_open, 16 * (plane - 1));
    }
    /* What agrees is as its neighbours are; without a section, all that is not implied is own. */
    uint8_t least = b ? ALL : NONE;
    for (int32_t j = 0; j < n_cols; j++) {
      row[j] = (uint8_t)((row[j] >= least && row[j] <= ALL) | (row[j] >= IMPLIED) << 4);
    }
    if (l->list->n >= N_AT_ONCE) read_list(l, b);
  }
  if (b) read_list(l, b);
  if (plane == ODD_BOTH) frame(l);
}

/* Put the planes together: bytes of OWN and IMPLIED. */
static void join_planes(const lattice *l) {
  for (int32_t r = 0; r < l->n_rows; r++) {
    int is_odd = (r + l->p) & 1;
    int32_t i = (r - (is_odd ? 1 - l->p : l->p)) / 2, n = l->n_cols / 2;
    const uint8_t *evens = plane_row(l, is_odd ? ODD_ROWS : A, i), *odds = plane_row(l, is_odd ? ODD_BOTH : ODD_COLS, i);
    const uint8_t *first = l->q ? odds : evens, *second = l->q ? evens : odds;
    uint8_t *RESTRICT to = l->cells + (size_t)r * (size_t)l->n_cols;
    for (int32_t j = 0; j < n; j++) {
      to[2 * j] = first[j];
      to[2 * j + 1] = second[j];
    }
    if (l->n_cols & 1) to[2 * n] = first[n];
  }
}

/* Decode a lattice below known samples into its cells; b NULL: without a section. */
static void decode_lattice(lattice *l, const above *a, bits *b) {
  l->rows[A] = l->rows[ODD_COLS] = (l->n_rows + 1 - l->p) / 2;
  l->rows[ODD_BOTH] = l->rows[ODD_ROWS] = l->n_rows - l->rows[A];
  l->cols[A] = l->cols[ODD_ROWS] = (l->n_cols + 1 - l->q) / 2;
  l->cols[ODD_BOTH] = l->cols[ODD_COLS] = l->n_cols - l->cols[A];
  take_above(l, a);
  for (int plane = ODD_BOTH; plane <= ODD_ROWS; plane++) {
    if (l->rows[plane] && l->cols[plane]) decode_plane(l, plane, b);
  }
  join_planes(l);
}

/* A root block: lattices of more and more samples, each as if it were a unit below the one before. */
static void decode_root(lattice *l, bits *b, uint8_t *coarser) {
  int32_t n_rows = l->n_rows, n_cols = l->n_cols;
  int shift = 0;
  uint8_t corner = CORNER;
  coarser[0] = 1;
  if (b && b->job) coarser[0] = b->truth[0];
  if (b) read_bits(b, &corner, coarser, 1);
  while ((n_rows - 1) >> shift || (n_cols - 1) >> shift) shift++;
  above a = {coarser, NULL, 1, 1, 1, 0, 0, 0};
  l->cells[0] = coarser[0];
  while (shift-- > 0) {
    l->n_rows = ((n_rows - 1) >> shift) + 1;
    l->n_cols = ((n_cols - 1) >> shift) + 1;
    if (b) b->own_step = (ptrdiff_t)1 << shift;
    decode_lattice(l, &a, b);
    above below = {coarser, NULL, (size_t)l->n_cols, l->n_rows, l->n_cols, 0, 0, 0};
    a = below;
    if (shift) memcpy(coarser, l->cells, (size_t)l->n_rows * (size_t)l->n_cols);
  }
}

/* Which samples of a coarse level are valid: all beside own ones, unless implied void, and those of which a bit says so. */
static void decode_fills(const lattice *l, bits *b) {
  size_t n_cols = (size_t)l->n_cols;
  uint8_t beside[MOST + 2];
  list *s = l->list;
  s->n = 0;
  for (int32_t r = 0; r < l->n_rows; r++) {
    uint8_t *RESTRICT here = l->cells + (size_t)r * n_cols;
    const uint8_t *north = r > 0 ? here - n_cols : here, *south = r + 1 < l->n_rows ? here + n_cols : here;
    beside[0] = beside[n_cols + 1] = 0;
    for (size_t c = 0; c < n_cols; c++) beside[c + 1] = (here[c] | north[c] | south[c]) & OWN;
    for (size_t c = 0; c < n_cols; c++) {
      uint8_t known = (uint8_t)((beside[c] | beside[c + 1] | beside[c + 2]) ? VALID : UNKNOWN);
      here[c] = (uint8_t)(here[c] | (here[c] & IMPLIED ? 0 : known));
    }
    uint8_t any = 0;
    for (size_t c = 0; c < n_cols; c++) any |= here[c];
    int32_t n = 0;
    for (size_t c = 0; any & UNKNOWN && c < n_cols; c++) {
      s->places[n] = here + c;
      n += here[c] >> 2 & 1;
    }
    if (!n) continue;
    memset(s->models, FILL, (size_t)n);
    s->n = n;
    for (int32_t k = 0; b && b->job && k < n; k++) s->bits[k] = b->job->mask[s->places[k] - l->cells];
    if (b) read_bits(b, s->models, s->bits, s->n);
    for (int32_t k = 0; k < s->n; k++) *s->places[k] |= (uint8_t)(b && !s->bits[k] ? 0 : VALID);
    s->n = 0;
  }
}

static void ISA(decode_mask)(lattice *l, const above *a, bits *b, uint8_t *coarser, int is_finest) {
  if (a) {
    decode_lattice(l, a, b);
  } else {
    decode_root(l, b, coarser);
  }
  if (!is_finest) decode_fills(l, b);
  const uint8_t *RESTRICT cells = l->cells;
  size_t n = (size_t)l->n_rows * (size_t)l->n_cols;
  uint8_t all = 255, any = 0;
  for (size_t i = 0; i < n; i++) {
    all &= cells[i];
    any |= cells[i];
  }
  l->all = all;
  l->any = any;
}
