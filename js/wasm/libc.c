/*
 * The part of C's library that native/src calls. A libc for WebAssembly would do, and bring the printing of floats, files and
 * imports that a page has to provide.
 */
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { PAGE = 65536, LEAST_GROWTH = 16 }; /* pages: what is not touched costs nothing */

_Noreturn void abort(void) { __builtin_trap(); }

/* ---- Memory: pieces that know the one before them; free ones are in a list for each power of two. ---- */

typedef struct piece {
  size_t size;             /* with this head, a multiple of ALIGN; bit 0: it is in use */
  struct piece *before;    /* the one that lies before it, NULL: none */
  struct piece *next, *last; /* of a free one, in its list */
} piece;

enum { ALIGN = 16, HEAD = 16, LEAST = 32, N_LISTS = 32, USED = 1 };

extern unsigned char __heap_base;
static piece *lists[N_LISTS];
static piece *end; /* an empty piece behind all others */

static size_t size_of(const piece *p) { return p->size & ~(size_t)USED; }
static piece *behind(piece *p) { return (piece *)(void *)((char *)p + size_of(p)); }
static int list_of(size_t size) { return 31 - __builtin_clz((unsigned)size); }

static void unlist(piece *p) {
  if (p->last) p->last->next = p->next; else lists[list_of(p->size)] = p->next;
  if (p->next) p->next->last = p->last;
}

/* Take a piece that is in no list for a free one, joined with its free neighbours. */
static void enlist(piece *p) {
  p->size = size_of(p);
  piece *other = behind(p);
  if (!(other->size & USED)) {
    unlist(other);
    p->size += other->size;
  }
  if (p->before && !(p->before->size & USED)) {
    other = p->before;
    unlist(other);
    other->size += p->size;
    p = other;
  }
  behind(p)->before = p;
  p->last = NULL;
  p->next = lists[list_of(p->size)];
  if (p->next) p->next->last = p;
  lists[list_of(p->size)] = p;
}

/* More memory, for a piece of so many bytes; 0: there is none. */
static int grow(size_t size) {
  size_t n_pages = (size + HEAD + PAGE - 1) / PAGE;
  if (n_pages < LEAST_GROWTH) n_pages = LEAST_GROWTH;
  size_t first = __builtin_wasm_memory_grow(0, n_pages);
  if (first == SIZE_MAX) return 0;
  char *start = (char *)(first * PAGE), *stop = start + n_pages * PAGE;
  piece *p = end;
  if (!end) {
    p = (piece *)(void *)(((uintptr_t)&__heap_base + ALIGN - 1) & ~(uintptr_t)(ALIGN - 1));
    p->before = NULL;
  }
  end = (piece *)(void *)(stop - HEAD);
  end->size = USED;
  p->size = (size_t)((char *)end - (char *)p);
  enlist(p);
  return 1;
}

static piece *find(size_t size) {
  for (int i = list_of(size); i < N_LISTS; i++) {
    for (piece *p = lists[i]; p; p = p->next) {
      if (p->size >= size) return p;
    }
  }
  return NULL;
}

void *malloc(size_t n) {
  if (n > SIZE_MAX / 2) return NULL;
  size_t size = (n + HEAD + ALIGN - 1) / ALIGN * ALIGN;
  if (size < LEAST) size = LEAST;
  piece *p = find(size);
  if (!p) {
    if (!grow(size)) return NULL;
    p = find(size);
  }
  unlist(p);
  if (p->size >= size + LEAST) {
    piece *rest = (piece *)(void *)((char *)p + size);
    rest->size = p->size - size;
    rest->before = p;
    p->size = size | USED;
    enlist(rest);
  } else {
    p->size |= USED;
  }
  return (char *)p + HEAD;
}

void *calloc(size_t n, size_t size) {
  if (size && n > SIZE_MAX / size) return NULL;
  void *memory = malloc(n * size);
  if (memory) memset(memory, 0, n * size);
  return memory;
}

void free(void *memory) {
  if (memory) enlist((piece *)(void *)((char *)memory - HEAD));
}

/* ---- Bytes and texts ---- */

