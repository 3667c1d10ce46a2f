/* Method cdf53 (docs/format-cdf53.md, C.n): tiles of several levels. */
#include "range.h"

enum { HL, LH, HH, MOST_TRANSFORMS = 12, MOST_PLANES = 60, PIECE = 4096, N_STREAM_MODELS = 1515, N_BORDER_MODELS = 24 * 46 };
enum { TOP, LEFT, BOTTOM, RIGHT, N_SIDES };

/* ---- Payload (C.4) ---- */

typedef struct head {
  reader masks[MOST_LAYERS], borders;
  int64_t low;
  int n_planes;
  uint64_t n_whole, n_stream; /* bytes of the whole stream; of what is here */
} head;

static twz_status read_masks(const unit *u, reader *r, head *h, twz_error *error) {
  for (int i = 0; i < u->n_layers; i++) {
    TRY(read_section(r, &h->masks[i], "a mask", error));
    if (h->masks[i].n == 0) h->masks[i].bytes = NULL;
  }
  return TWZ_OK;
}

static twz_status read_head(const twz_file *f, const unit *u, reader *r, head *h, int is_held, twz_error *error) {
  uint64_t z, n_planes;
  int flags = r->bytes[r->at++], is_root = u->entry.at.level < 0;
  REQUIRE((flags & ~(f->header.features & VOIDS ? 1 : 0)) == 0, error, "flags %d of method cdf53", flags);
  if (flags & 1) TRY(read_masks(u, r, h, error));
  TRY(read_section(r, &h->borders, "borders", error));
  REQUIRE((h->borders.n > 0) == is_held, error, "borders of %llu bytes of a tile %s shared sides",
          (unsigned long long)h->borders.n, is_held ? "with" : "without");
  TRY(read_signed_varint(r, &h->low, error));
  REQUIRE(abs_i64(h->low) < (int64_t)1 << 31, error, "low is 2^31 or more");
  REQUIRE(is_root || h->low == 0, error, "low of a tile that is not the root one");
  TRY(read_varint(r, &n_planes, error));
  REQUIRE(n_planes <= MOST_PLANES, error, "%llu planes, more than 60", (unsigned long long)n_planes);
  h->n_planes = (int)n_planes;
  for (int i = 0; i < h->n_planes; i++) {
    TRY(read_varint(r, &z, error));
    h->n_whole += z;
  }
  TRY(read_varint(r, &h->n_stream, error));
  REQUIRE(h->n_stream <= h->n_whole, error, "%llu bytes of a stream of %llu", (unsigned long long)h->n_stream,
          (unsigned long long)h->n_whole);
  REQUIRE(r->n - r->at >= 4 && crc_matches(&f->crc, r->bytes, r->at, load_u32(r->bytes + r->at)), error,
          "the checksum of a tile's head is wrong");
  r->at += 4;
  return TWZ_OK;
}

/* Take the pieces together, checked; stream has room for all that is left. */
static twz_status join_pieces(const twz_file *f, reader *r, uint64_t n_stream, uint8_t *stream, twz_error *error) {
  uint64_t n_pieces = (n_stream + PIECE - 1) / PIECE;
  REQUIRE(r->n - r->at == n_stream + 4 * n_pieces, error, "a stream of %llu bytes where %llu are left",
          (unsigned long long)n_stream, (unsigned long long)(r->n - r->at));
  while (n_stream > 0) {
    size_t n = (size_t)min_u64(n_stream, PIECE);
    REQUIRE(crc_matches(&f->crc, r->bytes + r->at, n, load_u32(r->bytes + r->at + n)), error,
            "the checksum of a piece of a stream is wrong");
    memcpy(stream, r->bytes + r->at, n);
    stream += n;
    r->at += n + 4;
    n_stream -= n;
  }
  return TWZ_OK;
}

/* ---- Coefficients (C.2, C.3, C.5) ---- */

