/*
 * A lattice of method rapid (R.3 ... R.9), compiled for a set of instructions. Rows of planes, of features and of
 * details lie in rings: row i in place i mod their size. Rows end with room for a vector, and begin with one.
 */
#include "kernels.h"
#include "rapid_lanes.h"

enum { ROOM = 64, A_ROWS = 32, HELD_ROWS = 16, MOST_NEAR = 4095, RAW_CLASS = 32, GROUP = 32, MORE = SINGLE_ESCAPE - NO_DETAIL };

typedef struct ISA(work) {
  rapid_unit *u;
  rapid_weights weights[3]; /* of HH, HL, LH */
  ptrdiff_t stride;
  int32_t rows[3], cols[3], a_rows, a_cols;
  int32_t from, to;         /* columns of planes that are predicted */
  int32_t loaded, looked;   /* rows of A before `loaded` are there, features of rows before `looked` */
  int16_t *a, *ranges, *bends, *planes[3], *details[3], *near[2], *predicted, *sides;
  int32_t *wide_details[3], *heights[3]; /* where 16 bits are too few */
  /* Of a list: classes of pairs and samples, which pairs are two samples, entries, symbols, details. */
  uint8_t *pairs, *singles, *is_two, *entries, *symbols;
  int8_t *small;
  int32_t *large, *more;
} ISA(work);

static ALWAYS_INLINE int16_t *ISA(row_in)(const ISA(work) * w, int16_t *ring, int32_t i, int n) {
  return ring + (i & (n - 1)) * w->stride + ROOM;
}
static ALWAYS_INLINE int32_t *ISA(wide_row_in)(const ISA(work) * w, int32_t *ring, int32_t i) {
  return ring + (i & (HELD_ROWS - 1)) * w->stride + ROOM;
}
static ALWAYS_INLINE int16_t *ISA(row_of_a)(const ISA(work) * w, int32_t i) { return ISA(row_in)(w, w->a, i, A_ROWS); }
/* A row of a plane: outside, the last one; of a plane without samples, one of A. */
static int16_t *ISA(row_of)(const ISA(work) * w, int plane, int32_t i) {
  if (w->rows[plane] == 0 || w->cols[plane] == 0) return ISA(row_of_a)(w, i);
  return ISA(row_in)(w, w->planes[plane], max_i32(min_i32(i, w->rows[plane] - 1), 0), HELD_ROWS);
}

/* By symmetry about the first and the last of n. */
static int32_t ISA(mirrored)(int32_t i, int32_t n) {
  if (n == 1) return 0;
  int32_t period = 2 * (n - 1);
  i %= period;
  if (i < 0) i += period;
  return min_i32(i, period - i);
}

/* ---- What is known before any detail (R.4) ---- */

#define LOAD_SAMPLES(from)                                                                             \
  for (int32_t j = 0; j < n; j++) {                                                                    \
    int32_t height = (min_i32(max_i32((from)[j], low), high) - less) >> shift;                         \
    to[j] = (int16_t)min_i32(max_i32(height, -LIMIT), LIMIT);                                          \
  }

static void ISA(load_row)(const ISA(work) * w, int32_t i) {
  const rapid_unit *u = w->u;
  int32_t n = w->a_cols, low = u->low - u->parent_origin, high = u->high - u->parent_origin, less = u->origin - u->parent_origin;
  int shift = u->shift;
  ptrdiff_t source = min_i32(ISA(mirrored)(2 * i, u->n_rows) / 2, w->a_rows - 1) * u->parent_stride;
  int16_t *RESTRICT to = ISA(row_of_a)(w, i);
  if (u->short_parent) {
    const int16_t *RESTRICT from = u->short_parent + source;
    LOAD_SAMPLES(from)
  } else {
    const int32_t *RESTRICT from = u->parent + source;
    LOAD_SAMPLES(from)
  }
  for (int32_t k = 1; k <= MARGIN; k++) {
    int32_t last = n - 1 + k;
    to[-k] = to[min_i32(ISA(mirrored)(-2 * k, u->n_cols) / 2, n - 1)];
    to[last] = to[min_i32(ISA(mirrored)(2 * last, u->n_cols) / 2, n - 1)];
  }
}

/* Ranges of cells and bends of samples, from one column outside on. */
static void ISA(look)(const ISA(work) * w, int32_t i) {
  const int16_t *north = ISA(row_of_a)(w, i - 1), *here = ISA(row_of_a)(w, i), *south = ISA(row_of_a)(w, i + 1);
  int16_t *ranges = ISA(row_in)(w, w->ranges, i, HELD_ROWS), *bends = ISA(row_in)(w, w->bends, i, HELD_ROWS);
  const VECTOR limit = SPLAT(LIMIT);
  for (int32_t j = -1; j <= w->a_cols; j += LANES) {
    VECTOR x = LOAD(here + j), y = LOAD(here + j + 1), z = LOAD(south + j), v = LOAD(south + j + 1), twice = TWICE(x);
    STORE(ranges + j, SUB(MOST(MOST(x, y), MOST(z, v)), LEAST(LEAST(x, y), LEAST(z, v))));
    VECTOR across = SUB(ADD(LOAD(here + j - 1), y), twice), along = SUB(ADD(LOAD(north + j), z), twice);
    STORE(bends + j, LEAST(ADD(LEAST(ABS(across), limit), LEAST(ABS(along), limit)), limit));
  }
}

/* ---- Classes (R.5) ---- */

/* What the rows of features of a row of a plane are: sums of cells' ranges, of bends, and of details near. */
typedef struct ISA(features) {
  const int16_t *here, *above, *bends, *below, *near[3];
} ISA(features);

static ALWAYS_INLINE int32_t ISA(class_of)(int32_t expected) {
  float sparse = (float)(expected & ~(expected >> 2)); /* no rounding reaches the two top bits */
  int32_t bits;
  memcpy(&bits, &sparse, 4);
  return max_i32(min_i32((bits >> 22) - 254, MOST_CLASS), 0);
}

