/* Units of method rapid as payloads (R.1, R.2, R.6, R.7): symbols, words, root blocks. Lattices are in encode_rows.h. */
#include "encode.h"
#include "kernels.h"

enum {
  MOST_SHIFT = 30, ORIGIN_BITS = 10, BYTES_OF_BAND = 1 << 15,
  EVERY = 3,                     /* one detail in so many counts for the estimate of their bits */
  RAW_CLASS = 32, PAIR_LIMIT = 7, SIDE = 2 * PAIR_LIMIT + 1, SINGLE_LIMIT = 31,
  MOST_RAW_BYTES = 8,            /* of a sample: 13 bits, 5, and 33 */
  MOST_ENTRIES = 3,              /* of a pair */
  MOST_HEAD = 128,
  MOST_SIDE = 1 << 14            /* samples of a unit along an axis */
};

struct twz_encoder {
  twz_allocator allocator;
  const struct row_kernels *kernels;
  scratch rows, unit, payload;   /* of a lattice; of all that a unit needs besides; what is made */
  uint32_t inverses[SLOTS + 1];  /* by f: ceil(2^(32 + b) / f) - 2^32, b the bits of f - 1; division by f for any 32 bits */
};

/* ---- Tables and memory ---- */

/* Symbols by slots, as decoders look them up. */
static void fill_slots(rapid_tables *t, const uint32_t *freqs, const uint32_t *starts) {
  for (int i = 0; i < N_TABLES * N_SYMBOLS; i++) {
    uint32_t *slots = t->slots + ((size_t)(i / N_SYMBOLS) << SLOT_BITS);
    for (uint32_t m = 0; m < freqs[i] && starts[i] + m < SLOTS; m++) slots[starts[i] + m] = (uint32_t)(i % N_SYMBOLS) | (freqs[i] - 1) << 8 | m << 20;
  }
  for (int table = 0; table < N_TABLES; table++) {
    int rest = table * N_SYMBOLS + (table < SINGLES ? NO_DETAILS : NO_DETAIL);
    t->rests[table] = (rapid_rest){(uint16_t)starts[rest], (uint16_t)freqs[rest]};
  }
  rapid_fill_orders(t);
}

twz_status encode_tables_new(const twz_allocator *a, int32_t k_max, int32_t cut, int32_t has_slots, const int64_t *stencils, const int64_t *weights,
                             const uint32_t *freqs, const uint32_t *starts, encode_tables **made, twz_error *error) {
  *made = NULL;
  encode_tables *t = twz_allocate(a, sizeof *t);
  if (!t) return twz_no_memory(error, sizeof *t);
  t->allocator = *a;
  t->rapid = twz_allocate(a, sizeof *t->rapid); /* pages of its slots are never touched */
  if (!t->rapid) {
    encode_tables_free(t);
    return twz_no_memory(error, sizeof *t->rapid);
  }
  t->rapid->k_max = k_max;
  t->rapid->cut = cut;
  for (int i = 0; i < 3 * N_LEVEL_CLASSES; i++) {
    for (int k = 0; k < N_TAPS; k++) t->rapid->stencils[i / 3][i % 3][k] = (int16_t)stencils[N_TAPS * i + k];
    for (int k = 0; k < 4; k++) t->rapid->weights[i / 3][i % 3][k] = (int32_t)weights[4 * i + k];
  }
  for (int i = 0; i < N_TABLES * N_SYMBOLS; i++) {
    uint32_t cost = freqs[i] ? SLOT_BITS - (uint32_t)bit_length(freqs[i] - 1) : 0;
    t->freqs[i] = (freqs[i] & FREQ_MASK) | (starts[i] & FREQ_MASK) << FREQ_BITS | cost << COST_SHIFT;
  }
  if (has_slots) fill_slots(t->rapid, freqs, starts);
  *made = t;
  return TWZ_OK;
}

void encode_tables_free(encode_tables *t) {
  if (!t) return;
  twz_allocator allocator = t->allocator;
  twz_release(&allocator, t->rapid);
  twz_release(&allocator, t);
}

