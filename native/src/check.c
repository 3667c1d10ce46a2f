/* A verifier (FORMAT §13.1): all bytes, all units, and what units share. Meshes are not decoded. */
#include <stdlib.h>

#include "digest.h"

enum { MOST_READ = 1 << 22 };

typedef struct check {
  twz_file *file;
  twz_workers workers; /* who works; whom to tell is apart */
  twz_workers told;
  uint64_t n_done;     /* of twice the file's bytes, which are read and then decoded */
  twz_fetch fetch;
  void *source;
  const uint8_t *bytes; /* that were read last */
  uint8_t *buffer;
  size_t n_buffer;
  uint8_t top[DIGEST_SIZE]; /* the digest that stands for all heights */
} check;

/* Heights have the digest that the file states. */
static twz_status check_heights(check *c, twz_error *error) {
  uint8_t top[DIGEST_SIZE];
  TRY(digest_heights(c->file, c->fetch, c->source, &c->workers, top, error));
  REQUIRE(!CHECKSUMS_COUNT || memcmp(top, c->top, DIGEST_SIZE) == 0, error, "the heights have another digest than the file says");
  return TWZ_OK;
}

static twz_status report_check(const check *c, twz_error *error) {
  return report(&c->told, min_u64(c->n_done, 2 * c->file->file_size), 2 * c->file->file_size, error);
}

/* Read bytes. */
static twz_status read_bytes(check *c, uint64_t offset, uint64_t n, twz_error *error) {
  const twz_allocator *a = &c->file->allocator;
  TRY(report_check(c, error));
  c->n_done += n;
  if (c->file->memory) {
    c->bytes = c->file->memory + offset;
    return TWZ_OK;
  }
  if (n > c->n_buffer) {
    if (n > c->file->max_bytes || n > SIZE_MAX) {
      return twz_fail(error, TWZ_LIMIT, "a section of %llu bytes, more than is allowed", (unsigned long long)n);
    }
    twz_release(a, c->buffer);
    c->n_buffer = 0;
    c->buffer = twz_allocate(a, (size_t)n);
    if (!c->buffer) return twz_no_memory(error, (size_t)n);
    c->n_buffer = (size_t)n;
  }
  twz_range range = {.offset = offset, .length = n};
  c->bytes = c->buffer;
  return n ? fetch_range(c->file, &range, c->fetch, c->source, c->buffer, error) : TWZ_OK;
}

static twz_status load_page(check *c, place head, const page_place *page, segment **s, twz_error *error) {
  twz_file *f = c->file;
  TRY(read_bytes(c, page->offset, page->length, error));
  return read_segment(s, &f->grid, head, page, c->bytes, f->file_size, &f->crc, &f->allocator, error);
}

/* ---- Bytes: one pass over the file ---- */

/* Segments of one level in the order of the file. */
typedef struct pages {
  struct { place head; page_place page; } *all;
  size_t n, capacity;
} pages;

static twz_status add_children(check *c, pages *p, const segment *s, twz_error *error) {
  const twz_allocator *a = &c->file->allocator;
  if (p->capacity - p->n < (size_t)s->n_heads) {
    size_t capacity = 2 * p->capacity + (size_t)s->n_heads;
    void *larger = twz_allocate(a, capacity * sizeof *p->all);
    if (!larger) return twz_no_memory(error, capacity * sizeof *p->all);
    if (p->n) memcpy(larger, p->all, p->n * sizeof *p->all);
    twz_release(a, p->all);
    p->all = larger;
    p->capacity = capacity;
  }
  for (int i = 0; i < s->n_heads; i++) {
    if (s->children[i].page_length == 0) continue;
    p->all[p->n].head = child_page(s, i, &p->all[p->n].page);
    p->n++;
  }
  return TWZ_OK;
}

static int compare_sections(const void *a, const void *b) {
  const section_place *x = *(const section_place *const *)a, *y = *(const section_place *const *)b;
  return x->offset < y->offset ? -1 : x->offset > y->offset;
}

/* Read the payloads and meshes of a segment, which follow each other, and compare their checksums. */
static twz_status check_sections(check *c, const segment *s, twz_error *error) {
  const section_place *order[2 * MOST_KEYS];
  size_t n = 0;
  for (int i = 0; i < s->n_keys; i++) {
    if (s->payloads[i].length) order[n++] = &s->payloads[i];
    if (s->meshes[i].length) order[n++] = &s->meshes[i];
  }
  qsort(order, n, sizeof *order, compare_sections);
  for (size_t i = 0, stop; i < n; i = stop) {
    uint64_t start = order[i]->offset, length = order[i]->length;
    for (stop = i + 1; stop < n && length + order[stop]->length <= MOST_READ; stop++) length += order[stop]->length;
    TRY(read_bytes(c, start, length, error));
    for (size_t k = i; k < stop; k++) {
      const section_place *p = order[k];
      REQUIRE(crc_matches(&c->file->crc, c->bytes + (p->offset - start), p->length, p->crc), error,
              "the checksum of a payload or mesh is wrong (bytes %llu to %llu)", (unsigned long long)p->offset,
              (unsigned long long)(p->offset + p->length - 1));
    }
  }
  return TWZ_OK;
}

