#include "mutate.h"

#include <math.h>
#include <stdlib.h>

#include "internal.h"
#include "tables.h"

enum { MOST_PIECES = 16, MOST_METADATA = 1 << 20, MOST_LAYOUT = 9000 };

typedef struct text {
  uint8_t *bytes;
  size_t n;
} text;

/* A segment. */
typedef struct piece {
  place head;
  segment_layout layout;
  text payloads[MOST_KEYS], meshes[MOST_KEYS];
  uint8_t flags[MOST_KEYS], codes[4 * MOST_BLOCKS];
  int children[MOST_HEADS]; /* numbers of pieces; 0: absent */
  text page;
  uint64_t n_bytes, offset, page_offset; /* of the body; where the page lies */
} piece;

/* Something wrong that is put in while a file is written. */
typedef enum fault { NO_FAULT, NUMBER, FIRST_CHILD, PAGE_BYTE, HEADER_LENGTH, GAP, END, CUT } fault;

typedef struct parts {
  uint8_t header[HEADER_SIZE];
  text metadata, parameters; /* inflated */
  piece *pieces[MOST_PIECES];
  int n_pieces;
  fault fault;
} parts;

static uint32_t state;
static uint32_t below(uint32_t n) {
  state ^= state << 13;
  state ^= state >> 17;
  state ^= state << 5;
  return state % n;
}

static void *get(size_t n) {
  void *memory = calloc(n ? n : 1, 1);
  if (!memory) abort();
  return memory;
}

static text copied(const uint8_t *bytes, size_t n) {
  text t = {get(n), n};
  if (n) memcpy(t.bytes, bytes, n);
  return t;
}

static void replace(text *t, text by) {
  free(t->bytes);
  *t = by;
}

static void store(uint8_t *to, uint64_t value, int width) {
  for (int i = 0; i < width; i++) to[i] = (uint8_t)(value >> (8 * i));
}

static void free_parts(parts *p) {
  for (int i = 0; i < p->n_pieces; i++) {
    for (int k = 0; k < MOST_KEYS; k++) {
      free(p->pieces[i]->payloads[k].bytes);
      free(p->pieces[i]->meshes[k].bytes);
    }
    free(p->pieces[i]->page.bytes);
    free(p->pieces[i]);
  }
  free(p->metadata.bytes);
  free(p->parameters.bytes);
}

/* ---- Taking a file apart ---- */

/* The grid of a header, if there is one. */
static int grid_of(const uint8_t *bytes, grid *g) {
  header h;
  memset(&h, 0, sizeof h);
  h.n_rows = load_u32(bytes + 24);
  h.n_cols = load_u32(bytes + 28);
  h.block_log2 = bytes[32];
  h.border_rings = bytes[33];
  h.method = bytes[34];
  if (h.n_rows < 1 || h.n_cols < 1 || h.n_rows > 1u << 31 || h.n_cols > 1u << 31 || h.block_log2 < 5 || h.block_log2 > 10) return 0;
  grid_init(g, &h);
  return 1;
}

static uint64_t number_of(const uint8_t *column, int n, int width, int i) {
  uint64_t value = 0;
  for (int plane = 0; plane < width; plane++) value |= (uint64_t)column[plane * n + i] << (8 * plane);
  return value;
}

static void put_number(uint8_t *column, int n, int width, int i, uint64_t value) {
  for (int plane = 0; plane < width; plane++) column[plane * n + i] = (uint8_t)(value >> (8 * plane));
}

static text part_of(const uint8_t *bytes, size_t n, uint64_t offset, uint64_t length) {
  if (offset > n || length > n - offset) return copied(bytes, 0);
  return copied(bytes + offset, (size_t)length);
}

/* Number of a new piece; 0: there is no room. */
static int add_piece(parts *p, const grid *g, place head) {
  if (p->n_pieces == MOST_PIECES) return 0;
  piece *s = p->pieces[p->n_pieces] = get(sizeof *s);
  s->head = head;
  lay_out_segment(&s->layout, g, head);
  return p->n_pieces++;
}

