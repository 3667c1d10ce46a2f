/* One text for encoder and decoder, as in Python: a decoder ignores the value to code, and returns what it has read. */
#include "encode_tables.h"

enum { RANGE, POINT, CACHE, PENDING, BYTE_POS, OUT_POS };
enum { FINE, BAD_STENCIL, BAD_WEIGHT, BAD_CUT, BAD_FREQUENCY };
enum { N_UNARY = 14, N_PREFIX = 32, N_OF_MAGNITUDE = N_UNARY + N_PREFIX, MOST_CODE = 255 };
enum { CORE = 0, FREQUENCIES = 2 * N_OF_MAGNITUDE, WEIGHTS = 8 * N_OF_MAGNITUDE, OWN_TABLE = 14 * N_OF_MAGNITUDE };
enum { BASE, HAS_DELTAS, SHIFT, DELTAS };
enum { BASE_BITS = 4, SHIFT_BITS = 3, CUT_BITS = 6, COUNT_BITS = 10, PROBABILITY_BITS = 22, MOST_COUNT = 254 };

/* Move the byte above the lowest 32 bits of an encoder's point out; what a carry may still change is held back. */
static void move_out(tables_job *job) {
  int64_t *s = job->state, carry = s[POINT] >> 40, byte = s[POINT] >> 32 & 255;
  if (byte < 255 || carry) {
    int64_t first = s[CACHE];
    for (; s[PENDING] > 0; s[PENDING]--, s[OUT_POS]++) {
      if (s[OUT_POS] >= 0 && (uint64_t)s[OUT_POS] < job->n_stream) job->stream[s[OUT_POS]] = (uint8_t)(first + carry);
      first = 255;
    }
    s[CACHE] = byte;
  }
  s[PENDING]++;
  s[POINT] &= 0xFFFFFFFF;
}

static void renew(tables_job *job) {
  int64_t *s = job->state;
  while (s[RANGE] < 1 << 24) {
    s[RANGE] <<= 8;
    if (job->is_encoder) {
      s[POINT] <<= 8;
      move_out(job);
    } else {
      int64_t at = s[BYTE_POS]++;
      s[POINT] = (s[POINT] << 8 | ((uint64_t)at < job->n_stream ? job->stream[at] : 0)) & 0xFFFFFFFF;
    }
  }
}

static int64_t code_bit(tables_job *job, int index, int64_t bit) {
  int64_t *s = job->state, p = job->models[index] >> COUNT_BITS, count = job->models[index] & ((1 << COUNT_BITS) - 1);
  int64_t bound = (s[RANGE] >> 16) * (p >> 6 | 1), rate = 131072 / (2 * count + 3);
  if (!job->is_encoder) bit = s[POINT] < bound;
  if (bit) {
    s[RANGE] = bound;
    p += ((((int64_t)1 << PROBABILITY_BITS) - p) * rate) >> 16;
  } else {
    s[POINT] += job->is_encoder ? bound : -bound;
    s[RANGE] -= bound;
    p -= (p * rate) >> 16;
  }
  job->models[index] = (uint32_t)(p << COUNT_BITS | (count + (count < MOST_COUNT)));
  renew(job);
  return bit;
}

static int64_t code_raw(tables_job *job, int n_bits, int64_t value) {
  int64_t *s = job->state, coded = 0;
  for (int shift = n_bits - 1; shift >= 0; shift--) {
    s[RANGE] >>= 1;
    int64_t bit = job->is_encoder ? value >> shift & 1 : s[POINT] >= s[RANGE];
    if (bit) s[POINT] += job->is_encoder ? s[RANGE] : -s[RANGE];
    coded = coded << 1 | bit;
    renew(job);
  }
  return coded;
}

static int64_t code_magnitude(tables_job *job, int first, int64_t value) {
  int64_t n_ones = 0, bit = 1, rest = value - N_UNARY + 1;
  for (; bit && n_ones < N_UNARY; n_ones += bit) bit = code_bit(job, first + (int)n_ones, value > n_ones);
  if (n_ones < N_UNARY) return n_ones;
  int n_bits = 0;
  for (; bit && n_bits < N_PREFIX - 1; n_bits += (int)bit) {
    bit = code_bit(job, first + N_UNARY + n_bits, job->is_encoder && rest >> (n_bits + 1) > 0);
  }
  return N_UNARY - 1 + ((int64_t)1 << n_bits | code_raw(job, n_bits, value - (N_UNARY - 1)));
}

