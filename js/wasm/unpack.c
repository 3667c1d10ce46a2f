/*
 * Unpacks the decoder: an LZMA stream without a header, of lc 3, lp 0, pb 0 (build.sh makes it). It is a sixth smaller
 * than gzip, which browsers unpack themselves, and takes as long as these bytes on a line of 20 Mbit/s.
 *
 * A module of its own: js/src/module.js writes the stream to `place` and calls `unpack`, which writes behind it. What it
 * unpacks lies beside it in core-data.js; a stream that is none gives bytes that are no module.
 */
#include <stdint.h>

#define EXPORT(name) __attribute__((export_name(#name)))

/* Of probabilities, one of each state, or the first one of what is named. */
enum {
  IS_MATCH = 0, IS_REPEAT = 12, IS_OLDER = 24, IS_SECOND = 36, IS_THIRD = 48, IS_LONG = 60,
  SLOTS = 72,      /* four trees of 64 */
  FOOTERS = 328,
  ALIGNED = 443,
  LENGTHS = 459,
  LENGTHS_OF_REPEATS = 733,
  LITERALS = 1007, /* eight times 768 */
  N_PROBABILITIES = LITERALS + 8 * 768
};

extern uint8_t __heap_base;
static uint16_t probabilities[N_PROBABILITIES];
static const uint8_t *next;
static uint32_t range, code;

/* The place of the stream. */
EXPORT(place) uint8_t *place(void) { return &__heap_base; }

static void normalize(void) {
  if (range >> 24) return;
  range <<= 8;
  code = code << 8 | *next++;
}

static uint32_t bit(uint32_t i) {
  uint32_t p = probabilities[i], bound = (range >> 11) * p, is1 = code >= bound;
  if (is1) {
    probabilities[i] = (uint16_t)(p - (p >> 5));
    code -= bound;
    range -= bound;
  } else {
    probabilities[i] = (uint16_t)(p + ((2048 - p) >> 5));
    range = bound;
  }
  normalize();
  return is1;
}

static uint32_t even_bits(uint32_t n) {
  uint32_t value = 0;
  while (n--) {
    range >>= 1;
    uint32_t is1 = code >= range;
    if (is1) code -= range;
    value = value << 1 | is1;
    normalize();
  }
  return value;
}

static uint32_t tree(uint32_t first, uint32_t n) {
  uint32_t node = 1;
  for (uint32_t i = 0; i < n; i++) node = node << 1 | bit(first + node);
  return node - (1u << n);
}

static uint32_t low_bits_first(uint32_t first, uint32_t n) {
  uint32_t node = 1, value = 0;
  for (uint32_t i = 0; i < n; i++) {
    uint32_t one = bit(first + node);
    node = node << 1 | one;
    value |= one << i;
  }
  return value;
}

static uint32_t length(uint32_t first) {
  if (!bit(first)) return 2 + tree(first + 2, 3);
  return bit(first + 1) ? 18 + tree(first + 18, 8) : 10 + tree(first + 10, 3);
}

/* Distances count from 0. */
static uint32_t distance(uint32_t of_length) {
  uint32_t slot = tree(SLOTS + 64 * (of_length < 5 ? of_length - 2 : 3), 6);
  if (slot < 4) return slot;
  uint32_t n = (slot >> 1) - 1, high = (2 | (slot & 1)) << n;
  if (slot < 14) return high + low_bits_first(FOOTERS + high - slot, n);
  high += even_bits(n - 4) << 4;
  return high + low_bits_first(ALIGNED, 4);
}

/* Unpack `size` bytes of a stream of n; return where they are. */
EXPORT(unpack) const uint8_t *unpack(uint32_t n, uint32_t size) {
  uint8_t *out = &__heap_base + n;
  uint32_t state = 0, newest = 0, second = 0, third = 0, fourth = 0, at = 0, other;
  for (uint32_t i = 0; i < N_PROBABILITIES; i++) probabilities[i] = 1024;
  next = &__heap_base + 1; /* the first byte is 0 */
  range = 0xffffffff;
  for (uint32_t i = 0; i < 4; i++) code = code << 8 | *next++;
  while (at < size) {
    if (!bit(IS_MATCH + state)) {
      uint32_t first = LITERALS + 768 * (at ? out[at - 1] >> 5 : 0), symbol = 1, one;
      if (state >= 7) {
        /* As long as the byte is that which the last match would have had. */
        uint32_t expected = out[at - newest - 1];
        do {
          one = expected >> 7 & 1;
          expected <<= 1;
          symbol = symbol << 1 | bit(first + ((1 + one) << 8) + symbol);
        } while (symbol < 256 && (symbol & 1) == one);
      }
      while (symbol < 256) symbol = symbol << 1 | bit(first + symbol);
      out[at++] = (uint8_t)symbol;
      state = state < 4 ? 0 : state - (state < 10 ? 3 : 6);
      continue;
    }
    uint32_t n_bytes = 1;
    if (!bit(IS_REPEAT + state)) {
      fourth = third;
      third = second;
      second = newest;
      n_bytes = length(LENGTHS);
      newest = distance(n_bytes);
      state = state < 7 ? 7 : 10;
    } else {
      uint32_t is_short = 0;
      if (!bit(IS_OLDER + state)) is_short = !bit(IS_LONG + state);
      else {
        if (!bit(IS_SECOND + state)) other = second;
        else {
          if (!bit(IS_THIRD + state)) other = third;
          else {
            other = fourth;
            fourth = third;
          }
          third = second;
        }
        second = newest;
        newest = other;
      }
      if (!is_short) n_bytes = length(LENGTHS_OF_REPEATS);
      state = is_short ? (state < 7 ? 9 : 11) : state < 7 ? 8 : 11;
    }
    for (; n_bytes && at < size; n_bytes--, at++) out[at] = out[at - newest - 1];
  }
  return out;
}
