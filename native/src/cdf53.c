#include "internal.h"
twz_status decode_cdf53(const twz_file *f, unit *u, const unit *above, const uint8_t *payload, size_t n,
                        scratch *s, twz_error *error){(void)f;(void)u;(void)above;(void)payload;(void)n;(void)s;return twz_fail(error,TWZ_UNSUPPORTED,"cdf53");}
