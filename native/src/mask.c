/* Which samples are valid, and which are the raster's own (FORMAT §5.1, §5.2). */
#include "encode_mask.h"
#include "tables.h"

/*
 * Planes: the parent's samples (A), then odd rows and columns (HH), odd columns (HL), odd rows (LH). Before a sample is
 * read, its byte is its context: its four neighbours, and more if it is implied void.
 */
enum { A, HH, HL, LH, N_PLANES };
enum { OWN = 1, VALID = 2, UNKNOWN = 4, IMPLIED = 16, NONE = 0, ALL = 15 };
enum { GROUP = 32, LEFT = 8, N_AT_ONCE = 4096, N_AHEAD = 32 };
enum { MOST = 2 * 1024 + 4 }; /* samples of a region along an axis, or more (§2.4) */
/* Models (§5.2). */
enum { CORNER = 48, FILL = 49, GROUPS = 50, N_MODELS = 62, N_GROUP_SETS = 7 };
enum { SLOT_BITS = 12, N_SLOTS = 1 << SLOT_BITS, STATE_START = 1 << 16, MOST_STATES = 4 };

typedef struct bits {
  mask_job *job; /* of an encoder: it notes what a decoder reads, of samples that it knows. NULL: a decoder's */
  const uint8_t *truth;
  ptrdiff_t own_step; /* of a lattice's samples in the region */
  const uint8_t *words; /* some more than there are may be read: PAYLOAD_SLACK */
  size_t n_words, at;
  uint32_t states[MOST_STATES], n_read, mask; /* mask: one less than there are states */
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
  uint8_t *truth; /* of an encoder: own samples, in the places of a plane's */
  list *list;
} lattice;

