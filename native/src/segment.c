/* Segments and their index pages (FORMAT §3). */
#include "internal.h"

enum { DEPTH = 4, MOST_PAGE = 1 << 15, MOST_COLUMNS = 17 * MOST_KEYS + 4 * MOST_BLOCKS + 12 * MOST_HEADS };

/* ---- Tables by place ---- */

static size_t slot_of(const table *t, place at) {
  uint64_t x = (uint64_t)at.row << 32 | at.col;
  x = (x ^ (uint64_t)(at.level + 1) * 0x9E3779B97F4A7C15u) * 0xBF58476D1CE4E5B9u;
  return (size_t)(x >> 32) & (t->n_slots - 1);
}

static int is_same(place a, place b) { return a.level == b.level && a.row == b.row && a.col == b.col; }

entry *table_find(const table *t, place at) {
  if (!t->n_slots) return NULL;
  entry *e = t->slots[slot_of(t, at)];
  while (e && !is_same(e->at, at)) e = e->next;
  return e;
}

int table_insert(table *t, const twz_allocator *a, entry *e) {
  if (t->n >= t->n_slots) {
    table larger = {NULL, t->n_slots ? 2 * t->n_slots : 64, t->n};
    larger.slots = twz_allocate_zeros(a, larger.n_slots * sizeof *larger.slots);
    if (!larger.slots) return 0;
    for (size_t i = 0; i < t->n_slots; i++) {
      while (t->slots[i]) {
        entry *moved = t->slots[i];
        t->slots[i] = moved->next;
        entry **slot = &larger.slots[slot_of(&larger, moved->at)];
        moved->next = *slot;
        *slot = moved;
      }
    }
    twz_release(a, t->slots);
    *t = larger;
  }
  entry **slot = &t->slots[slot_of(t, e->at)];
  e->next = *slot;
  *slot = e;
  t->n++;
  return 1;
}

void table_remove(table *t, entry *e) {
  entry **at = &t->slots[slot_of(t, e->at)];
  while (*at != e) at = &(*at)->next;
  *at = e->next;
  t->n--;
}

/* ---- Which keys belong together (§3.1) ---- */

static int first_heads(const grid *g) { return g->k_max < DEPTH ? g->k_max : g->k_max % DEPTH; }

place head_of_key(const grid *g, place key) {
  int t = first_heads(g);
  place head = {-1, 0, 0};
  if (key.level < t) return head;
  int up = (key.level - t) % DEPTH;
  head.level = key.level - up;
  head.row = key.row >> up;
  head.col = key.col >> up;
  return head;
}

place parent_of_head(const grid *g, place head) {
  place up = {-1, 0, 0};
  if (head.level < first_heads(g) + DEPTH) return up;
  up.level = head.level - DEPTH;
  up.row = head.row >> DEPTH;
  up.col = head.col >> DEPTH;
  return up;
}

int index_of_place(const place *places, int n, place p) {
  for (int i = 0; i < n; i++) {
    if (is_same(places[i], p)) return i;
  }
  return -1;
}

segment_state find_segment(const twz_file *f, place head, segment **s, page_place *page, place *missing) {
  *s = (segment *)table_find(&f->segments, head);
  if (*s) return FOUND;
  place parent = parent_of_head(&f->grid, head);
  segment_state above = find_segment(f, parent, s, page, missing);
  if (above != FOUND) return above;
  const segment *p = *s;
  int i = index_of_place(p->heads, p->n_heads, head);
  if (i < 0 || p->children[i].page_length == 0) return ABSENT;
  *missing = child_page(p, i, page);
  return MISSING;
}

place child_page(const segment *s, int i, page_place *page) {
  page->offset = s->children[i].page;
  page->length = s->children[i].page_length;
  page->body = s->children[i].offset;
  page->end = page->body + s->children[i].length;
  page->siblings_end = s->children_end;
  return s->heads[i];
}

/* Append the children of a block, in Morton order; return how many there are now. */
static int add_children(const grid *g, place block, place *to, int n) {
  uint32_t n_rows = n_blocks(g, g->n_rows, block.level + 1), n_cols = n_blocks(g, g->n_cols, block.level + 1);
  for (uint32_t i = 0; i < 4; i++) {
    place child = {block.level + 1, 2 * block.row + (i >> 1), 2 * block.col + (i & 1)};
    if (child.row < n_rows && child.col < n_cols) to[n++] = child;
  }
  return n;
}