twz_status encoder_new(const twz_allocator *a, twz_kernels kernels, twz_encoder **made, twz_error *error) {
  *made = NULL;
  const row_kernels *found = find_kernels(kernels);
  if (!found) return twz_fail(error, TWZ_UNSUPPORTED, "kernels that this processor has not");
  twz_encoder *e = twz_allocate_zeros(a, sizeof *e);
  if (!e) return twz_no_memory(error, sizeof *e);
  e->allocator = *a;
  e->kernels = found;
  for (uint32_t f = 1; f <= SLOTS; f++) e->inverses[f] = (uint32_t)((((uint64_t)1 << (32 + bit_length(f - 1))) - 1) / f + 1);
  e->rows.allocator = e->unit.allocator = e->payload.allocator = &e->allocator;
  *made = e;
  return TWZ_OK;
}

void encoder_free(twz_encoder *e) {
  if (!e) return;
  scratch_free(&e->rows);
  scratch_free(&e->unit);
  scratch_free(&e->payload);
  twz_allocator allocator = e->allocator;
  twz_release(&allocator, e);
}

/* ---- Symbols (R.6, R.7) ---- */

/* Write n bits, 40 at most. */
static void put_bits(symbol_log *l, uint64_t bits, int n) {
  uint8_t *at = l->raw + (l->n_bits >> 3);
  bits = bits << (l->n_bits & 7) | *at;
  for (int i = 0; i < 8; i++) at[i] = (uint8_t)(bits >> (8 * i));
  l->n_bits += (size_t)n;
}

/* What the symbol of a value says no more, if there is anything. */
static void put_beyond(symbol_log *l, int32_t value) {
  int64_t beyond = abs_i64(value) - SINGLE_LIMIT - 1;
  if (beyond < 0) return;
  int length = bit_length((uint64_t)beyond + 1) - 1;
  uint64_t rest = (uint64_t)(beyond + 1 - ((int64_t)1 << length)) << 1 | (value < 0);
  put_bits(l, (uint64_t)length | rest << 5, 5 + length + 1);
}

static ALWAYS_INLINE uint32_t single_symbol(int32_t value) {
  return value < -SINGLE_LIMIT || value > SINGLE_LIMIT ? SINGLE_ESCAPE : (uint32_t)(value + SINGLE_LIMIT);
}

static ALWAYS_INLINE int raw_bits_of(uint8_t single) { return max_i32((int8_t)single - RAW_CLASS, 0) >> 1; }