/* Products of 16 bits, sums of 32: compilers make vectors of these loops. */
static ALWAYS_INLINE void ISA(classes)(const ISA(features) * f, int plane, const rapid_weights *by, int32_t n, uint8_t *pairs, uint8_t *singles) {
  enum { PIECE = 64 };
  const int16_t of_range = (int16_t)by->of_range, of_bend = (int16_t)by->of_bend, of_near = (int16_t)by->of_near;
  const int32_t shift = by->shift, constant = by->constant;
  for (int32_t first = 0; first < n; first += PIECE) { /* rows end with room */
    int32_t expected[PIECE];
    int16_t range[PIECE], bend[PIECE], near[PIECE];
    const int16_t *here = f->here + first, *above = f->above + first, *bends = f->bends + first, *below = f->below + first;
    const int16_t *p = f->near[0] + first, *q = f->near[1] + first, *r = f->near[2] + first;
    uint8_t *RESTRICT own = singles + first, *RESTRICT both = pairs + first / 2;
    for (int k = 0; k < PIECE; k++) {
      range[k] = (int16_t)(here[k] + (plane == HH ? 0 : plane == HL ? above[k] : here[k - 1]));
      bend[k] = (int16_t)(bends[k] + (plane == HH ? bends[k + 1] + below[k] + below[k + 1] : plane == HL ? bends[k + 1] : below[k]));
      near[k] = (int16_t)(plane == HH ? 0 : plane == HL ? p[k] + q[k] : p[k] + p[k - 1] + q[k] + q[k - 1] + r[k] + r[k - 1]);
    }
    for (int k = 0; k < PIECE; k++) {
      expected[k] = ((of_range * range[k] + of_bend * bend[k]) >> shift) + (plane == HH ? 0 : of_near * near[k]) + constant;
    }
    for (int k = 0; k < PIECE; k++) own[k] = (uint8_t)ISA(class_of)(expected[k]);
    for (int k = 0; k < PIECE / 2; k++) both[k] = (uint8_t)ISA(class_of)((expected[2 * k] >> 1) + (expected[2 * k + 1] >> 1));
  }
}

static void ISA(class_row)(const ISA(features) * f, int plane, const rapid_weights *by, int32_t n, uint8_t *pairs, uint8_t *singles) {
  if (plane == HH) ISA(classes)(f, HH, by, n, pairs, singles);
  if (plane == HL) ISA(classes)(f, HL, by, n, pairs, singles);
  if (plane == LH) ISA(classes)(f, LH, by, n, pairs, singles);
}

/* Hide samples without details: `valid` of n samples, at every `step`; NULL: all are valid. An odd sample is a pair. */
static void ISA(hide)(const uint8_t *RESTRICT valid, ptrdiff_t step, int32_t n, uint8_t *RESTRICT pairs, uint8_t *RESTRICT singles) {
  if (n % 2) {
    pairs[n / 2] = (uint8_t)(singles[n - 1] - (singles[n - 1] == 3)); /* the mean of its halves, rounded down */
    singles[n] = HIDDEN;
  }
  if (!valid) return;
  if (step == 2) {
    for (int32_t k = 0; k < n; k++) singles[k] = (uint8_t)(singles[k] | (valid[2 * k] ? 0 : HIDDEN));
  } else {
    for (int32_t k = 0; k < n; k++) singles[k] = (uint8_t)(singles[k] | (valid[k * step] ? 0 : HIDDEN));
  }
  for (int32_t k = 0; k < (n + 1) / 2; k++) {
    uint8_t both = singles[2 * k] & singles[2 * k + 1];
    pairs[k] = (uint8_t)(pairs[k] | (both == HIDDEN ? HIDDEN : 0));
  }
}

/* ---- Symbols (R.6) ---- */

/* What a list has besides symbols. */
enum { HAS_ESCAPES = 1, HAS_RAW = 2 };

/* Write the entries of n pairs, a multiple of 32 in all; return how many. */
static int32_t ISA(make_list)(const ISA(work) * w, int32_t n, int *has) {
  uint8_t *pairs = w->pairs, *singles = w->singles, *entries = w->entries;
  const int8_t cut = (int8_t)w->u->tables->cut;
  int32_t k = 0;
  memset(pairs + n, HIDDEN, ROOM);
  memset(singles + 2 * n, HIDDEN, 2 * ROOM);
  for (; k < n; k += GROUP) {
    uint8_t any = 0;
    for (int i = 0; i < GROUP; i++) any |= (int8_t)pairs[k + i] >= cut;
    if (!any) {
      for (int i = 0; i < GROUP; i++) entries[i] = pairs[k + i] & 63;
      memset(w->is_two + k / 8, 0, GROUP / 8);
      entries += GROUP;
      continue;
    }
#if defined(__AVX2__)
    for (int32_t i = k; i < k + GROUP; i += 8) {
      __m128i pair = _mm_cvtepi8_epi16(_mm_loadl_epi64((const __m128i *)(const void *)(pairs + i)));
      __m128i single = _mm_loadu_si128((const __m128i *)(const void *)(singles + 2 * i));
      __m128i two = _mm_cmpgt_epi16(pair, _mm_set1_epi16((int16_t)(cut - 1)));
      __m128i raw = _mm_and_si128(two, _mm_cmpgt_epi8(single, _mm_set1_epi8(RAW_CLASS + 1)));
      unsigned mask = (unsigned)_mm_movemask_epi8(_mm_packs_epi16(two, two)) & 255;
      single = _mm_and_si128(_mm_or_si128(single, _mm_set1_epi8(SINGLES)), _mm_set1_epi8(127));
      __m128i entry = _mm_blendv_epi8(_mm_and_si128(pair, _mm_set1_epi16(63)), single, two);
      __m128i taken = _mm_loadu_si128((const __m128i *)(const void *)w->u->tables->take[mask]);
      _mm_storeu_si128((__m128i *)(void *)entries, _mm_shuffle_epi8(entry, taken));
      entries += 8 + _mm_popcnt_u32(mask);
      if (!_mm_testz_si128(raw, raw)) *has |= HAS_RAW;
      w->is_two[i / 8] = (uint8_t)mask;
    }
#else
    memset(w->is_two + k / 8, 1, GROUP / 8); /* some are: read_list finds out which, where it matters */
    for (int32_t i = k; i < k + GROUP; i++) { /* no branch by the class, which no processor foresees */
      int own = (int8_t)pairs[i], is_two = own >= cut, first = (int8_t)singles[2 * i], second = (int8_t)singles[2 * i + 1];
      entries[0] = (uint8_t)(is_two ? (SINGLES | first) & 127 : own & 63);
      entries[1] = (uint8_t)((SINGLES | second) & 127);
      entries += 1 + is_two;
      *has |= (is_two & ((first > RAW_CLASS + 1) | (second > RAW_CLASS + 1))) * HAS_RAW;
    }
#endif
  }
  int32_t n_made = (int32_t)(entries - w->entries) - (k - n);
  memset(w->entries + n_made, NO_PAIR, MOST_STATES);
  return (n_made + MOST_STATES - 1) & -MOST_STATES;
}

/* The next state by the symbol that a state says, but for the word that it may take. */
static ALWAYS_INLINE uint32_t ISA(next_state)(uint32_t state, const uint32_t *slots, uint32_t entry, uint8_t *symbol) {
  uint32_t found = slots[entry << SLOT_BITS | (state & (SLOTS - 1))], top = state >> SLOT_BITS;
  *symbol = (uint8_t)found;
  return (found >> 8 & (SLOTS - 1)) * top + top + (found >> 20);
}