static twz_status start_bits(bits *b, const reader *section, twz_error *error) {
  const uint8_t *at = section->bytes + 1;
  int sets = section->bytes[0], n_states = sets & 128 ? MOST_STATES : 1, group_set = sets >> 4 & 7;
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

static ALWAYS_INLINE uint8_t read_bit(uint32_t *state, uint32_t ones, const uint8_t **word) {
  uint32_t slot = *state % N_SLOTS, is_one = slot < ones, n_slots = is_one ? ones : N_SLOTS - ones;
  uint32_t x = n_slots * (*state >> SLOT_BITS) + slot - (is_one ? 0 : ones), filled = x << 16 | load_u16(*word), is_low = x < STATE_START;
  *state = is_low ? filled : x;
  *word += 2 * is_low;
  return (uint8_t)is_one;
}

/* With 1 state or MOST_STATES, which are in registers: the next sample's first. */
static ALWAYS_INLINE void read_by_states(bits *b, const uint8_t *RESTRICT models, uint8_t *RESTRICT to, int32_t n, const uint32_t n_states) {
  uint32_t states[MOST_STATES];
  for (uint32_t k = 0; k < n_states; k++) states[k] = b->states[(b->n_read + k) % n_states];
  for (int32_t i = 0; i < n;) {
    if (b->at > b->n_words) {
      b->is_short = 1;
      b->at = b->n_words;
    }
    const uint8_t *first = b->words + 2 * b->at, *word = first;
    int32_t stop = min_i32(i + N_AHEAD, n);
    for (; i + MOST_STATES <= stop; i += MOST_STATES) {
      for (uint32_t k = 0; k < MOST_STATES; k++) to[i + (int32_t)k] = read_bit(&states[k % n_states], b->ones[models[i + (int32_t)k]], &word);
    }
    for (uint32_t k = 0; k < MOST_STATES - 1 && i < stop; k++, i++) to[i] = read_bit(&states[k % n_states], b->ones[models[i]], &word);
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
    if (b->mask) read_by_states(b, models, to, n, MOST_STATES); else read_by_states(b, models, to, n, 1);
  }
}

static twz_status end_bits(const bits *b, twz_error *error) {
  int is_end = !b->is_short && b->at == b->n_words;
  for (uint32_t i = 0; i <= b->mask; i++) is_end &= b->states[i] == STATE_START;
  REQUIRE(is_end, error, "a mask does not end where its section does");
  return TWZ_OK;
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

/* Repeat the border of HH outside. */
static void frame(const lattice *l) {
  int32_t n_rows = l->rows[HH], n_cols = l->cols[HH];
  for (int32_t i = 0; i < n_rows; i++) {
    uint8_t *row = plane_row(l, HH, i);
    row[-1] = row[0];
    row[n_cols] = row[n_cols - 1];
  }
  memcpy(plane_row(l, HH, -1) - 1, plane_row(l, HH, 0) - 1, (size_t)n_cols + 2);
  memcpy(plane_row(l, HH, n_rows) - 1, plane_row(l, HH, n_rows - 1) - 1, (size_t)n_cols + 2);
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
  if (plane == HH) {
    north = plane_row(l, A, i - l->p) - l->q;
    south = plane_row(l, A, i - l->p + 1) - l->q;
    fill_contexts(to, n, north, north + 1, south, south + 1, 255);
  } else if (plane == HL) {
    west = plane_row(l, A, i) - l->q;
    north = l->rows[HH] ? plane_row(l, HH, i - 1 + l->p) : west;
    south = l->rows[HH] ? plane_row(l, HH, i + l->p) : west + 1;
    fill_contexts(to, n, west, west + 1, north, south, 1);
  } else {
    north = plane_row(l, A, i - l->p);
    south = plane_row(l, A, i - l->p + 1);
    west = l->cols[HH] ? plane_row(l, HH, i) - 1 + l->q : north;
    east = l->cols[HH] ? west + 1 : south;
    fill_contexts(to, n, north, south, west, east, 1);
  }
}

/* The kind of a group's bit, or -1; *is_mixed: some samples have neighbours that do not agree. */
static ALWAYS_INLINE int kind_of(const uint8_t *contexts, uint8_t *is_mixed) {
  static const uint64_t FIFTEENS = 0x0F0F0F0F0F0F0F0Fu;
  uint64_t words[GROUP / 8];
  memcpy(words, contexts, sizeof words);
  *is_mixed = 0;
  if (!((words[0] ^ FIFTEENS) | (words[1] ^ FIFTEENS) | (words[2] ^ FIFTEENS) | (words[3] ^ FIFTEENS))) return 0;
  uint8_t n_none = 0, n_all = 0, n_implied = 0;
  for (int k = 0; k < GROUP; k++) {
    n_none = (uint8_t)(n_none + (contexts[k] == NONE));
    n_all = (uint8_t)(n_all + (contexts[k] == ALL));
    n_implied = (uint8_t)(n_implied + (contexts[k] >= IMPLIED));
  }
  int n = n_none + n_all;
  *is_mixed = n + n_implied < GROUP;
  if (n == 0) return -1;
  if (*is_mixed) return n < GROUP / 2 ? 2 : 3;
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
  for (int word = 0; word < GROUP; word += 8, contexts += 8) {
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
  int32_t n = l->cols[plane], row = 2 * i + (plane == HL ? l->p : 1 - l->p), col = plane == LH ? l->q : 1 - l->q;
  const uint8_t *from = b->truth + row * b->own_step * b->job->n_cols + col * b->own_step;
  uint8_t *to = l->truth + (plane_row(l, plane, i) - l->planes);
  for (int32_t j = 0; j < n; j++) to[j] = from[2 * j * b->own_step];
}

/* Is a sample of a group unlike its four neighbours, which agree? */
static uint8_t is_unlike(const uint8_t *contexts, const uint8_t *truth) {
  int found = 0;
  for (int k = 0; k < GROUP; k++) found |= ((contexts[k] == NONE) & truth[k]) | ((contexts[k] == ALL) & (truth[k] ^ 1));
  return (uint8_t)found;
}

static void decode_plane(const lattice *l, int plane, bits *b) {
  int32_t n_rows = l->rows[plane], n_cols = l->cols[plane], n_groups = (n_cols + GROUP - 1) / GROUP, n_kinds = 0;
  for (int32_t i = 0; i < n_rows; i++) {
    uint8_t *row = plane_row(l, plane, i);
    row_contexts(l, plane, i, row);
    memset(row + n_cols, IMPLIED, (size_t)(n_groups * GROUP - n_cols));
    if (b && b->job) take_truth(l, plane, i, b);
    for (int32_t k = 0; b && k < n_groups; k++) {
      uint8_t is_mixed;
      int kind = kind_of(row + k * GROUP, &is_mixed);
      l->groups[i * n_groups + k] = (uint8_t)(is_mixed | (kind >= 0) << 1);
      l->kinds[n_kinds] = (uint8_t)(GROUPS + 4 * (plane - 1) + kind);
      if (b->job) l->opened[n_kinds] = is_unlike(row + k * GROUP, l->truth + (row - l->planes) + k * GROUP);
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
      if (is_open || is_mixed) list_group(l->list, row + k * GROUP, is_open, 16 * (plane - 1));
    }
    /* What agrees is as its neighbours are; without a section, all that is not implied is own. */
    uint8_t least = b ? ALL : NONE;
    for (int32_t j = 0; j < n_cols; j++) {
      row[j] = (uint8_t)((row[j] >= least && row[j] <= ALL) | (row[j] >= IMPLIED) << 4);
    }
    if (l->list->n >= N_AT_ONCE) read_list(l, b);
  }
  if (b) read_list(l, b);
  if (plane == HH) frame(l);
}

/* Put the planes together: bytes of OWN and IMPLIED. */
static void join_planes(const lattice *l) {
  for (int32_t r = 0; r < l->n_rows; r++) {
    int is_odd = (r + l->p) & 1;
    int32_t i = (r - (is_odd ? 1 - l->p : l->p)) / 2, n = l->n_cols / 2;
    const uint8_t *evens = plane_row(l, is_odd ? LH : A, i), *odds = plane_row(l, is_odd ? HH : HL, i);
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
  l->rows[A] = l->rows[HL] = (l->n_rows + 1 - l->p) / 2;
  l->rows[HH] = l->rows[LH] = l->n_rows - l->rows[A];
  l->cols[A] = l->cols[LH] = (l->n_cols + 1 - l->q) / 2;
  l->cols[HH] = l->cols[HL] = l->n_cols - l->cols[A];
  take_above(l, a);
  for (int plane = HH; plane <= LH; plane++) {
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
    int32_t n = 0;
    for (size_t first = 0; first < n_cols; first += GROUP) {
      size_t stop = min_size(first + GROUP, n_cols);
      uint8_t any = 0;
      for (size_t c = first; c < stop; c++) any |= here[c];
      for (size_t c = first; any & UNKNOWN && c < stop; c++) {
        s->places[n] = here + c;
        n += here[c] >> 2 & 1;
      }
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

/* Keep a bit of all cells as bytes of the region; NULL where all are 1. */
static twz_status keep(const twz_file *f, const uint8_t *RESTRICT cells, size_t n, uint8_t bit, uint8_t **to, int *has_1,
                       twz_error *error) {
  uint8_t all = bit, any = 0;
  for (size_t i = 0; i < n; i++) {
    all &= cells[i];
    any |= cells[i];
  }
  *has_1 = (any & bit) != 0;
  if (all) return TWZ_OK;
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
  size_t n_groups = most_rows * (most_cols / GROUP + 1), n_coarser = is_root ? most_rows * most_cols : 0;
  l->pitch = LEFT + (most_cols / GROUP + 1) * GROUP;
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
  size_t n_cells = (size_t)l.n_rows * (size_t)l.n_cols;
  TRY(take_memory(&l, !p->layer, 0, &coarser, s, error));
  bits memory, *b = section->bytes ? &memory : NULL;
  if (b) TRY(start_bits(b, section, error));
  if (p->layer) {
    size_t pitch = (size_t)p->layer->cols.n, first = (size_t)p->row * pitch + (size_t)p->col;
    const uint8_t *valid = p->layer->valid, *own = p->layer->own ? p->layer->own : valid;
    above a = {own ? own + first : NULL, valid ? valid + first : NULL, pitch, p->n_rows, p->n_cols, 0, 0, p->is_void};
    a.row = (int32_t)((int64_t)(((uint64_t)out->rows.first + 1) / 2) - p->first_row);
    a.col = (int32_t)((int64_t)(((uint64_t)out->cols.first + 1) / 2) - p->first_col);
    decode_lattice(&l, &a, b);
  } else {
    decode_root(&l, b, coarser);
  }
  int has_own;
  if (!is_finest) {
    decode_fills(&l, b);
    TRY(keep(f, l.cells, n_cells, OWN, &out->own, &has_own, error));
  }
  if (b) TRY(end_bits(b, error));
  return keep(f, l.cells, n_cells, is_finest ? OWN : VALID, &out->valid, has_valid, error);
}

twz_status encode_validity(mask_job *job, scratch *s, twz_error *error) {
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
  bits *noted = job->own ? &b : NULL;
  TRY(take_memory(&l, !job->has_above, job->own != NULL, &coarser, s, error));
  if (job->has_above) {
    above a = {job->own_above, job->valid_above, (size_t)job->above_cols, job->above_rows, job->above_cols, job->above_row, job->above_col, 0};
    decode_lattice(&l, &a, noted);
  } else {
    decode_root(&l, noted, coarser);
  }
  if (!job->is_finest) decode_fills(&l, noted);
  memcpy(job->cells, l.cells, (size_t)l.n_rows * (size_t)l.n_cols);
  if (job->is_full) return twz_fail(error, TWZ_BAD_ARGUMENT, "room for %llu bits, too few", (unsigned long long)job->capacity);
  return TWZ_OK;
}

uint64_t encode_mask_bits(const uint8_t *models, const uint8_t *values, uint64_t n, const uint32_t *freqs, uint32_t n_states,
                          uint32_t *states, uint8_t *words) {
  uint64_t at = n;
  for (uint64_t i = n; i > 0; i--) {
    uint32_t freq = freqs[models[i - 1]], own = values[i - 1] ? freq : N_SLOTS - freq, before = values[i - 1] ? 0 : freq;
    uint32_t *x = states + ((i - 1) & (n_states - 1));
    if (*x >= (uint64_t)own << (32 - SLOT_BITS)) {
      at--;
      words[2 * at] = (uint8_t)*x;
      words[2 * at + 1] = (uint8_t)(*x >> 8);
      *x >>= 16;
    }
    *x = (*x / own << SLOT_BITS) + *x % own + before;
  }
  return at;
}