ALSO_AVX2 void twz_log_pairs(encoding *e, symbol_log *l, const uint8_t *pairs, const uint8_t *singles, const int32_t *details, int32_t n) {
  const uint32_t *freqs = e->tables->freqs;
  const int cut = e->tables->rapid->cut;
  uint32_t *to = l->entries + l->n_entries, k = 0;
  int32_t *more = e->more, n_two = 0, n_escaped = 0; /* two samples each from the start on, others from the end */
  int has_raw = 0, has_beyond = 0;
  for (int32_t pair = 0; pair < n; pair++) {
    int class = (int8_t)pairs[pair];
    const int32_t *two = details + 2 * pair;
    if (class >= cut) {
      more[n_two++] = pair;
      for (int i = 0; i < 2; i++, k++) {
        uint8_t single = singles[2 * pair + i];
        if (single == HIDDEN) continue;
        uint32_t symbol = single_symbol((int32_t)shift_right(two[i], raw_bits_of(single)));
        has_raw |= single > RAW_CLASS + 1;
        has_beyond |= symbol == SINGLE_ESCAPE;
        *to++ = symbol | (SINGLES | (uint32_t)single) << 8 | (k & (MOST_STATES - 1)) << 16;
      }
    } else if (class >= 0) {
      int has_symbol = two[0] >= -PAIR_LIMIT && two[0] <= PAIR_LIMIT && two[1] >= -PAIR_LIMIT && two[1] <= PAIR_LIMIT;
      uint32_t table = (uint32_t)class << 8, symbol = has_symbol ? (uint32_t)((two[0] + PAIR_LIMIT) * SIDE + two[1] + PAIR_LIMIT) : PAIR_ESCAPE;
      if (!has_symbol || (freqs[table | symbol] & FREQ_MASK) == 0) {
        symbol = PAIR_ESCAPE;
        more[n - ++n_escaped] = pair;
      }
      *to++ = symbol | table | (k++ & (MOST_STATES - 1)) << 16;
    } else {
      k++;
    }
  }
  for (int32_t i = 0; i < 2 * n_escaped; i++) {
    int32_t detail = details[2 * more[n - 1 - i / 2] + i % 2];
    *to++ = single_symbol(detail) | ESCAPED << 8 | ((uint32_t)i & (MOST_STATES - 1)) << 16;
  }
  l->n_entries = (size_t)(to - l->entries);
  for (int32_t i = 0; has_raw && i < 2 * n_two; i++) {
    int32_t place = 2 * more[i / 2] + i % 2;
    int n_bits = singles[place] == HIDDEN ? 0 : raw_bits_of(singles[place]);
    if (n_bits) put_bits(l, (uint32_t)details[place] & ((1u << n_bits) - 1), n_bits);
  }
  for (int32_t i = 0; has_beyond && i < 2 * n_two; i++) {
    int32_t place = 2 * more[i / 2] + i % 2;
    if (singles[place] != HIDDEN) put_beyond(l, (int32_t)shift_right(details[place], raw_bits_of(singles[place])));
  }
  for (int32_t i = 0; i < 2 * n_escaped; i++) put_beyond(l, details[2 * more[n - 1 - i / 2] + i % 2]);
}

/* Encode a log, the last symbol first, before `end`; return how many words, or -1: a symbol has no slot. */
static ptrdiff_t encode_words(const encode_tables *t, const uint32_t *inverses, const symbol_log *l, uint32_t n_states, uint32_t *states, uint8_t *end) {
  uint8_t *at = end;
  for (uint32_t i = 0; i < n_states; i++) states[i] = FIRST_STATE;
  for (size_t k = l->n_entries; k > 0; k--) {
    uint32_t entry = l->entries[k - 1], found = t->freqs[entry & 0xFFFF], freq = found & FREQ_MASK;
    uint32_t *state = states + (entry >> 16 & (n_states - 1)), x = *state;
    if (freq == 0) return -1;
    int is_full = x >= (uint64_t)freq << (32 - SLOT_BITS); /* no branch, which no processor foresees: k words are left */
    at[-2] = (uint8_t)x;
    at[-1] = (uint8_t)(x >> 8);
    at -= 2 * is_full;
    x >>= 16 * is_full;
    uint32_t whole = (uint32_t)((((uint64_t)x * inverses[freq] >> 32) + x) >> (SLOT_BITS - (found >> COST_SHIFT))); /* x / freq */
    *state = x + whole * (SLOTS - freq) + (found >> FREQ_BITS & FREQ_MASK);
  }
  return (end - at) / 2;
}

/* ---- Payloads (R.1) ---- */

typedef struct coded_band {
  uint32_t states[MOST_STATES];
  uint8_t *words;
  size_t n_words;
} coded_band;

static uint8_t *write_varint(uint8_t *to, uint64_t value) {
  for (; value >= 128; value >>= 7) *to++ = (uint8_t)(value | 128);
  *to++ = (uint8_t)value;
  return to;
}