void *memcpy(void *restrict to, const void *restrict from, size_t n) { return __builtin_memcpy(to, from, n); }
void *memmove(void *to, const void *from, size_t n) { return __builtin_memmove(to, from, n); }
void *memset(void *to, int byte, size_t n) { return __builtin_memset(to, byte, n); }

int memcmp(const void *a, const void *b, size_t n) {
  const unsigned char *x = a, *y = b;
  for (; n && *x == *y; n--, x++, y++) continue;
  return n ? *x - *y : 0;
}

size_t strlen(const char *text) {
  size_t n = 0;
  while (text[n]) n++;
  return n;
}

int strcmp(const char *a, const char *b) {
  for (; *a && *a == *b; a++, b++) continue;
  return (unsigned char)*a - (unsigned char)*b;
}

char *strchr(const char *text, int c) {
  for (; *text != (char)c; text++) {
    if (!*text) return NULL;
  }
  return (char *)text;
}

void *memchr(const void *bytes, int byte, size_t n) {
  const unsigned char *at = bytes;
  for (; n; n--, at++) {
    if (*at == (unsigned char)byte) return (void *)at;
  }
  return NULL;
}

/* ---- Sorting, in place, in a time that no order makes long (heapsort) ---- */

static void swap(char *a, char *b, size_t size) {
  for (size_t i = 0; i < size; i++) {
    char byte = a[i];
    a[i] = b[i];
    b[i] = byte;
  }
}

static void sink(char *items, size_t i, size_t n, size_t size, int (*compare)(const void *, const void *)) {
  for (size_t child; (child = 2 * i + 1) < n; i = child) {
    if (child + 1 < n && compare(items + child * size, items + (child + 1) * size) < 0) child++;
    if (compare(items + i * size, items + child * size) >= 0) return;
    swap(items + i * size, items + child * size, size);
  }
}

void qsort(void *first, size_t n, size_t size, int (*compare)(const void *, const void *)) {
  char *items = first;
  for (size_t i = n / 2; i-- > 0;) sink(items, i, n, size, compare);
  for (size_t i = n; i-- > 1;) {
    swap(items, items + i * size, size);
    sink(items, 0, i, size, compare);
  }
}

/* ---- Printing: %s, %d, %u, %llu and %% ---- */

typedef struct printed {
  char *to;
  size_t room, n;
} printed;

static void put(printed *p, char c) {
  if (p->n + 1 < p->room) p->to[p->n] = c;
  p->n++;
}

static void put_number(printed *p, unsigned long long number) {
  char digits[20];
  int n = 0;
  do digits[n++] = (char)('0' + number % 10);
  while (number /= 10);
  while (n) put(p, digits[--n]);
}

int vsnprintf(char *to, size_t room, const char *format, va_list arguments) {
  printed p = {to, room, 0};
  for (const char *at = format; *at; at++) {
    if (*at != '%') {
      put(&p, *at);
    } else if (*++at == 's') {
      for (const char *text = va_arg(arguments, const char *); *text; text++) put(&p, *text);
    } else if (*at == 'd') {
      int number = va_arg(arguments, int);
      if (number < 0) put(&p, '-');
      put_number(&p, number < 0 ? 0u - (unsigned)number : (unsigned)number);
    } else if (*at == 'u') {
      put_number(&p, va_arg(arguments, unsigned));
    } else if (at[0] == 'l' && at[1] == 'l' && at[2] == 'u') {
      put_number(&p, va_arg(arguments, unsigned long long));
      at += 2;
    } else if (*at == '%') {
      put(&p, '%');
    } else {
      abort(); /* a format that no message had so far */
    }
  }
  if (room) to[p.n < room ? p.n : room - 1] = 0;
  return (int)p.n;
}

/* ---- Numbers ---- */

double ldexp(double x, int exponent) {
  for (; exponent > 1000; exponent -= 1000) x *= 0x1p1000;
  /* Of a number of 53 bits only the last step may round. */
  for (; exponent < -1000; exponent += 1000) x *= 0x1p-1000;
  union { uint64_t bits; double number; } power = {(uint64_t)(exponent + 1023) << 52};
  return x * power.number;
}
