/* Errors, memory, checksums, varints (FORMAT §1.3, §1.4). */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "internal.h"

twz_status twz_fail(twz_error *error, twz_status status, const char *format, ...) {
  if (error) {
    va_list arguments;
    va_start(arguments, format);
    error->status = status;
    vsnprintf(error->text, sizeof error->text, format, arguments);
    va_end(arguments);
    memset(error->reserved, 0, sizeof error->reserved);
  }
  return status;
}

int twz_version(void) {
  return 10000 * TWZ_VERSION_MAJOR + 100 * TWZ_VERSION_MINOR + TWZ_VERSION_PATCH;
}

/* ---- Memory ---- */

void *twz_allocate(const twz_allocator *a, size_t n_bytes) {
  if (n_bytes == 0) n_bytes = 1;
  return a->allocate ? a->allocate(a->context, n_bytes) : malloc(n_bytes);
}

void *twz_allocate_pages(const twz_allocator *a, size_t n_bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  /* To map pages of 4 KiB took a fifth of all time. What is left at the end stays of small pages. */
  const size_t page = (size_t)1 << 21;
  if (!a->allocate && n_bytes >= page && n_bytes < SIZE_MAX - page) {
    void *memory = aligned_alloc(page, (n_bytes + page - 1) / page * page);
    if (memory) madvise(memory, n_bytes / page * page, MADV_HUGEPAGE); /* a wish: if it fails, pages are small */
    return memory;
  }
#endif
  return twz_allocate(a, n_bytes);
}

void *twz_allocate_zeros(const twz_allocator *a, size_t n_bytes) {
  if (!a->allocate) return calloc(n_bytes ? n_bytes : 1, 1);
  void *memory = twz_allocate(a, n_bytes);
  if (memory) memset(memory, 0, n_bytes);
  return memory;
}

void twz_release(const twz_allocator *a, void *memory) {
  if (!memory) return;
  if (a->release) {
    a->release(a->context, memory);
  } else {
    free(memory);
  }
}

twz_status take_sized(void *to, size_t size, const void *given, const char *name, twz_error *error) {
  size_t given_size;
  memcpy(&given_size, given, sizeof given_size);
  if (given_size <= sizeof given_size) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "%s.size is %u, expected sizeof(%s): begin with its macro", name, (unsigned)given_size, name);
  }
  memcpy(to, given, min_size(given_size, size));
  return TWZ_OK;
}

twz_status report(const twz_workers *w, uint64_t n_done, uint64_t n_all, twz_error *error) {
  if (!w->report || w->report(w->report_context, n_done, n_all) == 0) return TWZ_OK;
  return twz_fail(error, TWZ_CANCELLED, "ended by the caller, %llu of %llu done", (unsigned long long)n_done, (unsigned long long)n_all);
}

twz_status twz_no_memory(twz_error *error, size_t n_bytes) {
  return twz_fail(error, TWZ_NO_MEMORY, "no memory for %llu bytes", (unsigned long long)n_bytes);
}

twz_status scratch_reserve(scratch *s, size_t n_bytes, twz_error *error) {
  s->used = 0;
  if (n_bytes + SCRATCH_ALIGN <= s->size) return TWZ_OK;
  scratch_free(s);
  s->memory = twz_allocate(s->allocator, n_bytes + SCRATCH_ALIGN);
  if (!s->memory) return twz_no_memory(error, n_bytes);
  s->size = n_bytes + SCRATCH_ALIGN;
  return TWZ_OK;
}

void *scratch_take(scratch *s, size_t n_bytes) {
  size_t misplaced = ((uintptr_t)s->memory + s->used) % SCRATCH_ALIGN;
  if (misplaced) s->used += SCRATCH_ALIGN - misplaced;
  if (n_bytes > s->size || s->used > s->size - n_bytes) abort(); /* an error of this library's own */
  void *taken = s->memory + s->used;
  s->used += n_bytes;
  return taken;
}

void scratch_free(scratch *s) {
  twz_release(s->allocator, s->memory);
  s->memory = NULL;
  s->size = s->used = 0;
}

/* ---- CRC-32, sixteen bytes at a time ---- */

void crc_tables_fill(crc_tables *t) {
  for (uint32_t i = 0; i < 256; i++) {
    uint32_t c = i;
    for (int k = 0; k < 8; k++) c = (c >> 1) ^ (0xEDB88320u & (0u - (c & 1)));
    t->of[0][i] = c;
  }
  for (uint32_t i = 0; i < 256; i++) {
    for (int k = 1; k < 16; k++) {
      uint32_t c = t->of[k - 1][i];
      t->of[k][i] = (c >> 8) ^ t->of[0][c & 255];
    }
  }
}

uint32_t crc32_of(const crc_tables *t, const uint8_t *bytes, size_t n) {
  uint32_t crc = 0xFFFFFFFFu;
  for (; n >= 16; n -= 16, bytes += 16) {
    uint32_t next = 0;
    for (int i = 0; i < 4; i++) {
      uint32_t a = load_u32(bytes + 4 * i) ^ (i ? 0 : crc);
      const uint32_t (*of)[256] = t->of + 12 - 4 * i;
      next ^= of[3][a & 255] ^ of[2][a >> 8 & 255] ^ of[1][a >> 16 & 255] ^ of[0][a >> 24];
    }
    crc = next;
  }
  for (; n; n--, bytes++) crc = (crc >> 8) ^ t->of[0][(crc ^ *bytes) & 255];
  return ~crc;
}

/* ---- Varints ---- */

twz_status read_varint(reader *r, uint64_t *value, twz_error *error) {
  *value = 0;
  for (int i = 0; i < 5; i++) {
    REQUIRE(r->at < r->n, error, "a varint goes beyond the end of its section");
    uint8_t byte = r->bytes[r->at++];
    *value |= (uint64_t)(byte & 127) << (7 * i);
    if (byte < 128) {
      REQUIRE(i == 0 || byte != 0, error, "a varint that could be shorter");
      return TWZ_OK;
    }
  }
  return twz_fail(error, TWZ_CORRUPT, "a varint of more than five bytes");
}

twz_status read_signed_varint(reader *r, int64_t *value, twz_error *error) {
  uint64_t z;
  TRY(read_varint(r, &z, error));
  *value = z % 2 ? -(int64_t)((z + 1) / 2) : (int64_t)(z / 2);
  return TWZ_OK;
}

twz_status read_byte(reader *r, int *byte, twz_error *error) {
  REQUIRE(r->at < r->n, error, "a payload is cut");
  *byte = r->bytes[r->at++];
  return TWZ_OK;
}

twz_status read_section(reader *r, reader *section, const char *name, twz_error *error) {
  uint64_t n;
  TRY(read_varint(r, &n, error));
  REQUIRE(n <= r->n - r->at, error, "%s of %llu bytes where %llu are left", name,
          (unsigned long long)n, (unsigned long long)(r->n - r->at));
  section->bytes = r->bytes + r->at;
  section->n = (size_t)n;
  section->at = 0;
  r->at += (size_t)n;
  return TWZ_OK;
}
