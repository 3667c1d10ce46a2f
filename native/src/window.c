/* Windows: which units they need, which bytes these need, decoding and copying out (FORMAT §11). */
#include <stdlib.h>

#include "rapid.h"

enum { MOST_STAGES = 28 };

typedef enum state { UNUSED, WANTED, PLACED, FED, DECODED } state;

typedef struct slot {
  state state;
  section_place place;
  const uint8_t *payload;
  int is_borrowed; /* the payload is in the file's memory */
  unit *unit;
  part wanted; /* of the region; nothing: it is not wanted yet */
} slot;

/* The units of one level of keys, a rectangle of them; the finest stage is the first. */
typedef struct stage {
  int level; /* of the keys */
  uint32_t row, col, n_rows, n_cols;
  slot *slots;
} stage;

struct twz_window {
  twz_file *file;
  int level;
  twz_box box;
  int n_stages, is_planned, is_placed, is_decoded, is_spent;
  int is_sparse; /* units are wanted one by one */
  stage stages[MOST_STAGES];
  uint64_t own_bytes, *n_bytes; /* decoded units and payloads, of this window or of several */
  /* Slots that wait for payloads, by offset. */
  slot **waiting;
  size_t n_waiting, first_waiting;
};

static size_t n_slots(const stage *s) { return (size_t)s->n_rows * s->n_cols; }

static place key_at(const stage *s, size_t i) {
  place key = {s->level, s->row + (uint32_t)(i / s->n_cols), s->col + (uint32_t)(i % s->n_cols)};
  return key;
}

static slot *slot_at(const stage *s, place key) {
  return &s->slots[(size_t)(key.row - s->row) * s->n_cols + (key.col - s->col)];
}

/* The number of the unit that holds a line of a level, along an axis of n samples of the full grid. */
static uint32_t unit_of_line(const grid *g, uint32_t n, int key_level, int level, uint32_t line) {
  if (key_level < 0) return 0;
  int shift = g->block_log2 + level - key_level;
  return min_u32(line >> shift, n_blocks(g, n, key_level) - 1);
}

place unit_of_sample(const grid *g, int level, uint32_t row, uint32_t col) {
  int key_level = key_level_of(g, level);
  place key = {key_level, unit_of_line(g, g->n_rows, key_level, level, row), unit_of_line(g, g->n_cols, key_level, level, col)};
  return key;
}

/* ---- Beginning ---- */

static void plan_stages(twz_window *w) {
  const grid *g = &w->file->grid;
  stage *s = w->stages;
  const twz_box *b = &w->box;
  s->level = key_level_of(g, w->level);
  s->row = unit_of_line(g, g->n_rows, s->level, w->level, b->row);
  s->col = unit_of_line(g, g->n_cols, s->level, w->level, b->col);
  s->n_rows = unit_of_line(g, g->n_rows, s->level, w->level, b->row + b->n_rows - 1) - s->row + 1;
  s->n_cols = unit_of_line(g, g->n_cols, s->level, w->level, b->col + b->n_cols - 1) - s->col + 1;
  w->n_stages = 1;
  while (s->level >= 0) {
    place first = {s->level, s->row, s->col};
    place last = {s->level, s->row + s->n_rows - 1, s->col + s->n_cols - 1};
    first = parent_unit(g, first);
    last = parent_unit(g, last);
    s++;
    s->level = first.level;
    s->row = first.row;
    s->col = first.col;
    s->n_rows = last.row - first.row + 1;
    s->n_cols = last.col - first.col + 1;
    w->n_stages++;
  }
}

static twz_status new_window(twz_file *file, int level, const twz_box *box, uint64_t *n_bytes, twz_window **window, twz_error *error) {
  *window = NULL;
  TRY(level_number(file, level, &level, error));
  const grid *g = &file->grid;
  uint32_t n_rows = level_size(g, g->n_rows, level), n_cols = level_size(g, g->n_cols, level);
  twz_box all = {0, 0, n_rows, n_cols};
  if (!box) box = &all;
  if (box->n_rows == 0 || box->n_cols == 0 || box->row >= n_rows || box->col >= n_cols ||
      box->n_rows > n_rows - box->row || box->n_cols > n_cols - box->col) {
    return twz_fail(error, TWZ_BAD_ARGUMENT,
                    "a window of %u x %u samples from row %u, column %u on; level %d has %u x %u", box->n_rows,
                    box->n_cols, box->row, box->col, level, n_rows, n_cols);
  }
  twz_window *w = twz_allocate_zeros(&file->allocator, sizeof *w);
  if (!w) return twz_no_memory(error, sizeof *w);
  w->file = file;
  w->level = level;
  w->box = *box;
  w->is_sparse = n_bytes != NULL;
  w->n_bytes = n_bytes ? n_bytes : &w->own_bytes;
  plan_stages(w);
  for (int i = 0; i < w->n_stages; i++) {
    stage *s = &w->stages[i];
    uint64_t n = (uint64_t)s->n_rows * s->n_cols;
    twz_status status = TWZ_OK;
    *w->n_bytes += n * sizeof(slot);
    if (*w->n_bytes > file->max_bytes || n > SIZE_MAX / sizeof(slot)) {
      status = twz_fail(error, TWZ_LIMIT, "a window of %llu units: read it in parts", (unsigned long long)n);
    } else {
      s->slots = twz_allocate_zeros(&file->allocator, n_slots(s) * sizeof(slot));
      if (!s->slots) status = twz_no_memory(error, n_slots(s) * sizeof(slot));
    }
    if (status != TWZ_OK) {
      twz_window_free(w);
      return status;
    }
  }
  *window = w;
  return TWZ_OK;
}

twz_status twz_window_new(twz_file *file, int level, const twz_box *box, twz_window **window, twz_error *error) {
  return new_window(file, level, box, NULL, window, error);
}

