/* Inflate (RFC 1950, RFC 1951), as FORMAT §1.3 wants it: no byte left over, no output above a limit. */
#include "internal.h"

enum { MOST_BITS = 15, N_LENGTHS = 286, N_DISTANCES = 30, FAST_BITS = 9 };

/* A canonical Huffman code: counts by length and symbols by code, and a table for short codes. */
typedef struct huffman {
  uint16_t counts[MOST_BITS + 1], symbols[288];
  uint16_t fast[1 << FAST_BITS]; /* symbol * 16 + length; 0: longer or unused */
} huffman;

typedef struct inflater {
  const uint8_t *bytes;
  size_t n, at;
  uint64_t held; /* bits not taken yet, the first one lowest */
  int n_held;
  size_t n_missing; /* bytes beyond the end that were held as 0 */
  uint8_t *out;
  size_t limit, n_out;
  const uint8_t *dictionary;
  size_t n_dictionary;
  huffman lengths, distances;
} inflater;

static void fill(inflater *s) {
  while (s->n_held <= 48) {
    if (s->at < s->n) {
      s->held |= (uint64_t)s->bytes[s->at++] << s->n_held;
    } else {
      s->n_missing++;
    }
    s->n_held += 8;
  }
}

/* Have bits been taken that are not there? */
static int is_beyond(const inflater *s) { return s->n_missing * 8 > (size_t)s->n_held; }

static uint32_t take(inflater *s, int n) {
  if (s->n_held < n) fill(s);
  uint32_t bits = (uint32_t)(s->held & (((uint64_t)1 << n) - 1));
  s->held >>= n;
  s->n_held -= n;
  return bits;
}

/* Returns 0 where the lengths are no code. Only a code of one symbol may leave codes unused, if it is no code of lengths. */
static int make(huffman *h, const uint8_t *lengths, int n, int may_be_incomplete) {
  uint16_t next[MOST_BITS + 1]; /* by length: of symbols, and the code of the next one */
  uint32_t codes[MOST_BITS + 1], code = 0;
  memset(h, 0, sizeof *h);
  for (int i = 0; i < n; i++) h->counts[lengths[i]]++;
  h->counts[0] = 0;
  int left = 1, n_used = 0;
  for (int length = 1; length <= MOST_BITS; length++) {
    left = left * 2 - h->counts[length];
    if (left < 0) return 0;
    next[length] = (uint16_t)n_used;
    n_used += h->counts[length];
    codes[length] = code = (code + h->counts[length - 1]) << 1;
  }
  if (left > 0 && !(may_be_incomplete && n_used <= 1 && h->counts[1] == n_used)) return 0;
  for (int i = 0; i < n; i++) {
    int length = lengths[i];
    if (length == 0) continue;
    h->symbols[next[length]++] = (uint16_t)i;
    uint32_t own = codes[length]++, reversed = 0;
    if (length > FAST_BITS) continue;
    for (int k = 0; k < length; k++) reversed |= (own >> k & 1) << (length - 1 - k);
    for (; reversed < 1 << FAST_BITS; reversed += 1u << length) h->fast[reversed] = (uint16_t)(i * 16 + length);
  }
  return 1;
}

/* Returns the next symbol, or -1. */
static int decode(inflater *s, const huffman *h) {
  if (s->n_held < MOST_BITS) fill(s);
  uint16_t found = h->fast[s->held & ((1 << FAST_BITS) - 1)];
  if (found) {
    s->held >>= found & 15;
    s->n_held -= found & 15;
    return found >> 4;
  }
  int32_t code = 0, first = 0, index = 0;
  for (int length = 1; length <= MOST_BITS; length++) {
    code |= (int32_t)take(s, 1);
    int32_t count = h->counts[length];
    if (code - count < first) return h->symbols[index + code - first];
    index += count;
    first = (first + count) * 2;
    code *= 2;
  }
  return -1;
}

