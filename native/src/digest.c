/* Digests of heights and their root (FORMAT §4.9), by SHA-256 (FIPS 180-4). */
#include "digest.h"

#include <stdlib.h>

enum { TILE = 512, FAN = 8, SHA_BLOCK = 64, TILE_BITS = TILE * TILE / 8 };

/* ---- SHA-256 ---- */

typedef struct sha256 {
  uint32_t state[8];
  uint64_t n;
  uint8_t block[SHA_BLOCK];
} sha256;

static void sha_start(sha256 *s) {
  static const uint32_t FIRST[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  memcpy(s->state, FIRST, sizeof FIRST);
  s->n = 0;
}

static inline uint32_t turn(uint32_t x, int n) { return x >> n | x << (32 - n); }

static void sha_blocks(uint32_t state[8], const uint8_t *bytes, size_t n_blocks) {
  static const uint32_t K[64] = {
      0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5, 0xd807aa98, 0x12835b01, 0x243185be,
      0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174, 0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa,
      0x5cb0a9dc, 0x76f988da, 0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967, 0x27b70a85,
      0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85, 0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3,
      0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070, 0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f,
      0x682e6ff3, 0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
  for (; n_blocks; n_blocks--, bytes += SHA_BLOCK) {
    uint32_t w[64], v[8];
    for (int i = 0; i < 16; i++) {
      w[i] = (uint32_t)bytes[4 * i] << 24 | (uint32_t)bytes[4 * i + 1] << 16 | (uint32_t)bytes[4 * i + 2] << 8 | bytes[4 * i + 3];
    }
    for (int i = 16; i < 64; i++) {
      uint32_t a = w[i - 15], b = w[i - 2];
      w[i] = w[i - 16] + (turn(a, 7) ^ turn(a, 18) ^ a >> 3) + w[i - 7] + (turn(b, 17) ^ turn(b, 19) ^ b >> 10);
    }
    memcpy(v, state, sizeof v);
    for (int i = 0; i < 64; i++) {
      uint32_t a = v[0], e = v[4];
      uint32_t t1 = v[7] + (turn(e, 6) ^ turn(e, 11) ^ turn(e, 25)) + ((e & v[5]) ^ (~e & v[6])) + K[i] + w[i];
      uint32_t t2 = (turn(a, 2) ^ turn(a, 13) ^ turn(a, 22)) + ((a & v[1]) ^ (a & v[2]) ^ (v[1] & v[2]));
      memmove(v + 1, v, 7 * sizeof *v);
      v[4] += t1;
      v[0] = t1 + t2;
    }
    for (int i = 0; i < 8; i++) state[i] += v[i];
  }
}

static void sha_add(sha256 *s, const void *data, size_t n) {
  const uint8_t *bytes = data;
  size_t held = (size_t)(s->n % SHA_BLOCK);
  s->n += n;
  if (held) {
    size_t taken = min_size(n, SHA_BLOCK - held);
    memcpy(s->block + held, bytes, taken);
    bytes += taken;
    n -= taken;
    if (held + taken < SHA_BLOCK) return;
    sha_blocks(s->state, s->block, 1);
  }
  sha_blocks(s->state, bytes, n / SHA_BLOCK);
  if (n % SHA_BLOCK) memcpy(s->block, bytes + n / SHA_BLOCK * SHA_BLOCK, n % SHA_BLOCK);
}

static void store_u32(uint8_t *to, uint32_t v) {
  for (int i = 0; i < 4; i++) to[i] = (uint8_t)(v >> 8 * i);
}

static void sha_end(sha256 *s, uint8_t digest[DIGEST_SIZE]) {
  static const uint8_t FILL[SHA_BLOCK] = {0x80};
  uint8_t length[8];
  for (int i = 0; i < 8; i++) length[i] = (uint8_t)(8 * s->n >> (56 - 8 * i));
  sha_add(s, FILL, 1 + (size_t)((119 - s->n % SHA_BLOCK) % SHA_BLOCK));
  sha_add(s, length, sizeof length);
  for (int i = 0; i < 32; i++) digest[i] = (uint8_t)(s->state[i / 4] >> (24 - 8 * (i % 4)));
}

/* ---- Nodes ---- */

static const uint8_t NONE[DIGEST_SIZE]; /* of a node without valid samples */

/* Nodes of a height along an axis: tiles at height 0, leaves at 1. */
static uint64_t n_nodes(uint32_t n_samples, int height) { return (((uint64_t)n_samples - 1) >> (9 + 3 * height)) + 1; }

static int top_height(const twz_file *f) {
  int height = 1;
  while (n_nodes(max_u32(f->header.n_rows, f->header.n_cols), height) > 1) height++;
  return height;
}

/* The digest of a node by those of its children. */
static void digest_node(const uint8_t *children, size_t n, uint8_t digest[DIGEST_SIZE]) {
  int is_void = 1;
  for (size_t i = 0; i < n && is_void; i++) is_void = memcmp(children + i * DIGEST_SIZE, NONE, DIGEST_SIZE) == 0;
  memset(digest, 0, DIGEST_SIZE);
  if (is_void) return;
  sha256 s;
  sha_start(&s);
  sha_add(&s, "\1", 1);
  sha_add(&s, children, n * DIGEST_SIZE);
  sha_end(&s, digest);
}

/* Children of a node along an axis: the first one and how many. */
static int n_children(uint32_t n_samples, int height, uint64_t at) {
  uint64_t n = n_nodes(n_samples, height - 1), first = FAN * at;
  return (int)min_u64(n - first, FAN);
}

typedef struct digesting {
  twz_file *file;
  twz_fetch fetch;
  void *source;
  twz_workers workers, told;
  uint8_t *heights, *valid, *bits;
  uint64_t n_done, n_all; /* samples */
} digesting;

/* The digest of rows and columns of the strip in memory that make a tile. */
static void digest_tile(const digesting *d, size_t stride, size_t col, size_t n_rows, size_t n_cols, uint8_t digest[DIGEST_SIZE]) {
  size_t width = dtype_size(d->file->header.dtype), n = 0, n_valid = 0;
  memset(d->bits, 0, TILE_BITS);
  for (size_t r = 0; r < n_rows; r++) {
    uint8_t *heights = d->heights + (r * stride + col) * width;
    const uint8_t *valid = d->valid + r * stride + col;
    for (size_t c = 0; c < n_cols; c++, n++) {
      if (valid[c]) {
        d->bits[n / 8] |= (uint8_t)(128 >> n % 8);
        n_valid++;
      } else {
        memset(heights + c * width, 0, width);
      }
    }
  }
  memset(digest, 0, DIGEST_SIZE);
  if (n_valid == 0) return;
  const uint16_t one = 1;
  uint8_t is_little;
  memcpy(&is_little, &one, 1);
  sha256 s;
  sha_start(&s);
  sha_add(&s, "\0", 1);
  for (size_t r = 0; r < n_rows; r++) {
    uint8_t *row = d->heights + (r * stride + col) * width;
    for (size_t at = 0; !is_little && at < n_cols * width; at += width) {
      for (size_t i = 0; i < width / 2; i++) {
        uint8_t first = row[at + i];
        row[at + i] = row[at + width - 1 - i];
        row[at + width - 1 - i] = first;
      }
    }
    sha_add(&s, row, n_cols * width);
  }
  sha_add(&s, d->bits, (n + 7) / 8);
  sha_end(&s, digest);
}

/* Decode a row of tiles of a leaf; returns their digests. */
static twz_status digest_strip(digesting *d, const twz_box *box, uint8_t *digests, twz_error *error) {
  twz_window *w;
  TRY(report(&d->told, d->n_done, d->n_all, error));
  TRY(twz_window_new(d->file, -1, box, &w, error));
  twz_status status = twz_window_load(w, d->fetch, d->source, error);
  if (status == TWZ_OK) status = twz_window_decode_into(w, &d->workers, d->heights, 0, d->valid, 0, error);
  twz_window_free(w);
  TRY(status);
  for (uint32_t col = 0; col < box->n_cols; col += TILE, digests += DIGEST_SIZE) {
    digest_tile(d, box->n_cols, col, box->n_rows, min_u32(TILE, box->n_cols - col), digests);
  }
  d->n_done += (uint64_t)box->n_rows * box->n_cols;
  return TWZ_OK;
}

static twz_status digest_below(digesting *d, int height, uint64_t row, uint64_t col, uint8_t digest[DIGEST_SIZE], twz_error *error) {
  const header *h = &d->file->header;
  int n_rows = n_children(h->n_rows, height, row), n_cols = n_children(h->n_cols, height, col);
  uint8_t children[FAN * FAN * DIGEST_SIZE];
  for (int i = 0; i < n_rows; i++) {
    uint8_t *of_row = children + i * n_cols * DIGEST_SIZE;
    if (height == 1) {
      twz_box box = {(uint32_t)(FAN * row + (uint64_t)i) * TILE, (uint32_t)col * FAN * TILE, 0, 0};
      box.n_rows = min_u32(TILE, h->n_rows - box.row);
      box.n_cols = min_u32(FAN * TILE, h->n_cols - box.col);
      TRY(digest_strip(d, &box, of_row, error));
      continue;
    }
    for (int j = 0; j < n_cols; j++) {
      TRY(digest_below(d, height - 1, FAN * row + (uint64_t)i, FAN * col + (uint64_t)j, of_row + j * DIGEST_SIZE, error));
    }
  }
  digest_node(children, (size_t)(n_rows * n_cols), digest);
  return TWZ_OK;
}

twz_status digest_heights(twz_file *f, twz_fetch fetch, void *source, const twz_workers *workers, uint8_t top[DIGEST_SIZE],
                          twz_error *error) {
  digesting d = {.file = f, .fetch = fetch, .source = source, .workers = TWZ_WORKERS};
  if (workers) TRY(take_sized(&d.workers, sizeof d.workers, workers, "twz_workers", error));
  d.told = d.workers;
  d.workers.report = NULL;
  d.n_all = (uint64_t)f->header.n_rows * f->header.n_cols;
  const size_t n_strip = (size_t)TILE * min_u32(FAN * TILE, f->header.n_cols), width = dtype_size(f->header.dtype);
  d.heights = twz_allocate(&f->allocator, n_strip * (width + 1) + TILE_BITS);
  if (!d.heights) return twz_no_memory(error, n_strip * (width + 1) + TILE_BITS);
  d.valid = d.heights + n_strip * width;
  d.bits = d.valid + n_strip;
  twz_status status = digest_below(&d, top_height(f), 0, 0, top, error);
  twz_release(&f->allocator, d.heights);
  return status;
}

/* ---- The root ---- */

static void add_text(sha256 *s, const json_value *text) {
  uint8_t n[4];
  size_t length = text ? text->n_string : 0;
  store_u32(n, text ? (uint32_t)length : UINT32_MAX);
  sha_add(s, n, 4);
  sha_add(s, text ? text->string : "", length);
}

static void add_double(sha256 *s, double value) {
  uint64_t bits;
  value += 0.0; /* of -0 */
  memcpy(&bits, &value, 8);
  uint8_t bytes[8];
  store_u32(bytes, (uint32_t)bits);
  store_u32(bytes + 4, (uint32_t)(bits >> 32));
  sha_add(s, bytes, 8);
}

static void root_of_top(const twz_file *f, const uint8_t top[DIGEST_SIZE], char root[TWZ_ROOT_SIZE]) {
  static const char *const TEXTS[] = {"crs", "units", "area_or_point"}, *const KINDS[] = {"height", "depth", "radius"};
  static const uint8_t MISSING[8] = {0, 0, 0, 0, 0, 0, 0xf8, 0x7f};
  const json_value *metadata = f->json.root, *epoch = json_member(metadata, "coordinate_epoch");
  const json_value *kind = json_member(metadata, "heights_are");
  uint8_t place[9], digest[DIGEST_SIZE];
  int is_kind = 0;
  sha256 s;
  sha_start(&s);
  sha_add(&s, "\2", 1);
  store_u32(place, f->header.n_rows);
  store_u32(place + 4, f->header.n_cols);
  place[8] = (uint8_t)f->header.dtype;
  sha_add(&s, place, sizeof place);
  for (int i = 0; i < 6; i++) add_double(&s, f->info.transform[i]);
  add_double(&s, f->info.scale);
  add_double(&s, f->info.offset);
  if (epoch && epoch->kind == JSON_NUMBER) add_double(&s, json_number(epoch)); else sha_add(&s, MISSING, sizeof MISSING);
  for (int i = 0; i < 3; i++) add_text(&s, json_member(metadata, TEXTS[i]));
  for (int i = 0; kind && kind->kind == JSON_STRING && i < 3; i++) {
    is_kind |= kind->n_string == strlen(KINDS[i]) && memcmp(kind->string, KINDS[i], kind->n_string) == 0;
  }
  add_text(&s, is_kind ? kind : NULL);
  sha_add(&s, top, DIGEST_SIZE);
  sha_end(&s, digest);
  for (int i = 0; i < 2 * DIGEST_SIZE; i++) root[i] = "0123456789abcdef"[digest[i / 2] >> (i % 2 ? 0 : 4) & 15];
  root[2 * DIGEST_SIZE] = 0;
}

twz_status twz_file_root(twz_file *f, twz_fetch fetch, void *source, const twz_workers *workers, char *root, twz_error *error) {
  uint8_t top[DIGEST_SIZE];
  if (!f->is_open) return twz_fail(error, TWZ_NOT_READY, "the file is not open yet");
  TRY(digest_heights(f, fetch, source, workers, top, error));
  root_of_top(f, top, root);
  return TWZ_OK;
}

/* ---- Digests that a file has ---- */

twz_status twz_file_stated_root(twz_file *f, twz_fetch fetch, void *source, char *root, twz_error *error) {
  uint8_t bytes[LEAST_DIGESTS];
  root[0] = 0;
  if (!f->is_open) return twz_fail(error, TWZ_NOT_READY, "the file is not open yet");
  if (!f->grid.has_digests) return TWZ_OK;
  twz_range range = {.offset = f->file_size - LEAST_DIGESTS, .length = LEAST_DIGESTS};
  TRY(fetch_range(f, &range, fetch, source, bytes, error));
  uint64_t n = load_u32(bytes + DIGEST_SIZE + 4), length = n * DIGEST_SIZE + DIGESTS_TAIL;
  REQUIRE(n > 0 && length <= f->file_size - HEADER_SIZE, error, "%u digests do not fit into the file", (unsigned)n);
  if (n > 1) {
    range.offset = f->file_size - length;
    range.length = DIGEST_SIZE;
    TRY(fetch_range(f, &range, fetch, source, bytes, error));
  }
  root_of_top(f, bytes, root);
  return TWZ_OK;
}

/* Nodes of one height: their places and digests. */
typedef struct node {
  uint64_t row, col;
  const uint8_t *digest;
} node;

static twz_status count_is_wrong(uint32_t n, twz_error *error) {
  return twz_fail(error, TWZ_CORRUPT, "%u digests are not those of a raster of this size", n);
}

static int compare_nodes(const void *a, const void *b) {
  const node *x = a, *y = b;
  if (x->row != y->row) return x->row < y->row ? -1 : 1;
  return x->col < y->col ? -1 : x->col > y->col;
}

/* Compare digests with those below them, from the top on; `all` has room for n nodes. */
static twz_status check_nodes(const twz_file *f, const uint8_t *digests, uint32_t n, node *all, twz_error *error) {
  const header *h = &f->header;
  uint64_t first = 0, end = 0, n_used = 1;
  all[end++] = (node){0, 0, digests};
  if (memcmp(digests, NONE, DIGEST_SIZE) == 0) end = 0;
  for (int height = top_height(f); height > 1; height--) {
    uint64_t n_level = end;
    for (; first < n_level; first++) {
      const node up = all[first];
      int n_rows = n_children(h->n_rows, height, up.row), n_cols = n_children(h->n_cols, height, up.col);
      uint8_t digest[DIGEST_SIZE];
      if ((uint64_t)(n_rows * n_cols) > n - n_used) return count_is_wrong(n, error);
      const uint8_t *children = digests + n_used * DIGEST_SIZE;
      digest_node(children, (size_t)(n_rows * n_cols), digest);
      REQUIRE(memcmp(digest, up.digest, DIGEST_SIZE) == 0, error, "a digest is not that of the digests below it");
      for (int i = 0; i < n_rows * n_cols; i++) {
        const uint8_t *own = children + i * DIGEST_SIZE;
        if (memcmp(own, NONE, DIGEST_SIZE) == 0) continue;
        all[end++] = (node){FAN * up.row + (uint64_t)(i / n_cols), FAN * up.col + (uint64_t)(i % n_cols), own};
      }
      n_used += (uint64_t)(n_rows * n_cols);
    }
    qsort(all + first, (size_t)(end - first), sizeof *all, compare_nodes);
  }
  return n_used == n ? TWZ_OK : count_is_wrong(n, error);
}

twz_status check_digests_of(const twz_file *f, const uint8_t *digests, uint32_t n, twz_error *error) {
  /* No more bytes than the digests themselves, which are in memory. */
  _Static_assert(sizeof(node) <= DIGEST_SIZE, "a node");
  node *all = twz_allocate(&f->allocator, n * sizeof *all);
  if (!all) return twz_no_memory(error, n * sizeof *all);
  twz_status status = check_nodes(f, digests, n, all, error);
  twz_release(&f->allocator, all);
  return status;
}
