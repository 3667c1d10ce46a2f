/* Opening a file, and what is known of it: segments and decoded units. */
#include "internal.h"
#include "kernels.h"

void file_lock(twz_file *f) {
  if (f->locks.lock) f->locks.lock(f->locks.context);
}

void file_unlock(twz_file *f) {
  if (f->locks.unlock) f->locks.unlock(f->locks.context);
}

/* ---- Making and freeing ---- */

twz_status twz_file_new(const twz_options *options, uint64_t file_size, twz_file **file, twz_error *error) {
  twz_options given = TWZ_OPTIONS;
  *file = NULL;
  if (options) TRY(take_sized(&given, sizeof given, options, "twz_options", error));
  const row_kernels *kernels = find_kernels(given.kernels);
  if (!kernels) return twz_fail(error, TWZ_BAD_ARGUMENT, "this processor or this build lacks the kernels asked for");
  twz_file *f = twz_allocate_zeros(&given.allocator, sizeof *f);
  if (!f) return twz_no_memory(error, sizeof *f);
  f->allocator = given.allocator;
  f->locks = given.locks;
  f->file_size = file_size;
  f->cache_bytes = given.cache_bytes;
  f->max_bytes = given.max_bytes ? given.max_bytes : UINT64_MAX;
  f->kernels = kernels;
  crc_tables_fill(&f->crc);
  for (int c = 0; c < 256; c++) f->rates[c] = 131072 / (2 * c + 3);
  *file = f;
  return TWZ_OK;
}

void unit_free(twz_file *f, unit *u) {
  for (int i = 0; i < u->n_layers; i++) {
    twz_release(&f->allocator, u->layers[i].heights);
    twz_release(&f->allocator, u->layers[i].shorts);
    twz_release(&f->allocator, u->layers[i].valid);
    twz_release(&f->allocator, u->layers[i].own);
    twz_release(&f->allocator, u->layers[i].remainders);
  }
  twz_release(&f->allocator, u);
}

static void free_table(twz_file *f, table *t, void (*release)(twz_file *, entry *)) {
  for (size_t i = 0; i < t->n_slots; i++) {
    while (t->slots[i]) {
      entry *e = t->slots[i];
      t->slots[i] = e->next;
      release(f, e);
    }
  }
  twz_release(&f->allocator, t->slots);
}

static void free_segment(twz_file *f, entry *e) { twz_release(&f->allocator, e); }
static void free_unit(twz_file *f, entry *e) { unit_free(f, (unit *)e); }

void twz_file_free(twz_file *f) {
  if (!f) return;
  free_table(f, &f->segments, free_segment);
  free_table(f, &f->units, free_unit);
  json_free(&f->json);
  for (int i = 0; i < 2; i++) twz_release(&f->allocator, f->tags[i]);
  twz_release(&f->allocator, f->metadata);
  twz_release(&f->allocator, f->start);
  twz_release(&f->allocator, f->rapid);
  twz_release(&f->allocator, f->predictive);
  twz_release(&f->allocator, f->cdf97);
  twz_release(&f->allocator, f->idle.memory);
  twz_allocator allocator = f->allocator;
  twz_release(&allocator, f);
}

/* ---- Opening (§3.5) ---- */

/* How many bytes from the start are needed, as far as is known. */
static uint64_t start_needed(const twz_file *f) {
  if (f->header.file_size == 0) return min_u64(f->file_size, FIRST_READ);
  const header *h = &f->header;
  return (uint64_t)h->header_size + h->metadata_length + h->parameters_length + h->top_page_length;
}

static twz_status read_parameters(twz_file *f, const uint8_t *bytes, twz_error *error) {
  const header *h = &f->header;
  uint32_t n = h->parameters_length;
  REQUIRE(crc_matches(&f->crc, bytes, n, h->parameters_crc), error, "the checksum of the parameters is wrong");
  REQUIRE_KNOWN(n == 0 || h->method == TWZ_RAPID || h->method == TWZ_PREDICTIVE, error,
                "parameters of method %s, which a newer release may know", f->info.method_name);
  if (h->method == TWZ_RAPID) return rapid_tables_new(f, bytes, n, error);
  if (h->method == TWZ_PREDICTIVE) return predictive_tables_new(f, bytes, n, error);
  if (h->method == TWZ_CDF97) return cdf97_tables_new(f, error);
  return TWZ_OK;
}

static twz_status read_top_page(twz_file *f, const uint8_t *page, twz_error *error) {
  place top = {-1, 0, 0};
  uint64_t body = start_needed(f);
  page_place where = {body - f->header.top_page_length, body, 0, 0, f->header.top_page_length};
  segment *s;
  TRY(read_segment(&s, &f->grid, top, &where, page, f->file_size, &f->crc, &f->allocator, error));
  if (table_insert(&f->segments, &f->allocator, &s->entry)) return TWZ_OK;
  twz_release(&f->allocator, s);
  return twz_no_memory(error, 64 * sizeof(void *));
}