typedef struct tile {
  int n_transforms;
  int32_t rows[MOST_TRANSFORMS + 2], cols[MOST_TRANSFORMS + 2]; /* R_t, C_t */
  int held[N_SIDES];
  ptrdiff_t pitch;    /* of F: a margin of one zero all around */
  int64_t *f, *other; /* F, and what a pass writes; without margin, cols[0] a row */
  int64_t *m;         /* what is known of magnitudes */
  int8_t *signs;
  uint8_t *found;     /* bit 0: D of this place has been found significant, bit 1: L */
  uint8_t *row_of, *col_of; /* by row (column) of F: the transform it is high in; n_transforms: none */
  uint32_t *pixels, *significant;
  uint32_t *sets;     /* place in F, times 2; 1 more for L */
  size_t n_pixels, n_significant, n_sets;
  model models[N_STREAM_MODELS];
  uint8_t thresholds[85];
  coder coder;
  int is_cut, is_stopped, plane;
} tile;

/* A place in F. */
typedef struct spot {
  int32_t row, col;
  int t, band;
} spot;

static size_t at_of(const tile *z, int32_t row, int32_t col) { return (size_t)((row + 1) * z->pitch + col + 1); }

static spot spot_at(const tile *z, size_t at) {
  spot p;
  p.row = (int32_t)(at / (size_t)z->pitch) - 1;
  p.col = (int32_t)(at % (size_t)z->pitch) - 1;
  int of_row = z->row_of[p.row], of_col = z->col_of[p.col];
  p.t = min_i32(of_row, of_col);
  p.band = of_row > of_col ? HL : of_row < of_col ? LH : HH;
  return p;
}

static int shift_of(const spot *p) { return p->band == HH ? max_i32(p->t - 1, 0) : p->t; }
static int kappa_of(const spot *p) { return 3 * min_i32(p->t, 3) + p->band; }

/* Where the band of transform t begins and ends in F. */
static void band_of(const tile *z, int t, int band, int32_t *top, int32_t *bottom, int32_t *left, int32_t *right) {
  *top = band == HL ? 0 : z->rows[t + 1];
  *bottom = band == HL ? z->rows[t + 1] : z->rows[t];
  *left = band == LH ? 0 : z->cols[t + 1];
  *right = band == LH ? z->cols[t + 1] : z->cols[t];
}

/* Number k of the four places below p (row by row); 0: there is none. */
static size_t child_of(const tile *z, const spot *p, int k) {
  if (p->t == 0) return 0;
  int32_t top, bottom, left, right, own_top, own_left, unused;
  band_of(z, p->t, p->band, &own_top, &unused, &own_left, &unused);
  band_of(z, p->t - 1, p->band, &top, &bottom, &left, &right);
  int32_t row = top + 2 * (p->row - own_top) + (k >> 1), col = left + 2 * (p->col - own_left) + (k & 1);
  return row < bottom && col < right ? at_of(z, row, col) : 0;
}

/* The place above p; 0: p is a root. */
static size_t parent_at(const tile *z, const spot *p) {
  if (p->t + 1 >= z->n_transforms) return 0;
  int32_t top, bottom, left, right, own_top, own_left, unused;
  band_of(z, p->t, p->band, &own_top, &unused, &own_left, &unused);
  band_of(z, p->t + 1, p->band, &top, &bottom, &left, &right);
  int32_t row = top + ((p->row - own_top) >> 1), col = left + ((p->col - own_left) >> 1);
  return row < bottom && col < right ? at_of(z, row, col) : 0;
}

static int has_children(const tile *z, const spot *p) { return child_of(z, p, 0) != 0; }

/* A bit; 0 and is_stopped where a cut stream has no more. */
static int stream_bit(tile *z, int number) {
  if (z->is_cut ? z->coder.position > z->coder.n : coder_is_cut(&z->coder)) { /* a whole stream that is longer is corrupt: §6.2 */
    z->is_stopped = 1;
    return 0;
  }
  return adaptive_bit(&z->coder, &z->models[number]);
}

static int known(const tile *z, size_t at) { return (int)min_i64(z->m[at] >> z->plane, 6); }

static int around(const tile *z, const spot *p, size_t at) {
  size_t up = (size_t)z->pitch, above = parent_at(z, p);
  int sum = known(z, at - 1) + known(z, at + 1) + known(z, at - up) + known(z, at + up) + (above ? known(z, above) : 0);
  return z->thresholds[2 * sum + known(z, at - up - 1) + known(z, at - up + 1) + known(z, at + up - 1) + known(z, at + up + 1)];
}

