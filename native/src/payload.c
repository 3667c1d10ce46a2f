/* Payloads of units: sections, then the method, then what holds for all methods (FORMAT §5.1, §5.3). */
#include "range.h"
#include "rapid.h"

uint64_t unit_bytes(const twz_file *f, place key) {
  uint64_t n = sizeof(unit), a_sample = cell_size(&f->heights) + 1;
  if (f->header.features & VOIDS) a_sample += 1;
  if (f->header.features & REMAINDERS) a_sample += 8;
  for (int level = first_level_of(key); level <= last_level_of(&f->grid, key); level++) {
    axis rows, cols;
    unit_axes(&f->grid, key, level, &rows, &cols);
    n += (uint64_t)rows.n * (uint64_t)cols.n * a_sample;
  }
  return n;
}

parent parent_of(const twz_file *f, place key, const unit *above) {
  parent p;
  memset(&p, 0, sizeof p);
  if (!above) return p;
  const grid *g = &f->grid;
  p.layer = &above->layers[key.level - above->first_level];
  p.is_void = above->is_void;
  uint32_t rings = (uint32_t)g->rings;
  uint32_t n_rows = level_size(g, g->n_rows, key.level), n_cols = level_size(g, g->n_cols, key.level);
  uint32_t row = key.row << g->block_log2, col = key.col << g->block_log2, size = 1u << g->block_log2;
  p.first_row = row - min_u32(row, rings);
  p.first_col = col - min_u32(col, rings);
  p.n_rows = (int32_t)(min_u32(row + size + rings, n_rows - 1) - p.first_row + 1);
  p.n_cols = (int32_t)(min_u32(col + size + rings, n_cols - 1) - p.first_col + 1);
  p.row = (int32_t)(p.first_row - p.layer->rows.first);
  p.col = (int32_t)(p.first_col - p.layer->cols.first);
  return p;
}

/* Step 1 of §5.1. */
static void clip(int32_t *heights, size_t n, int32_t low, int32_t high) {
  for (size_t i = 0; i < n; i++) heights[i] = min_i32(max_i32(heights[i], low), high);
}

/* Step 2 of §5.1: no valid sample keeps a height that is written as nodata. */
static twz_status move_from_nodata(const heights *h, layer *l, size_t n, const reader *exceptions, twz_error *error) {
  size_t n_met = 0;
  if (h->first <= h->last) {
    for (size_t i = 0; i < n; i++) {
      int32_t height = height_at(l, i);
      if (height < h->first || height > h->last || (l->valid && !l->valid[i])) continue;
      int is_down = 0;
      if (exceptions->bytes) {
        REQUIRE(n_met / 8 < exceptions->n, error, "the exception section is too short");
        is_down = exceptions->bytes[n_met / 8] >> (7 - n_met % 8) & 1;
      }
      int32_t moved = is_down ? h->first - 1 : h->last + 1;
      if (l->shorts) {
        l->shorts[i] = (int16_t)(moved - l->origin);
      } else {
        l->heights[i] = moved;
      }
      n_met++;
    }
  }
  if (!exceptions->bytes) return TWZ_OK;
  REQUIRE(exceptions->n == (n_met + 7) / 8, error, "an exception section of %llu bytes for %llu samples",
          (unsigned long long)exceptions->n, (unsigned long long)n_met);
  int n_filled = (int)((8 - n_met % 8) % 8);
  REQUIRE((exceptions->bytes[exceptions->n - 1] & ((1 << n_filled) - 1)) == 0, error,
          "a 1 in the filling of the exception section");
  return TWZ_OK;
}

/* §5.3. */
static twz_status decode_remainders(const twz_file *f, layer *l, size_t n, const reader *section, twz_error *error) {
  size_t width = dtype_size(f->header.dtype), n_planes = section->bytes[0], n_out;
  REQUIRE(n_planes >= 1 && n_planes <= width, error, "remainders of %llu bytes", (unsigned long long)n_planes);
  uint8_t *planes = twz_allocate(&f->allocator, n_planes * n);
  if (!planes) return twz_no_memory(error, n_planes * n);
  twz_status status = inflate_zlib(section->bytes + 1, section->n - 1, planes, n_planes * n, &n_out, "a section of remainders", error);
  if (status == TWZ_OK && n_out != n_planes * n) {
    status = twz_fail(error, TWZ_CORRUPT, "remainders of %llu bytes instead of %llu", (unsigned long long)n_out,
                      (unsigned long long)(n_planes * n));
  }
  if (status == TWZ_OK) {
    l->remainders = twz_allocate(&f->allocator, n * sizeof *l->remainders);
    if (!l->remainders) status = twz_no_memory(error, n * sizeof *l->remainders);
  }
  for (size_t i = 0; status == TWZ_OK && i < n; i++) {
    uint64_t z = 0;
    for (size_t k = 0; k < n_planes; k++) z |= (uint64_t)planes[k * n + i] << (8 * k);
    l->remainders[i] = (int64_t)(z & 1 ? ~(z >> 1) : z >> 1);
  }
  twz_release(&f->allocator, planes);
  return status;
}

