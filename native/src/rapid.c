/* Method rapid: tables of a file (R.10), payloads, root blocks. */
#include "rapid.h"

#include "kernels.h"
#include "range.h"
#include "tables.h"

enum {
  N_FAMILIES = 6, MOST_CODE = 255, N_MODELS = 646, OWN_CODES = 644, /* the first of two models */
  OF_FREQUENCIES = 2, OF_WEIGHTS = 8, /* groups of models */
  N_PAIR_SYMBOLS = PAIR_ESCAPE + 1, N_SINGLE_SYMBOLS = SINGLE_ESCAPE + 1, MOST_SUM = 1 << 18
};

/* A family of the annex (R.11). */
typedef struct family {
  uint8_t cut, weights[N_LEVEL_CLASSES][3][4];
  uint8_t pairs[MOST_CLASS + 1][N_PAIR_SYMBOLS], singles[MOST_CLASS + 2][N_SINGLE_SYMBOLS];
} family;

/* Taps of planes, and of these the core's, the missing one first (R.3). */
static const int TAPS[3] = {16, 20, 24};
static const int CORE_TAPS[3][4] = {{5, 6, 9, 10}, {5, 6, 14, 17}, {4, 7, 15, 16}};

static int32_t value_of_code(int g) {
  if (g < 32) return g;
  int e = ((g - 32) >> 4) + 1;
  return ((16 + g % 16) << e) + (1 << (e - 1));
}

/* A magnitude of a group of 46 models (R.10). */
static int64_t read_magnitude(coder *c, model *models, int group) {
  return magnitude(c, models + 46 * group, models + 46 * group + 14, 0);
}

twz_status read_changed_stencil(coder *c, model *models, int n_taps, const int *core, int16_t *stencil, twz_error *error) {
  int shift = (int)raw_bits(c, 3);
  int64_t sum = 0;
  for (int tap = 0; tap < n_taps; tap++) {
    if (tap == core[0]) continue;
    int is_core = tap == core[1] || tap == core[2] || tap == core[3];
    int64_t m = read_magnitude(c, models, is_core ? 0 : 1);
    REQUIRE(m <= 65534, error, "parameters: a weight changes by more than 65534");
    if (m > 0 && raw_bits(c, 1)) m = -m;
    int64_t weight = stencil[tap] + m * ((int64_t)1 << shift);
    REQUIRE(weight >= -32767 && weight <= 32767, error, "parameters: a weight beyond 32767");
    stencil[tap] = (int16_t)weight;
    sum += weight;
  }
  REQUIRE(4096 - sum >= -32767 && 4096 - sum <= 32767, error, "parameters: a weight beyond 32767");
  stencil[core[0]] = (int16_t)(4096 - sum);
  return TWZ_OK;
}

static twz_status read_stencil(coder *c, model *models, int plane, int16_t *stencil, twz_error *error) {
  memcpy(stencil, twz_rapid_stencils[plane][raw_bits(c, 4)], sizeof(int16_t) * N_TAPS);
  if (raw_bits(c, 1)) TRY(read_changed_stencil(c, models, TAPS[plane], CORE_TAPS[plane], stencil, error));
  int32_t sum = 0;
  for (int k = 0; k < N_TAPS; k++) sum += stencil[k] < 0 ? -stencil[k] : stencil[k];
  REQUIRE(sum <= MOST_SUM, error, "parameters: a stencil whose absolute weights sum to %d", sum);
  return TWZ_OK;
}

/* Change codes of the annex, all but number `skipped`. */
static twz_status read_codes(coder *c, model *models, int group, int n, int skipped, uint8_t *codes, twz_error *error) {
  int before = 0;
  for (int k = 0; k < n; k++) {
    if (k == skipped) continue;
    int g = codes[k];
    int64_t m = read_magnitude(c, models, group + (g ? 3 : 0) + before);
    REQUIRE(m <= MOST_CODE, error, "parameters: a code changes by more than 255");
    before = min_i32(bit_length((uint64_t)m), 2);
    int code = m > 0 && g > 0 && raw_bits(c, 1) ? g - (int)m : g + (int)m;
    REQUIRE(code >= 0 && code <= MOST_CODE, error, "parameters: code %d", code);
    codes[k] = (uint8_t)code;
  }
  return TWZ_OK;
}