/* pixel(p, f) */
static int decode_pixel(tile *z, const spot *p, size_t at, int first) {
  if (!stream_bit(z, first + around(z, p, at))) return 0;
  size_t up = (size_t)z->pitch;
  int x = min_i32(max_i32(z->signs[at - 1] + z->signs[at + 1], -1), 1);
  int y = min_i32(max_i32(z->signs[at - up] + z->signs[at + up], -1), 1);
  int is_negative = stream_bit(z, 1440 + 9 * p->band + 3 * (x + 1) + y + 1);
  if (z->is_stopped) return 0;
  z->signs[at] = is_negative ? -1 : 1;
  z->m[at] = (int64_t)1 << z->plane;
  z->significant[z->n_significant++] = (uint32_t)at;
  return 1;
}

static int n_found_beside(const tile *z, size_t at, int bit) {
  ptrdiff_t up = z->pitch;
  const uint8_t *s = z->found + at;
  int n = (s[-1] >> bit & 1) + (s[1] >> bit & 1);
  for (int k = -1; k <= 1; k++) n += (s[k - up] >> bit & 1) + (s[k + up] >> bit & 1);
  return min_i32(n, 7);
}

static void sort_pixels(tile *z) {
  size_t kept = 0, n = z->n_pixels, i = 0;
  for (; i < n && !z->is_stopped; i++) {
    size_t at = z->pixels[i];
    spot p = spot_at(z, at);
    if (shift_of(&p) > z->plane) continue;
    if (!decode_pixel(z, &p, at, 16 * kappa_of(&p))) z->pixels[kept++] = (uint32_t)at;
  }
  z->n_pixels = kept;
}

/* D(p): returns whether it leaves the list. */
static int sort_descendants(tile *z, const spot *p, size_t at) {
  int kappa = kappa_of(p), size = (int)min_i64(z->m[at] >> z->plane, 3);
  if (!stream_bit(z, 576 + 8 * (4 * kappa + size) + n_found_beside(z, at, 0))) return 0;
  z->found[at] |= 1;
  int is_later = 0;
  for (int k = 0; k < 4 && !z->is_stopped; k++) {
    size_t child = child_of(z, p, k);
    if (!child) continue;
    spot q = spot_at(z, child);
    int is_found = shift_of(&q) <= z->plane && decode_pixel(z, &q, child, 192 + 16 * (2 * kappa_of(&q) + is_later));
    is_later |= is_found;
    if (!is_found) z->pixels[z->n_pixels++] = (uint32_t)child;
  }
  spot first = spot_at(z, child_of(z, p, 0));
  if (has_children(z, &first)) z->sets[z->n_sets++] = (uint32_t)(2 * at + 1);
  return 1;
}

/* L(p) */
static int sort_rest(tile *z, const spot *p, size_t at) {
  int n = 0;
  for (int k = 0; k < 4; k++) {
    size_t child = child_of(z, p, k);
    n += child && z->m[child] != 0;
  }
  if (!stream_bit(z, 960 + 8 * (5 * kappa_of(p) + n) + n_found_beside(z, at, 1))) return 0;
  z->found[at] |= 2;
  for (int k = 0; k < 4; k++) {
    size_t child = child_of(z, p, k);
    if (!child) continue;
    spot q = spot_at(z, child);
    if (has_children(z, &q)) z->sets[z->n_sets++] = (uint32_t)(2 * child);
  }
  return 1;
}

/* Those that stay move forward over those that left; what is appended meanwhile is dealt with, too. */
static void sort_sets(tile *z) {
  size_t kept = 0;
  for (size_t i = 0; i < z->n_sets && !z->is_stopped; i++) {
    uint32_t set = z->sets[i];
    size_t at = set >> 1;
    spot p = spot_at(z, at);
    int leaves = set & 1 ? sort_rest(z, &p, at) : sort_descendants(z, &p, at);
    if (!leaves) z->sets[kept++] = set;
  }
  z->n_sets = kept;
}