void lay_out_segment(segment_layout *l, const grid *g, place head) {
  int is_top = head.level < 0, n_levels = is_top ? first_heads(g) : DEPTH;
  place root = {0, 0, 0}, row[MOST_HEADS];
  int n_row = 1;
  row[0] = is_top ? root : head;
  l->n_keys = l->n_blocks = l->n_heads = 0;
  if (is_top) {
    l->keys[l->n_keys++] = head;
    l->blocks[l->n_blocks++] = root;
  }
  for (int i = 0; i < n_levels; i++) {
    place below[MOST_HEADS];
    int n_below = 0;
    for (int k = 0; k < n_row; k++) {
      l->keys[l->n_keys++] = row[k];
      l->n_blocks = add_children(g, row[k], l->blocks, l->n_blocks);
      n_below = add_children(g, row[k], below, n_below);
    }
    memcpy(row, below, sizeof *row * (size_t)n_below);
    n_row = n_below;
  }
  if (row[0].level < g->k_max) {
    memcpy(l->heads, row, sizeof *row * (size_t)n_row);
    l->n_heads = n_row;
  }
}

void order_of_file(const segment_layout *l, int *order) {
  int first = l->keys[0].level, n = 0;
  for (int i = 0; i < l->n_keys; i++) {
    if (l->keys[i].level == first) order[n++] = i;
  }
  for (int i = 0; i < l->n_keys; i++) {
    if (l->keys[i].level != first + 1) continue;
    order[n++] = i;
    for (int k = 0; k < l->n_keys; k++) {
      const place *below = &l->keys[k], *above = &l->keys[i];
      if (below->level == first + 2 && below->row >> 1 == above->row && below->col >> 1 == above->col) order[n++] = k;
    }
  }
  for (int i = l->n_keys - 1; i >= 0; i--) {
    if (l->keys[i].level == first + 3) order[n++] = i;
  }
}

/* ---- Pages (§3.3) ---- */

/* Number i of a column of n numbers of `width` bytes, which is stored in planes. */
static uint64_t number_at(const uint8_t *column, int n, int width, int i) {
  uint64_t value = 0;
  for (int plane = 0; plane < width; plane++) value |= (uint64_t)column[plane * n + i] << (8 * plane);
  return value;
}

typedef struct columns {
  const uint8_t *payload_length, *mesh_length, *flags, *codes, *page_length, *child_length, *payload_crc, *mesh_crc;
} columns;

static void split_columns(columns *c, const uint8_t *content, const segment_layout *l) {
  c->payload_length = content;
  c->mesh_length = c->payload_length + 4 * l->n_keys;
  c->flags = c->mesh_length + 4 * l->n_keys;
  c->codes = c->flags + l->n_keys;
  c->page_length = c->codes + 4 * l->n_blocks;
  c->child_length = c->page_length + 4 * l->n_heads;
  c->payload_crc = c->child_length + 8 * l->n_heads;
  c->mesh_crc = c->payload_crc + 4 * l->n_keys;
}

static twz_status place_sections(segment *s, const segment_layout *l, const columns *c, uint64_t *at, twz_error *error) {
  int order[MOST_KEYS], n = l->n_keys;
  order_of_file(l, order);
  for (int k = 0; k < n; k++) {
    int i = order[k];
    uint64_t length = number_at(c->payload_length, n, 4, i), mesh = number_at(c->mesh_length, n, 4, i);
    uint64_t crc = number_at(c->payload_crc, n, 4, i), mesh_crc = number_at(c->mesh_crc, n, 4, i);
    REQUIRE(length < 1u << 31 && mesh < 1u << 31, error, "a payload or mesh of 2^31 bytes or more");
    REQUIRE(length || !crc, error, "an empty payload with a checksum");
    REQUIRE(mesh || !mesh_crc, error, "an empty mesh section with a checksum");
    REQUIRE_KNOWN(c->flags[i] == 0, error, "flags %d of a key, which a newer release may know", c->flags[i]);
    const section_place payload = {*at, (uint32_t)length, (uint32_t)crc}, mesh_section = {*at + length, (uint32_t)mesh, (uint32_t)mesh_crc};
    s->payloads[i] = payload;
    s->meshes[i] = mesh_section;
    *at += length + mesh;
  }
  return TWZ_OK;
}

/* Place the pages of children, which begin at *at. */
static twz_status place_pages(segment *s, const segment_layout *l, const columns *c, uint64_t *at, twz_error *error) {
  for (int i = 0; i < l->n_heads; i++) {
    uint64_t page = number_at(c->page_length, l->n_heads, 4, i);
    REQUIRE(page == 0 || (page >= 13 && page <= MOST_PAGE), error, "a child's page of %llu bytes",
            (unsigned long long)page);
    s->children[i].page = *at;
    s->children[i].page_length = (uint32_t)page;
    *at += page;
  }
  return TWZ_OK;
}