/* What the stream of a file says (R.10). */
static twz_status read_stream(const twz_file *f, rapid_tables *t, family *of, const uint8_t *bytes, size_t n, twz_error *error) {
  coder c;
  model models[N_MODELS];
  coder_start(&c, bytes, n, f->rates);
  for (int i = 0; i < N_MODELS; i++) models[i] = FRESH_MODEL;
  for (int i = 0; i < 3 * N_LEVEL_CLASSES; i++) TRY(read_stencil(&c, models, i % 3, t->stencils[i / 3][i % 3], error));
  for (int i = 0; i < 3 * N_LEVEL_CLASSES; i++) {
    TRY(read_codes(&c, models, OF_WEIGHTS, i % 3 ? 4 : 3, -1, of->weights[i / 3][i % 3], error));
  }
  of->cut = (uint8_t)raw_bits(&c, 6);
  REQUIRE(of->cut <= MOST_CLASS + 1, error, "parameters: a cut of %d", of->cut);
  int is_own = 0;
  for (int i = 0; i < of->cut; i++) {
    is_own = adaptive_bit(&c, &models[OWN_CODES + is_own]);
    if (is_own) TRY(read_codes(&c, models, OF_FREQUENCIES, N_PAIR_SYMBOLS, NO_DETAILS, of->pairs[i], error));
  }
  for (int i = 0; i < MOST_CLASS + 2; i++) {
    is_own = adaptive_bit(&c, &models[OWN_CODES + is_own]);
    if (is_own) TRY(read_codes(&c, models, OF_FREQUENCIES, N_SINGLE_SYMBOLS, NO_DETAIL, of->singles[i], error));
  }
  return coder_end(&c, "parameters", error);
}

/* The slots of a table: `rest` has those that the others leave; symbols from `first_sure` on have one at least. */
static twz_status fill_slots(rapid_tables *t, int table, const uint8_t *codes, int n, int rest, int first_sure, twz_error *error) {
  int32_t frequencies[N_PAIR_SYMBOLS], others = 0;
  for (int s = 0; s < n; s++) {
    frequencies[s] = s == rest ? 0 : value_of_code(codes[s]) + (s >= first_sure);
    others += frequencies[s];
  }
  REQUIRE(others < SLOTS, error, "parameters: frequencies of table %d leave no slot to details of 0", table);
  frequencies[rest] = SLOTS - others;
  t->rests[table] = (rapid_rest){0, (uint16_t)frequencies[rest]};
  for (int s = 0; s < rest; s++) t->rests[table].first = (uint16_t)(t->rests[table].first + frequencies[s]);
  uint32_t *slot = t->slots + ((size_t)table << SLOT_BITS);
  for (uint32_t s = 0; s < (uint32_t)n; s++) {
    uint32_t m = (uint32_t)frequencies[s];
    for (uint32_t y = 0; y < m; y++) slot[y] = s | (m - 1) << 8 | y << 20;
    slot += m;
  }
  return TWZ_OK;
}

/* By which of eight pairs are two entries: where entries of pairs and singles in turn are. */
void rapid_fill_orders(rapid_tables *t) {
  for (unsigned mask = 0; mask < 256; mask++) {
    uint8_t n = 0, below = 0;
    for (uint8_t k = 0; k < 16; k++) {
      int is_there = k % 2 == 0 || (mask >> (k / 2) & 1);
      t->put[mask][k] = is_there ? n : 128;
      if (is_there) t->take[mask][n++] = k;
    }
    while (n < 16) t->take[mask][n++] = 128;
    for (int lane = 0; lane < 8; lane++) {
      t->expand[mask][lane] = below;
      below = (uint8_t)(below + (mask >> lane & 1));
    }
  }
}