/* §5.4. */
static twz_status decode_corrections(const job *j, const reader *section, int32_t *corrections, twz_error *error) {
  enum { PIECE = 32, N_MODELS = 170, FIRST_SAMPLE = 16, UNARY = 124, PREFIX = 138, MOST_PIECES = 2051 / PIECE + 1 };
  const layer *l = j->out;
  model models[N_MODELS];
  for (int i = 0; i < N_MODELS; i++) models[i] = FRESH_MODEL;
  uint8_t above[MOST_PIECES] = {0}, farther[MOST_PIECES] = {0}; /* bits of the pieces one and two rows up */
  coder c;
  coder_start(&c, section->bytes, section->n, j->file->rates);
  int k = max_i32(bit_length((uint64_t)j->file->header.step) - 5, 0), has_any = 0;
  ptrdiff_t pitch = l->cols.n;
  for (int32_t row = 0; row < l->rows.n && !coder_is_cut(&c); row++) {
    int p = (int)((l->rows.first + (uint32_t)row) & 1), before = 0;
    for (int32_t first = 0, piece = 0; first < l->cols.n; first += PIECE, piece++) {
      before = adaptive_bit(&c, &models[8 * p + 4 * before + 2 * above[piece] + farther[piece]]);
      farther[piece] = above[piece];
      above[piece] = (uint8_t)before;
      int32_t stop = before ? min_i32(first + PIECE, l->cols.n) : first;
      for (int32_t col = first; col < stop; col++) {
        int q = (int)((l->cols.first + (uint32_t)col) & 1);
        if (j->parent.layer && !p && !q) continue; /* inherited */
        int32_t *t = corrections + row * pitch + col;
        int west = (col > 0 && t[-1]) + (col > 1 && t[-2]), north = (row > 0 && t[-pitch]) + (row > 1 && t[-2 * pitch]);
        int diagonal = (row > 0 && col > 0 && t[-pitch - 1]) + (row > 0 && col + 1 < l->cols.n && t[1 - pitch]);
        if (!adaptive_bit(&c, &models[FIRST_SAMPLE + 27 * (2 * p + q) + 9 * west + 3 * north + diagonal])) continue;
        int is_negative = (int)raw_bits(&c, 1);
        int64_t size = 1 + magnitude(&c, models + UNARY, models + PREFIX, k);
        REQUIRE(size <= INT32_MAX, error, "a correction of 2^31 or more");
        *t = (int32_t)(is_negative ? -size : size);
        has_any = 1;
      }
    }
  }
  TRY(coder_end(&c, "corrections", error));
  REQUIRE(has_any, error, "a section of corrections that are all 0");
  return TWZ_OK;
}

enum { MASK, EXCEPTIONS, REMAINDER_BYTES, CORRECTED, N_SECTIONS };

static twz_status read_sections(const twz_file *f, reader *r, int is_finest, reader *sections, twz_error *error) {
  static const char *const NAMES[N_SECTIONS] = {"a mask", "exceptions", "remainders", "corrections"};
  int flags = r->bytes[r->at++], known = 1 << EXCEPTIONS;
  if (f->header.features & VOIDS) known |= 1 << MASK;
  if ((f->header.features & REMAINDERS) && is_finest) known |= 1 << REMAINDER_BYTES;
  if (f->header.features & CORRECTIONS) known |= 1 << CORRECTED;
  REQUIRE((flags & ~known) == 0, error, "flags %d of a payload", flags);
  for (int i = 0; i < N_SECTIONS; i++) {
    if (!(flags >> i & 1)) continue;
    TRY(read_section(r, &sections[i], NAMES[i], error));
    REQUIRE(sections[i].n >= 1, error, "a section of length 0: %s", NAMES[i]);
  }
  return TWZ_OK;
}

int rapid_bands(const twz_file *f, const uint8_t *payload, size_t n) {
  reader r = {payload, n, 0}, sections[N_SECTIONS];
  return read_sections(f, &r, 0, sections, NULL) == TWZ_OK && r.at < n ? (payload[r.at] >> 3 & 3) + 1 : 1;
}