twz_status sparse_window_new(twz_file *f, int level, const twz_box *box, uint64_t *n_bytes, twz_window **window, twz_error *error) {
  return new_window(f, level, box, n_bytes, window, error);
}

static void release_payload(twz_file *f, slot *one) {
  if (!one->is_borrowed) twz_release(&f->allocator, (void *)(uintptr_t)one->payload);
  one->payload = NULL;
}

/* Leave all units and payloads. */
static void empty_slots(twz_window *w) {
  for (int i = 0; i < w->n_stages; i++) {
    stage *s = &w->stages[i];
    for (size_t k = 0; s->slots && k < n_slots(s); k++) {
      if (s->slots[k].unit) cache_leave(w->file, s->slots[k].unit);
      release_payload(w->file, &s->slots[k]);
      memset(&s->slots[k], 0, sizeof s->slots[k]);
    }
  }
}

void twz_window_free(twz_window *w) {
  if (!w) return;
  twz_file *f = w->file;
  empty_slots(w);
  for (int i = 0; i < w->n_stages; i++) twz_release(&f->allocator, w->stages[i].slots);
  twz_release(&f->allocator, w->waiting);
  twz_release(&f->allocator, w);
}

/* ---- What is needed ---- */

/* The part of a unit's region that lies in rows and columns of a level, not with the last ones. */
static part part_of_unit(const grid *g, place key, int level, int64_t row, int64_t col, int64_t end_row, int64_t end_col) {
  axis rows, cols;
  unit_axes(g, key, level, &rows, &cols);
  part p;
  p.row = (int32_t)clamp_i64(row - rows.first, 0, rows.n);
  p.col = (int32_t)clamp_i64(col - cols.first, 0, cols.n);
  p.end_row = (int32_t)clamp_i64(end_row - rows.first, 0, rows.n);
  p.end_col = (int32_t)clamp_i64(end_col - cols.first, 0, cols.n);
  return p;
}

void window_want(twz_window *w, place key, int64_t row, int64_t col, int64_t end_row, int64_t end_col) {
  slot *one = slot_at(w->stages, key);
  one->state = WANTED;
  one->wanted = part_of_unit(&w->file->grid, key, w->level, row, col, end_row, end_col);
}

const unit *window_unit(const twz_window *w, place key) { return slot_at(w->stages, key)->unit; }

static part all_of_unit(const grid *g, place key, int level) { return part_of_unit(g, key, level, 0, 0, INT64_MAX / 2, INT64_MAX / 2); }

/*
 * A part of a unit of rapid follows from a part of its parent's samples, unless samples are moved from nodata, which are
 * counted. A unit most of which is wanted is of a reader that goes on: it gets all.
 */
static part worth_decoding(const twz_file *f, place key, part wanted) {
  part all = all_of_unit(&f->grid, key, first_level_of(key));
  int64_t n = (int64_t)(wanted.end_row - wanted.row) * (wanted.end_col - wanted.col), n_all = (int64_t)all.end_row * all.end_col;
  if (f->header.method != TWZ_RAPID || f->heights.first <= f->heights.last || key.level < 0) return all;
  return 4 * n > 3 * n_all ? all : wanted;
}

/* Want what a part of a unit follows from of the unit above it: the rows that its strips need, in all columns (R.5). */
static void want_parent(const twz_file *f, slot *above, place parent, place key, part wanted, int n_bands) {
  const grid *g = &f->grid;
  int64_t row = (int64_t)key.row << g->block_log2, col = (int64_t)key.col << g->block_log2, size = (int64_t)1 << g->block_log2;
  int64_t first = 0, end = INT64_MAX / 2;
  if (f->header.method == TWZ_RAPID) {
    int32_t n_rows = all_of_unit(g, key, key.level + 1).end_row;
    first = row + STRIP * rapid_band(n_rows, rapid_first_band(n_rows, wanted.row, n_bands), n_bands) - 2;
    end = row + min_i64(size + 1, ((wanted.end_row + 1) / 2 + 1 + STRIP) / STRIP * STRIP + 2);
  }
  part p = part_of_unit(g, parent, key.level, max_i64(first, row), col, end, col + size + 1), *w = &above->wanted;
  if (w->end_row == 0) *w = p;
  w->row = min_i32(w->row, p.row);
  w->col = min_i32(w->col, p.col);
  w->end_row = max_i32(w->end_row, p.end_row);
  w->end_col = max_i32(w->end_col, p.end_col);
}

/* Count bytes of the window; an error counts none, so that the next try ends alike. */
static twz_status count_bytes(twz_window *w, uint64_t n, twz_error *error) {
  if (n > w->file->max_bytes - min_u64(*w->n_bytes, w->file->max_bytes)) {
    return twz_fail(error, TWZ_LIMIT, "a window that takes more than %llu bytes of memory: read it in parts",
                    (unsigned long long)w->file->max_bytes);
  }
  *w->n_bytes += n;
  return TWZ_OK;
}

/* Find which units must be decoded: those that the cache lacks, and what they follow from. */
static twz_status plan_units(twz_window *w, twz_error *error) {
  twz_file *f = w->file;
  uint64_t n_before = *w->n_bytes;
  for (int i = 0; i < w->n_stages; i++) {
    stage *s = &w->stages[i];
    for (size_t k = 0; k < n_slots(s); k++) {
      slot *one = &s->slots[k];
      place key = key_at(s, k);
      int level = i ? w->stages[i - 1].level : w->level;
      const twz_box *b = &w->box;
      if (i == 0 && !w->is_sparse) {
        one->state = WANTED;
        one->wanted = part_of_unit(&f->grid, key, level, b->row, b->col, (int64_t)b->row + b->n_rows, (int64_t)b->col + b->n_cols);
      }
      if (one->state != WANTED) continue;
      one->wanted = worth_decoding(f, key, one->wanted);
      one->unit = cache_take(f, key, &one->wanted);
      if (one->unit) {
        one->state = DECODED;
        continue;
      }
      if (count_bytes(w, unit_bytes(f, key), error) != TWZ_OK) {
        empty_slots(w);
        *w->n_bytes = n_before;
        return TWZ_LIMIT;
      }
      if (i + 1 < w->n_stages) {
        place parent = parent_unit(&f->grid, key);
        slot *above = slot_at(s + 1, parent);
        above->state = WANTED;
        want_parent(f, above, parent, key, one->wanted, 1); /* with payloads, less may be known to be enough */
      }
    }
  }
  w->is_planned = 1;
  return TWZ_OK;
}