/* Check a level of segments, which begin at byte *at, and list those below. */
static twz_status check_level(check *c, const pages *level, pages *below, uint64_t *at, twz_error *error) {
  for (size_t i = 0; i < level->n; i++) {
    const page_place *page = &level->all[i].page;
    REQUIRE(page->body == *at, error, "a segment's body begins at byte %llu, where the one before it ends at byte %llu",
            (unsigned long long)page->body, (unsigned long long)*at);
    *at = page->end;
    segment *s;
    TRY(load_page(c, level->all[i].head, page, &s, error));
    twz_status status = check_sections(c, s, error);
    if (status == TWZ_OK) status = add_children(c, below, s, error);
    twz_release(&c->file->allocator, s);
    TRY(status);
  }
  return TWZ_OK;
}

/* Digests fill the file behind the segments, have the right checksum, and are those of the digests below them. */
static twz_status check_digests(check *c, uint64_t at, twz_error *error) {
  twz_file *f = c->file;
  TRY(read_bytes(c, f->file_size - DIGESTS_TAIL, DIGESTS_TAIL, error));
  uint32_t crc = load_u32(c->bytes), n = load_u32(c->bytes + 4);
  uint64_t length = (uint64_t)DIGEST_SIZE * n;
  REQUIRE(n > 0 && at <= f->file_size && length == f->file_size - DIGESTS_TAIL - at, error,
          "%u digests do not fill the file behind the segments", n);
  TRY(read_bytes(c, at, length, error));
  REQUIRE(crc_matches(&f->crc, c->bytes, (size_t)length, crc), error, "the checksum of the digests is wrong");
  memcpy(c->top, c->bytes, DIGEST_SIZE);
  return check_digests_of(f, c->bytes, n, error);
}

static twz_status check_bytes(check *c, const segment *top, twz_error *error) {
  pages levels[2] = {{NULL, 0, 0}, {NULL, 0, 0}};
  uint64_t at = top->end;
  twz_status status = check_sections(c, top, error);
  if (status == TWZ_OK) status = add_children(c, &levels[0], top, error);
  for (int i = 0; status == TWZ_OK && levels[i].n; i = !i) {
    levels[!i].n = 0;
    status = check_level(c, &levels[i], &levels[!i], &at, error);
  }
  for (int i = 0; i < 2; i++) twz_release(&c->file->allocator, levels[i].all);
  TRY(status);
  if (c->file->grid.has_digests) return check_digests(c, at, error);
  REQUIRE(at == c->file->file_size, error, "the segments end at byte %llu of %llu", (unsigned long long)at,
          (unsigned long long)c->file->file_size);
  return TWZ_OK;
}

/* ---- Units, segment by segment ---- */

/* Find a segment, and read pages until it is known; NULL: it is absent. */
static twz_status find_loaded(check *c, place head, segment **s, twz_error *error) {
  twz_file *f = c->file;
  for (;;) {
    page_place page;
    place missing;
    segment_state known = find_segment(f, head, s, &page, &missing);
    if (known == ABSENT) *s = NULL;
    if (known != MISSING) return TWZ_OK;
    TRY(load_page(c, missing, &page, s, error));
    if (table_insert(&f->segments, &f->allocator, &(*s)->entry)) continue;
    twz_release(&f->allocator, *s);
    return twz_no_memory(error, sizeof **s);
  }
}

/* Is a segment the one of `head`, or below it? */
static int is_within(const grid *g, place head, place other) {
  while (other.level > head.level) other = parent_of_head(g, other);
  return other.level == head.level && other.row == head.row && other.col == head.col;
}

/* Release the pages of all segments but this one and those above it: neighbours are read again where they are needed. */
static void forget_others(twz_file *f, place head) {
  for (size_t i = 0; i < f->segments.n_slots; i++) {
    for (entry *e = f->segments.slots[i], *next; e; e = next) {
      next = e->next;
      if (is_within(&f->grid, e->at, head)) continue;
      table_remove(&f->segments, e);
      twz_release(&f->allocator, e);
    }
  }
}