/* Take the page at an offset and the body at another. */
static int read_piece(parts *p, const grid *g, place head, const uint8_t *bytes, size_t n, uint64_t offset,
                      uint64_t page_length, uint64_t at) {
  uint8_t content[MOST_LAYOUT];
  size_t n_content;
  if (page_length < 13 || offset > n || page_length > n - offset) return 0;
  int number = add_piece(p, g, head);
  if (p->n_pieces == MOST_PIECES) return 0;
  piece *s = p->pieces[number];
  const segment_layout *l = &s->layout;
  size_t size = (size_t)(17 * l->n_keys + 4 * l->n_blocks + 12 * l->n_heads);
  const uint8_t *page = bytes + offset;
  if (inflate_zlib(page + 12, (size_t)page_length - 12, content, size, &n_content, "", NULL) != TWZ_OK || n_content != size) return 0;
  int order[MOST_KEYS];
  order_of_file(l, order);
  const uint8_t *lengths = content + 9 * l->n_keys + 4 * l->n_blocks;
  uint64_t pages = at;
  for (int i = 0; i < l->n_heads; i++) at += number_of(lengths, l->n_heads, 4, i);
  for (int k = 0; k < l->n_keys; k++) {
    int i = order[k];
    uint64_t payload = number_of(content, l->n_keys, 4, i), mesh = number_of(content + 4 * l->n_keys, l->n_keys, 4, i);
    s->payloads[i] = part_of(bytes, n, at, payload);
    s->meshes[i] = part_of(bytes, n, at + payload, mesh);
    at += payload + mesh;
  }
  memcpy(s->flags, content + 8 * l->n_keys, (size_t)l->n_keys);
  memcpy(s->codes, content + 9 * l->n_keys, 4 * (size_t)l->n_blocks);
  at = load_u64(page + 4);
  for (int i = 0; i < l->n_heads; i++) {
    uint64_t of_page = number_of(lengths, l->n_heads, 4, i), own = number_of(lengths + 4 * l->n_heads, l->n_heads, 8, i);
    if (own > n || own < of_page) break; /* damaged: sums beyond the file's end would wrap */
    if (own) s->children[i] = read_piece(p, g, l->heads[i], bytes, n, pages, of_page, at);
    pages += of_page;
    at += own - of_page;
  }
  return number;
}

static int take_apart(parts *p, const uint8_t *bytes, size_t n) {
  memset(p, 0, sizeof *p);
  grid g;
  if (n < HEADER_SIZE || load_u16(bytes + 10) != HEADER_SIZE || !grid_of(bytes, &g)) return 0;
  memcpy(p->header, bytes, HEADER_SIZE);
  uint64_t n_metadata = load_u32(bytes + 76), n_parameters = load_u32(bytes + 108), n_page = load_u32(bytes + 116);
  uint64_t start = HEADER_SIZE + n_metadata + n_parameters;
  if (start + n_page > n || n_metadata > MOST_METADATA) return 0;
  size_t n_text = 0;
  uint8_t *inflated = get(MOST_METADATA);
  twz_status status = inflate_raw(bytes + HEADER_SIZE, (size_t)n_metadata, (const uint8_t *)twz_dictionary,
                                  twz_dictionary_size, inflated, MOST_METADATA, &n_text, "", NULL);
  p->metadata = copied(inflated, status == TWZ_OK ? n_text : 0);
  free(inflated);
  p->parameters = copied(bytes + HEADER_SIZE + n_metadata, (size_t)n_parameters);
  const place top = {-1, 0, 0};
  read_piece(p, &g, top, bytes, n, start, n_page, start + n_page);
  return p->n_pieces > 0;
}

/* ---- Putting it together ---- */

/* A deflated stream of fixed codes, and of runs of one byte. */
typedef struct bits {
  text *to;
  uint32_t held;
  int n_held;
} bits;

static void put_bits(bits *b, uint32_t value, int n) {
  b->held |= value << b->n_held;
  for (b->n_held += n; b->n_held >= 8; b->n_held -= 8) {
    b->to->bytes[b->to->n++] = (uint8_t)b->held;
    b->held >>= 8;
  }
}

static void put_code(bits *b, uint32_t code, int n) { /* the highest bit first */
  for (int i = n - 1; i >= 0; i--) put_bits(b, code >> i & 1, 1);
}

static void put_symbol(bits *b, uint32_t s) {
  if (s < 144) {
    put_code(b, 48 + s, 8);
  } else if (s < 256) {
    put_code(b, 256 + s, 9);
  } else if (s < 280) {
    put_code(b, s - 256, 7);
  } else {
    put_code(b, s - 88, 8);
  }
}

static void put_run(bits *b, uint32_t symbol) { /* of the byte before */
  put_symbol(b, symbol);
  put_code(b, 0, 5);
}