/* Read symbols with so few states that nearly all details are 0: these need no slot, and branches are foreseen. */
static ALWAYS_INLINE int ISA(read_few)(const ISA(work) * w, rapid_stream *z, int32_t n, const int n_states) {
  const uint8_t *entries = w->entries, *at = z->words;
  const rapid_tables *t = w->u->tables;
  uint8_t *symbols = w->symbols;
  uint32_t x[8];
  memcpy(x, z->states, (size_t)n_states * sizeof *x);
  for (int32_t k = 0; k < n; k++) symbols[k] = entries[k] < SINGLES ? NO_DETAILS : NO_DETAIL;
  for (int32_t k = 0; k < n; k += 8) {
    if (at > z->words_end) return 0;
    for (int i = 0; i < 8; i++) {
      const rapid_rest *rest = &t->rests[entries[k + i]];
      uint32_t *state = &x[i & (n_states - 1)], y = (*state & (SLOTS - 1)) - rest->first, next = rest->n * (*state >> SLOT_BITS) + y;
      if (y >= rest->n) next = ISA(next_state)(*state, t->slots, entries[k + i], symbols + k + i);
      if (next < FIRST_STATE) {
        next = next << 16 | load_u16(at);
        at += 2;
      }
      *state = next;
    }
  }
  memcpy(z->states, x, (size_t)n_states * sizeof *x);
  z->words = at;
  return 1;
}

#if defined(__AVX512VBMI2__)
#define WIDEN(at) _mm512_cvtepu8_epi32(_mm_loadu_si128((const __m128i *)(const void *)(at)))
#define NARROW(at, v) _mm_storeu_si128((__m128i *)(void *)(at), _mm512_cvtepi32_epi8(v))
#define LOOK_UP(slots, at) _mm512_i32gather_epi32(at, slots, 4)

static ALWAYS_INLINE __m512i ISA(refill)(__m512i next, const uint8_t **at, const rapid_tables *t) {
  __mmask16 takes = _mm512_cmplt_epu32_mask(next, _mm512_set1_epi32(FIRST_STATE));
  __m512i words = _mm512_maskz_expand_epi32(takes, _mm512_cvtepu16_epi32(_mm256_loadu_si256((const __m256i *)(const void *)*at)));
  *at += 2 * (unsigned)_mm_popcnt_u32(takes);
  (void)t;
  return _mm512_mask_or_epi32(next, takes, _mm512_slli_epi32(next, 16), words);
}
#elif defined(__AVX2__)
#define WIDEN(at) _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)(const void *)(at)))
#define NARROW(at, v) _mm_storel_epi64((__m128i *)(void *)(at), ISA(low_bytes)(v))
#define LOOK_UP(slots, at) ISA(look_up)(slots, at)

static ALWAYS_INLINE __m128i ISA(low_bytes)(__m256i v) {
  __m256i halves = _mm256_shuffle_epi8(v, _mm256_set1_epi32(0x0C080400));
  return _mm_unpacklo_epi32(_mm256_castsi256_si128(halves), _mm256_extracti128_si256(halves, 1));
}

/* Eight slots, one by one: in half the time of a gather with 256 bits. */
static ALWAYS_INLINE __m256i ISA(look_up)(const uint32_t *slots, __m256i at) {
  __m128i halves[2] = {_mm256_castsi256_si128(at), _mm256_extracti128_si256(at, 1)};
  for (int i = 0; i < 2; i++) {
    uint64_t low = (uint64_t)_mm_cvtsi128_si64(halves[i]), high = (uint64_t)_mm_extract_epi64(halves[i], 1);
    __m128i x = _mm_insert_epi32(_mm_cvtsi32_si128((int)slots[(uint32_t)low]), (int)slots[low >> 32], 1);
    halves[i] = _mm_insert_epi32(_mm_insert_epi32(x, (int)slots[(uint32_t)high], 2), (int)slots[high >> 32], 3);
  }
  return _mm256_inserti128_si256(_mm256_castsi128_si256(halves[0]), halves[1], 1);
}

static ALWAYS_INLINE __m256i ISA(refill)(__m256i next, const uint8_t **at, const rapid_tables *t) {
  __m256i takes = _mm256_cmpeq_epi32(_mm256_srli_epi32(next, 16), _mm256_setzero_si256());
  unsigned mask = (unsigned)_mm256_movemask_ps(_mm256_castsi256_ps(takes));
  __m256i order = _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)(const void *)t->expand[mask]));
  __m256i words = _mm256_permutevar8x32_epi32(_mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i *)(const void *)*at)), order);
  *at += 2 * (unsigned)_mm_popcnt_u32(mask);
  return _mm256_blendv_epi8(next, _mm256_or_si256(_mm256_slli_epi32(next, 16), words), takes);
}
#endif

/*
 * Read the symbols of n entries, a multiple of 32. Returns 0 where words are missing: what is read of a group of 32 lies in
 * PAYLOAD_SLACK.
 */
static int ISA(read_symbols)(const ISA(work) * w, rapid_stream *z, int32_t n) {
  const uint8_t *entries = w->entries, *at = z->words;
  const rapid_tables *t = w->u->tables;
  uint8_t *symbols = w->symbols;
  if (w->u->n_states == 1) return ISA(read_few)(w, z, n, 1);
  if (w->u->n_states == 8) return ISA(read_few)(w, z, n, 8);
#if defined(__AVX2__)
  enum { WIDTH = LANES / 2, N_VECTORS = MOST_STATES / WIDTH };
  const VECTOR low = V(set1_epi32)(SLOTS - 1);
  VECTOR x[N_VECTORS];
  for (int v = 0; v < N_VECTORS; v++) x[v] = LOAD((const void *)(z->states + WIDTH * v));
#endif
  for (int32_t k = 0; k < n; k += MOST_STATES) {
    if (at > z->words_end) return 0;
#if defined(__AVX2__)
    __m256i all = _mm256_loadu_si256((const __m256i *)(const void *)(entries + k));
    __m256i hidden = _mm256_cmpeq_epi8(_mm256_and_si256(all, _mm256_set1_epi8(63)), _mm256_set1_epi8(63));
    if (_mm256_movemask_epi8(hidden) == -1) { /* they change no state, and details of 0 are what hidden samples have */
      all = _mm256_blendv_epi8(_mm256_set1_epi8(NO_DETAILS), _mm256_set1_epi8(NO_DETAIL), _mm256_slli_epi16(all, 1));
      _mm256_storeu_si256((__m256i *)(void *)(symbols + k), all);
      continue;
    }
    for (int v = 0; v < N_VECTORS; v++) {
      VECTOR slot = V_SI(or)(V(slli_epi32)(WIDEN(entries + k + WIDTH * v), SLOT_BITS), V_SI(and)(x[v], low));
      VECTOR found = LOOK_UP(t->slots, slot), top = V(srli_epi32)(x[v], SLOT_BITS);
      VECTOR product = V(mullo_epi32)(V_SI(and)(V(srli_epi32)(found, 8), low), top);
      NARROW(symbols + k + WIDTH * v, found);
      x[v] = ISA(refill)(V(add_epi32)(product, V(add_epi32)(top, V(srli_epi32)(found, 20))), &at, t);
    }
#else
    for (int i = 0; i < MOST_STATES; i++) {
      uint32_t next = ISA(next_state)(z->states[i], t->slots, entries[k + i], symbols + k + i), takes = next < FIRST_STATE;
      uint32_t longer = next << 16 | load_u16(at);
      z->states[i] = takes ? longer : next; /* no branch: which one no processor foresees */
      at += 2 * takes;
    }
#endif
  }
#if defined(__AVX2__)
  for (int v = 0; v < N_VECTORS; v++) STORE((void *)(z->states + WIDTH * v), x[v]);
#endif
  z->words = at;
  return 1;
}