/* Code `n` codes but the one `skipped`; is one out of range? */
static int code_codes(tables_job *job, int groups, int64_t n, int64_t skipped, const int64_t *trained, int64_t *codes) {
  int64_t last = 0;
  for (int64_t k = 0; k < n; k++) {
    int64_t usual = trained[k];
    if (k == skipped) {
      codes[k] = usual;
      continue;
    }
    int64_t change = codes[k] - usual, after = last < 1 ? 0 : last < 2 ? 1 : 2;
    last = code_magnitude(job, groups + (int)(3 * (usual > 0) + after) * N_OF_MAGNITUDE, change < 0 ? -change : change);
    int64_t is_less = last > 0 && usual > 0 ? code_raw(job, 1, change < 0) : 0;
    codes[k] = is_less ? usual - last : usual + last;
    if (last > MOST_CODE || codes[k] < 0 || codes[k] > MOST_CODE) return 1;
  }
  return 0;
}

static int found(tables_job *job, int status, int64_t which) {
  job->status = status;
  job->which = which;
  return status != FINE;
}

static int code_stencil(tables_job *job, int index) {
  int plane = index % job->n_planes;
  int64_t *own = job->stencils + (size_t)index * (size_t)(DELTAS + job->n_taps);
  own[BASE] = code_raw(job, BASE_BITS, own[BASE]);
  own[HAS_DELTAS] = code_raw(job, 1, own[HAS_DELTAS]);
  if (!own[HAS_DELTAS]) return 0;
  own[SHIFT] = code_raw(job, SHIFT_BITS, own[SHIFT]);
  for (int tap = 0; tap < job->n_taps; tap++) {
    int64_t first = job->tap_kinds[plane * job->n_taps + tap], delta = own[DELTAS + tap];
    if (first < 0) continue;
    int64_t size = code_magnitude(job, (int)first, delta < 0 ? -delta : delta);
    if (size > 2 * job->max_weight) return found(job, BAD_STENCIL, plane);
    own[DELTAS + tap] = size > 0 && code_raw(job, 1, delta < 0) ? -size : size;
  }
  return 0;
}

twz_status twz_python_code_tables(tables_job *job, twz_error *error) {
  if (job->size != sizeof *job) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "tables by a job of %llu bytes", (unsigned long long)job->size);
  }
  found(job, FINE, 0);
  for (int i = 0; i < job->n_stencils; i++) {
    if (code_stencil(job, i)) return TWZ_OK;
  }
  for (int row = 0, n = job->n_features; row < job->n_weights; row++) {
    if (code_codes(job, WEIGHTS, n, job->skipped[row], job->trained_weights + row * n, job->weights + row * n)) {
      found(job, BAD_WEIGHT, row);
      return TWZ_OK;
    }
  }
  job->cut[0] = code_raw(job, CUT_BITS, job->cut[0]);
  if (job->cut[0] > job->n_classes) {
    found(job, BAD_CUT, job->cut[0]);
    return TWZ_OK;
  }
  int64_t was_own = 0;
  for (int table = 0; table < job->n_tables; table++) {
    /* Pairs of classes from the cut on, and tables that do not exist, have none. */
    if (job->n_symbols[table] == 0 || (job->cut[0] <= table && table < job->singles)) continue;
    was_own = job->is_own[table] = code_bit(job, OWN_TABLE + (int)was_own, job->is_own[table]);
    size_t first = (size_t)table * (size_t)job->most_symbols;
    if (was_own && code_codes(job, FREQUENCIES, job->n_symbols[table], job->rests[table], job->trained + first, job->codes + first)) {
      found(job, BAD_FREQUENCY, table);
      return TWZ_OK;
    }
  }
  return TWZ_OK;
}