/* Place the bodies of children. */
static twz_status place_children(segment *s, const segment_layout *l, const columns *c, uint64_t first, uint64_t most,
                                 twz_error *error) {
  uint64_t at = first;
  for (int i = 0; i < l->n_heads; i++) {
    uint64_t page = s->children[i].page_length, length = number_at(c->child_length, l->n_heads, 8, i);
    REQUIRE((page == 0) == (length == 0), error, "a child segment has a page or a length of 0, not both");
    REQUIRE(length >= page && length - page <= most - at, error, "a child segment ends beyond the file");
    s->children[i].offset = at;
    s->children[i].length = length - page;
    at += length - page;
  }
  s->children_end = at;
  return TWZ_OK;
}

static twz_status fill_segment(segment *s, const grid *g, const segment_layout *l, const page_place *where,
                               const uint8_t *page, const uint8_t *content, uint64_t most,
                               twz_error *error) {
  columns c;
  split_columns(&c, content, l);
  uint64_t first_child = load_u64(page + 4), at = where->body;
  TRY(place_pages(s, l, &c, &at, error));
  TRY(place_sections(s, l, &c, &at, error));
  int is_top = s->entry.at.level < 0, has_children = l->n_heads > 0;
  REQUIRE((first_child > 0) == has_children, error, "first_child %llu of a segment %s children",
          (unsigned long long)first_child, has_children ? "with" : "without");
  /* Where digests follow, only a verifier finds the exact end of the last segment. */
  uint64_t end = is_top ? (has_children ? first_child : g->has_digests ? at : most) : where->end;
  REQUIRE(at == end && at <= most, error, "a segment's body ends at byte %llu instead of %llu",
          (unsigned long long)at, (unsigned long long)end);
  s->end = at;
  if (has_children) {
    REQUIRE(first_child >= where->siblings_end && first_child <= most, error,
            "first_child lies before the segment's siblings or beyond the file");
    TRY(place_children(s, l, &c, first_child, most, error));
    int are_last = is_top && l->heads[0].level + DEPTH >= g->k_max;
    REQUIRE(!are_last || g->has_digests || s->children_end == most, error, "bytes after the last segment");
  }
  for (int i = 0; i < l->n_blocks; i++) {
    const uint8_t *code = c.codes + i;
    s->codes[i].z_min = code[0];
    s->codes[i].z_max = code[l->n_blocks];
    s->codes[i].error = code[2 * l->n_blocks];
    s->codes[i].mesh_error = code[3 * l->n_blocks];
  }
  return TWZ_OK;
}

twz_status read_segment(segment **found, const grid *g, place head, const page_place *where,
                        const uint8_t *page, uint64_t file_size, const crc_tables *crc,
                        const twz_allocator *allocator, twz_error *error) {
  REQUIRE(where->length >= 13, error, "an index page of %u bytes", where->length);
  REQUIRE(crc_matches(crc, page + 4, where->length - 4, load_u32(page)), error,
          "the checksum of an index page is wrong");
  segment_layout l;
  lay_out_segment(&l, g, head);
  uint8_t content[MOST_COLUMNS];
  size_t size = (size_t)(17 * l.n_keys + 4 * l.n_blocks + 12 * l.n_heads), n;
  TRY(inflate_zlib(page + 12, where->length - 12, content, size, &n, "an index page", error));
  REQUIRE(n == size, error, "an index page of %llu bytes inflated, not %llu", (unsigned long long)n,
          (unsigned long long)size);
  /* One piece of memory: the segment, then what it points to. */
  size_t places = (size_t)(l.n_keys + l.n_blocks + l.n_heads) * sizeof(place);
  size_t n_bytes = sizeof(segment) + 2 * (size_t)l.n_keys * sizeof(section_place) +
                   (size_t)l.n_heads * sizeof(child_place) + places + (size_t)l.n_blocks * sizeof(block_codes);
  segment *s = twz_allocate_zeros(allocator, n_bytes);
  if (!s) return twz_no_memory(error, n_bytes);
  s->entry.at = head;
  s->n_keys = l.n_keys;
  s->n_blocks = l.n_blocks;
  s->n_heads = l.n_heads;
  s->payloads = (section_place *)(s + 1);
  s->meshes = s->payloads + l.n_keys;
  s->children = (child_place *)(s->meshes + l.n_keys);
  s->keys = (place *)(s->children + l.n_heads);
  s->blocks = s->keys + l.n_keys;
  s->heads = s->blocks + l.n_blocks;
  s->codes = (block_codes *)(s->heads + l.n_heads);
  memcpy(s->keys, l.keys, sizeof(place) * (size_t)l.n_keys);
  memcpy(s->blocks, l.blocks, sizeof(place) * (size_t)l.n_blocks);
  memcpy(s->heads, l.heads, sizeof(place) * (size_t)l.n_heads);
  uint64_t most = file_size - (g->has_digests ? LEAST_DIGESTS : 0); /* where the last segment may end */
  twz_status status = fill_segment(s, g, &l, where, page, content, most, error);
  if (status != TWZ_OK) {
    twz_release(allocator, s);
    return status;
  }
  *found = s;
  return TWZ_OK;
}