/* Details of n pairs in 8 bits, in `small`; where more follows: MORE, of the first of a pair. */
static void ISA(place_symbols)(const ISA(work) * w, int32_t n, int *has) {
  const uint8_t *symbols = w->symbols;
  for (int32_t k = 0; k < n; k += GROUP) {
    int8_t *RESTRICT small = w->small + 2 * k;
    uint32_t any;
    uint8_t seen = 0;
    memcpy(&any, w->is_two + k / 8, sizeof any);
    if (!any) {
      for (int i = 0; i < GROUP; i++) { /* a fifteenth, exactly */
        int16_t symbol = symbols[i], first = (int16_t)((int16_t)(symbol * 137) >> 11), second = (int16_t)(symbol - 15 * first - 7);
        seen |= symbol == PAIR_ESCAPE;
        small[2 * i] = (int8_t)(symbol == PAIR_ESCAPE ? MORE : first - 7);
        small[2 * i + 1] = (int8_t)second;
      }
      symbols += GROUP;
    }
#if defined(__AVX2__)
    for (int i = 0; any && i < GROUP; i += 8, small += 16) {
      unsigned mask = w->is_two[(k + i) / 8];
      const __m128i low = _mm_set1_epi16(255), bits = _mm_setr_epi16(1, 2, 4, 8, 16, 32, 64, 128);
      __m128i two = _mm_cmpeq_epi16(_mm_and_si128(_mm_set1_epi16((int16_t)mask), bits), bits);
      __m128i put = _mm_loadu_si128((const __m128i *)(const void *)w->u->tables->put[mask]);
      __m128i both = _mm_shuffle_epi8(_mm_loadu_si128((const __m128i *)(const void *)symbols), put), pair = _mm_and_si128(both, low);
      symbols += 8 + _mm_popcnt_u32(mask);
      __m128i first = _mm_mulhi_epu16(pair, _mm_set1_epi16(4370));
      __m128i second = _mm_sub_epi16(pair, _mm_sub_epi16(_mm_slli_epi16(first, 4), first));
      __m128i escaped = _mm_cmpeq_epi16(first, _mm_set1_epi16(15));
      first = _mm_blendv_epi8(_mm_sub_epi16(first, _mm_set1_epi16(7)), _mm_set1_epi16(MORE), escaped);
      second = _mm_slli_epi16(_mm_sub_epi16(second, _mm_set1_epi16(7)), 8);
      pair = _mm_or_si128(_mm_and_si128(first, low), second);
      pair = _mm_blendv_epi8(pair, _mm_sub_epi8(both, _mm_set1_epi8(NO_DETAIL)), two);
      seen |= _mm_movemask_epi8(_mm_cmpeq_epi8(pair, _mm_set1_epi8(MORE))) != 0;
      _mm_storeu_si128((__m128i *)(void *)small, pair);
    }
#else
    for (int i = 0; any && i < GROUP; i++) {
      int is_two = (int8_t)w->pairs[k + i] >= w->u->tables->cut, symbol = *symbols, next = symbols[is_two], part = symbol * 137 >> 11;
      int first = is_two ? symbol - NO_DETAIL : symbol == PAIR_ESCAPE ? MORE : part - 7;
      int second = is_two ? next - NO_DETAIL : symbol - 15 * part - 7;
      small[2 * i] = (int8_t)first;
      small[2 * i + 1] = (int8_t)second;
      seen |= (first == MORE) | (second == MORE);
      symbols += 1 + is_two;
    }
#endif
    if (seen) *has |= HAS_ESCAPES;
  }
}

/* ---- Raw bits (R.7) ---- */

static ALWAYS_INLINE int ISA(n_raw_bits)(uint8_t single) { return max_i32((int8_t)single - RAW_CLASS, 0) >> 1; }

/* The next n raw bits, 33 at most; whatever they are behind the last one. */
static ALWAYS_INLINE uint64_t ISA(take)(rapid_stream *z, int n) {
  uint64_t bits = load_u64(z->raw + min_size(z->n_bits >> 3, z->n_raw)) >> (z->n_bits & 7);
  z->n_bits += (size_t)n;
  return bits & (((uint64_t)1 << n) - 1);
}

/* A detail whose symbol says that more follows, above its n_low lower bits. */
static int32_t ISA(read_beyond)(const ISA(work) * w, rapid_stream *z, int n_low, int32_t low) {
  int length = (int)ISA(take)(z, 5);
  uint64_t rest = ISA(take)(z, length + 1);
  int64_t beyond = ((int64_t)1 << length) + (int64_t)(rest >> 1) + NO_DETAIL;
  int64_t detail = (rest & 1 ? -beyond : beyond) * ((int64_t)1 << n_low) + low;
  return (int32_t)clamp_i64(detail, -(int64_t)w->u->most_detail, w->u->most_detail);
}

/* Raw bits of single samples among n pairs. Only sums of numbers of bits go from one to the next. */
static void ISA(read_raw)(const ISA(work) * w, rapid_stream *z, int32_t n) {
  enum { PIECE = 32 };
  uint8_t *RESTRICT n_bits = w->entries; /* which have been read */
  const uint8_t *RESTRICT pairs = w->pairs, *RESTRICT singles = w->singles;
  const int cut = w->u->tables->cut;
  const int32_t most = w->u->most_detail;
  for (int32_t k = 0; k < n; k++) {
    uint8_t is_two = (int8_t)pairs[k] >= cut ? 255 : 0;
    n_bits[2 * k] = (uint8_t)(ISA(n_raw_bits)(singles[2 * k]) & is_two);
    n_bits[2 * k + 1] = (uint8_t)(ISA(n_raw_bits)(singles[2 * k + 1]) & is_two);
  }
  memset(n_bits + 2 * n, 0, PIECE);
  const uint8_t *bytes = z->raw;
  size_t at = z->n_bits;
  for (int32_t first = 0; first < 2 * n && at <= 8 * z->n_raw; first += PIECE, n_bits += PIECE) {
    int32_t held[PIECE], scales[PIECE], *RESTRICT large = w->large + first;
    uint64_t words[PIECE / 8];
    memcpy(words, n_bits, sizeof words);
    if (!(words[0] | words[1] | words[2] | words[3])) continue;
    for (int i = 0; i < PIECE; i += 4) { /* at most 13 bits each */
      uint64_t bits = load_u64(bytes + (at >> 3)) >> (at & 7);
      for (int k = i; k < i + 4; k++) {
        scales[k] = 1 << n_bits[k]; /* not every processor shifts each lane by a number of its own */
        held[k] = (int32_t)bits & (scales[k] - 1);
        bits >>= n_bits[k];
        at += n_bits[k];
      }
    }
    for (int i = 0; i < PIECE; i++) {
      int32_t detail = large[i], whole = detail * scales[i] + held[i];
      whole = detail == MORE ? held[i] : min_i32(max_i32(whole, -most), most); /* these keep their low bits */
      large[i] = scales[i] == 1 ? detail : whole;
    }
  }
  z->n_bits = at;
}