static twz_status read_tables(const twz_file *f, rapid_tables *t, const uint8_t *parameters, size_t n, twz_error *error) {
  int number = n ? parameters[0] >> 5 : f->header.step == 1 ? 0 : f->header.step == 3 ? 1 : 2;
  REQUIRE(number < N_FAMILIES, error, "parameters: family %d of tables, and there are %d", number, N_FAMILIES);
  family of;
  size_t n_bytes;
  TRY(inflate_zlib(twz_rapid_families[number], twz_rapid_families_size[number], (uint8_t *)&of, sizeof of, &n_bytes,
                   "a table of this library", error));
  t->k_max = n ? parameters[0] & 31 : 0;
  for (int i = 0; i < 3 * N_LEVEL_CLASSES; i++) memcpy(t->stencils[i / 3][i % 3], twz_rapid_stencils[i % 3][0], sizeof(int16_t) * N_TAPS);
  if (n > 1) TRY(read_stream(f, t, &of, parameters + 1, n - 1, error));
  t->cut = of.cut;
  for (int i = 0; i < 12 * N_LEVEL_CLASSES; i++) t->weights[i / 12][i / 4 % 3][i % 4] = value_of_code(of.weights[i / 12][i / 4 % 3][i % 4]);
  for (int class = 0; class < N_LEVEL_CLASSES; class++) t->weights[class][HH][3] = 0;
  for (int i = 0; i < SINGLES; i++) {
    static const uint8_t none[N_PAIR_SYMBOLS];
    int has_pairs = i <= MOST_CLASS, has_singles = i <= MOST_CLASS || i == ESCAPED - SINGLES;
    const uint8_t *singles = !has_singles ? none : i <= MOST_CLASS ? of.singles[i] : of.singles[MOST_CLASS + 1];
    TRY(fill_slots(t, i, has_pairs ? of.pairs[i] : none, N_PAIR_SYMBOLS, NO_DETAILS, has_pairs ? PAIR_ESCAPE : SLOTS, error));
    TRY(fill_slots(t, SINGLES + i, singles, N_SINGLE_SYMBOLS, NO_DETAIL, has_singles ? 0 : SLOTS, error));
  }
  rapid_fill_orders(t);
  return TWZ_OK;
}

twz_status rapid_tables_new(twz_file *f, const uint8_t *parameters, size_t n, twz_error *error) {
  f->rapid = twz_allocate_pages(&f->allocator, sizeof *f->rapid);
  if (!f->rapid) return twz_no_memory(error, sizeof *f->rapid);
  return read_tables(f, f->rapid, parameters, n, error);
}

void weigh_rapid(const rapid_unit *u, int plane, rapid_weights *made) {
  enum { MOST_WEIGHT = 1 << 13, TO_STEPS = 2 };
  const int32_t *v = u->tables->weights[u->level_class][plane];
  int64_t most = max_i32(v[1], v[2]);
  int more = 0;
  while (more < 16 && (most << (u->shift + more + 1)) / u->step < MOST_WEIGHT << TO_STEPS) more++;
  made->constant = (v[0] >> TO_STEPS) + 1;
  made->of_range = (int32_t)min_i64((((int64_t)v[1] << (u->shift + more)) / u->step) >> TO_STEPS, MOST_WEIGHT - 1);
  made->of_bend = (int32_t)min_i64((((int64_t)v[2] << (u->shift + more)) / u->step) >> TO_STEPS, MOST_WEIGHT - 1);
  made->of_near = min_i32(v[3] >> TO_STEPS, (1 << 15) - 1);
  made->shift = more;
}

/* ---- Payloads (R.1) ---- */