static int compare_slots(const void *a, const void *b) {
  const slot *x = *(const slot *const *)a, *y = *(const slot *const *)b;
  return x->place.offset < y->place.offset ? -1 : x->place.offset > y->place.offset;
}

static twz_status wait_for_payloads(twz_window *w, twz_error *error) {
  size_t n = 0;
  for (int i = 0; i < w->n_stages; i++) {
    for (size_t k = 0; k < n_slots(&w->stages[i]); k++) n += w->stages[i].slots[k].state == PLACED;
  }
  twz_release(&w->file->allocator, w->waiting);
  w->n_waiting = 0;
  w->waiting = twz_allocate(&w->file->allocator, n * sizeof *w->waiting);
  if (!w->waiting) return twz_no_memory(error, n * sizeof *w->waiting);
  for (int i = 0; i < w->n_stages; i++) {
    for (size_t k = 0; k < n_slots(&w->stages[i]); k++) {
      slot *one = &w->stages[i].slots[k];
      if (one->state == PLACED) w->waiting[w->n_waiting++] = one;
    }
  }
  qsort(w->waiting, n, sizeof *w->waiting, compare_slots);
  for (size_t i = 1; i < n; i++) {
    const section_place *before = &w->waiting[i - 1]->place, *after = &w->waiting[i]->place;
    REQUIRE(before->offset + before->length <= after->offset, error, "payloads of two units overlap at byte %llu",
            (unsigned long long)after->offset);
  }
  w->first_waiting = 0;
  return TWZ_OK;
}

/*
 * The keys whose pages a unit needs: its own, and of a tile (C.1) those of the units in it, whose payloads
 * must be empty. Number 0 is its own; keys past the raster's edge are in no segment.
 */
static size_t n_keys_of(const grid *g, place key) {
  if (g->tile_levels == 0) return 1;
  int n_levels = key.level < 0 ? g->first_tiles : g->tile_levels;
  return (((size_t)1 << (2 * n_levels)) - 1) / 3 + (key.level < 0);
}

static place key_of(place key, size_t i) {
  if (i == 0) return key;
  if (key.level < 0) {
    place root = {0, 0, 0};
    key = root;
    i--;
  }
  int up = 0;
  for (size_t n = 1; i >= n; n *= 4, up++) i -= n;
  place below = {key.level + up, (key.row << up) + (uint32_t)(i >> up), (key.col << up) + (uint32_t)(i & (((size_t)1 << up) - 1))};
  return below;
}

typedef struct asked {
  twz_range *ranges;
  size_t capacity, n;
} asked;

/* Ask for a page; returns 0 where there is no room. */
static int ask_page(asked *a, const page_place *page) {
  size_t m = 0;
  while (m < a->n && (a->ranges[m].offset != page->offset || a->ranges[m].length != page->length)) m++;
  if (m < a->n) return 1;
  if (m == a->capacity) return 0;
  memset(&a->ranges[m], 0, sizeof a->ranges[m]);
  a->ranges[m].offset = page->offset;
  a->ranges[m].length = page->length;
  a->ranges[m].is_page = 1;
  a->n++;
  return 1;
}

static segment_state lookup(twz_file *f, place key, segment **s, page_place *page, place *missing) {
  file_lock(f);
  segment_state known = find_segment(f, head_of_key(&f->grid, key), s, page, missing);
  file_unlock(f);
  return known;
}

/* Find the place of a unit's payload, or ask for the pages that tell it. */
static twz_status place_unit(twz_window *w, slot *one, place key, asked *a, twz_error *error) {
  twz_file *f = w->file;
  size_t n_keys = n_keys_of(&f->grid, key);
  int is_known = 1;
  for (size_t i = 0; i < n_keys; i++) {
    place missing, part = key_of(key, i);
    segment *s;
    page_place page;
    segment_state known = lookup(f, part, &s, &page, &missing);
    if (known == MISSING) {
      is_known = 0;
      if (!ask_page(a, &page)) return TWZ_OK;
    }
    int m = known == FOUND ? index_of_place(s->keys, s->n_keys, part) : -1;
    if (m < 0) continue;
    if (i == 0) one->place = s->payloads[m];
    REQUIRE(i == 0 || s->payloads[m].length == 0, error, "a payload at a key that heads no tile");
  }
  if (!is_known) return TWZ_OK;
  TRY(count_bytes(w, one->place.length, error));
  one->state = one->place.length ? PLACED : FED;
  return TWZ_OK;
}

/* Find the places of payloads; where pages are missing, write their ranges. */
static twz_status place_units(twz_window *w, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  asked a = {ranges, capacity, 0};
  for (int i = w->n_stages - 1; i >= 0; i--) {
    stage *s = &w->stages[i];
    for (size_t k = 0; k < n_slots(s) && a.n < capacity; k++) {
      if (s->slots[k].state == WANTED) TRY(place_unit(w, &s->slots[k], key_at(s, k), &a, error));
    }
  }
  *n = a.n;
  w->is_placed = a.n == 0;
  return wait_for_payloads(w, error);
}