/* What symbols do not say of the details of n pairs: from `small` to `large`. */
static int ISA(read_more)(const ISA(work) * w, rapid_stream *z, int32_t n, int has) {
  const int8_t *small = w->small;
  int32_t *RESTRICT large = w->large, *more = w->more, n_escaped = 0, n_more = 0;
  for (int32_t j = 0; j < 2 * n; j++) large[j] = small[j];
  /* Places of what goes on: single samples from the start on, pairs behind them. */
  int32_t *escaped = more + 2 * n;
  const int8_t *at = has & HAS_ESCAPES ? small : NULL, *end = small + 2 * n;
  for (; at && (at = memchr(at, MORE, (size_t)(end - at))) != NULL; at++) {
    int32_t i = (int32_t)(at - small);
    if (w->is_two[i / 16] >> (i / 2 % 8) & 1) more[n_more++] = i; else escaped[n_escaped++] = i;
  }
  if (n_escaped) {
    int32_t n_entries = (2 * n_escaped + MOST_STATES - 1) & -MOST_STATES;
    memset(w->entries, ESCAPED, (size_t)(2 * n_escaped));
    memset(w->entries + 2 * n_escaped, NO_PAIR, (size_t)(n_entries - 2 * n_escaped));
    if (!ISA(read_symbols)(w, z, n_entries)) return 0;
  }
  if (has & HAS_RAW) ISA(read_raw)(w, z, n);
  for (int32_t k = 0; k < n_more; k++) {
    int n_low = ISA(n_raw_bits)(w->singles[more[k]]);
    large[more[k]] = ISA(read_beyond)(w, z, n_low, n_low ? large[more[k]] : 0);
  }
  for (int32_t k = 0; k < 2 * n_escaped; k++) {
    int32_t detail = w->symbols[k] - NO_DETAIL;
    large[escaped[k / 2] + k % 2] = detail == MORE ? ISA(read_beyond)(w, z, 0, 0) : max_i32(min_i32(detail, w->u->most_detail), -w->u->most_detail);
  }
  return z->n_bits <= 8 * z->n_raw;
}

/* Read the details of n pairs: into `large` if *has is not 0 afterwards, else into `small`. Returns 0 where bytes are missing. */
static int ISA(read_list)(const ISA(work) * w, rapid_stream *z, int32_t n, int *has) {
  *has = 0;
  int32_t n_entries = ISA(make_list)(w, n, has);
  if (!ISA(read_symbols)(w, z, n_entries)) return 0;
  ISA(place_symbols)(w, n, has);
#if !defined(__AVX2__)
  for (int32_t k = 0; *has && k < n; k += 8) {
    unsigned mask = 0;
    for (int i = 0; i < 8; i++) mask |= (unsigned)((int8_t)w->pairs[k + i] >= w->u->tables->cut) << i;
    w->is_two[k / 8] = (uint8_t)mask;
  }
#endif
  return !*has || ISA(read_more)(w, z, n, *has);
}


/* ---- Strips of details (R.5 ... R.7) ---- */

static ALWAYS_INLINE int ISA(is_line)(const ISA(work) * w, int plane, int32_t row) {
  const int *known = w->u->known;
  return plane == HL && ((known[0] && row == 0) || (known[2] && row == w->rows[HL] - 1));
}

/* Move the details of a row from where they are in a list; where the prediction may be far from heights, as they are. */
static void ISA(place_row)(const ISA(work) * w, int plane, int32_t row, ptrdiff_t at, int has) {
  int16_t *RESTRICT to = ISA(row_in)(w, w->details[plane], row, HELD_ROWS);
  int32_t *RESTRICT wide = ISA(wide_row_in)(w, w->wide_details[plane], row);
  const int8_t *RESTRICT small = w->small + at;
  const int32_t *RESTRICT large = w->large + at;
  int32_t n = w->cols[plane];
  if (has) {
    for (int32_t j = 0; j < n; j++) to[j] = (int16_t)max_i32(min_i32(large[j], INT16_MAX), -INT16_MAX);
  } else {
    for (int32_t j = 0; j < n; j++) to[j] = small[j];
  }
  if (!w->u->is_narrow || ISA(is_line)(w, plane, row)) {
    if (has) memcpy(wide, large, (size_t)n * sizeof *wide);
    for (int32_t j = 0; !has && j < n; j++) wide[j] = small[j];
  } else if (plane == LH) {
    wide[0] = has ? large[0] : small[0];
    wide[n - 1] = has ? large[n - 1] : small[n - 1];
  }
  if (plane == LH) return;
  int16_t *RESTRICT near = ISA(row_in)(w, w->near[plane], row, HELD_ROWS);
  for (int32_t j = 0; j < n; j++) near[j] = (int16_t)min_i32(to[j] < 0 ? -to[j] : to[j], MOST_NEAR);
  near[-1] = near[n] = near[n + 1] = 0;
}

/* Nothing is known of the details of a row. */
static void ISA(forget)(const ISA(work) * w, int plane, int32_t row) {
  memset(ISA(row_in)(w, w->near[plane], row, HELD_ROWS) - ROOM, 0, (size_t)w->stride * sizeof(int16_t));
}

/* The rows of a plane that a strip has. */
static void ISA(rows_of_strip)(const ISA(work) * w, int plane, int32_t strip, int32_t *first, int32_t *last) {
  *first = max_i32(STRIP * strip - (plane == LH), 0);
  *last = min_i32(STRIP * strip - (plane == LH) + STRIP, w->rows[plane]);
}

