/* Which samples are valid, and which are the raster's own (FORMAT §5.1, §5.2). */
#include "internal.h"
#include "tables.h"

/*
 * Planes: the parent's samples (A), then odd rows and columns (HH), odd columns (HL), odd rows (LH). Before a sample is
 * read, its byte is its context: its four neighbours, and more if it is implied void.
 */
enum { A, HH, HL, LH, N_PLANES };
enum { OWN = 1, VALID = 2, UNKNOWN = 4, IMPLIED = 16, NONE = 0, ALL = 15 };
enum { GROUP = 32, LEFT = 8, N_AT_ONCE = 4096, N_AHEAD = 32 };
/* Models (§5.2). */
enum { CORNER = 48, FILL = 49, GROUPS = 50, N_MODELS = 62 };
enum { SLOT_BITS = 12, N_SLOTS = 1 << SLOT_BITS, STATE_START = 1 << 16, MOST_STATES = 4 };

typedef struct bits {
  const uint8_t *words; /* some more than there are may be read: PAYLOAD_SLACK */
  size_t n_words, at;
  uint32_t states[MOST_STATES], n_read, mask; /* mask: one less than there are states */
  uint16_t ones[N_MODELS];
  int is_short;
} bits;

/* Samples that wait until many are read at once. */
typedef struct list {
  uint8_t models[N_AT_ONCE + GROUP], bits[N_AT_ONCE + GROUP];
  uint8_t *places[N_AT_ONCE + GROUP];
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
  list *list;
} lattice;

static twz_status start_bits(bits *b, const reader *section, twz_error *error) {
  int sets = section->bytes[0], n_states = sets & 128 ? MOST_STATES : 1;
  size_t n_head = 1 + 4 * (size_t)n_states;
  REQUIRE(section->n >= n_head && (section->n - n_head) % 2 == 0, error, "a mask of %llu bytes", (unsigned long long)section->n);
  memset(b, 0, sizeof *b);
  for (int i = 0; i < n_states; i++) b->states[i] = load_u32(section->bytes + 1 + 4 * i);
  b->mask = (uint32_t)n_states - 1;
  b->words = section->bytes + n_head;
  b->n_words = (section->n - n_head) / 2;
  memcpy(b->ones, twz_mask_samples[sets & 15], sizeof twz_mask_samples[0]);
  memcpy(b->ones + FILL, twz_mask_groups[sets >> 4 & 7], sizeof twz_mask_groups[0]);
  return TWZ_OK;
}

static void read_bits(bits *from, const uint8_t *RESTRICT models, uint8_t *RESTRICT to, int32_t n) {
  bits b = *from; /* in registers */
  for (int32_t start = 0; start < n; start += N_AHEAD) {
    if (b.at > b.n_words) {
      b.is_short = 1;
      b.at = b.n_words;
    }
    const uint8_t *word = b.words + 2 * b.at;
    int32_t stop = min_i32(start + N_AHEAD, n);
    for (int32_t i = start; i < stop; i++) {
      uint32_t *state = &b.states[(b.n_read + (uint32_t)i) & b.mask];
      uint32_t ones = b.ones[models[i]], slot = *state & (N_SLOTS - 1), whole = *state >> SLOT_BITS, is_one = slot < ones;
      uint32_t x = is_one ? ones * whole + slot : (N_SLOTS - ones) * whole + slot - ones;
      to[i] = (uint8_t)is_one;
      uint32_t is_low = x < STATE_START, filled = (x & 0xFFFFu) << 16 | load_u16(word);
      *state = is_low ? filled : x;
      word += 2 * is_low;
    }
    b.at = (size_t)(word - b.words) / 2;
  }
  b.n_read += (uint32_t)n;
  *from = b;
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
  return n_all == GROUP ? 0 : 1;
}

static void read_list(list *s, bits *b) {
  read_bits(b, s->models, s->bits, s->n);
  for (int32_t k = 0; k < s->n; k++) *s->places[k] = s->bits[k];
  s->n = 0;
}

/* Note the samples of a group that are read: all that are not implied, or those whose neighbours do not agree. */
static void list_group(list *s, uint8_t *contexts, int is_open, int base) {
  uint8_t low = is_open ? NONE : NONE + 1, width = is_open ? 16 : 14;
  int32_t n = s->n;
  for (int word = 0; word < GROUP; word += 8, contexts += 8) {
    uint64_t all;
    memcpy(&all, contexts, sizeof all);
    if (!is_open && (all == 0 || all == 0x0F0F0F0F0F0F0F0Fu)) continue;
    for (int k = 0; k < 8; k++) {
      s->models[n] = (uint8_t)(base + contexts[k]);
      s->places[n] = contexts + k;
      n += contexts[k] >= low && contexts[k] < low + width;
    }
  }
  s->n = n;
}

static void decode_plane(const lattice *l, int plane, bits *b) {
  int32_t n_rows = l->rows[plane], n_cols = l->cols[plane], n_groups = (n_cols + GROUP - 1) / GROUP, n_kinds = 0;
  for (int32_t i = 0; i < n_rows; i++) {
    uint8_t *row = plane_row(l, plane, i);
    row_contexts(l, plane, i, row);
    memset(row + n_cols, IMPLIED, (size_t)(n_groups * GROUP - n_cols));
    for (int32_t k = 0; b && k < n_groups; k++) {
      uint8_t is_mixed;
      int kind = kind_of(row + k * GROUP, &is_mixed);
      l->groups[i * n_groups + k] = (uint8_t)(is_mixed | (kind >= 0) << 1);
      l->kinds[n_kinds] = (uint8_t)(GROUPS + 4 * (plane - 1) + kind);
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
      if (l->list->n >= N_AT_ONCE && k + 1 < n_groups) read_ahead(l->list, b);
    }
  }
}
