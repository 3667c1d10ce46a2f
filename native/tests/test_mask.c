/* Ones of masks that are read in a row, held against the same bits one by one. */
#include <stdio.h>

#include "mask.c"

/* As many as the coder reads by itself before a zero, or before it must take a byte. */
static ones one_by_one(uint32_t range, uint32_t code, int32_t n) {
  const uint32_t p = MODEL((1 << 22) - 255, 254) >> 14 | 1;
  ones found = {range, 0};
  for (; found.n < n; found.n++) {
    uint32_t bound = (found.range >> 16) * p;
    if (code >= bound || bound < 1u << 24) break;
    found.range = bound;
  }
  return found;
}

int main(void) {
  static const int32_t COUNTS[5] = {1, 2, 77, 1024, 70000};
  const model settled = MODEL((1 << 22) - 255, 254);
  int32_t rates[256];
  for (int c = 0; c < 256; c++) rates[c] = 131072 / (2 * c + 3);
  coder c = {0, 0, NULL, 0, 0, rates};
  if (learned(&c, settled, 1) != settled) return puts("a settled model changes"), 1;
  uint32_t random = 1;
  for (uint32_t high = 256; high < 65536; high += high < 400 || high > 65400 || high % 21845 < 9 ? 1 : 37) {
    for (int k = 0; k < 10; k++) {
      random = (uint32_t)(((uint64_t)random * 1664525u + 1013904223u) & 0xffffffffu);
      uint32_t range = high << 16 | random >> 16, code = k < 5 ? 0 : (uint32_t)((uint64_t)range * (random >> 8) >> 24);
      ones found = settled_ones(range, code, COUNTS[k % 5]), expected = one_by_one(range, code, COUNTS[k % 5]);
      if (found.range != expected.range || found.n != expected.n) {
        printf("range %u, code %u, %d ones: found %d and range %u, expected %d and %u\n", range, code, COUNTS[k % 5], found.n,
               found.range, expected.n, expected.range);
        return 1;
      }
    }
  }
  return 0;
}