/* Append the ranges of payloads whose places are known, those that follow each other as one range. */
static void add_payloads(const twz_window *w, twz_range *ranges, size_t capacity, size_t *n) {
  size_t n_pages = *n;
  for (size_t i = w->first_waiting; i < w->n_waiting; i++) {
    const slot *one = w->waiting[i];
    if (one->state != PLACED) continue;
    twz_range *last = *n > n_pages ? &ranges[*n - 1] : NULL;
    if (last && last->offset + last->length == one->place.offset && last->length < (uint64_t)1 << 24) {
      last->length += one->place.length;
      continue;
    }
    if (*n == capacity) break;
    memset(&ranges[*n], 0, sizeof ranges[*n]);
    ranges[*n].offset = one->place.offset;
    ranges[*n].length = one->place.length;
    ++*n;
  }
}

static int compare_ranges(const void *a, const void *b) {
  const twz_range *x = a, *y = b;
  return x->offset < y->offset ? -1 : x->offset > y->offset;
}

static twz_status feed_pages(twz_window *w, uint64_t offset, const uint8_t *bytes, size_t n, twz_error *error);
static twz_status feed_payload(twz_window *w, slot *one, const uint8_t *bytes, twz_error *error);

/* Give a window what it needs of a file in memory. */
static twz_status feed_from_memory(twz_window *w, twz_error *error) {
  const uint8_t *memory = w->file->memory;
  twz_range ranges[16];
  size_t n;
  while (!w->is_placed) {
    TRY(place_units(w, ranges, sizeof ranges / sizeof *ranges, &n, error));
    for (size_t i = 0; i < n; i++) TRY(feed_pages(w, ranges[i].offset, memory + ranges[i].offset, (size_t)ranges[i].length, error));
  }
  for (; w->first_waiting < w->n_waiting; w->first_waiting++) {
    slot *one = w->waiting[w->first_waiting];
    TRY(feed_payload(w, one, memory + one->place.offset, error));
  }
  return TWZ_OK;
}

twz_status twz_window_need(twz_window *w, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  *n = 0;
  if (w->file->memory) {
    if (!w->is_planned) TRY(plan_units(w, error));
    return feed_from_memory(w, error);
  }
  if (capacity == 0) return twz_fail(error, TWZ_BAD_ARGUMENT, "no room for a range");
  if (!w->is_planned) TRY(plan_units(w, error));
  if (!w->is_placed) TRY(place_units(w, ranges, capacity, n, error));
  int has_pages = *n > 0;
  add_payloads(w, ranges, capacity, n);
  if (!has_pages) return TWZ_OK; /* payloads are in order and apart */
  qsort(ranges, *n, sizeof *ranges, compare_ranges);
  for (size_t i = 1; i < *n; i++) {
    REQUIRE(ranges[i - 1].offset + ranges[i - 1].length <= ranges[i].offset, error,
            "pages or payloads of two segments overlap at byte %llu", (unsigned long long)ranges[i].offset);
  }
  return TWZ_OK;
}

/* ---- Feeding ---- */

/* Take the page of a key's segment, or of one above it, if it lies in the bytes and is missing. */
static twz_status feed_page(twz_file *f, place key, uint64_t offset, const uint8_t *bytes, size_t n, twz_error *error) {
  for (;;) {
    segment *known, *read;
    page_place page;
    place missing;
    if (lookup(f, key, &known, &page, &missing) != MISSING || page.offset < offset || page.offset - offset > n ||
        page.length > n - (page.offset - offset)) {
      return TWZ_OK;
    }
    TRY(read_segment(&read, &f->grid, missing, &page, bytes + (page.offset - offset), f->file_size, &f->crc,
                     &f->allocator, error));
    file_lock(f);
    int is_new = !table_find(&f->segments, missing);
    int is_kept = is_new && table_insert(&f->segments, &f->allocator, &read->entry);
    file_unlock(f);
    if (!is_kept) twz_release(&f->allocator, read);
    if (is_new && !is_kept) return twz_no_memory(error, sizeof *read);
  }
}

static twz_status feed_pages(twz_window *w, uint64_t offset, const uint8_t *bytes, size_t n, twz_error *error) {
  for (int i = w->n_stages - 1; i >= 0; i--) {
    stage *s = &w->stages[i];
    for (size_t k = 0; k < n_slots(s); k++) {
      if (s->slots[k].state != WANTED) continue;
      place key = key_at(s, k);
      size_t n_keys = n_keys_of(&w->file->grid, key);
      for (size_t m = 0; m < n_keys; m++) TRY(feed_page(w->file, key_of(key, m), offset, bytes, n, error));
    }
  }
  return TWZ_OK;
}

static twz_status feed_payload(twz_window *w, slot *one, const uint8_t *bytes, twz_error *error) {
  twz_file *f = w->file;
  REQUIRE(crc_matches(&f->crc, bytes, one->place.length, one->place.crc), error,
          "the checksum of a payload is wrong (bytes %llu to %llu)", (unsigned long long)one->place.offset,
          (unsigned long long)(one->place.offset + one->place.length - 1));
  size_t n = one->place.length;
  one->state = FED;
  if (f->memory && f->file_size - one->place.offset - n >= PAYLOAD_SLACK) {
    one->payload = bytes;
    one->is_borrowed = 1;
    return TWZ_OK;
  }
  uint8_t *payload = twz_allocate(&f->allocator, n + PAYLOAD_SLACK);
  if (!payload) {
    one->state = PLACED;
    return twz_no_memory(error, n + PAYLOAD_SLACK);
  }
  memcpy(payload, bytes, n);
  memset(payload + n, 0, PAYLOAD_SLACK);
  one->payload = payload;
  return TWZ_OK;
}

