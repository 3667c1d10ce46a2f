/*
 * Write files made of sound ones (mutate.h): mutants FOLDER N FIRST_SEED FILES...; the number of each is its seed, and
 * its name ends in the name of the file that it is made of.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "mutate.h"

enum { MOST = 1 << 20 };

static uint32_t state;
static uint32_t below(uint32_t n) {
  state = state * 1664525u + 1013904223u;
  return (uint32_t)(((uint64_t)state * n) >> 32);
}

/* A bit, a byte, a few bytes fewer or more. */
static size_t change(uint8_t *bytes, size_t n, size_t most) {
  size_t at = n ? below((uint32_t)n) : 0, more = 1 + below(4);
  switch (below(4)) {
    case 0:
      if (n) bytes[at] ^= (uint8_t)(1u << below(8));
      break;
    case 1:
      if (n) bytes[at] = (uint8_t)below(256);
      break;
    case 2:
      if (n < more) break;
      at = below((uint32_t)(n - more + 1));
      memmove(bytes + at, bytes + at + more, n - at - more);
      return n - more;
    default:
      if (n + more > most) break;
      memmove(bytes + at + more, bytes + at, n - at);
      for (size_t i = 0; i < more; i++) bytes[at + i] = (uint8_t)below(256);
      return n + more;
  }
  return n;
}

static size_t read_file(const char *path, uint8_t *bytes) {
  FILE *file = fopen(path, "rb");
  size_t n = file ? fread(bytes, 1, MOST, file) : 0;
  if (!file || n == 0) {
    fprintf(stderr, "%s cannot be read\n", path);
    exit(1);
  }
  fclose(file);
  return n;
}

int main(int n, char **arguments) {
  static uint8_t bytes[MOST], other[MOST];
  if (n < 5) {
    fprintf(stderr, "mutants FOLDER N FIRST_SEED FILES...\n");
    return 2;
  }
  uint32_t first = (uint32_t)atoi(arguments[3]), stop = first + (uint32_t)atoi(arguments[2]), n_files = (uint32_t)n - 4;
  for (uint32_t seed = first; seed < stop; seed++) {
    state = (uint32_t)(((uint64_t)seed * 2654435761u) & 0xffffffffu);
    for (int i = 0; i < 3; i++) below(2);
    const char *path = arguments[4 + below(n_files)], *from = arguments[4 + below(n_files)];
    const char *name = strrchr(path, '/') ? strrchr(path, '/') + 1 : path;
    size_t n_bytes = read_file(path, bytes), n_other = read_file(from, other);
    size_t n_new = mutate_file(bytes, n_bytes, MOST, other, n_other, seed, change);
    if (n_new) n_bytes = n_new; /* else it stays as it is */
    char target[1024];
    snprintf(target, sizeof target, "%s/%06u-%s", arguments[1], (unsigned)seed, name);
    FILE *file = fopen(target, "wb");
    if (!file || fwrite(bytes, 1, n_bytes, file) != n_bytes || fclose(file) != 0) {
      fprintf(stderr, "%s cannot be written\n", target);
      return 1;
    }
  }
  return 0;
}
