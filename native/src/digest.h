/* Digests of heights (FORMAT §4.9). */
#ifndef TWZ_DIGEST_H
#define TWZ_DIGEST_H

#include "internal.h"

/* Decode all heights; returns the digest of the top. */
twz_status digest_heights(twz_file *f, twz_fetch fetch, void *source, const twz_workers *workers, uint8_t top[DIGEST_SIZE],
                          twz_error *error);
/* Compare the digests of a file with those below them; heights are not decoded. */
twz_status check_digests_of(const twz_file *f, const uint8_t *digests, uint32_t n, twz_error *error);

#endif