twz_status twz_window_feed(twz_window *w, uint64_t offset, const void *bytes, size_t n, twz_error *error) {
  if (!w->is_planned || offset > w->file->file_size || n > w->file->file_size - offset) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "bytes beyond the end of the file, or before any were needed");
  }
  if (!w->is_placed) TRY(feed_pages(w, offset, bytes, n, error));
  size_t low = w->first_waiting, high = w->n_waiting;
  while (low < high) { /* the first slot at or after offset */
    size_t middle = low + (high - low) / 2;
    if (w->waiting[middle]->place.offset < offset) low = middle + 1; else high = middle;
  }
  for (; low < w->n_waiting; low++) {
    slot *one = w->waiting[low];
    uint64_t at = one->place.offset - offset;
    if (at >= n) break;
    if (one->state == PLACED && one->place.length <= n - at) {
      TRY(feed_payload(w, one, (const uint8_t *)bytes + at, error));
    }
  }
  while (w->first_waiting < w->n_waiting && w->waiting[w->first_waiting]->state != PLACED) w->first_waiting++;
  return TWZ_OK;
}

static twz_status window_need(void *w, twz_range *ranges, size_t capacity, size_t *n, twz_error *error) {
  return twz_window_need(w, ranges, capacity, n, error);
}
static twz_status window_feed(void *w, uint64_t offset, const void *bytes, size_t n, twz_error *error) {
  return twz_window_feed(w, offset, bytes, n, error);
}

twz_status twz_window_load(twz_window *w, twz_fetch fetch, void *source, twz_error *error) {
  return load_all(&w->file->allocator, window_need, window_feed, w, fetch, source, error);
}

/* ---- Copying out ---- */

/* What is wanted of a window: arrays from the first sample of a box on. */
typedef struct output {
  uint8_t *heights, *valid, *own;
  ptrdiff_t heights_stride, valid_stride, own_stride;
} output;

/* Copy the part of a unit's core that lies in the box. */
static twz_status copy_unit(const twz_window *w, const unit *u, const twz_box *b, const twz_box *part,
                            const output *out, twz_error *error) {
  const twz_file *f = w->file;
  const layer *l = &u->layers[w->level - u->first_level];
  size_t size = dtype_size(f->header.dtype);
  for (uint32_t row = part->row; row < part->row + part->n_rows; row++) {
    size_t at = (size_t)(row - l->rows.first) * (size_t)l->cols.n + (part->col - l->cols.first);
    ptrdiff_t to_row = (ptrdiff_t)(row - b->row);
    size_t to_col = part->col - b->col;
    if (out->heights && u->is_written) {
      fill_voids(&f->heights, out->heights + to_row * out->heights_stride + to_col * size, l, at, part->n_cols);
    } else if (out->heights) {
      TRY(write_raw(&f->heights, out->heights + to_row * out->heights_stride + to_col * size, u->is_void ? NULL : l, at,
                    part->n_cols, error));
    }
    const uint8_t *own = l->own ? l->own : l->valid;
    struct { uint8_t *to; const uint8_t *from; } copies[2] = {
        {out->valid ? out->valid + to_row * out->valid_stride + to_col : NULL, l->valid},
        {out->own ? out->own + to_row * out->own_stride + to_col : NULL, own}};
    for (int i = 0; i < 2; i++) {
      if (!copies[i].to) continue;
      if (u->is_void || !copies[i].from) {
        memset(copies[i].to, !u->is_void, part->n_cols);
      } else {
        memcpy(copies[i].to, copies[i].from + at, part->n_cols);
      }
    }
  }
  return TWZ_OK;
}

/* The lines from `first` on, of n, that unit number i of an axis gives: up to the next unit's first. */
static void part_of_axis(const stage *s, int level, const grid *g, uint32_t i, int is_last, uint32_t *first, uint32_t *n) {
  if (s->level < 0) return;
  int shift = g->block_log2 + level - s->level;
  uint64_t begin = (uint64_t)i << shift, end = is_last ? UINT64_MAX : ((uint64_t)i + 1) << shift;
  uint64_t stop = min_u64((uint64_t)*first + *n, end);
  if (begin < *first) begin = *first;
  *first = (uint32_t)begin;
  *n = (uint32_t)(stop - begin);
}

/* What a unit gives to the window's box; is it all that it gives to any? */
static int has_core(const twz_window *w, place key, twz_box *own) {
  const grid *g = &w->file->grid;
  const stage *s = &w->stages[0];
  twz_box all = {0, 0, level_size(g, g->n_rows, w->level), level_size(g, g->n_cols, w->level)};
  uint32_t last_row = key.level < 0 ? 0 : n_blocks(g, g->n_rows, key.level) - 1, last_col = key.level < 0 ? 0 : n_blocks(g, g->n_cols, key.level) - 1;
  *own = w->box;
  part_of_axis(s, w->level, g, key.row, key.row == last_row, &own->row, &own->n_rows);
  part_of_axis(s, w->level, g, key.col, key.col == last_col, &own->col, &own->n_cols);
  part_of_axis(s, w->level, g, key.row, key.row == last_row, &all.row, &all.n_rows);
  part_of_axis(s, w->level, g, key.col, key.col == last_col, &all.col, &all.n_cols);
  return memcmp(own, &all, sizeof all) == 0;
}

/* ---- Decoding ---- */

typedef struct decoding {
  twz_window *window;
  const output *output; /* where units of the window's level go at once; NULL: nowhere */
  stage *stage;
  size_t *todo, first;  /* slots of the stage; the first one that this round decodes */
  twz_workers workers;
  uint64_t n_done, n_all; /* units */
  scratch *scratches;   /* one a worker */
  twz_error *errors;    /* one a worker; the first is kept */
} decoding;