/* Returns how many of the first n_old bits were decoded or are none. */
static size_t refine(tile *z, size_t n_old) {
  for (size_t i = 0; i < n_old; i++) {
    size_t at = z->significant[i];
    spot p = spot_at(z, at);
    if (shift_of(&p) > z->plane) continue;
    int64_t high = z->m[at] >> (z->plane + 1);
    int bit = stream_bit(z, 1467 + 16 * (high == 1 ? 0 : high <= 3 ? 1 : 2) + around(z, &p, at));
    if (z->is_stopped) return i;
    if (bit) z->m[at] += (int64_t)1 << z->plane;
  }
  return n_old;
}

static void begin_lists(tile *z) {
  for (int t = z->n_transforms - 1; t >= 0; t--) {
    for (int band = HL; band <= HH; band++) {
      int32_t top, bottom, left, right;
      band_of(z, t, band, &top, &bottom, &left, &right);
      for (int32_t row = top; row < bottom; row++) {
        for (int32_t col = left; col < right; col++) {
          spot p = {row, col, t, band};
          if (parent_at(z, &p)) continue;
          size_t at = at_of(z, row, col);
          z->pixels[z->n_pixels++] = (uint32_t)at;
          if (has_children(z, &p)) z->sets[z->n_sets++] = (uint32_t)(2 * at);
        }
      }
    }
  }
}

static void fill_thresholds(tile *z) {
  static const uint8_t THRESHOLDS[15] = {1, 2, 3, 4, 5, 6, 7, 9, 11, 14, 18, 24, 32, 40, 48};
  for (int s = 0; s < 85; s++) {
    z->thresholds[s] = 0;
    for (int i = 0; i < 15; i++) z->thresholds[s] = (uint8_t)(z->thresholds[s] + (THRESHOLDS[i] <= s));
  }
}

/* Decode the stream and put the coefficients into F. */
static twz_status decode_stream(tile *z, const head *h, const uint8_t *stream, const int32_t *rates, twz_error *error) {
  if (h->n_planes == 0) return TWZ_OK;
  for (int i = 0; i < N_STREAM_MODELS; i++) z->models[i] = FRESH_MODEL;
  fill_thresholds(z);
  begin_lists(z);
  coder_start(&z->coder, stream, (size_t)h->n_stream, rates);
  z->is_cut = h->n_stream < h->n_whole;
  size_t n_refined = 0, n_old = 0;
  for (z->plane = h->n_planes - 1;; z->plane--) {
    n_old = z->n_significant;
    n_refined = 0;
    sort_pixels(z);
    if (!z->is_stopped) sort_sets(z);
    if (!z->is_stopped) n_refined = refine(z, n_old);
    if (z->plane == 0 || z->is_stopped) break;
  }
  if (!z->is_cut) {
    REQUIRE(!z->is_stopped, error, "a stream of method cdf53 is cut");
    TRY(coder_end(&z->coder, "a stream of method cdf53", error));
  }
  for (size_t i = 0; i < z->n_significant; i++) {
    size_t at = z->significant[i];
    spot p = spot_at(z, at);
    int e = z->plane + (i < n_old && i >= n_refined), shift = shift_of(&p);
    int64_t rho = e > shift ? ((int64_t)3 << e) >> 3 : 0;
    int64_t size = min_i64((z->m[at] + rho) >> shift, (int64_t)1 << 34);
    z->f[(ptrdiff_t)p.row * z->cols[0] + p.col] = z->signs[at] < 0 ? -size : size;
  }
  return TWZ_OK;
}

/* The coefficients at held sides, put into F (C.4). */
static twz_status decode_borders(tile *z, const reader *section, const int32_t *rates, twz_error *error) {
  if (section->n == 0) return TWZ_OK;
  model models[N_BORDER_MODELS];
  for (int i = 0; i < N_BORDER_MODELS; i++) models[i] = FRESH_MODEL;
  coder c;
  coder_start(&c, section->bytes, section->n, rates);
  for (int side = TOP; side < N_SIDES; side++) {
    for (int t = z->n_transforms - 1; t >= 0 && z->held[side] && !coder_is_cut(&c); t--) {
      int is_row = side == TOP || side == BOTTOM;
      const int32_t *along = is_row ? z->cols : z->rows, *across = is_row ? z->rows : z->cols;
      int32_t line = side == TOP || side == LEFT ? 0 : across[t + 1] - 1;
      int64_t a = 0, b = 0;
      for (int32_t i = along[t + 1]; i < along[t]; i++) {
        model *group = models + 46 * min_i32(bit_length((uint64_t)(2 * a + b)), 23);
        int64_t size = magnitude(&c, group, group + 14, 0);
        int64_t value = size && raw_bits(&c, 1) ? -size : size;
        z->f[is_row ? (ptrdiff_t)line * z->cols[0] + i : (ptrdiff_t)i * z->cols[0] + line] = value;
        b = a;
        a = size;
      }
    }
  }
  return coder_end(&c, "borders of a tile", error);
}