static text deflated(const uint8_t *bytes, size_t n, int is_zlib) {
  text t = {get(n + n / 4 + 32), 0};
  bits b = {&t, 0, 0};
  if (is_zlib) put_bits(&b, 0x0178, 16);
  put_bits(&b, 3, 3); /* the last block, of fixed codes */
  for (size_t i = 0; i < n;) {
    size_t run = 0;
    while (i > 0 && run < 258 && i + run < n && bytes[i + run] == bytes[i - 1]) run++;
    if (run >= 3) {
      run = run == 258 ? run : min_size(run, 10);
      put_run(&b, run == 258 ? 285 : (uint32_t)run + 254);
      i += run;
    } else {
      put_symbol(&b, bytes[i++]);
    }
  }
  put_symbol(&b, 256);
  put_bits(&b, 0, 7 & -b.n_held);
  if (!is_zlib) return t;
  uint32_t a = 1, c = 0;
  for (size_t i = 0; i < n; i++) {
    a = (a + bytes[i]) % 65521;
    c = (c + a) % 65521;
  }
  for (int i = 0; i < 4; i++) t.bytes[t.n++] = (uint8_t)((c << 16 | a) >> (24 - 8 * i));
  return t;
}

static int present_children(const piece *s) {
  int n = 0;
  for (int i = 0; i < s->layout.n_heads; i++) n += s->children[i] != 0;
  return n;
}

static void write_page(parts *p, piece *s, const crc_tables *crc, int has_fault) {
  const segment_layout *l = &s->layout;
  uint8_t content[MOST_LAYOUT] = {0};
  size_t size = (size_t)(17 * l->n_keys + 4 * l->n_blocks + 12 * l->n_heads);
  uint8_t *mesh_length = content + 4 * l->n_keys, *page_length = content + 9 * l->n_keys + 4 * l->n_blocks;
  uint8_t *child_length = page_length + 4 * l->n_heads, *payload_crc = child_length + 8 * l->n_heads;
  s->n_bytes = 0;
  for (int i = 0; i < l->n_keys; i++) {
    const text *payload = &s->payloads[i], *mesh = &s->meshes[i];
    put_number(content, l->n_keys, 4, i, payload->n);
    put_number(mesh_length, l->n_keys, 4, i, mesh->n);
    put_number(payload_crc, l->n_keys, 4, i, crc32_of(crc, payload->bytes, payload->n));
    put_number(payload_crc + 4 * l->n_keys, l->n_keys, 4, i, crc32_of(crc, mesh->bytes, mesh->n));
    s->n_bytes += payload->n + mesh->n;
  }
  memcpy(content + 8 * l->n_keys, s->flags, (size_t)l->n_keys);
  memcpy(content + 9 * l->n_keys, s->codes, 4 * (size_t)l->n_blocks);
  for (int i = 0; i < l->n_heads; i++) {
    const piece *child = p->pieces[s->children[i]];
    if (!s->children[i]) continue;
    put_number(page_length, l->n_heads, 4, i, child->page.n);
    put_number(child_length, l->n_heads, 8, i, child->page.n + child->n_bytes);
    s->n_bytes += child->page.n;
  }
  if (has_fault && p->fault == NUMBER) content[below((uint32_t)size)] ^= (uint8_t)(1 << below(8));
  text stream = deflated(content, size, 1);
  replace(&s->page, copied(stream.bytes, stream.n + 12));
  memcpy(s->page.bytes + 12, stream.bytes, stream.n);
  free(stream.bytes);
}

/* Children lie behind their parents: pieces in the order of the file. */
static int order_pieces(const parts *p, int *order) {
  int n = 1;
  order[0] = 0;
  for (int i = 0; i < n; i++) {
    const piece *s = p->pieces[order[i]];
    for (int k = 0; k < s->layout.n_heads; k++) {
      if (s->children[k] && n < MOST_PIECES) order[n++] = s->children[k];
    }
  }
  return n;
}

static size_t put(uint8_t *to, size_t at, const uint8_t *bytes, size_t n) {
  if (n) memcpy(to + at, bytes, n);
  return at + n;
}