static void decode_one(void *argument, size_t index, size_t worker) {
  decoding *d = argument;
  twz_file *f = d->window->file;
  twz_error *error = &d->errors[worker];
  if (error->status != TWZ_OK) return;
  size_t number = d->todo[d->first + index];
  slot *one = &d->stage->slots[number];
  place key = key_at(d->stage, number);
  order o = {NULL, NULL, one->payload, one->place.length, NULL, 0};
  twz_box own;
  const output *out = d->stage == d->window->stages && has_core(d->window, key, &own) ? d->output : NULL;
  if (key.level >= 0) o.above = slot_at(d->stage + 1, parent_unit(&f->grid, key))->unit;
  o.unit = twz_allocate_zeros(&f->allocator, sizeof *o.unit);
  if (!o.unit) {
    twz_no_memory(error, sizeof *o.unit);
    return;
  }
  o.unit->entry.at = key;
  o.unit->layers[0].ready = one->wanted;
  o.unit->n_users = 1;
  if (out && out->heights) { /* the core alone: what it shares is another unit's to write */
    const twz_box *all = &d->window->box;
    o.unit->layers[0].ready = part_of_unit(&f->grid, key, d->window->level, own.row, own.col, (int64_t)own.row + own.n_rows, (int64_t)own.col + own.n_cols);
    o.target = out->heights + (ptrdiff_t)(own.row - all->row) * out->heights_stride + (own.col - all->col) * dtype_size(f->header.dtype);
    o.target_stride = out->heights_stride;
  }
  twz_status status = decode_unit(f, &o, &d->scratches[worker], error);
  if (status == TWZ_OK && out) status = copy_unit(d->window, o.unit, &d->window->box, &own, out, error);
  if (status == TWZ_OK && !out) {
    one->unit = o.unit;
  } else {
    unit_free(f, o.unit);
  }
}

/* Decode n units of the stage, from number `first` of those to do. */
static twz_status decode_some(decoding *d, size_t first, size_t n, twz_error *error) {
  const twz_workers *workers = &d->workers;
  twz_file *f = d->window->file;
  d->first = first;
  if (workers->run && n > 1) {
    workers->run(workers->context, n, decode_one, d);
  } else {
    for (size_t i = 0; i < n; i++) decode_one(d, i, 0);
  }
  twz_status status = TWZ_OK;
  for (size_t i = 0; i < workers->n_workers && status == TWZ_OK; i++) {
    if (d->errors[i].status != TWZ_OK) status = twz_fail(error, d->errors[i].status, "%s", d->errors[i].text);
  }
  for (size_t i = first; i < first + n; i++) {
    slot *one = &d->stage->slots[d->todo[i]];
    if (one->unit) one->unit = cache_give(f, one->unit);
    if (!one->unit && !d->output) continue;
    release_payload(f, one);
    one->state = DECODED;
  }
  d->n_done += n;
  return status;
}

static twz_status decode_stage(decoding *d, twz_error *error) {
  /* Units that are decoded between two reports, by each worker: they wait for the last of them. */
  enum { MOST_UNTOLD = 16 };
  stage *s = d->stage;
  twz_file *f = d->window->file;
  size_t n = 0;
  for (size_t k = 0; k < n_slots(s); k++) {
    slot *one = &s->slots[k];
    if (one->state == WANTED || one->state == PLACED) {
      return twz_fail(error, TWZ_NOT_READY, "bytes of the window are missing: need, fetch and feed first");
    }
    if (one->state != FED) continue;
    part wanted = one->wanted;
    one->unit = cache_take(f, key_at(s, k), &wanted); /* another window may have decoded it meanwhile */
    if (one->unit) {
      release_payload(f, one);
      one->state = DECODED;
      d->n_done++;
    } else {
      d->todo[n++] = k;
    }
  }
  size_t most = d->workers.report ? MOST_UNTOLD * d->workers.n_workers : n;
  for (size_t first = 0; first < n; first += most) {
    TRY(report(&d->workers, d->n_done, d->n_all, error));
    TRY(decode_some(d, first, min_size(most, n - first), error));
  }
  return TWZ_OK;
}

/* Now that payloads are there: want of each unit what those below it need, with the bands that they have. */
static void want_less(twz_window *w) {
  const twz_file *f = w->file;
  for (int i = 0; f->header.method == TWZ_RAPID && i + 1 < w->n_stages; i++) {
    stage *s = &w->stages[i];
    for (size_t k = 0; k < n_slots(s + 1); k++) s[1].slots[k].wanted = (part){0, 0, 0, 0};
    for (size_t k = 0; k < n_slots(s); k++) {
      const slot *one = &s->slots[k];
      place key = key_at(s, k), parent = parent_unit(&f->grid, key);
      if (one->state != FED || !one->payload) continue;
      want_parent(f, slot_at(s + 1, parent), parent, key, one->wanted, rapid_bands(f, one->payload, one->place.length));
    }
    for (size_t k = 0; k < n_slots(s + 1); k++) {
      slot *above = &s[1].slots[k];
      place key = key_at(s + 1, k);
      if (above->state != FED) continue;
      /* Where all below is void, nothing is wanted: it is decoded as a whole, and so must be what is above it. */
      above->wanted = above->wanted.end_row ? worth_decoding(f, key, above->wanted) : all_of_unit(&f->grid, key, s->level);
    }
  }
}

/* Memory of a worker outlives its window: to map it anew takes as long as to decode a unit. */
static void exchange_idle(twz_file *f, scratch *s) {
  file_lock(f);
  scratch idle = f->idle;
  f->idle = *s;
  *s = idle;
  s->allocator = &f->allocator;
  file_unlock(f);
}

