#include "internal.h"
twz_status decode_cdf97(const job *j, const reader *b, scratch *s, twz_error *e){(void)j;(void)b;(void)s;return twz_fail(e,TWZ_UNSUPPORTED,"cdf97");}
twz_status decode_cdf53(const twz_file *f, unit *u, const unit *above, const uint8_t *payload, size_t n,
                        scratch *s, twz_error *error){(void)f;(void)u;(void)above;(void)payload;(void)n;(void)s;return twz_fail(error,TWZ_UNSUPPORTED,"cdf53");}
twz_status cdf97_tables_new(twz_file *f, twz_error *e){(void)f;(void)e;return TWZ_OK;}