static const char TOO_LONG[] = "%s inflates to more than %llu bytes";
static const char DAMAGED[] = "%s is no deflated stream: %s";

static twz_status stored(inflater *s, const char *name, twz_error *error) {
  take(s, s->n_held % 8);
  uint32_t n = take(s, 16), inverse = take(s, 16);
  REQUIRE(n == (~inverse & 0xFFFF) && !is_beyond(s), error, DAMAGED, name, "length of a stored block");
  REQUIRE(n <= s->limit - s->n_out, error, TOO_LONG, name, (unsigned long long)s->limit);
  for (; n > 0; n--) s->out[s->n_out++] = (uint8_t)take(s, 8);
  REQUIRE(!is_beyond(s), error, DAMAGED, name, "it ends early");
  return TWZ_OK;
}

static twz_status read_codes(inflater *s, const char *name, twz_error *error) {
  static const uint8_t ORDER[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
  uint8_t lengths[320] = {0};
  int n_lengths = 257 + (int)take(s, 5), n_distances = 1 + (int)take(s, 5), n_codes = 4 + (int)take(s, 4);
  REQUIRE(n_lengths <= N_LENGTHS && n_distances <= N_DISTANCES, error, DAMAGED, name, "number of codes");
  for (int i = 0; i < n_codes; i++) lengths[ORDER[i]] = (uint8_t)take(s, 3);
  REQUIRE(make(&s->lengths, lengths, 19, 0), error, DAMAGED, name, "code of code lengths");
  memset(lengths, 0, sizeof lengths);
  for (int i = 0; i < n_lengths + n_distances;) {
    int symbol = decode(s, &s->lengths);
    REQUIRE(symbol >= 0 && !is_beyond(s), error, DAMAGED, name, "code lengths");
    if (symbol < 16) {
      lengths[i++] = (uint8_t)symbol;
      continue;
    }
    REQUIRE(symbol != 16 || i > 0, error, DAMAGED, name, "nothing to repeat");
    uint8_t repeated = symbol == 16 ? lengths[i - 1] : 0;
    int n = symbol == 16 ? 3 + (int)take(s, 2) : symbol == 17 ? 3 + (int)take(s, 3) : 11 + (int)take(s, 7);
    REQUIRE(i + n <= n_lengths + n_distances, error, DAMAGED, name, "code lengths");
    while (n--) lengths[i++] = repeated;
  }
  REQUIRE(lengths[256] && make(&s->lengths, lengths, n_lengths, 1) &&
              make(&s->distances, lengths + n_lengths, n_distances, 1),
          error, DAMAGED, name, "codes of a block");
  return TWZ_OK;
}

static void fixed_codes(inflater *s) {
  uint8_t lengths[288];
  for (int i = 0; i < 288; i++) lengths[i] = (uint8_t)(i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8);
  make(&s->lengths, lengths, 288, 1);
  memset(lengths, 5, 32); /* the last two never occur: `block` refuses them */
  make(&s->distances, lengths, 32, 1);
}

static int copy_match(inflater *s, size_t length, size_t distance) {
  if (length > s->limit - s->n_out) return 0;
  for (; length && distance > s->n_out; length--, s->n_out++) {
    s->out[s->n_out] = s->dictionary[s->n_dictionary - (distance - s->n_out)];
  }
  uint8_t *to = s->out + s->n_out;
  for (size_t i = 0; i < length; i++) to[i] = *(to + i - distance);
  s->n_out += length;
  return 1;
}

static twz_status block(inflater *s, const char *name, twz_error *error) {
  static const uint16_t LENGTHS[29] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                       31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
  static const uint8_t LENGTH_BITS[29] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2,
                                          2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};
  static const uint16_t DISTANCES[30] = {1,   2,   3,   4,   5,   7,    9,    13,   17,   25,
                                         33,  49,  65,  97,  129, 193,  257,  385,  513,  769,
                                         1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577};
  for (;;) {
    int symbol = decode(s, &s->lengths);
    REQUIRE(symbol >= 0 && !is_beyond(s), error, DAMAGED, name, "it ends early or has no such code");
    if (symbol < 256) {
      REQUIRE(s->n_out < s->limit, error, TOO_LONG, name, (unsigned long long)s->limit);
      s->out[s->n_out++] = (uint8_t)symbol;
      continue;
    }
    if (symbol == 256) return TWZ_OK;
    REQUIRE(symbol < 286, error, DAMAGED, name, "no such length");
    size_t length = LENGTHS[symbol - 257] + take(s, LENGTH_BITS[symbol - 257]);
    int code = decode(s, &s->distances);
    REQUIRE(code >= 0 && code < 30, error, DAMAGED, name, "no such distance");
    size_t distance = DISTANCES[code] + take(s, code < 4 ? 0 : code / 2 - 1);
    REQUIRE(!is_beyond(s), error, DAMAGED, name, "it ends early");
    REQUIRE(distance <= s->n_out + s->n_dictionary, error, DAMAGED, name, "a distance beyond the start");
    REQUIRE(copy_match(s, length, distance), error, TOO_LONG, name, (unsigned long long)s->limit);
  }
}

