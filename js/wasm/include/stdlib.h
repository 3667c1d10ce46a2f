/* Declarations that the library takes of C's own headers: libc.c has the functions. */
#pragma once
#include <stddef.h>

void *malloc(size_t n);
void *calloc(size_t n, size_t size);
void free(void *memory);
_Noreturn void abort(void);
void qsort(void *first, size_t n, size_t size, int (*compare)(const void *, const void *));