/* The lines of units first ... last of an axis, and one beyond them on the sides that are asked for. */
static void lines_of(const grid *g, uint32_t n, int key_level, int level, uint32_t first, uint32_t last, int is_more_after,
                     uint32_t *start, uint32_t *n_lines) {
  uint32_t size = level_size(g, n, level), n_units = key_level < 0 ? 1 : n_blocks(g, n, key_level);
  int shift = g->block_log2 + level - max_i32(key_level, 0);
  uint32_t end = last + 1 >= n_units ? size : ((last + 1) << shift) + (uint32_t)is_more_after;
  *start = first ? (first << shift) - 1 : 0;
  *n_lines = end - *start;
}

static twz_status check_units_of(check *c, int level, const twz_box *box, twz_error *error) {
  twz_window *w;
  TRY(report_check(c, error));
  TRY(twz_window_new(c->file, level, box, &w, error));
  twz_status status = twz_window_load(w, c->fetch, c->source, error);
  if (status == TWZ_OK) status = twz_window_decode(w, &c->workers, error);
  if (status == TWZ_OK) status = check_window(w, error);
  twz_window_free(w);
  return status;
}

/* Is there a segment `down` and `right` of this one whose units are all void, as it is absent? */
static twz_status find_absent(check *c, place head, uint32_t down, uint32_t right, int *is_absent, twz_error *error) {
  const grid *g = &c->file->grid;
  place other = {head.level, head.row + down, head.col + right};
  *is_absent = 0;
  if (head.level < 0 || other.row >= n_blocks(g, g->n_rows, head.level) || other.col >= n_blocks(g, g->n_cols, head.level)) return TWZ_OK;
  segment *s;
  TRY(find_loaded(c, other, &s, error));
  *is_absent = s == NULL;
  return TWZ_OK;
}

/*
 * Decode the units of a segment, a row of them at a time, beside those above and to the left, with which they share
 * samples; and beside those below and to the right that no segment lists.
 */
static twz_status check_segment(check *c, place head, const segment *s, twz_error *error) {
  const grid *g = &c->file->grid;
  int is_open_below, is_open_right;
  TRY(find_absent(c, head, 1, 0, &is_open_below, error));
  TRY(find_absent(c, head, 0, 1, &is_open_right, error));
  int last_level = s->keys[s->n_keys - 1].level;
  for (int key_level = head.level; key_level <= last_level; key_level++) {
    place key = {key_level, 0, 0};
    if (key_level_of(g, first_level_of(key)) != key_level) continue; /* in a tile */
    int level = last_level_of(g, key);
    int down = key_level - max_i32(head.level, 0);
    uint32_t top = 0, bottom = 0, left = 0, right = 0;
    if (key_level >= 0) {
      place block = {0, 0, 0};
      if (head.level >= 0) block = head;
      top = block.row << down;
      left = block.col << down;
      bottom = min_u32(((block.row + 1) << down) - 1, n_blocks(g, g->n_rows, key_level) - 1);
      right = min_u32(((block.col + 1) << down) - 1, n_blocks(g, g->n_cols, key_level) - 1);
    }
    for (uint32_t row = top; row <= bottom; row++) {
      twz_box box;
      lines_of(g, g->n_rows, key_level, level, row, row, row == bottom && is_open_below, &box.row, &box.n_rows);
      lines_of(g, g->n_cols, key_level, level, left, right, is_open_right, &box.col, &box.n_cols);
      TRY(check_units_of(c, level, &box, error));
    }
  }
  for (int i = 0; i < s->n_keys; i++) c->n_done += s->payloads[i].length;
  forget_others(c->file, head);
  return TWZ_OK;
}

static twz_status check_below(check *c, place head, twz_error *error) {
  segment *s;
  TRY(find_loaded(c, head, &s, error));
  TRY(check_segment(c, head, s, error));
  for (int i = 0; i < s->n_heads; i++) {
    if (s->children[i].page_length) TRY(check_below(c, s->heads[i], error));
  }
  return TWZ_OK;
}

twz_status twz_file_check(twz_file *f, twz_fetch fetch, void *source, const twz_workers *workers, twz_error *error) {
  if (!f->is_open) return twz_fail(error, TWZ_NOT_READY, "the file is not open yet");
  check c = {.file = f, .workers = TWZ_WORKERS, .told = TWZ_WORKERS, .fetch = fetch, .source = source};
  if (workers) TRY(take_sized(&c.workers, sizeof c.workers, workers, "twz_workers", error));
  c.told = c.workers;
  c.workers.report = NULL;
  const place top = {-1, 0, 0};
  twz_status status = check_bytes(&c, (segment *)table_find(&f->segments, top), error);
  if (status == TWZ_OK) c.n_done = f->file_size;
  if (status == TWZ_OK) status = check_below(&c, top, error);
  if (status == TWZ_OK && f->grid.has_digests) status = check_heights(&c, error);
  twz_release(&f->allocator, c.buffer);
  return status;
}