/* Fill the classes of a strip's pairs and samples; what its list holds is hidden or has one. */
static void ISA(class_strip)(const ISA(work) * w, int plane, int32_t first, int32_t last) {
  const rapid_unit *u = w->u;
  int32_t n = w->cols[plane], n_pairs = (n + 1) / 2;
  for (int32_t row = first; row < last; row++) {
    const int16_t *above = ISA(row_in)(w, w->near[HH], row - 1, HELD_ROWS), *hh = ISA(row_in)(w, w->near[HH], row, HELD_ROWS);
    const int16_t *hl = ISA(row_in)(w, w->near[HL], row, HELD_ROWS), *below = ISA(row_in)(w, w->near[HL], row + 1, HELD_ROWS);
    const ISA(features) f = {
        ISA(row_in)(w, w->ranges, row, HELD_ROWS), ISA(row_in)(w, w->ranges, row - 1, HELD_ROWS),
        ISA(row_in)(w, w->bends, row, HELD_ROWS), ISA(row_in)(w, w->bends, row + 1, HELD_ROWS), {hh, plane == HL ? above : hl, below}};
    uint8_t *pairs = w->pairs + (ptrdiff_t)(row - first) * n_pairs, *singles = w->singles + (ptrdiff_t)(row - first) * 2 * n_pairs;
    ISA(class_row)(&f, plane, &w->weights[plane], n, pairs, singles);
    const uint8_t *valid = u->valid;
    if (valid) valid += (2 * row + (plane != HL)) * u->valid_stride + (plane != LH) * u->valid_step;
    ISA(hide)(valid, 2 * u->valid_step, n, pairs, singles);
  }
}

static int ISA(read_strip)(const ISA(work) * w, int plane, int32_t strip, rapid_stream *z) {
  int32_t first, last, n = w->cols[plane], n_pairs = (n + 1) / 2;
  int has;
  ISA(rows_of_strip)(w, plane, strip, &first, &last);
  if (plane != LH && last == w->rows[plane]) ISA(forget)(w, plane, last); /* outside nothing is near */
  if (first >= last || n == 0) return 1;
  ISA(class_strip)(w, plane, first, last);
  if (!ISA(read_list)(w, z, n_pairs * (last - first), &has)) return 0;
  for (int32_t row = first; row < last; row++) ISA(place_row)(w, plane, row, (ptrdiff_t)(row - first) * 2 * n_pairs, has);
  return 1;
}

/* ---- Heights (R.8, R.9) ---- */

typedef struct ISA(tap) {
  const int16_t *at;
  int16_t first, second;
} ISA(tap);

/* Predict a row of a plane; of a narrow unit that is decoded, settle its heights, too. */
static ALWAYS_INLINE void ISA(predict)(const ISA(work) * w, int plane, int32_t row, const ISA(tap) * taps, const int n_taps,
                                       const int16_t *p0, const int16_t *p1, const int16_t *p2, const int16_t *p3) {
  const rapid_unit *u = w->u;
  const int is_fine = u->step <= 3, is_narrow = u->is_narrow && !u->is_encoded;
  const int16_t *details = ISA(row_in)(w, w->details[plane], row, HELD_ROWS);
  int16_t *own = ISA(row_in)(w, w->planes[plane], row, HELD_ROWS);
  /* No detail beyond `most` says more than it: all heights are within LIMIT. */
  const int32_t most = is_narrow ? 2 * LIMIT / u->step + 1 : 0;
  const VECTOR low = SPLAT(u->low - u->origin), high = SPLAT(u->high - u->origin), step = SPLAT(u->step);
  const VECTOR most_detail = SPLAT(most), least_detail = SPLAT(-most), two = SPLAT(2);
  ISA(tap_weights) weights[14];
  for (int k = 0; k < n_taps; k++) weights[k] = TWO_WEIGHTS(taps[k].first, taps[k].second);
  for (int32_t j = w->from; j < w->to; j += LANES) {
    ISA(sums) sums = NO_SUMS;
    for (int k = 0; k < n_taps; k++) ADD_TAPS(sums, taps[k].at + j, weights[k]);
    VECTOR x = LOAD(p0 + j), y = LOAD(p1 + j), z = LOAD(p2 + j), v = LOAD(p3 + j);
    VECTOR least = LEAST(LEAST(x, y), LEAST(z, v)), greatest = MOST(MOST(x, y), MOST(z, v));
    VECTOR quarters = LEAST(MOST(ISA(quarters)(sums), TWICE(TWICE(least))), TWICE(TWICE(greatest)));
    VECTOR whole = QUARTER(ADD(quarters, two)), side;
    if (is_fine) side = ABOVE(TWICE(TWICE(whole)), quarters); else side = ABOVE(quarters, ADD(ADD(x, y), ADD(z, v)));
    if (is_narrow) {
      VECTOR detail = SUB(XOR(LEAST(MOST(LOAD(details + j), least_detail), most_detail), side), side);
      STORE(own + j, LEAST(MOST(ADD(whole, MUL(detail, step)), low), high));
    } else {
      STORE(w->predicted + j, quarters);
      STORE(w->sides + j, side);
    }
  }
}

static void ISA(predict_row)(const ISA(work) * w, int plane, int32_t i) {
  const int16_t *v = w->u->tables->stencils[w->u->level_class][plane];
  const int16_t *up = ISA(row_of_a)(w, i - 1), *at = ISA(row_of_a)(w, i), *down = ISA(row_of_a)(w, i + 1), *low = ISA(row_of_a)(w, i + 2);
  if (plane == HH) {
    const ISA(tap) taps[8] = {{up - 1, v[0], v[1]}, {up + 1, v[2], v[3]}, {at - 1, v[4], v[5]}, {at + 1, v[6], v[7]},
                              {down - 1, v[8], v[9]}, {down + 1, v[10], v[11]}, {low - 1, v[12], v[13]}, {low + 1, v[14], v[15]}};
    ISA(predict)(w, HH, i, taps, 8, at, at + 1, down, down + 1);
    return;
  }
  const int16_t *h2 = ISA(row_of)(w, HH, i - 2), *h1 = ISA(row_of)(w, HH, i - 1), *h = ISA(row_of)(w, HH, i), *hd = ISA(row_of)(w, HH, i + 1);
  if (plane == HL) {
    const ISA(tap) taps[12] = {{up - 1, v[0], v[1]}, {up + 1, v[2], v[3]}, {at - 1, v[4], v[5]}, {at + 1, v[6], v[7]},
                               {down - 1, v[8], v[9]}, {down + 1, v[10], v[11]}, {h2, v[12], 0}, {h1 - 1, v[13], v[14]},
                               {h1 + 1, v[15], 0}, {h - 1, v[16], v[17]}, {h + 1, v[18], 0}, {hd, v[19], 0}};
    ISA(predict)(w, HL, i, taps, 12, at, at + 1, h1, h);
    return;
  }
  const int16_t *l = ISA(row_of)(w, HL, i), *ld = ISA(row_of)(w, HL, i + 1);
  const ISA(tap) taps[14] = {{up - 1, v[0], v[1]}, {up + 1, v[2], 0}, {at - 1, v[3], v[4]}, {at + 1, v[5], 0}, {down - 1, v[6], v[7]},
                             {down + 1, v[8], 0}, {low - 1, v[9], v[10]}, {low + 1, v[11], 0}, {h1 - 1, v[12], v[13]},
                             {h - 2, v[14], v[15]}, {h, v[16], v[17]}, {hd - 1, v[18], v[19]}, {l - 1, v[20], v[21]}, {ld - 1, v[22], v[23]}};
  ISA(predict)(w, LH, i, taps, 14, at, down, h - 1, h);
}