twz_status rapid_open_payload(rapid_unit *u, const reader *bytes, twz_error *error) {
  static const uint8_t STATES[4] = {1, 8, 32, 0};
  reader r = *bytes;
  int flags, shift = 0;
  uint64_t number = 0, n_words[MOST_BANDS], n_raw[MOST_BANDS];
  TRY(read_byte(&r, &flags, error));
  u->is_narrow = flags & 1;
  u->n_states = STATES[flags >> 1 & 3];
  u->n_bands = (flags >> 3 & 3) + 1;
  REQUIRE(flags < 64 && u->n_states && (!u->is_narrow || u->step <= LIMIT) && (u->parent || u->short_parent || u->n_bands == 1),
          error, "flags %d of method rapid", flags);
  if (!u->is_narrow) TRY(read_byte(&r, &shift, error));
  REQUIRE(shift <= 30, error, "heights that are shifted by %d bits", shift);
  u->shift = shift;
  if (flags & 32) TRY(read_varint(&r, &number, error));
  int64_t middle = shift_right((int64_t)u->z_min + u->z_max, 1), k = (int64_t)(number >> 1) ^ -(int64_t)(number & 1);
  int64_t origin = middle + clamp_i64(k, -INT32_MAX, INT32_MAX) * ((int64_t)1 << min_i32(10 + shift, 31));
  REQUIRE(origin >= u->z_min && origin <= u->z_max, error, "an origin outside of the range of heights");
  u->origin = (int32_t)origin;
  u->low = u->is_narrow ? max_i32(u->z_min, u->origin - LIMIT) : u->z_min;
  u->high = u->is_narrow ? min_i32(u->z_max, u->origin + LIMIT) : u->z_max;
  for (int i = 0; i < u->n_bands; i++) {
    TRY(read_varint(&r, &n_words[i], error));
    TRY(read_varint(&r, &n_raw[i], error));
  }
  for (int i = 0; i < u->n_bands; i++) {
    rapid_stream *z = &u->bands[i];
    size_t n_left = r.n - r.at, n_states = 4 * (size_t)u->n_states;
    REQUIRE(n_left >= n_states && n_words[i] <= (n_left - n_states) / 2 && n_raw[i] <= n_left - n_states - 2 * n_words[i], error,
            "streams of method rapid that the payload has no room for");
    for (int s = 0; s < u->n_states; s++, r.at += 4) {
      z->states[s] = load_u32(r.bytes + r.at);
      REQUIRE(z->states[s] >= FIRST_STATE, error, "a state of method rapid below 65536");
    }
    z->words = r.bytes + r.at;
    z->words_end = z->raw = z->words + 2 * n_words[i];
    z->n_raw = (size_t)n_raw[i];
    z->n_bits = 0;
    r.at += 2 * (size_t)n_words[i] + z->n_raw;
  }
  REQUIRE(r.at == r.n, error, "%llu bytes behind the streams of method rapid", (unsigned long long)(r.n - r.at));
  return TWZ_OK;
}

/* Streams end where they should; those of a part are not exceeded. */
twz_status rapid_close_payload(const rapid_unit *u, int is_part, twz_error *error) {
  for (int i = 0; i < u->n_bands; i++) {
    const rapid_stream *z = &u->bands[i];
    REQUIRE(z->words <= z->words_end && z->n_bits <= 8 * z->n_raw, error, "streams of method rapid are cut");
    if (is_part) continue;
    REQUIRE(z->words == z->words_end && (z->n_bits + 7) / 8 == z->n_raw, error, "bytes are left over behind the streams of method rapid");
    for (int s = 0; s < u->n_states; s++) REQUIRE(z->states[s] == FIRST_STATE, error, "a state of method rapid ends elsewhere");
    REQUIRE(z->n_bits % 8 == 0 || z->raw[z->n_raw - 1] >> z->n_bits % 8 == 0, error, "a 1 above the last raw bit");
  }
  return TWZ_OK;
}

/* ---- Root blocks (R.2) ---- */

/* A sample that nothing predicts. */
int32_t rapid_read_corner(rapid_unit *u, int is_valid, int32_t correction) {
  int64_t height = shift_right((int64_t)u->low + u->high, 1);
  if (is_valid) {
    rapid_stream *z = &u->bands[0];
    int n_bits = bit_length((uint64_t)((u->high - u->low) / u->step));
    uint64_t bits = load_u64(z->raw + min_size(z->n_bits >> 3, z->n_raw)) >> (z->n_bits & 7);
    z->n_bits += (size_t)n_bits;
    height = min_i64(u->low + (int64_t)(bits & (((uint64_t)1 << n_bits) - 1)) * u->step + (u->step >> 1), u->high);
  }
  return (int32_t)clamp_i64(height + correction, u->low, u->high);
}

