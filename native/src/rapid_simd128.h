/* Eight states of method rapid at once, of one unit or several in turns, and sums of 16 bits: what rapid_vectors.h has,
 * for WebAssembly's vectors of 128 bits. Included by rapid_unit.h. */

/* Where a stream is: its states, the first sample's first, the next word, and which samples have raw bits. */
typedef struct ISA(lanes) {
  v128_t x[2], raw;
  const uint8_t *words, *at;
} ISA(lanes);

/* By mask of four lanes: where the bytes of each lane's word are, of those that are read; 255: 0. */
#define NONE 255, 255
static const uint8_t ISA(order)[16][16] = {
    {NONE, NONE, NONE, NONE, NONE, NONE, NONE, NONE}, {0, 1, NONE, NONE, NONE, NONE, NONE, NONE, NONE},
    {NONE, NONE, 0, 1, NONE, NONE, NONE, NONE, NONE}, {0, 1, NONE, 2, 3, NONE, NONE, NONE, NONE, NONE},
    {NONE, NONE, NONE, NONE, 0, 1, NONE, NONE, NONE}, {0, 1, NONE, NONE, NONE, 2, 3, NONE, NONE, NONE},
    {NONE, NONE, 0, 1, NONE, 2, 3, NONE, NONE, NONE}, {0, 1, NONE, 2, 3, NONE, 4, 5, NONE, NONE, NONE},
    {NONE, NONE, NONE, NONE, NONE, NONE, 0, 1, NONE}, {0, 1, NONE, NONE, NONE, NONE, NONE, 2, 3, NONE},
    {NONE, NONE, 0, 1, NONE, NONE, NONE, 2, 3, NONE}, {0, 1, NONE, 2, 3, NONE, NONE, NONE, 4, 5, NONE},
    {NONE, NONE, NONE, NONE, 0, 1, NONE, 2, 3, NONE}, {0, 1, NONE, NONE, NONE, 2, 3, NONE, 4, 5, NONE},
    {NONE, NONE, 0, 1, NONE, 2, 3, NONE, 4, 5, NONE}, {0, 1, NONE, 2, 3, NONE, 4, 5, NONE, 6, 7, NONE}};
#undef NONE

/* Symbols of four samples from number j on (R.8), whose states are x. */
static ALWAYS_INLINE v128_t ISA(step)(ISA(lanes) * l, const ISA(span) * s, int32_t j, v128_t x, const uint32_t *slots) {
  v128_t c = wasm_v128_and(wasm_v128_load(s->contexts + j), wasm_i32x4_const_splat(DOWN - 1));
  v128_t slot = wasm_v128_or(wasm_i32x4_shl(c, 11), wasm_v128_and(x, wasm_i32x4_const_splat(SLOTS - 1)));
  v128_t entry = wasm_v128_load32_zero(slots + wasm_u32x4_extract_lane(slot, 0));
  entry = wasm_v128_load32_lane(slots + wasm_u32x4_extract_lane(slot, 1), entry, 1);
  entry = wasm_v128_load32_lane(slots + wasm_u32x4_extract_lane(slot, 2), entry, 2);
  entry = wasm_v128_load32_lane(slots + wasm_u32x4_extract_lane(slot, 3), entry, 3);
  v128_t symbol = wasm_v128_and(entry, wasm_i32x4_const_splat(63));
  v128_t frequency = wasm_v128_and(wasm_u32x4_shr(entry, 6), wasm_i32x4_const_splat(4095));
  v128_t next = wasm_i32x4_add(wasm_i32x4_mul(frequency, wasm_u32x4_shr(x, 11)), wasm_u32x4_shr(entry, 18));
  wasm_v128_store(s->details + j, wasm_i32x4_sub(symbol, wasm_i32x4_const_splat(ZERO_SYMBOL)));
  v128_t zero = wasm_i32x4_const_splat(0);
  l->raw = wasm_v128_or(l->raw, wasm_v128_or(wasm_i32x4_gt(c, wasm_i32x4_const_splat(FIRST_RAW - 1)), wasm_i32x4_eq(symbol, zero)));
  v128_t takes = wasm_i32x4_eq(wasm_u32x4_shr(next, 16), zero);
  unsigned mask = wasm_i32x4_bitmask(takes);
  v128_t word = wasm_i8x16_swizzle(wasm_v128_load64_zero(l->at), wasm_v128_load(ISA(order)[mask]));
  l->at += 2 * (unsigned)__builtin_popcount(mask);
  return wasm_v128_bitselect(wasm_v128_or(wasm_i32x4_shl(next, 16), word), next, takes);
}