#define SETTLE(number)                                                                                              \
  for (int32_t j = w->from; j < to; j++) {                                                                          \
    number whole = shift >= 2 ? (number)predicted[j] * ((number)1 << (shift - 2)) : ((number)predicted[j] * (1 << shift) + 2) >> 2; \
    number detail = details[j], side = sides[j];                                                                    \
    number height = whole + ((detail ^ side) - side) * (number)u->step;                                             \
    height = height < low ? low : height > high ? high : height;                                                    \
    heights[j] = (int32_t)height + origin;                                                                          \
  }

/* Of a unit that needs 32 bits. */
static void ISA(settle_wide)(const ISA(work) * w, int plane, int32_t row) {
  const rapid_unit *u = w->u;
  const int16_t *RESTRICT predicted = w->predicted, *RESTRICT sides = w->sides;
  const int32_t *RESTRICT details = ISA(wide_row_in)(w, w->wide_details[plane], row);
  int32_t *RESTRICT heights = ISA(wide_row_in)(w, w->heights[plane], row);
  const int32_t low = u->low - u->origin, high = u->high - u->origin, origin = u->origin, to = min_i32(w->to, w->cols[plane]);
  const int shift = u->shift;
  if (shift <= 16 && u->step <= 1 << 24) { /* all sums are below 2^31: details are below 32, or within the range of heights */
    SETTLE(int32_t)
  } else {
    SETTLE(int64_t)
  }
}

static int32_t ISA(parent_at)(const rapid_unit *u, ptrdiff_t at) {
  return (u->short_parent ? u->short_parent[at] : u->parent[at]) + u->parent_origin;
}

/* Predict an odd place of a line that units share, from the parent's samples on it: n, so far apart. */
static int64_t ISA(predict_on_line)(const rapid_unit *u, ptrdiff_t first, ptrdiff_t step, int32_t n, int32_t k, int *is_turned) {
  int64_t x[4];
  for (int32_t i = 0; i < 4; i++) {
    int32_t at = k - 1 + i;
    x[i] = ISA(parent_at)(u, first + step * ((uint32_t)at < (uint32_t)n ? at : ISA(mirrored)(at, n)));
  }
  int64_t least = min_i64(min_i64(x[0], x[1]), min_i64(x[2], x[3])), most = max_i64(max_i64(x[0], x[1]), max_i64(x[2], x[3]));
  int64_t quarters = clamp_i64(shift_right(9 * (x[1] + x[2]) - x[0] - x[3], 2), 4 * least, 4 * most), whole = shift_right(quarters + 2, 2);
  *is_turned = u->step <= 3 ? 4 * whole > quarters : quarters > 2 * (x[1] + x[2]);
  return whole;
}

static int32_t ISA(height_on_line)(const rapid_unit *u, ptrdiff_t first, ptrdiff_t step, int32_t n, int32_t k, int64_t detail) {
  int is_turned;
  int64_t whole = ISA(predict_on_line)(u, first, step, n, k, &is_turned);
  return (int32_t)clamp_i64(whole + (is_turned ? -detail : detail) * u->step, u->low, u->high);
}

/* Heights of a row that is settled: those on lines, and corrections. */
static void ISA(change_row)(const ISA(work) * w, int plane, int32_t row) {
  const rapid_unit *u = w->u;
  const int32_t *corrections = u->corrections, n = w->cols[plane], origin = u->origin, low = u->low, high = u->high;
  int is_line = ISA(is_line)(w, plane, row), has_column = plane == LH && (u->known[1] || u->known[3]);
  if (corrections) corrections += (2 * row + (plane != HL)) * u->corrections_stride + (plane != LH) * u->corrections_step;
  if (u->is_narrow && !is_line && !has_column && !corrections) return;
  int16_t *RESTRICT own = ISA(row_in)(w, w->planes[plane], row, HELD_ROWS);
  int32_t *RESTRICT heights = ISA(wide_row_in)(w, w->heights[plane], row);
  const int32_t *details = ISA(wide_row_in)(w, w->wide_details[plane], row);
  if (u->is_narrow && (is_line || corrections)) {
    for (int32_t j = w->from; j < w->to; j++) heights[j] = own[j] + origin;
  }
  for (int32_t j = w->from; is_line && j < min_i32(w->to, n); j++) {
    heights[j] = ISA(height_on_line)(u, row * u->parent_stride, 1, w->a_cols, j, details[j]);
  }
  for (int side = 1; side < 4; side += 2) {
    int32_t j = side == 1 ? 0 : n - 1;
    if (!has_column || !u->known[side]) continue;
    heights[j] = ISA(height_on_line)(u, j, u->parent_stride, w->a_rows, row, details[j]);
    own[j] = (int16_t)(min_i32(max_i32(heights[j], low), high) - origin); /* of a narrow unit; else see below */
  }
  if (u->is_narrow && !is_line && !corrections) return;
  int shift = u->shift;
  for (int32_t j = w->from; j < min_i32(w->to, n); j++) {
    int64_t change = corrections ? corrections[2 * j * u->corrections_step] : 0;
    heights[j] = (int32_t)clamp_i64(heights[j] + change, low, high);
    own[j] = (int16_t)max_i32(min_i32((heights[j] - origin) >> shift, LIMIT), -LIMIT);
  }
}

/* Even and odd samples of a row from column `begin` up to, not with, `end`. */
#define INTERLEAVE(type, of_even, of_odd)                                                  \
  do {                                                                                     \
    type *RESTRICT to = (type *)u->out + row * u->out_stride;                              \
    for (int32_t j = begin / 2; j < (begin + 1) / 2; j++) to[2 * j + 1] = (type)(of_odd);  \
    for (int32_t j = (begin + 1) / 2; j < end / 2; j++) {                                  \
      to[2 * j] = (type)(of_even);                                                         \
      to[2 * j + 1] = (type)(of_odd);                                                      \
    }                                                                                      \
    for (int32_t j = end / 2; j < (end + 1) / 2; j++) to[2 * j] = (type)(of_even);         \
  } while (0)

/* Write a row of the lattice: even samples and odd ones of two rows of planes. */
static void ISA(store_row)(const ISA(work) * w, int32_t row) {
  const rapid_unit *u = w->u;
  if (row < u->rows[0] || row >= u->rows[1]) return;
  int32_t i = row / 2, begin = u->cols[0], end = u->cols[1];
  if (u->is_narrow) {
    const int16_t *RESTRICT even = row % 2 ? ISA(row_in)(w, w->planes[LH], i, HELD_ROWS) : ISA(row_of_a)(w, i);
    const int16_t *RESTRICT odd = ISA(row_in)(w, w->planes[row % 2 ? HH : HL], i, HELD_ROWS);
    uint32_t add = u->add + (uint32_t)u->origin;
    if (u->is_short) {
      INTERLEAVE(uint16_t, (uint16_t)even[j] + (uint16_t)add, (uint16_t)odd[j] + (uint16_t)add);
    } else {
      INTERLEAVE(uint32_t, (uint32_t)even[j] + add, (uint32_t)odd[j] + add);
    }
    return;
  }
  int32_t *even = ISA(wide_row_in)(w, w->heights[LH], i);
  const int32_t *RESTRICT odd = ISA(wide_row_in)(w, w->heights[row % 2 ? HH : HL], i);
  for (int32_t j = begin / 2; row % 2 == 0 && j < (end + 1) / 2; j++) {
    even[j] = min_i32(max_i32(ISA(parent_at)(u, i * u->parent_stride + j), u->low), u->high);
  }
  uint32_t add = u->add;
  if (u->is_short) {
    INTERLEAVE(uint16_t, (uint32_t)even[j] + add, (uint32_t)odd[j] + add);
  } else {
    INTERLEAVE(uint32_t, (uint32_t)even[j] + add, (uint32_t)odd[j] + add);
  }
}