/* Write the file; 0: it has more than `most` bytes. */
static size_t put_together(parts *p, uint8_t *to, size_t most) {
  static crc_tables crc;
  if (!crc.of[0][1]) crc_tables_fill(&crc);
  int order[MOST_PIECES], n = order_pieces(p, order), faulty = (int)below((uint32_t)n);
  for (int i = n - 1; i >= 0; i--) write_page(p, p->pieces[order[i]], &crc, i == faulty);
  text metadata = deflated(p->metadata.bytes, p->metadata.n, 0);
  const uint64_t top_page = HEADER_SIZE + metadata.n + p->parameters.n;
  uint64_t at = top_page + p->pieces[0]->page.n;
  size_t n_gap = p->fault == GAP ? 1 + below(4) : 0;
  for (int i = 0; i < n; i++) {
    if (i == faulty) at += i ? n_gap : 0;
    p->pieces[order[i]]->offset = at;
    at += p->pieces[order[i]]->n_bytes;
  }
  size_t n_end = p->fault == END ? 1 + below(4) : 0, total = (size_t)at + n_end;
  if (at + n_end > most) {
    free(metadata.bytes);
    return 0;
  }
  memset(to, 0, total);
  uint8_t *h = p->header;
  store(h + 16, total, 8);
  store(h + 76, metadata.n, 4);
  store(h + 104, crc32_of(&crc, metadata.bytes, metadata.n), 4);
  store(h + 108, p->parameters.n, 4);
  store(h + 112, crc32_of(&crc, p->parameters.bytes, p->parameters.n), 4);
  store(h + 116, p->pieces[0]->page.n, 4);
  static const uint8_t LENGTHS[] = {16, 76, 104, 108, 112, 116};
  if (p->fault == HEADER_LENGTH) h[LENGTHS[below(sizeof LENGTHS)]] ^= (uint8_t)(1 << below(8));
  store(h + 124, crc32_of(&crc, h, 124), 4);
  put(to, put(to, put(to, 0, h, HEADER_SIZE), metadata.bytes, metadata.n), p->parameters.bytes, p->parameters.n);
  free(metadata.bytes);
  p->pieces[0]->page_offset = top_page;
  for (int i = 0, next = 1; i < n; i++) {
    piece *s = p->pieces[order[i]];
    uint64_t first = s->layout.n_heads ? (next < n ? p->pieces[order[next]]->offset : at) : 0;
    next += present_children(s);
    if (i == faulty && p->fault == FIRST_CHILD) first = below(2) || first == 0 ? first + 1 : first - 1;
    store(s->page.bytes + 4, first, 8);
    store(s->page.bytes, crc32_of(&crc, s->page.bytes + 4, s->page.n - 4), 4);
    if (i == faulty && p->fault == PAGE_BYTE) s->page.bytes[below((uint32_t)s->page.n)] ^= (uint8_t)(1 << below(8));
    put(to, (size_t)s->page_offset, s->page.bytes, s->page.n);
    size_t place = (size_t)s->offset;
    for (int k = 0; k < s->layout.n_heads; k++) {
      piece *child = p->pieces[s->children[k]];
      if (!s->children[k]) continue;
      child->page_offset = place;
      place += child->page.n;
    }
    int keys[MOST_KEYS];
    order_of_file(&s->layout, keys);
    for (int k = 0; k < s->layout.n_keys; k++) {
      place = put(to, place, s->payloads[keys[k]].bytes, s->payloads[keys[k]].n);
      place = put(to, place, s->meshes[keys[k]].bytes, s->meshes[keys[k]].n);
    }
  }
  return p->fault == CUT ? total - below((uint32_t)min_size(total, 60)) : total;
}

/* ---- Changes ---- */

#define PICK(values) (values[below((uint32_t)(sizeof(values) / sizeof(values)[0]))])

static void change_text(text *t, change_bytes plain) {
  size_t most = 2 * t->n + 64;
  text larger = {get(most), t->n};
  if (t->n) memcpy(larger.bytes, t->bytes, t->n);
  larger.n = plain(larger.bytes, larger.n, most);
  replace(t, larger);
}

/* Lay the sections out anew, by another grid: those of keys and blocks that it has, too. */
static void lay_out_anew(parts *p, const grid *g) {
  parts before = *p;
  const place top = {-1, 0, 0};
  p->n_pieces = 0;
  add_piece(p, g, top);
  for (int i = 0; i < p->n_pieces; i++) {
    piece *s = p->pieces[i];
    for (int k = 0; k < before.n_pieces; k++) {
      piece *old = before.pieces[k];
      for (int m = 0; m < old->layout.n_keys; m++) {
        int at = index_of_place(s->layout.keys, s->layout.n_keys, old->layout.keys[m]);
        if (at < 0) continue;
        text none = {NULL, 0};
        s->payloads[at] = old->payloads[m];
        s->meshes[at] = old->meshes[m];
        old->payloads[m] = old->meshes[m] = none;
      }
      for (int m = 0; m < s->layout.n_heads; m++) {
        int has_key = 0;
        for (int j = 0; j < old->layout.n_keys && !has_key; j++) {
          place head = head_of_key(g, old->layout.keys[j]);
          has_key = old->payloads[j].n && index_of_place(&s->layout.heads[m], 1, head) == 0;
        }
        if (has_key && !s->children[m]) s->children[m] = add_piece(p, g, s->layout.heads[m]);
      }
    }
  }
  text none = {NULL, 0};
  before.metadata = before.parameters = none;
  free_parts(&before);
}

