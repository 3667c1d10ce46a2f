/*
 * Digests of heights that JavaScript has, and the root of a file (FORMAT §4.9). What makes them is native/src/digest.c,
 * whose functions are its own: it reads windows by a call that waits, and a page cannot wait.
 */
#include "../../native/src/digest.c"

#include "root.h"

void root_tile(uint8_t dtype, uint8_t *heights, uint8_t *valid, uint32_t n_rows, uint32_t n_cols, uint8_t digest[DIGEST_SIZE]) {
  static uint8_t bits[TILE_BITS];
  static twz_file file;
  file.header.dtype = dtype;
  const digesting d = {.file = &file, .heights = heights, .valid = valid, .bits = bits};
  digest_tile(&d, n_cols, 0, n_rows, n_cols, digest);
}

/* The digest of a node by those of all tiles, row by row. */
static void digest_above(const twz_file *f, const uint8_t *tiles, int height, uint64_t row, uint64_t col, uint8_t digest[DIGEST_SIZE]) {
  const header *h = &f->header;
  if (height == 0) {
    memcpy(digest, tiles + (row * n_nodes(h->n_cols, 0) + col) * DIGEST_SIZE, DIGEST_SIZE);
    return;
  }
  int n_rows = n_children(h->n_rows, height, row), n_cols = n_children(h->n_cols, height, col);
  uint8_t children[FAN * FAN * DIGEST_SIZE];
  for (int i = 0; i < n_rows * n_cols; i++) {
    uint64_t child_row = FAN * row + (uint64_t)(i / n_cols), child_col = FAN * col + (uint64_t)(i % n_cols);
    digest_above(f, tiles, height - 1, child_row, child_col, children + i * DIGEST_SIZE);
  }
  digest_node(children, (size_t)(n_rows * n_cols), digest);
}

twz_status root_of_tiles(const twz_file *f, const uint8_t *tiles, size_t n, char root[TWZ_ROOT_SIZE], twz_error *error) {
  uint8_t top[DIGEST_SIZE];
  uint64_t n_tiles = n_nodes(f->header.n_rows, 0) * n_nodes(f->header.n_cols, 0);
  REQUIRE(n == n_tiles * DIGEST_SIZE, error, "found %u bytes of digests, expected %u", (unsigned)n, (unsigned)(n_tiles * DIGEST_SIZE));
  digest_above(f, tiles, top_height(f), 0, 0, top);
  root_of_top(f, top, root);
  return TWZ_OK;
}

twz_status root_place(const twz_file *f, const uint8_t tail[LEAST_DIGESTS], twz_range *top, twz_error *error) {
  uint64_t n = load_u32(tail + DIGEST_SIZE + 4), length = n * DIGEST_SIZE + DIGESTS_TAIL;
  REQUIRE(n > 0 && length <= f->file_size - HEADER_SIZE, error, "%u digests do not fit into the file", (unsigned)n);
  top->offset = f->file_size - length;
  top->length = DIGEST_SIZE;
  return TWZ_OK;
}

void root_stated(const twz_file *f, const uint8_t top[DIGEST_SIZE], char root[TWZ_ROOT_SIZE]) { root_of_top(f, top, root); }