/* Inflates up to the last block; s->at is then behind the last byte used. */
static twz_status inflate(inflater *s, const char *name, twz_error *error) {
  int is_last;
  do {
    is_last = (int)take(s, 1);
    uint32_t kind = take(s, 2);
    REQUIRE(kind < 3, error, DAMAGED, name, "kind of a block");
    if (kind == 0) {
      TRY(stored(s, name, error));
      continue;
    }
    if (kind == 1) {
      fixed_codes(s);
    } else {
      TRY(read_codes(s, name, error));
    }
    TRY(block(s, name, error));
  } while (!is_last);
  s->at -= (size_t)s->n_held / 8 - s->n_missing;
  return TWZ_OK;
}

twz_status inflate_raw(const uint8_t *bytes, size_t n, const uint8_t *dictionary, size_t n_dictionary,
                       uint8_t *out, size_t limit, size_t *n_out, const char *name,
                       twz_error *error) {
  inflater s;
  memset(&s, 0, sizeof s);
  s.bytes = bytes;
  s.n = n;
  s.out = out;
  s.limit = limit;
  s.dictionary = dictionary;
  s.n_dictionary = n_dictionary;
  TRY(inflate(&s, name, error));
  REQUIRE(s.at == n, error, DAMAGED, name, "bytes are left over");
  *n_out = s.n_out;
  return TWZ_OK;
}

twz_status inflate_zlib(const uint8_t *bytes, size_t n, uint8_t *out, size_t limit, size_t *n_out,
                        const char *name, twz_error *error) {
  REQUIRE(n >= 6, error, DAMAGED, name, "it ends early");
  /* Deflate, a window of at most 32 KiB, no preset dictionary, the check of the two bytes. */
  REQUIRE((bytes[0] & 15) == 8 && bytes[0] >> 4 <= 7 && !(bytes[1] & 32) && (bytes[0] * 256 + bytes[1]) % 31 == 0,
          error, DAMAGED, name, "its first two bytes");
  TRY(inflate_raw(bytes + 2, n - 6, NULL, 0, out, limit, n_out, name, error));
  uint32_t a = 1, b = 0;
  for (size_t i = 0; i < *n_out;) {
    size_t stop = min_size(*n_out, i + 5552); /* sums fit 32 bits so long */
    for (; i < stop; i++) {
      a += out[i];
      b += a;
    }
    a %= 65521;
    b %= 65521;
  }
  const uint8_t *end = bytes + n - 4;
  uint32_t stated = (uint32_t)end[0] << 24 | (uint32_t)end[1] << 16 | (uint32_t)end[2] << 8 | end[3];
  REQUIRE(!CHECKSUMS_COUNT || (b << 16 | a) == stated, error, DAMAGED, name, "Adler-32");
  return TWZ_OK;
}