static twz_status make_payload(twz_encoder *encoder, const encoding *e, const rapid_unit *u, int64_t number, encode_job *job,
                               twz_error *error) {
  static const uint32_t N_STATES[3] = {1, 8, MOST_STATES};
  coded_band bands[MOST_BANDS];
  size_t n_bytes = MOST_HEAD, n_others = 0, most_words = 0;
  for (int b = 0; b < e->n_bands; b++) {
    n_bytes += 2 * e->logs[b].n_entries + 4 * MOST_STATES + e->logs[b].n_bits / 8 + 1;
    n_others += 2 * e->logs[b].n_entries + SCRATCH_ALIGN;
  }
  TRY(scratch_reserve(&encoder->payload, n_bytes + n_others + SCRATCH_ALIGN, error));
  uint8_t *payload = scratch_take(&encoder->payload, n_bytes), *to = payload + 1;
  for (int b = 0; b < e->n_bands; b++) bands[b].words = scratch_take(&encoder->payload, 2 * e->logs[b].n_entries);
  int which = 2; /* several bands are large enough for all states */
  for (int is_again = 0; is_again < 2; is_again++) {
    for (int b = 0; b < e->n_bands && (!is_again || which < 2); b++) {
      uint8_t *end = bands[b].words + (is_again ? 2 * bands[b].n_words : 2 * e->logs[b].n_entries);
      ptrdiff_t n_words = encode_words(e->tables, encoder->inverses, &e->logs[b], N_STATES[which], bands[b].states, end);
      if (n_words < 0) return twz_fail(error, TWZ_BAD_ARGUMENT, "a symbol that the tables have no slot for");
      bands[b].n_words = (size_t)n_words;
      bands[b].words = end - 2 * n_words;
      most_words = max_size(most_words, (size_t)n_words);
    }
    if (!is_again && e->n_bands == 1) which = (most_words >= 1 << 7) + (most_words >= 1 << 11); /* each state takes two bytes */
  }
  payload[0] = (uint8_t)(u->is_narrow | which << 1 | (e->n_bands - 1) << 3 | (number ? 32 : 0));
  if (!u->is_narrow) *to++ = (uint8_t)u->shift;
  if (number) to = write_varint(to, number > 0 ? 2 * (uint64_t)number : 2 * (uint64_t)-number - 1);
  for (int b = 0; b < e->n_bands; b++) to = write_varint(write_varint(to, bands[b].n_words), (e->logs[b].n_bits + 7) / 8);
  for (int b = 0; b < e->n_bands; b++) {
    size_t n_raw = (e->logs[b].n_bits + 7) / 8;
    for (uint32_t s = 0; s < N_STATES[which]; s++) {
      for (int i = 0; i < 4; i++) *to++ = (uint8_t)(bands[b].states[s] >> (8 * i));
    }
    memcpy(to, bands[b].words, 2 * bands[b].n_words);
    to += 2 * bands[b].n_words;
    memcpy(to, e->logs[b].raw, n_raw);
    to += n_raw;
  }
  job->payload = payload;
  job->n_payload = (uint64_t)(to - payload);
  return TWZ_OK;
}

ALSO_AVX2 int twz_bands_for(const encoding *e, const int32_t *rows, const int32_t *cols) {
  int64_t n = 0, octaves = 0;
  for (int p = HH; p <= LH; p++) {
    const int32_t *details = e->details[p];
    int64_t all = rows[p] * ((int64_t)cols[p] + cols[p] % 2);
    for (int64_t k = 0; k < all; k += EVERY, n++) {
      float size = (float)(details[k] < 0 ? -details[k] : details[k]);
      int32_t bits;
      size += size;
      size += 1;
      memcpy(&bits, &size, sizeof bits); /* its logarithm, in 2^-23 of an octave above 2^-127 */
      octaves += bits - (127 << 23);
    }
  }
  int64_t n_bits = EVERY * min_i64(2 * octaves, octaves + n * ((int64_t)3 << 22)) >> 23;
  return (int)min_i64(1 + n_bits / (8 * BYTES_OF_BAND), MOST_BANDS);
}

/* ---- Units ---- */