static void change_header(parts *p) {
  static const uint32_t SIDES[] = {1, 2, 3, 5, 32, 33, 34, 64, 65, 66, 67, 127, 129, 130, 257, 513, 1025, 2049, 65537,
                                   1u << 24, (1u << 25) + 1, 1u << 30, 0x7FFFFFFF, 0x80000000u, 0x80000001u, 0};
  static const uint32_t STEPS[] = {0, 1, 2, 3, 5, 7, 15, 33, 255, 257, 4095, 65535, 65537, (1 << 20) + 1, (1 << 24) - 1,
                                   (1 << 29) + 1, 0x3FFFFFFF, 0x7FFFFFFF, 0xFFFFFFFFu};
  static const int32_t HEIGHTS[] = {0, 1, -1, -2, 32766, 32768, 65533, 65535, -65533, 1 << 30, -(1 << 30), (1 << 30) - 1,
                                    1 - (1 << 30), 1 << 29, -(1 << 29), (1 << 29) - 1, 1 << 18, (1 << 30) + 1, INT32_MIN, INT32_MAX};
  static const uint64_t WHOLE[] = {0, 1, 2, 3, 10, 1000, (1u << 31) - 1, (uint64_t)1 << 32, (uint64_t)1 << 53, ((uint64_t)1 << 63) - 1,
                                   (uint64_t)1 << 63};
  static const int64_t BASES[] = {0, 1, -1, (int64_t)1 << 31, -((int64_t)1 << 31), (int64_t)1 << 53, (int64_t)1 << 62, INT64_MAX, INT64_MIN};
  static const double ERRORS[] = {0, 1, 1e-300, 1e300, 0.5, 2, 1e6, -1, HUGE_VAL};
  uint8_t *h = p->header;
  uint8_t before[12];
  memcpy(before, h + 24, 12);
  switch (below(13)) {
    case 0: store(h + 24, PICK(SIDES), 4); break;
    case 1: store(h + 28, PICK(SIDES), 4); break;
    case 2: h[32] = (uint8_t)(4 + below(8)); break;
    case 3: h[33] = (uint8_t)below(5); break;
    case 4: h[34] = (uint8_t)below(6); break;
    case 5: h[35] = (uint8_t)below(10); break;
    case 6: h[36 + below(2)] = (uint8_t)below(11); break;
    case 7: h[12] ^= (uint8_t)(1 << below(8)); break;
    case 8: store(h + 64, PICK(STEPS), 4); break;
    case 9:
      store(h + 68, (uint32_t)PICK(HEIGHTS), 4);
      if (below(2)) store(h + 72, (uint32_t)PICK(HEIGHTS), 4);
      break;
    case 10: {
      uint64_t x = PICK(WHOLE), y = below(2) ? 1 : PICK(WHOLE), base = (uint64_t)PICK(BASES);
      if (below(2)) store(h + 40, x, 8);
      if (below(2)) store(h + 48, y, 8);
      if (below(2)) store(h + 56, base, 8);
      break;
    }
    case 11:
      for (int i = 0; i < 3; i++) {
        double x = PICK(ERRORS);
        if (below(2)) memcpy(h + 80 + 8 * i, &x, 8);
      }
      break;
    default: h[below(124)] ^= (uint8_t)(1 << below(8)); break;
  }
  grid g;
  if (memcmp(before, h + 24, 12) == 0) return;
  if (grid_of(h, &g)) lay_out_anew(p, &g); else memcpy(h + 24, before, 12);
}