/* ---- Inverse transform (C.3) ---- */

/* n_lines lines of n values, s apart, in `from` as s, then d; interleaved to `to`. */
static void invert_lines(const int64_t *from, int64_t *to, int32_t n, ptrdiff_t s, int32_t n_lines, ptrdiff_t next, int is_first_held,
                         int is_last_held) {
  int32_t n_low = (n + 1) / 2, n_high = n / 2;
  for (int32_t i = 0; i < n_low; i++) {
    const int64_t *low = from + i * s;
    const int64_t *before = from + (n_low + max_i32(i - 1, 0)) * s, *after = from + (n_low + min_i32(i, n_high - 1)) * s;
    int is_held = (i == 0 && is_first_held) || (2 * i == n - 1 && is_last_held) || n == 1;
    int64_t *x = to + 2 * i * s;
    for (int32_t k = 0; k < n_lines; k++) {
      x[k * next] = is_held ? low[k * next] : low[k * next] - ((before[k * next] + after[k * next] + 2) >> 2);
    }
  }
  for (int32_t i = 0; i < n_high; i++) {
    const int64_t *d = from + (n_low + i) * s, *left = to + 2 * i * s, *right = 2 * i + 2 < n ? left + 2 * s : left;
    int64_t *x = to + (2 * i + 1) * s;
    for (int32_t k = 0; k < n_lines; k++) x[k * next] = d[k * next] + ((left[k * next] + right[k * next]) >> 1);
  }
}

static void invert_transform(tile *z, int t) {
  ptrdiff_t pitch = z->cols[0];
  invert_lines(z->f, z->other, z->rows[t], pitch, z->cols[t], 1, z->held[TOP], z->held[BOTTOM]);
  invert_lines(z->other, z->f, z->cols[t], 1, z->rows[t], pitch, z->held[LEFT], z->held[RIGHT]);
}

/* ---- Tiles ---- */

static twz_status take_memory(tile *z, scratch *s, size_t n_stream, uint8_t **stream, twz_error *error) {
  size_t n_rows = (size_t)z->rows[0], n_cols = (size_t)z->cols[0], n = n_rows * n_cols, n_edged = (n_rows + 2) * (n_cols + 2);
  size_t n_bytes = 16 * n + n_edged * 10 + n_rows + n_cols + 4 * 4 * (n + 1) + n_stream;
  TRY(scratch_reserve(s, n_bytes + 16 * SCRATCH_ALIGN, error));
  z->pitch = (ptrdiff_t)n_cols + 2;
  z->f = scratch_take(s, 8 * n);
  z->other = scratch_take(s, 8 * n);
  z->m = scratch_take(s, 8 * n_edged);
  z->signs = scratch_take(s, n_edged);
  z->found = scratch_take(s, n_edged);
  z->row_of = scratch_take(s, n_rows);
  z->col_of = scratch_take(s, n_cols);
  z->pixels = scratch_take(s, 4 * (n + 1));
  z->significant = scratch_take(s, 4 * (n + 1));
  z->sets = scratch_take(s, 8 * (n + 1));
  *stream = scratch_take(s, n_stream);
  memset(z->f, 0, 8 * n);
  memset(z->m, 0, 8 * n_edged);
  memset(z->signs, 0, n_edged);
  memset(z->found, 0, n_edged);
  for (int t = 0; t <= z->n_transforms; t++) { /* rows below R_t are of transform t or a later one */
    memset(z->row_of, t, (size_t)z->rows[t]);
    memset(z->col_of, t, (size_t)z->cols[t]);
  }
  return TWZ_OK;
}

