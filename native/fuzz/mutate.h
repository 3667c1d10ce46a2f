/*
 * Files made of sound ones: fields, sections and segments change, and lengths and checksums are made right again,
 * unless they are what changes. Anything may come out.
 */
#ifndef TWZ_MUTATE_H
#define TWZ_MUTATE_H

#include <stddef.h>
#include <stdint.h>

/* Changes n bytes in place, to at most `most`; returns how many there are then. */
typedef size_t (*change_bytes)(uint8_t *bytes, size_t n, size_t most);

/*
 * Change a file in place, to at most `most` bytes; `other` (may be NULL) is a file that parts may come from, `plain`
 * changes bytes that have no structure. Returns the number of bytes; 0: the file has no structure that is known.
 */
size_t mutate_file(uint8_t *bytes, size_t n, size_t most, const uint8_t *other, size_t n_other, uint32_t seed,
                   change_bytes plain);

#endif
