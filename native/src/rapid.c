/* Method rapid: tables of a file (R.10), streams and limits of a unit (R.1, R.2). */
#include "rapid.h"

#include "kernels.h"
#include "range.h"
#include "tables.h"

enum {
  REACH_LAYOUT = 3, WEIGHTS_LAYOUT = 5, N_FAMILIES = 6, N_CODES = N_CONTEXTS * N_SYMBOLS, MOST_CODE = 127,
  N_MODELS = 416, OWN_CODES = 414 /* the first of two models */
};

static const int TAPS[3] = {19, 19, 23};
/* Of a stencil: the taps of the core, c_1 first (R.6). */
static const int CORE_TAPS[3][4] = {{5, 6, 9, 10}, {1, 2, 9, 12}, {1, 2, 12, 13}};

static int32_t value_of_code(int g) {
  if (g < 32) return g;
  int e = ((g - 32) >> 4) + 1;
  return ((16 + g % 16) << e) + (1 << (e - 1));
}

/* The first symbol with the greatest code of the annex. */
static int rest_symbol(const uint8_t *trained) {
  int rest = 0;
  for (int s = 1; s < N_SYMBOLS; s++) {
    if (trained[s] > trained[rest]) rest = s;
  }
  return rest;
}

static twz_status fill_slots(rapid_tables *t, const uint8_t *codes, const uint8_t *trained, twz_error *error) {
  for (int context = 0; context < N_CONTEXTS; context++) {
    const uint8_t *own = codes + context * N_SYMBOLS;
    int rest = rest_symbol(trained + context * N_SYMBOLS);
    int32_t frequencies[N_SYMBOLS];
    int64_t others = 0;
    for (int s = 0; s < N_SYMBOLS; s++) {
      frequencies[s] = s == rest ? 0 : value_of_code(own[s]);
      others += frequencies[s];
    }
    REQUIRE(others < SLOTS, error, "parameters: frequencies of context %d are too large", context);
    frequencies[rest] = (int32_t)(SLOTS - others);
    REQUIRE(frequencies[0] >= 1, error, "parameters: symbol 0 of context %d has no frequency", context);
    uint32_t *slot = t->slots + context * SLOTS;
    for (uint32_t s = 0; s < N_SYMBOLS; s++) {
      uint32_t f = (uint32_t)frequencies[s];
      for (uint32_t y = 0; y < f; y++) *slot++ = s | f << 6 | y << 18;
    }
  }
  return TWZ_OK;
}

/* A magnitude of a group of 46 models (P.10, R.10). */
static int64_t read_magnitude(coder *c, model *models, int group) {
  return magnitude(c, models + 46 * group, models + 46 * group + 14, 0);
}