static twz_status decode_window(twz_window *w, const twz_workers *workers, const output *out, twz_error *error) {
  if (w->is_spent) return twz_fail(error, TWZ_BAD_ARGUMENT, "the window was decoded into its caller's memory before: make another");
  if (w->is_decoded) return TWZ_OK;
  decoding d = {.window = w, .output = out, .workers = TWZ_WORKERS};
  if (workers) TRY(take_sized(&d.workers, sizeof d.workers, workers, "twz_workers", error));
  if (!d.workers.run) d.workers.n_workers = 1;
  size_t n_none;
  if (w->file->memory) TRY(twz_window_need(w, NULL, 0, &n_none, error));
  if (!w->is_placed) return twz_fail(error, TWZ_NOT_READY, "the window's bytes are missing: need, fetch and feed first");
  const twz_allocator *a = &w->file->allocator;
  size_t n_workers = d.workers.n_workers, most = 1;
  for (int i = 0; i < w->n_stages; i++) most = max_size(n_slots(&w->stages[i]), most);
  for (int i = 0; i < w->n_stages; i++) {
    for (size_t k = 0; k < n_slots(&w->stages[i]); k++) d.n_all += w->stages[i].slots[k].state == FED;
  }
  d.todo = twz_allocate(a, most * sizeof *d.todo);
  d.scratches = twz_allocate_zeros(a, n_workers * sizeof *d.scratches);
  d.errors = twz_allocate_zeros(a, n_workers * sizeof *d.errors);
  twz_status status = TWZ_OK;
  if (!d.todo || !d.scratches || !d.errors) status = twz_no_memory(error, most * sizeof *d.todo);
  for (size_t i = 0; d.scratches && i < n_workers; i++) d.scratches[i].allocator = a;
  if (d.scratches) exchange_idle(w->file, &d.scratches[0]);
  want_less(w);
  for (int i = w->n_stages - 1; i >= 0 && status == TWZ_OK; i--) {
    d.stage = &w->stages[i];
    status = decode_stage(&d, error);
  }
  if (d.scratches) exchange_idle(w->file, &d.scratches[0]);
  for (size_t i = 0; d.scratches && i < n_workers; i++) scratch_free(&d.scratches[i]);
  twz_release(a, d.todo);
  twz_release(a, d.scratches);
  twz_release(a, d.errors);
  w->is_decoded = status == TWZ_OK && !out;
  w->is_spent = out != NULL;
  return status;
}

twz_status twz_window_decode(twz_window *w, const twz_workers *workers, twz_error *error) {
  return decode_window(w, workers, NULL, error);
}

twz_status twz_window_decode_into(twz_window *w, const twz_workers *workers, void *heights, ptrdiff_t heights_stride,
                                  uint8_t *valid, ptrdiff_t valid_stride, twz_error *error) {
  output out = {heights, valid, NULL, heights_stride, valid_stride, 0};
  if (!heights_stride) out.heights_stride = (ptrdiff_t)(w->box.n_cols * dtype_size(w->file->header.dtype));
  if (!valid_stride) out.valid_stride = (ptrdiff_t)w->box.n_cols;
  TRY(decode_window(w, workers, &out, error));
  stage *s = &w->stages[0];
  for (size_t i = 0; i < n_slots(s); i++) { /* those of the cache, or that stay in it */
    if (!s->slots[i].unit) continue;
    twz_box own;
    has_core(w, key_at(s, i), &own);
    TRY(copy_unit(w, s->slots[i].unit, &w->box, &own, &out, error));
  }
  return TWZ_OK;
}

static twz_status read_box(const twz_window *w, const twz_box *b, const output *out, twz_error *error) {
  if (!w->is_decoded) return twz_fail(error, TWZ_NOT_READY, "the window is not decoded yet");
  const twz_box *all = &w->box;
  if (b->n_rows == 0 || b->n_cols == 0 || b->row < all->row || b->col < all->col ||
      (uint64_t)b->row + b->n_rows > (uint64_t)all->row + all->n_rows ||
      (uint64_t)b->col + b->n_cols > (uint64_t)all->col + all->n_cols) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "a part that is empty or not in the window");
  }
  const grid *g = &w->file->grid;
  const stage *s = &w->stages[0];
  uint32_t top = unit_of_line(g, g->n_rows, s->level, w->level, b->row);
  uint32_t bottom = unit_of_line(g, g->n_rows, s->level, w->level, b->row + b->n_rows - 1);
  uint32_t left = unit_of_line(g, g->n_cols, s->level, w->level, b->col);
  uint32_t right = unit_of_line(g, g->n_cols, s->level, w->level, b->col + b->n_cols - 1);
  for (uint32_t i = top; i <= bottom; i++) {
    for (uint32_t j = left; j <= right; j++) {
      place key = {s->level, i, j};
      twz_box part = *b;
      part_of_axis(s, w->level, g, i, i == bottom, &part.row, &part.n_rows);
      part_of_axis(s, w->level, g, j, j == right, &part.col, &part.n_cols);
      TRY(copy_unit(w, slot_at(s, key)->unit, b, &part, out, error));
    }
  }
  return TWZ_OK;
}

twz_status twz_window_read_part(const twz_window *w, const twz_box *part, void *heights, ptrdiff_t heights_stride,
                                uint8_t *valid, ptrdiff_t valid_stride, twz_error *error) {
  output out = {heights, valid, NULL, heights_stride, valid_stride, 0};
  if (!heights_stride) out.heights_stride = (ptrdiff_t)(part->n_cols * dtype_size(w->file->header.dtype));
  if (!valid_stride) out.valid_stride = (ptrdiff_t)part->n_cols;
  return read_box(w, part, &out, error);
}

twz_status twz_window_read(const twz_window *w, void *heights, ptrdiff_t heights_stride, uint8_t *valid,
                           ptrdiff_t valid_stride, twz_error *error) {
  return twz_window_read_part(w, &w->box, heights, heights_stride, valid, valid_stride, error);
}

twz_status twz_window_read_own_part(const twz_window *w, const twz_box *part, uint8_t *own, ptrdiff_t own_stride,
                                    twz_error *error) {
  output out = {NULL, NULL, own, 0, 0, own_stride ? own_stride : (ptrdiff_t)part->n_cols};
  return read_box(w, part, &out, error);
}

twz_status twz_window_read_own(const twz_window *w, uint8_t *own, ptrdiff_t own_stride, twz_error *error) {
  return twz_window_read_own_part(w, &w->box, own, own_stride, error);
}

/* ---- What units share ---- */