static twz_status decode_heights(const job *j, const reader *rest, scratch *s, twz_error *error) {
  switch (j->file->header.method) {
    case TWZ_STORE: return decode_store(j, rest, error);
    case TWZ_RAPID: return decode_rapid(j, rest, s, error);
    case TWZ_PREDICTIVE: return decode_predictive(j, rest, s, error);
    default: return decode_cdf97(j, rest, s, error);
  }
}

static void lay_out(const twz_file *f, const order *o, unit *u) {
  place key = u->entry.at;
  u->first_level = first_level_of(key);
  u->n_layers = last_level_of(&f->grid, key) - u->first_level + 1;
  for (int i = 0; i < u->n_layers; i++) {
    layer *l = &u->layers[i];
    unit_axes(&f->grid, key, u->first_level + i, &l->rows, &l->cols);
    const part all = {0, 0, l->rows.n, l->cols.n};
    if (i > 0 || l->ready.end_row == 0 || o->n == 0) l->ready = all;
  }
}

/* Heights, corrected where there is a section that says so. */
static twz_status decode_corrected(job *j, const reader *section, const reader *rest, scratch *s, twz_error *error) {
  if (!section->bytes) return decode_heights(j, rest, s, error);
  const twz_allocator *a = &j->file->allocator;
  size_t n = (size_t)j->out->rows.n * (size_t)j->out->cols.n;
  int32_t *corrections = twz_allocate_zeros(a, n * sizeof *corrections);
  if (!corrections) return twz_no_memory(error, n * sizeof *corrections);
  j->corrections = corrections;
  twz_status status = decode_corrections(j, section, corrections, error);
  if (status == TWZ_OK) status = decode_heights(j, rest, s, error);
  twz_release(a, corrections);
  return status;
}

twz_status decode_unit(const twz_file *f, const order *o, scratch *s, twz_error *error) {
  unit *u = o->unit;
  place key = u->entry.at;
  lay_out(f, o, u);
  u->n_bytes = sizeof *u;
  u->is_void = o->n == 0;
  REQUIRE(!u->is_void || (f->header.features & VOIDS), error, "a unit without a payload in a file without voids");
  if (u->is_void) return TWZ_OK;
  if (f->header.method == TWZ_CDF53) return decode_cdf53(f, u, o->above, o->payload, o->n, s, error);

  layer *l = &u->layers[0];
  size_t n = (size_t)l->rows.n * (size_t)l->cols.n;
  int is_finest = u->first_level == f->grid.k_max, has_valid;
  reader rest = {o->payload, o->n, 0}, sections[N_SECTIONS];
  memset(sections, 0, sizeof sections);
  TRY(read_sections(f, &rest, is_finest, sections, error));
  job j = {f, key, u->first_level, l, parent_of(f, key, o->above), NULL, NULL, o->target_stride};
  TRY(decode_validity(f, l, &j.parent, is_finest, &sections[MASK], &has_valid, s, error));
  REQUIRE(has_valid, error, "a payload of a unit without a valid sample");
  /* Raw heights that are sums need no heights of the unit, where nothing else is done with these. */
  size_t size = dtype_size(f->header.dtype);
  u->is_written = o->target && f->header.method == TWZ_RAPID && key.level >= 0 && f->heights.is_sum && size > 1 &&
                  (uintptr_t)o->target % size == 0 && o->target_stride % (ptrdiff_t)size == 0 &&
                  f->heights.first > f->heights.last && !sections[EXCEPTIONS].bytes && !sections[REMAINDER_BYTES].bytes;
  if (u->is_written) {
    j.target = o->target;
  } else {
    void *memory = twz_allocate(&f->allocator, n * cell_size(&f->heights));
    if (!memory) return twz_no_memory(error, n * cell_size(&f->heights));
    if (f->heights.is_short) l->shorts = memory; else l->heights = memory;
    l->origin = f->heights.origin;
  }
  rest = (reader){rest.bytes + rest.at, rest.n - rest.at, 0};
  TRY(decode_corrected(&j, &sections[CORRECTED], &rest, s, error));
  if (u->is_written) return TWZ_OK;
  /* Each height of rapid is within its limits (R.9), which are within these. */
  if (f->header.method != TWZ_RAPID) clip(l->heights, n, f->header.z_min, f->header.z_max);
  TRY(move_from_nodata(&f->heights, l, n, &sections[EXCEPTIONS], error));
  if (sections[REMAINDER_BYTES].bytes) TRY(decode_remainders(f, l, n, &sections[REMAINDER_BYTES], error));
  u->n_bytes += n * (cell_size(&f->heights) + (l->valid ? 1u : 0u) + (l->own ? 1u : 0u) + (l->remainders ? 8u : 0u));
  return TWZ_OK;
}