static twz_status read_stencil(coder *c, model *models, int plane, int16_t *stencil, twz_error *error) {
  int set = (int)raw_bits(c, 4);
  REQUIRE(set < RAPID_SETS, error, "parameters: stencil %d of plane %d does not exist", set, plane);
  memcpy(stencil, twz_rapid_stencils[plane][set], sizeof(int16_t) * N_TAPS);
  if (!raw_bits(c, 1)) return TWZ_OK;
  return read_changed_stencil(c, models, TAPS[plane], CORE_TAPS[plane], stencil, error);
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

static twz_status read_codes(coder *c, model *models, const uint8_t *trained, uint8_t *codes, twz_error *error) {
  int is_own = 0;
  for (int context = 0; context < N_CONTEXTS; context++) {
    is_own = adaptive_bit(c, &models[OWN_CODES + is_own]);
    if (!is_own) continue;
    const uint8_t *annex = trained + context * N_SYMBOLS;
    int rest = rest_symbol(annex), before = 0;
    for (int s = 0; s < N_SYMBOLS; s++) {
      if (s == rest) continue;
      int g = annex[s];
      int64_t m = read_magnitude(c, models, (g ? 5 : 2) + min_i32(bit_length((uint64_t)before), 2));
      REQUIRE(m <= MOST_CODE, error, "parameters: a code changes by more than 127");
      before = (int)m;
      int code = m > 0 && g > 0 && raw_bits(c, 1) ? g - before : g + before;
      REQUIRE(code >= 0 && code <= MOST_CODE, error, "parameters: code %d of a frequency", code);
      codes[context * N_SYMBOLS + s] = (uint8_t)code;
    }
  }
  return TWZ_OK;
}

/* What the file says of V_k of the classes 0 ... n_classes - 1, rows HH, HL, LH, instead of the table (R.10). */
static twz_status read_weights(coder *c, model *models, int n_classes, int32_t (*features)[4][9], twz_error *error) {
  static const uint8_t SHIFTS[9] = {14, 7, 7, 7, 13, 13, 9, 7, 7};
  static const uint8_t TERMS[3][9] = {{0, 1, 2, 1, 1, 1, 4, 0, 0}, {0, 1, 2, 1, 1, 1, 2, 2, 4}, {0, 1, 2, 1, 1, 1, 2, 6, 4}};
  int codes[3][9] = {{12, 58, 50, 25, 33, 35, 57, 0, 0}, {4, 39, 37, 10, 25, 24, 37, 49, 32}, {4, 35, 19, 18, 22, 22, 35, 48, 23}};
  for (int i = 0; i < n_classes * 3; i++) {
    int class = i / 3, plane = i % 3;
    int64_t sum = 0;
    for (int k = 0; k < 9; k++) {
      int32_t *v = &features[class][plane][k];
      *v = 0;
      if (plane == 0 && k > 6) continue; /* HH has no planes before it */
      int64_t m = read_magnitude(c, models, 8);
      REQUIRE(m <= MOST_CODE, error, "parameters: a code of a weight changes by more than 127");
      if (m > 0 && raw_bits(c, 1)) m = -m;
      codes[plane][k] += (int)m;
      REQUIRE(codes[plane][k] >= 0 && codes[plane][k] <= MOST_CODE, error, "parameters: code %d of a weight", codes[plane][k]);
      *v = value_of_code(codes[plane][k]) << SHIFTS[k];
      sum += (int64_t)TERMS[plane][k] * *v * (k >= 4 && k <= 6 ? 1 : 8);
    }
    REQUIRE(sum < (1 << 24) - (1 << 15), error, "parameters: weights of features whose sums do not fit");
  }
  return TWZ_OK;
}

/* Of V_k of each class and row. */
static void scale_features(rapid_tables *t, const int32_t (*features)[4][9], int32_t n) {
  int log2 = bit_length((uint64_t)n) - 1, range_shift = max_i32(log2 - 4, 0);
  for (int i = 0; i < N_CLASSES * 4 * 9; i++) {
    int class = i / 36, row = i / 9 % 4, k = i % 9;
    int shift = k == 0 ? 0 : k >= 4 && k <= 6 ? range_shift : log2;
    int64_t scaled = floor_div((int64_t)features[class][row][k] * ((int64_t)1 << shift), k ? n : 1);
    t->features[class][row][k] = (int32_t)shift_right(scaled + 128, 8);
  }
}

static twz_status take_codes(uint8_t *codes, int layout, int family, twz_error *error) {
  size_t n;
  int i = layout * N_FAMILIES + family;
  TRY(inflate_zlib(twz_rapid_codes[i], twz_rapid_codes_size[i], codes, N_CODES, &n, "a table of this library", error));
  return TWZ_OK;
}

static twz_status read_tables(twz_file *f, rapid_tables *t, const uint8_t *parameters, size_t n, twz_error *error) {
  uint8_t trained[N_CODES], codes[N_CODES];
  int32_t step = f->header.step;
  int family = step == 1 ? 0 : step == 3 ? 1 : 2, layout = n ? parameters[0] : 1;
  REQUIRE_KNOWN(layout == 1 || layout == REACH_LAYOUT || layout == WEIGHTS_LAYOUT, error, "parameters of layout %d, which a newer release may know", layout);
  t->is_by_reach = layout == REACH_LAYOUT;
  for (int i = 0; i < N_CLASSES * 3; i++) {
    memcpy(t->stencils[i / 3][i % 3], twz_rapid_stencils[i % 3][0], sizeof(int16_t) * N_TAPS);
  }
  coder c;
  model models[N_MODELS];
  int n_classes = 0; /* that have weights of the file's own */
  if (n) {
    coder_start(&c, parameters + 1, n - 1, f->rates);
    for (int i = 0; i < N_MODELS; i++) models[i] = FRESH_MODEL;
    t->k_max = (int)raw_bits(&c, 5);
    family = (int)raw_bits(&c, 3);
    REQUIRE(family < N_FAMILIES, error, "parameters: family %d of frequencies", family);
    if (layout == WEIGHTS_LAYOUT) {
      t->is_by_reach = (int)raw_bits(&c, 1);
      n_classes = 1 + (int)raw_bits(&c, 2);
    }
    for (int i = 0; i < N_CLASSES * 3; i++) {
      TRY(read_stencil(&c, models, i % 3, t->stencils[i / 3][i % 3], error));
    }
  }
  int32_t features[N_CLASSES][4][9];
  memcpy(features, twz_rapid_features[family / 3], sizeof features);
  if (n_classes) TRY(read_weights(&c, models, n_classes, features, error));
  TRY(take_codes(trained, t->is_by_reach, family, error));
  memcpy(codes, trained, sizeof codes);
  if (n) {
    TRY(read_codes(&c, models, trained, codes, error));
    TRY(coder_end(&c, "parameters", error));
  }
  for (int i = 0; i < N_CLASSES * 3; i++) {
    int64_t sum = 0;
    for (int k = 0; k < N_TAPS; k++) sum += abs_i64(t->stencils[i / 3][i % 3][k]);
    t->widest = max_i64(t->widest, sum);
  }
  scale_features(t, (const int32_t (*)[4][9])features, step);
  for (int mask = 0; mask < 256; mask++) {
    for (int lane = 0, below = 0; lane < 8; lane++) {
      t->expand[mask][lane] = (uint8_t)below;
      below += mask >> lane & 1;
    }
  }
  return fill_slots(t, codes, trained, error);
}

twz_status rapid_tables_new(twz_file *f, const uint8_t *parameters, size_t n, twz_error *error) {
  f->rapid = twz_allocate_zeros(&f->allocator, sizeof *f->rapid);
  if (!f->rapid) return twz_no_memory(error, sizeof *f->rapid);
  return read_tables(f, f->rapid, parameters, n, error);
}

/* ---- Units ---- */

static twz_status open_streams(rapid_streams *z, const reader *bytes, twz_error *error) {
  reader r = *bytes;
  REQUIRE(r.n > 0, error, "a payload without a byte of method rapid");
  int flags = r.bytes[r.at++];
  REQUIRE(flags < 4, error, "flags %d of method rapid", flags);
  uint64_t n_words;
  TRY(read_varint(&r, &n_words, error));
  z->n_states = flags & 2 ? 1 : 8;
  REQUIRE(r.n - r.at >= 4 * z->n_states && n_words <= (r.n - r.at - 4 * z->n_states) / 2, error,
          "%llu words of method rapid where there is no room for them", (unsigned long long)n_words);
  for (uint32_t i = 0; i < z->n_states; i++, r.at += 4) z->states[i] = load_u32(r.bytes + r.at);
  z->n_words = (size_t)n_words;
  z->words = r.bytes + r.at;
  z->raw = z->words + 2 * z->n_words;
  z->n_raw = r.n - r.at - 2 * z->n_words;
  return TWZ_OK;
}

static twz_status close_streams(const rapid_unit *u, twz_error *error) {
  const rapid_streams *z = &u->streams;
  if (u->job->out->n_ready) { /* what follows is not known */
    REQUIRE(z->n_words_used <= z->n_words && z->n_bits <= 8 * z->n_raw, error, "streams of method rapid are cut");
    return TWZ_OK;
  }
  REQUIRE(z->n_words_used == z->n_words, error, "%llu words of method rapid, %llu are there",
          (unsigned long long)z->n_words_used, (unsigned long long)z->n_words);
  for (uint32_t i = 0; i < z->n_states; i++) REQUIRE(z->states[i] == 65536, error, "a state of method rapid ends elsewhere");
  REQUIRE((z->n_bits + 7) / 8 == z->n_raw, error, "raw bits of %llu bytes, %llu are there",
          (unsigned long long)((z->n_bits + 7) / 8), (unsigned long long)z->n_raw);
  REQUIRE(z->n_bits % 8 == 0 || z->raw[z->n_raw - 1] >> z->n_bits % 8 == 0, error, "a 1 above the last raw bit");
  return TWZ_OK;
}

/* R.2: what fits 32 bits. */
static const int64_t MOST_SUM = ((int64_t)1 << 31) - 64;

static void find_limits(rapid_unit *u, int is_wide) {
  const header *h = &u->job->file->header;
  const parent *p = &u->job->parent;
  rapid_scale *c = &u->scale;
  c->low = h->z_min;
  c->high = h->z_max;
  if (is_wide) return;
  const int64_t widest = u->tables->widest;
  int64_t origin = 0, reach = MOST_SUM / widest;
  if (p->layer && max_i64(-(int64_t)h->z_min, h->z_max) * widest > MOST_SUM) {
    int32_t low = INT32_MAX, high = INT32_MIN;
    for (int32_t r = 0; r < p->n_rows; r++) {
      for (int32_t i = 0; i < p->n_cols; i++) {
        int32_t height = parent_height(p, r, i);
        low = min_i32(low, height);
        high = max_i32(high, height);
      }
    }
    origin = shift_right((int64_t)low + high, 1);
  }
  c->low = (int32_t)(max_i64(h->z_min, origin - reach) - origin);
  c->high = (int32_t)(min_i64(h->z_max, origin + reach) - origin);
  c->origin = (int32_t)origin;
}

static twz_status open_unit(rapid_unit *u, const job *j, const reader *bytes, scratch *s, twz_error *error) {
  memset(u, 0, sizeof *u);
  u->job = j;
  u->tables = j->file->rapid;
  u->scratch = s;
  TRY(open_streams(&u->streams, bytes, error));
  u->streams.expand = u->tables->expand;
  int is_wide = bytes->bytes[0] & 1;
  find_limits(u, is_wide);
  rapid_scale *c = &u->scale;
  REQUIRE(c->low <= c->high, error, "a unit whose heights lie outside of what it can hold: it is not wide");
  int32_t n = j->file->header.step;
  c->step = n;
  c->log2 = bit_length((uint64_t)n) - 1;
  c->is_fine = n <= 3;
  c->is_by_reach = u->tables->is_by_reach;
  c->side_shift = max_i32(c->log2 - 5, 0);
  c->range_shift = max_i32(c->log2 - 4, 0);
  c->most_range = (1 << (15 + min_i32(c->log2, 4))) - 1;
  c->side_scale = (int32_t)(65536 / (8 * (int64_t)n));
  c->far_scale = (int32_t)(((int64_t)1024 << c->log2) / n);
  c->end_shift = 2 + c->log2 - c->side_shift;
  c->most_detail = ((int64_t)c->high - c->low) / n + 1;
  /* Sums of details times steps must fit 32 bits, too, or 64 are used: the heights are the same. */
  u->is_wide = is_wide || max_i64(c->most_detail, ZERO_SYMBOL) * n >= (int64_t)1 << 30;
  /* Stencils sum to 4096: heights less another origin are predicted the same, as long as sums fit. */
  int32_t change = j->file->heights.origin - c->origin;
  int64_t low = (int64_t)c->low - change, high = (int64_t)c->high - change;
  u->is_short = j->out->shorts && j->file->kernels->decode_rapid_short && !u->is_wide && j->parent.layer &&
                !j->parent.is_void && max_i64(-low, high) * u->tables->widest <= MOST_SUM;
  if (u->is_short) {
    c->low = (int32_t)low;
    c->high = (int32_t)high;
    c->origin += change;
  }
  /* Row 2 i of the lattice is stored in turn i + 1, the one below it in the next. */
  const layer *l = j->out;
  u->n_turns = ((l->rows.n_core + 1) >> 1) + 2;
  if (l->n_ready) {
    int32_t last = max_i32(l->n_ready - 1 - l->rows.core, 0);
    u->n_turns = min_i32(u->n_turns, (last >> 1) + 2 + (last & 1));
  }
  return TWZ_OK;
}

/* Heights of a unit that is not short, in a file that is: from 32 bits to 16. */
static twz_status decode_long(rapid_unit *u, layer *l, twz_error *error) {
  const twz_file *f = u->job->file;
  size_t n = (size_t)l->rows.n * (size_t)l->cols.n;
  int32_t *heights = l->heights = twz_allocate_zeros(&f->allocator, n * sizeof *heights);
  if (!heights) return twz_no_memory(error, n * sizeof *heights);
  twz_status status = f->kernels->decode_rapid(u, error);
  for (size_t i = 0; status == TWZ_OK && i < n; i++) l->shorts[i] = (int16_t)(heights[i] - l->origin);
  twz_release(&f->allocator, heights);
  l->heights = NULL;
  return status;
}

static twz_status decode_alone(rapid_unit *u, twz_error *error) {
  const row_kernels *kernels = u->job->file->kernels;
  if (u->is_short) return kernels->decode_rapid_short(u, error);
  return u->job->out->shorts ? decode_long(u, u->job->out, error) : kernels->decode_rapid(u, error);
}

twz_status decode_rapid(const job *const *jobs, const reader *bytes, int n, scratch *s, twz_error *error) {
  rapid_unit units[MOST_TOGETHER];
  for (int k = 0; k < n; k++) TRY(open_unit(&units[k], jobs[k], &bytes[k], &s[k], error));
  for (int k = 0, stop; k < n; k = stop) {
    for (stop = k; stop < n && units[stop].is_short && units[stop].streams.n_states == 8;) stop++;
    if (stop > k + 1) {
      TRY(jobs[0]->file->kernels->decode_rapid_groups(&units[k], stop - k, error));
    } else {
      stop = k + 1;
      TRY(decode_alone(&units[k], error));
    }
  }
  for (int k = 0; k < n; k++) TRY(close_streams(&units[k], error));
  return TWZ_OK;
}