static twz_status decode_root(rapid_unit *u, const job *j, twz_error *error) {
  const layer *l = j->out;
  int32_t n_rows = l->rows.n, n_cols = l->cols.n, stride = 1;
  int level_class = j->file->rapid->k_max - j->level;
  while (stride < max_i32(n_rows, n_cols) - 1) stride *= 2;
  size_t n = (size_t)n_rows * (size_t)n_cols;
  int32_t *memory = twz_allocate(&j->file->allocator, 2 * n * sizeof *memory), *heights = memory, *others = memory ? memory + n : NULL;
  if (!memory) return twz_no_memory(error, 2 * n * sizeof *memory);
  u->n_rows = (n_rows - 1) / stride + 1;
  u->n_cols = (n_cols - 1) / stride + 1;
  for (int32_t row = 0; row < u->n_rows; row++) {
    for (int32_t col = 0; col < u->n_cols; col++) {
      ptrdiff_t at = ((ptrdiff_t)row * n_cols + col) * stride;
      heights[row * u->n_cols + col] = rapid_read_corner(u, !l->valid || l->valid[at], j->corrections ? j->corrections[at] : 0);
    }
  }
  twz_status status = TWZ_OK;
  u->add = 0;
  u->is_short = 0;
  for (stride /= 2; stride && status == TWZ_OK; stride /= 2) {
    u->parent = heights;
    u->parent_stride = u->n_cols;
    u->n_rows = u->rows[1] = (n_rows - 1) / stride + 1;
    u->n_cols = u->cols[1] = (n_cols - 1) / stride + 1;
    u->out = others;
    u->out_stride = u->n_cols;
    u->level_class = (int)clamp_i64(level_class + bit_length((uint64_t)stride) - 1, 0, N_LEVEL_CLASSES - 1);
    u->valid_stride = u->corrections_stride = stride * (ptrdiff_t)n_cols;
    u->valid_step = u->corrections_step = stride;
    status = j->file->kernels->decode_rapid(u, error);
    others = heights;
    heights = u->out;
  }
  for (size_t i = 0; status == TWZ_OK && i < n; i++) {
    if (l->shorts) l->shorts[i] = (int16_t)(heights[i] - l->origin); else l->heights[i] = heights[i];
  }
  twz_release(&j->file->allocator, memory);
  return status;
}

twz_status decode_rapid(const job *j, const reader *bytes, scratch *s, twz_error *error) {
  static const int32_t zeros[1025];
  const layer *l = j->out;
  const parent *p = &j->parent;
  const header *h = &j->file->header;
  rapid_unit u;
  memset(&u, 0, offsetof(rapid_unit, bands));
  memset(&u.n_rows, 0, sizeof u - offsetof(rapid_unit, n_rows));
  u.tables = j->file->rapid;
  u.scratch = s;
  u.step = h->step;
  u.z_min = h->z_min;
  u.z_max = h->z_max;
  u.valid = l->valid;
  u.corrections = j->corrections;
  if (p->layer && !p->is_void) {
    u.parent_stride = p->layer->cols.n;
    ptrdiff_t at = p->row * u.parent_stride + p->col;
    if (p->layer->shorts) u.short_parent = p->layer->shorts + at; else u.parent = p->layer->heights + at;
    u.parent_origin = p->layer->origin;
  } else if (p->layer) {
    u.parent = zeros;
  }
  TRY(rapid_open_payload(&u, bytes, error));
  /* Levels are rounded down: predictions lie up to one level below the lowest height. */
  u.most_detail = (int32_t)min_i64(((int64_t)h->z_max - h->z_min + ((int64_t)1 << u.shift)) / h->step + 1, INT32_MAX);
  if (!p->layer) {
    TRY(decode_root(&u, j, error));
    return rapid_close_payload(&u, 0, error);
  }
  u.n_rows = l->rows.n;
  u.n_cols = l->cols.n;
  u.rows[0] = l->ready.row;
  u.rows[1] = l->ready.end_row;
  u.cols[0] = l->ready.col;
  u.cols[1] = l->ready.end_col;
  u.level_class = (int)clamp_i64(u.tables->k_max - j->level, 0, N_LEVEL_CLASSES - 1);
  u.valid_stride = u.corrections_stride = l->cols.n;
  u.valid_step = u.corrections_step = 1;
  for (int side = 0; side < 4; side++) u.known[side] = side % 2 ? l->cols.shared[side / 2] : l->rows.shared[side / 2];
  u.is_short = l->shorts != NULL;
  u.out = u.is_short ? (void *)l->shorts : (void *)l->heights;
  u.out_stride = l->cols.n;
  u.add = u.is_short ? (uint32_t)-l->origin : 0;
  if (j->target) {
    ptrdiff_t size = (ptrdiff_t)dtype_size(h->dtype);
    u.is_short = size == 2;
    u.out_stride = j->target_stride / size;
    u.out = j->target - u.rows[0] * j->target_stride - u.cols[0] * size;
    u.add = (uint32_t)j->file->heights.base;
  }
  TRY(j->file->kernels->decode_rapid(&u, error));
  return rapid_close_payload(&u, u.is_part, error);
}