/* What a unit holds of a sample of one of its layers. */
typedef struct held {
  int is_valid, is_own;
  int32_t quantum;
  int64_t remainder;
} held;

static held held_at(const heights *h, const unit *u, const layer *l, uint32_t row, uint32_t col) {
  held found = {0, 0, 0, 0};
  if (u->is_void) return found;
  size_t at = (size_t)(row - l->rows.first) * (size_t)l->cols.n + (col - l->cols.first);
  found.is_valid = is_valid_at(l, at);
  found.is_own = l->own ? l->own[at] : found.is_valid;
  if (found.is_valid) found.quantum = quantum_at(h, l, at);
  if (found.is_valid && l->remainders) found.remainder = l->remainders[at];
  return found;
}

static twz_status compare_units(const twz_file *f, const unit *a, const unit *b, twz_error *error) {
  if (a->is_void && b->is_void) return TWZ_OK;
  for (int i = 0; i < a->n_layers; i++) {
    const layer *x = &a->layers[i], *y = &b->layers[i];
    uint32_t top = max_u32(x->rows.first + (uint32_t)x->ready.row, y->rows.first + (uint32_t)y->ready.row);
    uint32_t left = max_u32(x->cols.first + (uint32_t)x->ready.col, y->cols.first + (uint32_t)y->ready.col);
    uint32_t bottom = min_u32(x->rows.first + (uint32_t)x->ready.end_row, y->rows.first + (uint32_t)y->ready.end_row);
    uint32_t right = min_u32(x->cols.first + (uint32_t)x->ready.end_col, y->cols.first + (uint32_t)y->ready.end_col);
    for (uint32_t row = top; row < bottom; row++) {
      for (uint32_t col = left; col < right; col++) {
        held p = held_at(&f->heights, a, x, row, col), q = held_at(&f->heights, b, y, row, col);
        REQUIRE(p.is_valid == q.is_valid && p.is_own == q.is_own && p.quantum == q.quantum && p.remainder == q.remainder,
                error, "two units of level %d differ in row %u, column %u, which they share", a->first_level + i, row, col);
      }
    }
  }
  return TWZ_OK;
}

/* Remainders can make heights that are not finite. */
static twz_status check_remainders(const twz_file *f, const unit *u, twz_error *error) {
  double row[2 * 1024 + 4];
  const layer *l = &u->layers[0];
  for (int32_t r = 0; l->remainders && r < l->rows.n; r++) {
    TRY(write_raw(&f->heights, row, l, (size_t)r * (size_t)l->cols.n, (size_t)l->cols.n, error));
  }
  return TWZ_OK;
}

twz_status check_window(const twz_window *w, twz_error *error) {
  const stage *s = &w->stages[0];
  for (size_t i = 0; i < n_slots(s); i++) {
    const unit *u = s->slots[i].unit;
    TRY(check_remainders(w->file, u, error));
    if (i % s->n_cols) TRY(compare_units(w->file, s->slots[i - 1].unit, u, error));
    if (i >= s->n_cols) TRY(compare_units(w->file, s->slots[i - s->n_cols].unit, u, error));
  }
  return TWZ_OK;
}

/* ---- Codes of blocks (§4.4) ---- */

static uint64_t decoded_error(int code) { return code ? ((uint64_t)(8 + code % 8) << (code / 8)) / 8 : 0; }

/* The box of a block; the segment of the unit that holds it must be known. */
static twz_status find_block(twz_file *f, place block, twz_block *found, twz_error *error) {
  place keys[32];
  int n = 0;
  place at = block;
  /* Up to the head of the segment, whose box is the file's; then down again. */
  segment *s = NULL;
  for (;;) {
    place key = {-1, 0, 0};
    if (at.level > 0) {
      key.level = at.level - 1;
      key.row = at.row >> 1;
      key.col = at.col >> 1;
    }
    place missing;
    page_place page;
    segment *own;
    int known = (int)lookup(f, key, &own, &page, &missing);
    if (known == MISSING) return twz_fail(error, TWZ_NOT_READY, "the index of the block is missing: load the window first");
    if (known == ABSENT) own = NULL;
    if (n == 0) s = own;
    if (!s || own != s || index_of_place(s->blocks, s->n_blocks, at) < 0) break;
    keys[n++] = at;
    if (at.level == 0) break;
    at = key; /* the key's block */
  }
  int64_t low = f->header.z_min, high = f->header.z_max;
  memset(found, 0, sizeof *found);
  for (int i = n - 1; i >= 0; i--) {
    const block_codes *c = &s->codes[index_of_place(s->blocks, s->n_blocks, keys[i])];
    int64_t size = high - low, below = low;
    low = below + floor_div(c->z_min * size, 255);
    high -= floor_div(c->z_max * size, 255);
    found->error = decoded_error(c->error);
    found->mesh_error = decoded_error(c->mesh_error);
  }
  found->z_min = (int32_t)low;
  found->z_max = (int32_t)high;
  found->raw_min = raw_of_quantum(&f->heights, low);
  found->raw_max = raw_of_quantum(&f->heights, high);
  found->raw_error = (double)found->error * f->info.quantum;
  return TWZ_OK;
}

twz_status twz_window_block(const twz_window *w, uint32_t row, uint32_t col, twz_block *found, twz_error *error) {
  const grid *g = &w->file->grid;
  const twz_box *b = &w->box;
  uint64_t size = (uint64_t)1 << g->block_log2;
  if (row >= n_blocks(g, g->n_rows, w->level) || col >= n_blocks(g, g->n_cols, w->level) ||
      row * size >= (uint64_t)b->row + b->n_rows || (row + 1) * size < b->row ||
      col * size >= (uint64_t)b->col + b->n_cols || (col + 1) * size < b->col) {
    return twz_fail(error, TWZ_BAD_ARGUMENT, "block %u, %u has no sample in the window", row, col);
  }
  place block = {w->level, row, col};
  return find_block(w->file, block, found, error);
}