/* The least and the greatest height that a unit's planes hold. */
static ALSO_AVX2 void find_range(const encode_job *job, int64_t *low, int64_t *high, int *is_within) {
  size_t n = (size_t)job->n_rows * (size_t)job->n_cols, n_seen = 0;
  int32_t least = INT32_MAX, most = INT32_MIN;
  if (job->valid) {
    for (size_t i = 0; i < n; i++) {
      n_seen += job->valid[i] != 0;
      least = job->valid[i] ? min_i32(least, job->target[i]) : least;
      most = job->valid[i] ? max_i32(most, job->target[i]) : most;
    }
  } else {
    n_seen = n;
    for (size_t i = 0; i < n; i++) {
      least = min_i32(least, job->target[i]);
      most = max_i32(most, job->target[i]);
    }
  }
  *is_within = n_seen == 0 || (least >= job->z_min && most <= job->z_max);
  for (int32_t row = 0; job->parent && row < job->parent_rows; row++) {
    const int32_t *from = job->parent + row * (ptrdiff_t)job->parent_stride;
    n_seen += (size_t)job->parent_cols;
    for (int32_t col = 0; col < job->parent_cols; col++) {
      least = min_i32(least, from[col]);
      most = max_i32(most, from[col]);
    }
  }
  for (size_t i = 0; job->kept && i < n; i++) {
    if (job->kept[i] == FREE) continue;
    n_seen++;
    least = min_i32(least, job->kept[i]);
    most = max_i32(most, job->kept[i]);
  }
  int64_t middle = shift_right((int64_t)job->z_min + job->z_max, 1);
  *low = max_i64(n_seen ? least : middle, job->z_min);
  *high = min_i64(n_seen ? most : middle, job->z_max);
}

/* Choose shift and origin: narrow if heights, and what may be asked for, fit. Returns the origin's number. */
static int64_t choose_head(const encode_job *job, rapid_unit *u, int64_t least, int64_t most) {
  int64_t middle = shift_right((int64_t)job->z_min + job->z_max, 1), offset = shift_right(least + most, 1) - middle;
  for (int shift = 0;; shift++) {
    int bits = ORIGIN_BITS + shift;
    /* Towards the middle, so that an origin stays within the range of heights. */
    int64_t numbers[2] = {0, offset >= 0 ? shift_right(offset, bits) : -shift_right(-offset, bits)};
    for (int wants_narrow = 1; wants_narrow >= 0; wants_narrow--) {
      for (int i = 0; i < 2; i++) {
        int64_t origin = middle + numbers[i] * ((int64_t)1 << bits), far = max_i64(most - origin, origin - least);
        int is_narrow = shift == 0 && far + (u->step >> 1) <= LIMIT && u->step <= LIMIT;
        if ((shift_right(far, shift) > LIMIT && shift < MOST_SHIFT) || is_narrow != wants_narrow) continue;
        u->is_narrow = is_narrow;
        u->shift = shift;
        u->origin = (int32_t)origin;
        u->low = is_narrow ? max_i32(u->z_min, (int32_t)max_i64(origin - LIMIT, INT32_MIN)) : u->z_min;
        u->high = is_narrow ? min_i32(u->z_max, (int32_t)min_i64(origin + LIMIT, INT32_MAX)) : u->z_max;
        return numbers[i];
      }
    }
  }
}

/* A sample that nothing predicts (R.2). */
static int32_t code_corner(const rapid_unit *u, encoding *e, ptrdiff_t place) {
  const encode_job *job = e->job;
  int64_t height = shift_right((int64_t)u->low + u->high, 1);
  if (!job->valid || job->valid[place]) {
    uint64_t most = (uint64_t)(((int64_t)u->high - u->low) / u->step);
    uint64_t index = (uint64_t)(clamp_i64((int64_t)job->target[place] - u->low, 0, INT64_MAX) / u->step);
    index = min_u64(index, most);
    put_bits(&e->logs[0], index, bit_length(most));
    height = min_i64(u->low + (int64_t)index * u->step + (u->step >> 1), u->high);
  }
  return job->added ? correct_height(job, place, height, u->low, u->high) : (int32_t)height;
}