/* C.2: sizes and held sides of a tile. */
static void begin_tile(tile *z, const twz_file *f, const unit *u) {
  const layer *finest = &u->layers[u->n_layers - 1];
  int is_root = u->entry.at.level < 0;
  int n = is_root ? f->grid.first_tiles + 1 : f->grid.tile_levels;
  for (int t = 0;; t++) {
    z->rows[t] = ((finest->rows.n - 1) >> t) + 1;
    z->cols[t] = ((finest->cols.n - 1) >> t) + 1;
    if (t >= n && (!is_root || (z->rows[t] == 1 && z->cols[t] == 1))) {
      z->n_transforms = t;
      break;
    }
  }
  z->held[TOP] = finest->rows.shared[0];
  z->held[BOTTOM] = finest->rows.shared[1];
  z->held[LEFT] = finest->cols.shared[0];
  z->held[RIGHT] = finest->cols.shared[1];
}

/* A level of the tile as the parent heights of the next one. */
static parent parent_in_tile(const layer *l) {
  parent p = {l, 0, 0, 0, l->rows.n, l->cols.n, l->rows.first, l->cols.first};
  return p;
}

static twz_status decode_masks(const twz_file *f, unit *u, const parent *above, const head *h, scratch *s, twz_error *error) {
  int has_any = 0;
  for (int i = 0; i < u->n_layers; i++) {
    int has_valid, is_finest = u->first_level + i == f->grid.k_max;
    parent p = i ? parent_in_tile(&u->layers[i - 1]) : *above;
    TRY(decode_validity(f, &u->layers[i], &p, is_finest, &h->masks[i], &has_valid, s, error));
    has_any |= has_valid;
  }
  REQUIRE(has_any, error, "a payload of a tile without a valid sample");
  return TWZ_OK;
}

/* Copy level l - t out of F. */
static twz_status copy_level(const twz_file *f, const tile *z, unit *u, layer *l, twz_error *error) {
  const int64_t most = ((int64_t)1 << 31) - 1;
  size_t n = (size_t)l->rows.n * (size_t)l->cols.n;
  l->heights = twz_allocate(&f->allocator, n * sizeof *l->heights);
  if (!l->heights) return twz_no_memory(error, n * sizeof *l->heights);
  for (int32_t r = 0; r < l->rows.n; r++) {
    for (int32_t c = 0; c < l->cols.n; c++) {
      int64_t x = z->f[(ptrdiff_t)r * z->cols[0] + c];
      l->heights[(size_t)r * (size_t)l->cols.n + (size_t)c] = (int32_t)clamp_i64(x, -most, most);
    }
  }
  u->n_bytes += n * (4 + (l->valid ? 1u : 0u) + (l->own ? 1u : 0u));
  return TWZ_OK;
}

twz_status decode_cdf53(const twz_file *f, unit *u, const unit *above, const uint8_t *payload, size_t n, scratch *s,
                        twz_error *error) {
  tile z;
  head h;
  memset(&z, 0, sizeof z);
  memset(&h, 0, sizeof h);
  reader r = {payload, n, 0};
  uint8_t *stream;
  begin_tile(&z, f, u);
  TRY(read_head(f, u, &r, &h, z.held[TOP] || z.held[LEFT] || z.held[BOTTOM] || z.held[RIGHT], error));
  parent p = parent_of(f, u->entry.at, above);
  TRY(decode_masks(f, u, &p, &h, s, error));
  TRY(take_memory(&z, s, n, &stream, error));
  TRY(join_pieces(f, &r, h.n_stream, stream, error));
  TRY(decode_stream(&z, &h, stream, f->rates, error));
  TRY(decode_borders(&z, &h.borders, f->rates, error));
  z.f[0] = h.low;
  if (above) { /* LL: the head's block */
    for (int32_t row = 0; row < z.rows[z.n_transforms]; row++) {
      for (int32_t col = 0; col < z.cols[z.n_transforms]; col++) {
        z.f[(ptrdiff_t)row * z.cols[0] + col] = parent_height(&p, row, col);
      }
    }
  }
  for (int t = z.n_transforms - 1; t >= 0; t--) {
    invert_transform(&z, t);
    if (t < u->n_layers) TRY(copy_level(f, &z, u, &u->layers[u->n_layers - 1 - t], error));
  }
  return TWZ_OK;
}