/* Predict and settle the rows of planes that are ready after a strip, and write those of the lattice. */
static void ISA(settle_rows)(const ISA(work) * w, int32_t strip, int32_t *done) {
  const int32_t *rows = w->rows;
  int32_t ready[3];
  ready[HH] = min_i32(STRIP * strip + STRIP, rows[HH]);
  ready[HL] = min_i32(STRIP * strip + STRIP - (ready[HH] < rows[HH]), rows[HL]);
  ready[LH] = min_i32(STRIP * strip + STRIP - 1 - (ready[HL] < rows[HL]), rows[LH]);
  for (int p = HH; p <= LH; p++) {
    for (; done[p] < ready[p]; done[p]++) {
      int32_t i = done[p], n = w->cols[p];
      if (n) {
        int16_t *own = ISA(row_in)(w, w->planes[p], i, HELD_ROWS);
        ISA(predict_row)(w, p, i);
        if (!w->u->is_narrow) ISA(settle_wide)(w, p, i);
        ISA(change_row)(w, p, i);
        for (int k = 1; k <= MARGIN; k++) {
          own[-k] = own[0];
          if (w->to >= n) own[n - 1 + k] = own[n - 1];
        }
      }
      if (p != HH) ISA(store_row)(w, 2 * i + (p == LH));
    }
  }
}

/* ---- A lattice ---- */

static twz_status ISA(begin)(ISA(work) * w, rapid_unit *u, twz_error *error) {
  memset(w, 0, sizeof *w);
  w->u = u;
  w->a_rows = (u->n_rows + 1) / 2;
  w->a_cols = (u->n_cols + 1) / 2;
  w->stride = (w->a_cols + 3 * ROOM) & -ROOM;
  size_t row = (size_t)w->stride, list = STRIP * row, n_bytes = list * (6 + 3 * sizeof(int32_t)) + 64 * SCRATCH_ALIGN;
  n_bytes += row * (sizeof(int16_t) * (A_ROWS + 10 * HELD_ROWS + 2) + sizeof(int32_t) * 6 * HELD_ROWS);
  TRY(scratch_reserve(u->scratch, n_bytes, error));
  w->a = scratch_take(u->scratch, A_ROWS * row * sizeof(int16_t));
  w->ranges = scratch_take(u->scratch, HELD_ROWS * row * sizeof(int16_t));
  w->bends = scratch_take(u->scratch, HELD_ROWS * row * sizeof(int16_t));
  w->predicted = scratch_take(u->scratch, row * sizeof(int16_t));
  w->sides = scratch_take(u->scratch, row * sizeof(int16_t));
  w->from = max_i32(u->cols[0] / 2 - 2 * MARGIN, 0) & -32;
  w->to = min_i32((u->cols[1] + 1) / 2 + MARGIN, w->a_cols);
  for (int p = HH; p <= LH; p++) {
    w->rows[p] = (u->n_rows + (p == HL)) / 2;
    w->cols[p] = (u->n_cols + (p == LH)) / 2;
    w->planes[p] = scratch_take(u->scratch, HELD_ROWS * row * sizeof(int16_t));
    w->details[p] = scratch_take(u->scratch, HELD_ROWS * row * sizeof(int16_t));
    w->wide_details[p] = scratch_take(u->scratch, HELD_ROWS * row * sizeof(int32_t));
    w->heights[p] = scratch_take(u->scratch, HELD_ROWS * row * sizeof(int32_t));
    if (w->to - w->from < w->a_cols) memset(w->planes[p], 0, HELD_ROWS * row * sizeof(int16_t));
    weigh_rapid(u, p, &w->weights[p]);
    if (p == LH) break;
    w->near[p] = scratch_take(u->scratch, HELD_ROWS * row * sizeof(int16_t));
    memset(w->near[p], 0, HELD_ROWS * row * sizeof(int16_t));
  }
  w->pairs = scratch_take(u->scratch, list);
  w->singles = scratch_take(u->scratch, list);
  w->is_two = scratch_take(u->scratch, list);
  w->entries = scratch_take(u->scratch, list);
  w->symbols = scratch_take(u->scratch, list);
  w->small = scratch_take(u->scratch, list);
  w->large = scratch_take(u->scratch, list * sizeof(int32_t));
  w->more = scratch_take(u->scratch, 2 * list * sizeof(int32_t));
  return TWZ_OK;
}

static twz_status ISA(decode_rapid)(rapid_unit *u, twz_error *error) {
  ISA(work) work, *w = &work;
  TRY(ISA(begin)(w, u, error));
  int32_t n_strips = rapid_strips(u->n_rows), first = u->rows[0] / 2, stop = (u->rows[1] + 1) / 2; /* rows of HL and LH */
  int32_t done[3] = {max_i32(first - 2, 0), first, first};
  int band = rapid_first_band(u->n_rows, u->rows[0], u->n_bands);
  int32_t strip = rapid_band(u->n_rows, band, u->n_bands);
  u->is_part = strip > 0;
  w->loaded = STRIP * strip - 2;
  w->looked = STRIP * strip - 1;
  for (int is_new = 1; strip < n_strips && (done[HL] < min_i32(stop, w->rows[HL]) || done[LH] < min_i32(stop, w->rows[LH])); strip++) {
    for (; strip >= rapid_band(u->n_rows, band + 1, u->n_bands); is_new = 1) band++;
    for (int p = HH; p <= HL && is_new; p++) ISA(forget)(w, p, STRIP * strip - 1);
    is_new = 0;
    for (; w->loaded < w->a_rows + 2 && w->loaded < STRIP * strip + STRIP + 2; w->loaded++) ISA(load_row)(w, w->loaded);
    for (; w->looked <= w->a_rows && w->looked <= STRIP * strip + STRIP; w->looked++) ISA(look)(w, w->looked);
    for (int p = HH; p <= LH; p++) {
      REQUIRE(ISA(read_strip)(w, p, strip, &u->bands[band]), error, "streams of method rapid are cut");
    }
    ISA(settle_rows)(w, strip, done);
  }
  u->is_part |= strip < n_strips;
  return TWZ_OK;
}
