/*
 * Digests of heights that JavaScript has, and the root of a file (FORMAT §4.9), 64 hexadecimal digits. What makes them is
 * native/src/digest.c, whose functions are its own: it reads windows by a call that waits, and a page cannot wait.
 */
#include "../../native/src/digest.c"

#include "host.h"

static uint8_t digest[DIGEST_SIZE];
static char root[TWZ_ROOT_SIZE];

EXPORT(digest_at) const uint8_t *digest_at(void) { return digest; }
EXPORT(root_at) const char *root_at(void) { return root; }

/* Digest what was given: heights of the file's dtype, at most 512 x 512, and their validity behind them. Those that are not
 * valid become 0. */
EXPORT(digest_given) int digest_given(uint32_t n_rows, uint32_t n_cols) {
  static uint8_t bits[TILE_BITS];
  size_t n = (size_t)n_rows * n_cols, size = twz_file_info(file)->dtype_bytes;
  if (n_rows > TILE || n_cols > TILE || n * (size + 1) > n_given)
    return twz_fail(&error, TWZ_BAD_ARGUMENT, "found a tile of %u x %u heights, expected at most %d x %d, all of them given",
                    (unsigned)n_rows, (unsigned)n_cols, TILE, TILE);
  const digesting d = {.file = file, .heights = given, .valid = given + n * size, .bits = bits};
  digest_tile(&d, n_cols, 0, n_rows, n_cols, digest);
  return TWZ_OK;
}

/* The digest of a node by those of all tiles, row by row. */
static void digest_above(const uint8_t *tiles, int height, uint64_t row, uint64_t col, uint8_t of_node[DIGEST_SIZE]) {
  const header *h = &file->header;
  if (height == 0) {
    memcpy(of_node, tiles + (row * n_nodes(h->n_cols, 0) + col) * DIGEST_SIZE, DIGEST_SIZE);
    return;
  }
  int n_rows = n_children(h->n_rows, height, row), n_cols = n_children(h->n_cols, height, col);
  uint8_t children[FAN * FAN * DIGEST_SIZE];
  for (int i = 0; i < n_rows * n_cols; i++) {
    uint64_t child_row = FAN * row + (uint64_t)(i / n_cols), child_col = FAN * col + (uint64_t)(i % n_cols);
    digest_above(tiles, height - 1, child_row, child_col, children + i * DIGEST_SIZE);
  }
  digest_node(children, (size_t)(n_rows * n_cols), of_node);
}

/* Make the root of n bytes that were given: digests of all tiles of 512 x 512, row by row. */
EXPORT(root_of_given) int root_of_given(size_t n) {
  uint8_t top[DIGEST_SIZE];
  uint64_t n_tiles = n_nodes(file->header.n_rows, 0) * n_nodes(file->header.n_cols, 0);
  REQUIRE(n == n_tiles * DIGEST_SIZE, &error, "found %u bytes of digests, expected %u", (unsigned)n, (unsigned)(n_tiles * DIGEST_SIZE));
  digest_above(given, top_height(file), 0, 0, top);
  root_of_top(file, top, root);
  return TWZ_OK;
}

/* Tell whether the file states digests, and where their tail lies. */
EXPORT(digests_need) int digests_need(void) {
  ranges[0] = (twz_range){.offset = file->file_size - LEAST_DIGESTS, .length = LEAST_DIGESTS};
  return file->grid.has_digests ? ranges_told(TWZ_OK, 1) : 0;
}

static twz_status find_top(void) {
  uint64_t n = load_u32(given + DIGEST_SIZE + 4), length = n * DIGEST_SIZE + DIGESTS_TAIL;
  REQUIRE(n > 0 && length <= file->file_size - HEADER_SIZE, &error, "%u digests do not fit into the file", (unsigned)n);
  ranges[0] = (twz_range){.offset = file->file_size - length, .length = DIGEST_SIZE};
  return TWZ_OK;
}

/* Tell where the top digest lies, by the tail that was given. */
EXPORT(top_need) int top_need(void) { return ranges_told(find_top(), 1); }

/* Make the root of the top digest that was given. */
EXPORT(root_of_top_given) void root_of_top_given(void) { root_of_top(file, given, root); }