/* The states in the order in which the next samples have them, or back from it. */
static void ISA(begin_lanes)(ISA(lanes) * l, const rapid_streams *z) {
  uint32_t turned[8];
  for (size_t k = 0; k < 8; k++) turned[k] = z->states[(z->n_symbols + k) & 7];
  l->x[0] = wasm_v128_load(turned);
  l->x[1] = wasm_v128_load(turned + 4);
  l->raw = wasm_i32x4_const_splat(0);
  l->words = l->at = z->words + 2 * min_size(z->n_words_used, z->n_words); /* a row takes a word a sample: PAYLOAD_SLACK */
}

static void ISA(end_lanes)(const ISA(lanes) * l, rapid_streams *z, int32_t n_read) {
  uint32_t turned[8];
  wasm_v128_store(turned, l->x[0]);
  wasm_v128_store(turned + 4, l->x[1]);
  for (size_t k = 0; k < 8; k++) z->states[(z->n_symbols + k) & 7] = turned[k];
  z->n_symbols += (size_t)n_read;
  z->n_words_used += (size_t)(l->at - l->words) / 2;
}

/* Samples of n spans in turns, from number j on, until the last one, which is the shortest, is read. */
static ALWAYS_INLINE int32_t ISA(read_in_turns)(ISA(lanes) * l, ISA(span) *const *spans, int n, int32_t j,
                                                const uint32_t *slots) {
  ISA(span) *s = spans[n - 1];
  for (; j + 8 <= s->n; j += 8) {
    for (int k = 0; k < n; k++) l[k].x[0] = ISA(step)(&l[k], spans[k], j, l[k].x[0], slots);
    for (int k = 0; k < n; k++) l[k].x[1] = ISA(step)(&l[k], spans[k], j + 4, l[k].x[1], slots);
  }
  ISA(end_lanes)(&l[n - 1], s->streams, j);
  s->has_raw = wasm_v128_any_true(l[n - 1].raw);
  ISA(read_one_by_one)(s, j, slots);
  return j;
}

/* A whole vector is written: rows end with room for one. */
static ALWAYS_INLINE void ISA(predict_taps)(int32_t n, const ISA(pair_of_taps) * taps, int n_taps, int32_t *predicted) {
  v128_t weights[14];
  for (int k = 0; k < n_taps; k++) {
    weights[k] = wasm_i32x4_splat((int)(((uint32_t)(uint16_t)taps[k].first) | (uint32_t)(uint16_t)taps[k].second << 16));
  }
  for (int32_t j = 0; j < n; j += 4) {
    v128_t sum = wasm_i32x4_const_splat(32), other = wasm_i32x4_const_splat(0);
    for (int k = 0; k < n_taps; k += 2) {
      sum = wasm_i32x4_add(sum, wasm_i32x4_dot_i16x8(wasm_v128_load(taps[k].at + j), weights[k]));
      other = wasm_i32x4_add(other, wasm_i32x4_dot_i16x8(wasm_v128_load(taps[k + 1].at + j), weights[k + 1]));
    }
    wasm_v128_store(predicted + j, wasm_i32x4_shr(wasm_i32x4_add(sum, other), 6));
  }
}

/* The lower halves of n cells of two rows, in turns. */
static ALWAYS_INLINE void ISA(store_in_turns)(int16_t *to, const int32_t *even, const int32_t *odd, int32_t n) {
  const v128_t low = wasm_i32x4_const_splat(65535);
  int32_t j = 0;
  for (; j + 4 <= n; j += 4) {
    v128_t upper = wasm_i32x4_shl(wasm_v128_load(odd + j), 16);
    wasm_v128_store(to + 2 * j, wasm_v128_or(wasm_v128_and(wasm_v128_load(even + j), low), upper));
  }
  for (; j < n; j++) {
    to[2 * j] = (int16_t)even[j];
    to[2 * j + 1] = (int16_t)odd[j];
  }
}

#define READ_RAW ISA(read_raw)
#define PACK ISA(pack_plain)
#define UNPACK ISA(unpack_plain)