static twz_status open_start(twz_file *f, twz_error *error) {
  const uint8_t *metadata = f->start + f->header.header_size, *parameters = metadata + f->header.metadata_length;
  TRY(check_optional_sections(&f->header, f->start, &f->crc, error));
  TRY(read_metadata(f, metadata, error));
  TRY(read_parameters(f, parameters, error));
  TRY(read_top_page(f, parameters + f->header.parameters_length, error));
  twz_release(&f->allocator, f->start);
  f->start = NULL;
  f->is_open = 1;
  return TWZ_OK;
}

twz_status twz_file_need(twz_file *f, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  *n = 0;
  if (f->is_open) return TWZ_OK;
  if (f->file_size < HEADER_SIZE) {
    return twz_fail(error, TWZ_CORRUPT, "a file of %llu bytes ends within the header", (unsigned long long)f->file_size);
  }
  if (capacity == 0) return twz_fail(error, TWZ_BAD_ARGUMENT, "no room for a range");
  *n = 1;
  memset(&ranges[0], 0, sizeof ranges[0]);
  ranges[0].offset = f->n_start;
  ranges[0].length = start_needed(f) - f->n_start;
  return TWZ_OK;
}

twz_status twz_file_feed(twz_file *f, uint64_t offset, const void *bytes, size_t n, twz_error *error) {
  if (f->is_open || offset > f->n_start || offset + n <= f->n_start || f->file_size < HEADER_SIZE) return TWZ_OK;
  for (;;) {
    uint64_t needed = start_needed(f);
    if (f->start_capacity < needed) {
      uint8_t *larger = twz_allocate(&f->allocator, (size_t)needed);
      if (!larger) return twz_no_memory(error, (size_t)needed);
      if (f->n_start) memcpy(larger, f->start, f->n_start);
      twz_release(&f->allocator, f->start);
      f->start = larger;
      f->start_capacity = (size_t)needed;
    }
    size_t skipped = (size_t)(f->n_start - offset);
    size_t taken = min_size(n - skipped, f->start_capacity - f->n_start);
    memcpy(f->start + f->n_start, (const uint8_t *)bytes + skipped, taken);
    f->n_start += taken;
    if (f->header.file_size == 0 && f->n_start >= HEADER_SIZE) {
      header h;
      TRY(read_header(&h, f->start, f->file_size, &f->crc, error));
      f->header = h;
      grid_init(&f->grid, &h);
      needed = start_needed(f);
    }
    if (f->header.file_size && f->n_start >= needed) return open_start(f, error);
    if (taken == n - skipped) return TWZ_OK;
  }
}

twz_status fetch_range(const twz_file *f, const twz_range *range, twz_fetch fetch, void *source, void *to, twz_error *error) {
  if (f->memory) {
    memcpy(to, f->memory + range->offset, (size_t)range->length);
    return TWZ_OK;
  }
  if (fetch(source, 1, range, &to) == 0) return TWZ_OK;
  return twz_fail(error, TWZ_FETCH_FAILED, "bytes %llu to %llu could not be read", (unsigned long long)range->offset,
                  (unsigned long long)(range->offset + range->length - 1));
}

/* Fetch ranges into one buffer and feed them, until nothing is needed. */
twz_status load_all(const twz_allocator *a, need_function need, feed_function feed, void *self, twz_fetch fetch,
                    void *source, twz_error *error) {
  enum { MOST_RANGES = 64 };
  for (;;) {
    twz_range ranges[MOST_RANGES];
    void *buffers[MOST_RANGES];
    size_t n, n_bytes = 0;
    TRY(need(self, ranges, MOST_RANGES, &n, error));
    if (n == 0) return TWZ_OK;
    for (size_t i = 0; i < n; i++) n_bytes += (size_t)ranges[i].length;
    uint8_t *buffer = twz_allocate(a, n_bytes);
    if (!buffer) return twz_no_memory(error, n_bytes);
    n_bytes = 0;
    for (size_t i = 0; i < n; i++) {
      buffers[i] = buffer + n_bytes;
      n_bytes += (size_t)ranges[i].length;
    }
    twz_status status = TWZ_OK;
    if (fetch(source, n, ranges, buffers) != 0) {
      status = twz_fail(error, TWZ_FETCH_FAILED, "bytes %llu to %llu could not be read",
                        (unsigned long long)ranges[0].offset,
                        (unsigned long long)(ranges[n - 1].offset + ranges[n - 1].length - 1));
    }
    for (size_t i = 0; i < n && status == TWZ_OK; i++) {
      status = feed(self, ranges[i].offset, buffers[i], (size_t)ranges[i].length, error);
    }
    twz_release(a, buffer);
    TRY(status);
  }
}

static twz_status file_need(void *f, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  return twz_file_need(f, ranges, capacity, n, error);
}
static twz_status file_feed(void *f, uint64_t offset, const void *bytes, size_t n, twz_error *error) {
  return twz_file_feed(f, offset, bytes, n, error);
}

twz_status twz_file_load(twz_file *f, twz_fetch fetch, void *source, twz_error *error) {
  return load_all(&f->allocator, file_need, file_feed, f, fetch, source, error);
}