/* Encode a root block; decode it, where the job has no target. */
static twz_status code_root(const twz_encoder *encoder, rapid_unit *u, encoding *e, int32_t *memory, twz_error *error) {
  const encode_job *job = e->job;
  const int is_decoded = job->target == NULL;
  int32_t n_rows = job->n_rows, n_cols = job->n_cols, stride = 1, *heights = memory, *others = memory + (size_t)n_rows * (size_t)n_cols;
  while (stride < max_i32(n_rows, n_cols) - 1) stride *= 2;
  u->n_rows = (n_rows - 1) / stride + 1;
  u->n_cols = (n_cols - 1) / stride + 1;
  for (int32_t row = 0; row < u->n_rows; row++) {
    for (int32_t col = 0; col < u->n_cols; col++) {
      ptrdiff_t at = ((ptrdiff_t)row * n_cols + col) * stride;
      heights[row * u->n_cols + col] = !is_decoded ? code_corner(u, e, at)
                                                   : rapid_read_corner(u, !job->valid || job->valid[at], job->added ? job->added[at] : 0);
    }
  }
  for (stride /= 2; stride; stride /= 2) {
    u->parent = heights;
    u->parent_stride = u->n_cols;
    u->n_rows = u->rows[1] = (n_rows - 1) / stride + 1;
    u->n_cols = u->cols[1] = (n_cols - 1) / stride + 1;
    u->out = others;
    u->out_stride = u->n_cols;
    u->level_class = (int)clamp_i64((int64_t)u->tables->k_max - job->level + bit_length((uint64_t)stride) - 1, 0, N_LEVEL_CLASSES - 1);
    u->valid_stride = u->corrections_stride = e->row_step = stride * (ptrdiff_t)n_cols;
    u->valid_step = u->corrections_step = e->col_step = stride;
    TRY(is_decoded ? encoder->kernels->decode_rapid(u, error) : encoder->kernels->encode_lattice(u, e, error));
    others = heights;
    heights = u->out;
  }
  memcpy(job->out, heights, (size_t)n_rows * (size_t)n_cols * sizeof *heights);
  return TWZ_OK;
}

/* Memory of a unit's details and logs. */
static twz_status make_room(twz_encoder *encoder, encoding *e, int32_t **root, twz_error *error) {
  const encode_job *job = e->job;
  size_t pairs = ((size_t)job->n_rows / 2 + 1) * ((size_t)job->n_cols / 4 + 1); /* of a plane */
  size_t all = 4 * (pairs + (size_t)job->n_rows + (size_t)job->n_cols) + 256, heights = job->parent ? 0 : 2 * (size_t)job->n_rows * (size_t)job->n_cols;
  size_t n_entries = MOST_ENTRIES * all, n_raw = 2 * MOST_RAW_BYTES * all, row = (size_t)job->n_cols + 64; /* `all`: of a root's lattices */
  size_t n_bytes = (6 * pairs + n_entries + heights + (STRIP + 1) * row) * sizeof(int32_t) + n_raw;
  TRY(scratch_reserve(&encoder->unit, n_bytes + 16 * SCRATCH_ALIGN, error));
  for (int p = HH; p <= LH; p++) e->details[p] = scratch_take(&encoder->unit, 2 * pairs * sizeof(int32_t));
  e->goals = scratch_take(&encoder->unit, row * sizeof(int32_t));
  e->more = scratch_take(&encoder->unit, STRIP * row * sizeof(int32_t));
  e->logs[0].entries = scratch_take(&encoder->unit, n_entries * sizeof(uint32_t));
  e->logs[0].raw = scratch_take(&encoder->unit, n_raw);
  *root = scratch_take(&encoder->unit, heights * sizeof(int32_t));
  return TWZ_OK;
}

void start_band(encoding *e, int band) {
  symbol_log *l = &e->logs[band];
  const symbol_log *before = l - 1;
  if (band > 0) {
    l->entries = before->entries + before->n_entries;
    l->raw = before->raw + (before->n_bits + 7) / 8;
  }
  l->n_entries = l->n_bits = 0;
  l->raw[0] = 0;
}

static twz_status check_job(const encode_job *job, twz_error *error) {
  if (job->size != sizeof *job) return twz_fail(error, TWZ_BAD_ARGUMENT, "a job of %llu bytes", (unsigned long long)job->size);
  if (job->n_rows < 1 || job->n_cols < 1 || job->n_rows > MOST_SIDE || job->n_cols > MOST_SIDE || job->step < 1 || job->z_min > job->z_max ||
      job->z_min < -(1 << 30) || job->z_max > 1 << 30) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "a unit of %d rows and %d columns, step %d, heights from %d to %d", job->n_rows, job->n_cols,
                    job->step, job->z_min, job->z_max);
  }
  return TWZ_OK;
}

