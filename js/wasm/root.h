/* Digests and roots: js/wasm/root.c. Roots are 64 hexadecimal digits. */
#ifndef ROOT_H
#define ROOT_H

#include "digest.h"

enum { ROOT_TILE = 512 };

/* Of at most ROOT_TILE x ROOT_TILE heights; those that are not valid become 0. */
void root_tile(uint8_t dtype, uint8_t *heights, uint8_t *valid, uint32_t n_rows, uint32_t n_cols, uint8_t digest[DIGEST_SIZE]);
/* Of n bytes: the digests of all tiles, row by row. */
twz_status root_of_tiles(const twz_file *f, const uint8_t *tiles, size_t n, char root[TWZ_ROOT_SIZE], twz_error *error);
/* Where the top digest of a file lies, by its last bytes. */
twz_status root_place(const twz_file *f, const uint8_t tail[LEAST_DIGESTS], twz_range *top, twz_error *error);
void root_stated(const twz_file *f, const uint8_t top[DIGEST_SIZE], char root[TWZ_ROOT_SIZE]);

#endif