static void change_metadata(parts *p, change_bytes plain) {
  static const char *const TEXTS[] = {"{\"nodata\":-9999}", "{\"nodata\":\"nan\"}", "{\"nodata\":0,\"mask_kind\":\"nodata\"}", "{\"nodata\":1e308}",
                                      "{\"scale\":1e-300,\"offset\":1e300}", "{\"scale\":0}", "{\"tags\":{\"a\":\"b\",\"\":\"\"},\"band_tags\":{\"x\":\"\\u0000\"}}",
                                      "{\"mask_kind\":\"mask\",\"moved\":2147483648}", "{\"transform\":[1e308,-1e308,1e308,0,0,1e308]}", "{\"nodata\":5e-324}",
                                      "{\"nodata\":18446744073709551616}", "{\"nodata\":18446744073709551617}", "{\"nodata\":-2147483648}", "{\"crs\":null}", "{}", "[]",
                                      "{\"a\":1.7976931348623158e308}", "{\"a\":1.7976931348623159e308}", "{\"moved\":3.0}", "{\"earlier\":[{}],\"origin\":1}"};
  if (below(2)) {
    const char *t = PICK(TEXTS);
    replace(&p->metadata, copied((const uint8_t *)t, strlen(t)));
  } else {
    change_text(&p->metadata, plain);
  }
}

/* A section at random: of keys that have one, where there are any. */
static text *any_section(parts *p, int is_mesh) {
  text *found = NULL;
  for (int i = 0; i < 20; i++) {
    piece *s = p->pieces[below((uint32_t)p->n_pieces)];
    uint32_t key = below((uint32_t)s->layout.n_keys);
    found = is_mesh ? &s->meshes[key] : &s->payloads[key];
    if (found->n) break;
  }
  return found;
}

static void change_section(parts *p, parts *other, change_bytes plain) {
  int is_mesh = below(8) == 0;
  text *t = any_section(p, is_mesh), *from = any_section(other && below(2) ? other : p, is_mesh), none = {get(0), 0};
  switch (below(6)) {
    case 0: replace(t, copied(t->bytes, t->n - min_size(t->n, below(5)))); break;
    case 1:
      if (t != from) replace(t, copied(from->bytes, from->n));
      break;
    case 2:
      replace(t, none);
      return;
    default: change_text(t, plain); break;
  }
  free(none.bytes);
}

static void change_segments(parts *p, const grid *g) {
  piece *s = p->pieces[below((uint32_t)p->n_pieces)];
  const segment_layout *l = &s->layout;
  int i = l->n_heads ? (int)below((uint32_t)l->n_heads) : 0;
  switch (below(4)) {
    case 0: s->codes[below(4 * (uint32_t)l->n_blocks)] = (uint8_t)below(256); break;
    case 1: s->flags[below((uint32_t)l->n_keys)] = (uint8_t)(below(4) == 0); break;
    case 2:
      if (l->n_heads) s->children[i] = s->children[i] ? 0 : add_piece(p, g, l->heads[i]);
      break;
    default: p->fault = (fault)(1 + below(CUT)); break;
  }
}

/* What rarely arises by itself: the tables and numbers of one file with the payloads of another. */
static void cross(parts *p, const parts *other) {
  uint32_t what = below(4);
  if (what == 0) {
    replace(&p->metadata, copied(other->metadata.bytes, other->metadata.n));
  } else if (what == 1) {
    memcpy(p->header + 40, other->header + 40, 36);
  } else {
    if (what == 2) p->header[34] = other->header[34];
    memcpy(p->header + 12, other->header + 12, 4);
    replace(&p->parameters, copied(other->parameters.bytes, other->parameters.n));
  }
}

size_t mutate_file(uint8_t *bytes, size_t n, size_t most, const uint8_t *other, size_t n_other, uint32_t seed, change_bytes plain) {
  parts p, q;
  state = seed * 2654435761u | 1;
  int has_parts = take_apart(&p, bytes, n), has_other = other && take_apart(&q, other, n_other);
  size_t n_new = 0;
  grid g;
  for (uint32_t k = has_parts ? 1 + below(3) : 0; k > 0; k--) {
    uint32_t what = below(12);
    if (what < 3) {
      change_header(&p);
    } else if (what == 3) {
      change_metadata(&p, plain);
    } else if (what == 4) {
      change_text(&p.parameters, plain);
    } else if (what < 7) {
      if (grid_of(p.header, &g)) change_segments(&p, &g);
    } else if (what == 7 && has_other) {
      cross(&p, &q);
    } else {
      change_section(&p, has_other ? &q : NULL, plain);
    }
  }
  if (has_parts) n_new = put_together(&p, bytes, most);
  free_parts(&p);
  if (other) free_parts(&q);
  return n_new;
}