static void begin_unit(rapid_unit *u, encoding *e, twz_encoder *encoder, const encode_tables *tables, const encode_job *job) {
  memset(e, 0, sizeof *e);
  memset(u, 0, sizeof *u);
  e->tables = tables;
  e->job = job;
  e->seen = job->seen;
  u->tables = tables->rapid;
  u->scratch = &encoder->rows;
  u->step = job->step;
  u->z_min = job->z_min;
  u->z_max = job->z_max;
  u->valid = job->valid;
  u->parent = job->parent;
}

/* The one lattice of a group. */
static void begin_group(rapid_unit *u, const encode_tables *tables, const encode_job *job) {
  u->parent_stride = (ptrdiff_t)job->parent_stride;
  u->n_rows = u->rows[1] = job->n_rows;
  u->n_cols = u->cols[1] = job->n_cols;
  u->out = job->out;
  u->out_stride = u->valid_stride = u->corrections_stride = job->n_cols;
  u->valid_step = u->corrections_step = 1;
  u->level_class = (int)clamp_i64((int64_t)tables->rapid->k_max - job->level, 0, N_LEVEL_CLASSES - 1);
  for (int side = 0; side < 4; side++) u->known[side] = job->shared[side];
}

twz_status twz_python_encode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error) {
  TRY(check_job(job, error));
  encoding e;
  rapid_unit u;
  int32_t *root;
  int64_t least, most;
  int is_within;
  begin_unit(&u, &e, encoder, tables, job);
  TRY(make_room(encoder, &e, &root, error));
  u.is_encoded = 1;
  find_range(job, &least, &most, &is_within);
  int64_t number = choose_head(job, &u, least, most);
  job->shift = u.shift;
  e.is_plain = u.is_narrow && is_within;
  e.n_bands = job->parent && !job->counts ? 0 : 1;
  start_band(&e, 0);
  if (!job->parent) {
    TRY(code_root(encoder, &u, &e, root, error));
  } else {
    e.row_step = job->n_cols;
    e.col_step = 1;
    begin_group(&u, tables, job);
    TRY(encoder->kernels->encode_lattice(&u, &e, error));
  }
  if (job->counts) {
    for (size_t k = 0; k < e.logs[0].n_entries; k++) job->counts[e.logs[0].entries[k] & 0xFFFF]++;
    return TWZ_OK;
  }
  return make_payload(encoder, &e, &u, number, job, error);
}

twz_status twz_python_decode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error) {
  encoding e;
  rapid_unit u;
  TRY(check_job(job, error));
  begin_unit(&u, &e, encoder, tables, job);
  u.corrections = job->added;
  reader bytes = {job->payload, (size_t)job->n_payload, 0};
  TRY(rapid_open_payload(&u, &bytes, error));
  /* Levels are rounded down: predictions lie up to one level below the lowest height. */
  u.most_detail = (int32_t)min_i64(((int64_t)u.z_max - u.z_min + ((int64_t)1 << u.shift)) / u.step + 1, INT32_MAX);
  if (job->parent) {
    begin_group(&u, tables, job);
    TRY(encoder->kernels->decode_rapid(&u, error));
  } else {
    size_t n_bytes = 2 * (size_t)job->n_rows * (size_t)job->n_cols * sizeof(int32_t);
    TRY(scratch_reserve(&encoder->unit, n_bytes + SCRATCH_ALIGN, error));
    TRY(code_root(encoder, &u, &e, scratch_take(&encoder->unit, n_bytes), error));
  }
  return rapid_close_payload(&u, 0, error);
}

twz_status twz_python_encode_mask(twz_encoder *encoder, mask_job *job, twz_error *error) { return encode_validity(job, encoder->kernels, &encoder->rows, error); }
