/* State that host.c and root.c share: the file of the instance, the bytes that JavaScript gave, the numbers that it is told. */
#ifndef HOST_H
#define HOST_H

#include "internal.h"

#define EXPORT(name) __attribute__((export_name(#name)))

extern twz_file *file;
extern twz_error error;
extern twz_range ranges[];
extern uint8_t *given; /* n_given bytes that JavaScript has: of the file, or of heights */
extern size_t n_given;
extern double told[];

/* Tell the first n ranges, and return how many they are. */
int ranges_told(twz_status status, size_t n);

#endif