twz_status twz_file_borrow(twz_file *f, const void *bytes, twz_error *error) {
  f->memory = bytes;
  for (;;) {
    twz_range range;
    size_t n;
    TRY(twz_file_need(f, &range, 1, &n, error));
    if (n == 0) return TWZ_OK;
    TRY(twz_file_feed(f, range.offset, f->memory + range.offset, (size_t)range.length, error));
  }
}

/* ---- What is known ---- */

const twz_info *twz_file_info(const twz_file *f) { return f->is_open ? &f->info : NULL; }

twz_status level_number(const twz_file *f, int level, int *found, twz_error *error) {
  if (!f->is_open) return twz_fail(error, TWZ_NOT_READY, "the file is not open yet");
  int n = f->info.n_levels;
  if (level < -n || level >= n) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "level %d; this file has levels 0 to %d, or -1 to -%d from the finest",
                    level, n - 1, n);
  }
  *found = level < 0 ? level + n : level;
  return TWZ_OK;
}

twz_status twz_file_level(const twz_file *f, int level, twz_level *found, twz_error *error) {
  TRY(level_number(f, level, &level, error));
  const double *t = f->info.transform;
  double size = 1, before;
  for (int j = f->grid.k_max - level; j > 0; j--) size *= 2;
  before = (1 - size) / 2; /* the level's first sample is the full grid's: its pixel begins so much earlier */
  memset(found, 0, sizeof *found);
  found->n_rows = level_size(&f->grid, f->grid.n_rows, level);
  found->n_cols = level_size(&f->grid, f->grid.n_cols, level);
  found->transform[0] = t[0] * size;
  found->transform[1] = t[1] * size;
  found->transform[2] = t[2] + (t[0] + t[1]) * before;
  found->transform[3] = t[3] * size;
  found->transform[4] = t[4] * size;
  found->transform[5] = t[5] + (t[3] + t[4]) * before;
  return TWZ_OK;
}

/* ---- The cache: units in order of use; those in use are in none ---- */

static void unlink_unit(twz_file *f, unit *u) {
  if (u->newer) u->newer->older = u->older; else f->newest = u->older;
  if (u->older) u->older->newer = u->newer; else f->oldest = u->newer;
  u->newer = u->older = NULL;
}

static void link_newest(twz_file *f, unit *u) {
  u->older = f->newest;
  u->newer = NULL;
  if (f->newest) f->newest->newer = u; else f->oldest = u;
  f->newest = u;
}

static void take_out(twz_file *f, unit *u) {
  if (u->n_users == 0) unlink_unit(f, u);
  table_remove(&f->units, &u->entry);
  f->cached_bytes -= u->n_bytes;
}

/* Take the oldest units that nobody uses out, until what is kept fits; returns them, to be released without the lock. */
static unit *trim(twz_file *f) {
  unit *out = NULL;
  while (f->oldest && f->cached_bytes > f->cache_bytes) {
    unit *u = f->oldest;
    take_out(f, u);
    u->older = out;
    out = u;
  }
  return out;
}

static void free_units(twz_file *f, unit *u) {
  while (u) {
    unit *next = u->older;
    unit_free(f, u);
    u = next;
  }
}

void twz_file_limit_cache(twz_file *f, uint64_t n_bytes) {
  file_lock(f);
  f->cache_bytes = n_bytes;
  unit *out = trim(f);
  file_unlock(f);
  free_units(f, out);
}

unit *cache_take(twz_file *f, place key, part *wanted) {
  file_lock(f);
  unit *u = (unit *)table_find(&f->units, key);
  if (u && !u->is_void && !part_has(u->layers[0].ready, *wanted)) {
    const part all = {0, 0, u->layers[0].rows.n, u->layers[0].cols.n};
    *wanted = all;
    u = NULL;
  }
  if (u && u->n_users++ == 0) unlink_unit(f, u);
  file_unlock(f);
  return u;
}

/* Give a decoded unit, with one user; returns the one to use, as another thread may have been first. */
unit *cache_give(twz_file *f, unit *u) {
  file_lock(f);
  unit *out = NULL, *less = NULL, *found = (unit *)table_find(&f->units, u->entry.at);
  if (found && !found->is_void && !part_has(found->layers[0].ready, u->layers[0].ready)) {
    take_out(f, found);
    found->is_cached = 0;
    if (found->n_users == 0) less = found;
    found = NULL;
  }
  if (found) {
    if (found->n_users++ == 0) unlink_unit(f, found);
  } else if (table_insert(&f->units, &f->allocator, &u->entry)) {
    u->is_cached = 1;
    f->cached_bytes += u->n_bytes;
    out = trim(f);
  }
  file_unlock(f);
  free_units(f, out);
  if (less) unit_free(f, less);
  if (!found) return u;
  unit_free(f, u);
  return found;
}

void cache_leave(twz_file *f, unit *u) {
  file_lock(f);
  int is_last = --u->n_users == 0;
  if (is_last && u->is_cached) {
    link_newest(f, u);
    is_last = 0;
  }
  unit *out = trim(f);
  file_unlock(f);
  free_units(f, out);
  if (is_last) unit_free(f, u);
}
