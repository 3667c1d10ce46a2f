/*
 * Rows of method rapid (R.3, R.5 ... R.9): included once for each kind of NUMBER that sums of heights are.
 * Rows of a plane lie in an array of HELD_ROWS, row i in place i mod HELD_ROWS. With SHORT, where heights less the
 * origin fit 16 bits, a cell of a plane holds a height and, in its upper half, the one to the right of it.
 */
#ifdef SHORT
#define FIRST(row, j) ((int32_t)((uint32_t)(row)[j] << 16) >> 16)
#define SECOND(row, j) ((row)[j] >> 16)
#define REGION int16_t
#else
#define FIRST(row, j) ((row)[j])
#define SECOND(row, j) ((row)[(j) + 1])
#define REGION int32_t
#endif

static ALWAYS_INLINE NUMBER NAMED(magnitude)(NUMBER a) { return a < 0 ? -a : a; }
static ALWAYS_INLINE NUMBER NAMED(least)(NUMBER a, NUMBER b) { return a < b ? a : b; }
static ALWAYS_INLINE NUMBER NAMED(most)(NUMBER a, NUMBER b) { return a > b ? a : b; }

/* Where plane A lies: sample (i, j) at i * row_step + j * col_step of one of the two. */
typedef struct NAMED(source) {
  const int32_t *heights;
  const int16_t *shorts; /* less their layer's origin; col_step is 1 */
  int32_t origin;
  ptrdiff_t row_step, col_step;
} NAMED(source);

/* A lattice. */
typedef struct NAMED(part) {
  int32_t stride, n_rows, n_cols;
  int32_t known_rows[2], known_cols[2];
  int is_whole; /* stride 1 and no plane empty: rows of the region are stored as a whole */
} NAMED(part);

typedef struct NAMED(work) {
  rapid_unit *unit;
  NAMED(source) source;
  NAMED(part) part;
  int32_t *planes[4], *errors[3], *bends; /* bends: of plane A */
  ptrdiff_t stride;                       /* of their rows */
  int32_t sizes[3][2];                    /* rows and columns of HH, HL, LH */
  int32_t loaded, bent;                   /* rows of A before `loaded` are there, bends before `bent` */
  const int16_t (*stencils)[N_TAPS];
  const int32_t (*features)[9];
  REGION *heights;                        /* of the region, less `lift` */
  int32_t lift;
  const uint8_t *valid;
  ptrdiff_t pitch;
  uint8_t *known;                         /* of the region: samples of shared lines that are decoded; the rest is not set */
  /* Of a row; packed: of its valid samples, one behind the other. */
  NUMBER *predicted;
  int32_t *contexts, *packed_contexts, *details, *packed_details, *own;
  /* Of a row of shared samples, besides. */
  NUMBER *sum, *twist, *line;
  int32_t *least, *most;
  size_t *places;
  uint8_t *line_valid;
} NAMED(work);

/* A row between its predictions and its heights: samples first ... stop - 1 have symbols. */
typedef struct NAMED(row) {
  int32_t first, stop, n;
  ptrdiff_t start, step; /* of its samples in the region */
  const uint8_t *valid;  /* of sample 0, the others `step` apart; NULL: all are */
} NAMED(row);

static ALWAYS_INLINE int32_t *NAMED(row_of)(const NAMED(work) * w, int32_t *array, int32_t row) {
  return array + (row & (HELD_ROWS - 1)) * w->stride + MARGIN;
}

/* Where heights of a row are computed. */
static ALWAYS_INLINE int32_t *NAMED(open_row)(const NAMED(work) * w, int plane, int32_t row) {
#ifdef SHORT
  (void)plane, (void)row;
  return w->own;
#else
  return NAMED(row_of)(w, w->planes[plane], row);
#endif
}

/* They are there, and around them. */
static void NAMED(close_row)(const NAMED(work) * w, int plane, int32_t row, int32_t n) {
#ifdef SHORT
  const int32_t *RESTRICT from = w->own;
  int32_t *RESTRICT to = NAMED(row_of)(w, w->planes[plane], row);
  IVDEP for (int32_t j = -REACH_OUTSIDE; j < n + REACH_OUTSIDE; j++) {
    to[j] = (int32_t)(((uint32_t)from[j] & 65535) | (uint32_t)from[j + 1] << 16);
  }
#else
  (void)w, (void)plane, (void)row, (void)n;
#endif
}

static void NAMED(extend)(int32_t *row, int32_t n) {
  int32_t first = row[0], last = row[n - 1];
  for (int32_t k = 0; k < MARGIN; k++) {
    row[-1 - k] = first;
    row[n + k] = last;
  }
}

static ALWAYS_INLINE int32_t NAMED(inside)(const NAMED(work) * w, int32_t height) {
  const rapid_scale *c = &w->unit->scale;
  return (int32_t)clamp_i64((int64_t)height - c->origin, c->low, c->high);
}

/* A height less the origin, out of the region. */
static ALWAYS_INLINE int32_t NAMED(stored)(const NAMED(work) * w, size_t at) {
  const rapid_scale *c = &w->unit->scale;
  return (int32_t)clamp_i64((int64_t)w->heights[at] - w->lift, c->low, c->high);
}

/* A height less the origin, corrected (FORMAT §5.4). */
static ALWAYS_INLINE int32_t NAMED(correct)(const NAMED(work) * w, size_t at, int32_t height) {
  const rapid_scale *c = &w->unit->scale;
  return (int32_t)corrected(w->unit->job, at, height, c->low, c->high);
}

/* ---- Predictions (R.6) ---- */

#define ROW(plane, k) NAMED(row_of)(w, w->planes[plane], i + (k))
#define ERRORS(plane, k) NAMED(row_of)(w, w->errors[plane], i + (k))

#ifdef SHORT
/* Two taps side by side are one product of pairs. */
static void NAMED(predict)(const NAMED(work) * w, int plane, int32_t i, int32_t n) {
  const int16_t *v = w->stencils[plane];
  const int32_t *own = ROW(plane, -1), *up = ROW(A, -1), *at = ROW(A, 0), *down = ROW(A, 1);
  const int32_t *hh_up = ROW(HH, -1), *hh = ROW(HH, 0), *hh_down = ROW(HH, 1);
  if (plane == HH) {
    const int32_t *low = ROW(A, 2);
    const ISA(pair_of_taps) t[10] = {
        {up - 1, v[0], v[1]}, {up + 1, v[2], v[3]}, {at - 1, v[4], v[5]}, {at + 1, v[6], v[7]},
        {down - 1, v[8], v[9]}, {down + 1, v[10], v[11]}, {low - 1, v[12], v[13]}, {low + 1, v[14], v[15]},
        {own - 1, v[16], v[17]}, {own + 1, v[18], 0}};
    ISA(predict_taps)(n, t, 10, w->predicted);
  } else if (plane == HL) {
    const ISA(pair_of_taps) t[12] = {
        {at - 1, v[0], v[1]}, {at + 1, v[2], v[3]}, {up, v[4], v[5]}, {down, v[6], v[7]}, {hh_up - 1, v[8], v[9]},
        {hh_up + 1, v[10], 0}, {hh - 1, v[11], v[12]}, {hh + 1, v[13], 0}, {ROW(HH, -2), v[14], 0}, {hh_down, v[15], 0},
        {own - 1, v[16], v[17]}, {own + 1, v[18], 0}};
    ISA(predict_taps)(n, t, 12, w->predicted);
  } else {
    const int32_t *hl = ROW(HL, 0), *hl_down = ROW(HL, 1);
    const ISA(pair_of_taps) t[14] = {
        {up, v[0], 0}, {at - 1, v[4], v[1]}, {at + 1, v[5], 0}, {down - 1, v[6], v[2]}, {down + 1, v[7], 0},
        {ROW(A, 2), v[3], 0}, {own - 1, v[8], v[9]}, {own + 1, v[10], 0}, {hh - 2, v[11], v[12]}, {hh, v[13], v[14]},
        {hh_up - 1, v[15], v[16]}, {hh_down - 1, v[17], v[18]}, {hl - 1, v[19], v[20]}, {hl_down - 1, v[21], v[22]}};
    ISA(predict_taps)(n, t, 14, w->predicted);
  }
}
#else
/* Inputs are not RESTRICT: compilers would keep what they have loaded for the next sample, and make no vectors. */
static void NAMED(predict)(const NAMED(work) * w, int plane, int32_t i, int32_t n) {
  const int32_t *own = ROW(plane, -1), *up = ROW(A, -1), *at = ROW(A, 0), *down = ROW(A, 1), *low = ROW(A, 2);
  const int32_t *h_top = ROW(HH, -2), *h_up = ROW(HH, -1), *h = ROW(HH, 0), *h_down = ROW(HH, 1);
  const int32_t *l = ROW(HL, 0), *l_down = ROW(HL, 1);
  NUMBER *predicted = w->predicted, v[N_TAPS];
  for (int k = 0; k < N_TAPS; k++) v[k] = w->stencils[plane][k];
  if (plane == HH) {
    PREDICT_IVDEP for (int32_t j = 0; j < n; j++) {
      NUMBER p = 32 + v[0] * up[j - 1] + v[1] * up[j] + v[2] * up[j + 1] + v[3] * up[j + 2];
      p += v[4] * at[j - 1] + v[5] * at[j] + v[6] * at[j + 1] + v[7] * at[j + 2];
      p += v[8] * down[j - 1] + v[9] * down[j] + v[10] * down[j + 1] + v[11] * down[j + 2];
      p += v[12] * low[j - 1] + v[13] * low[j] + v[14] * low[j + 1] + v[15] * low[j + 2];
      p += v[16] * own[j - 1] + v[17] * own[j] + v[18] * own[j + 1];
      predicted[j] = p >> 6;
    }
  } else if (plane == HL) {
    PREDICT_IVDEP for (int32_t j = 0; j < n; j++) {
      NUMBER p = 32 + v[0] * at[j - 1] + v[1] * at[j] + v[2] * at[j + 1] + v[3] * at[j + 2];
      p += v[4] * up[j] + v[5] * up[j + 1] + v[6] * down[j] + v[7] * down[j + 1];
      p += v[8] * h_up[j - 1] + v[9] * h_up[j] + v[10] * h_up[j + 1] + v[11] * h[j - 1] + v[12] * h[j];
      p += v[13] * h[j + 1] + v[14] * h_top[j] + v[15] * h_down[j];
      p += v[16] * own[j - 1] + v[17] * own[j] + v[18] * own[j + 1];
      predicted[j] = p >> 6;
    }
  } else {
    PREDICT_IVDEP for (int32_t j = 0; j < n; j++) {
      NUMBER p = 32 + v[0] * up[j] + v[1] * at[j] + v[2] * down[j] + v[3] * low[j];
      p += v[4] * at[j - 1] + v[5] * at[j + 1] + v[6] * down[j - 1] + v[7] * down[j + 1];
      p += v[8] * own[j - 1] + v[9] * own[j] + v[10] * own[j + 1] + v[11] * h[j - 2];
      p += v[12] * h[j - 1] + v[13] * h[j] + v[14] * h[j + 1] + v[15] * h_up[j - 1] + v[16] * h_up[j];
      p += v[17] * h_down[j - 1] + v[18] * h_down[j] + v[19] * l[j - 1] + v[20] * l[j];
      p += v[21] * l_down[j - 1] + v[22] * l_down[j];
      predicted[j] = p >> 6;
    }
  }
}
#endif

/* ---- Contexts (R.7) ---- */

/* Of a sample predicted as p, which is clamped, within the core's `low` and `high`; no branch, or compilers make no
 * vectors. */
static ALWAYS_INLINE int32_t NAMED(context_of)(const rapid_scale *c, const int32_t *f, int is_fine, int is_by_reach, NUMBER p,
                                               NUMBER low, NUMBER high, NUMBER sum, NUMBER twist, int32_t expected) {
  int32_t range = (int32_t)NAMED(least)((high - low) >> c->range_shift, c->most_range);
  int32_t bent = (int32_t)NAMED(least)(NAMED(magnitude)(twist) >> c->range_shift, c->most_range);
  int32_t e = (expected + f[0] + f[4] * range + f[5] * bent) >> 4, bin = ISA(bin_of_e)(e), fine = 0;
  if (is_fine) {
    int32_t side = (int32_t)((p + 32) & 63) - 32; /* P - 64 w */
    int32_t size = side < 0 ? -side : side;
    int32_t near = min_i32((size * c->side_scale) >> 16, 3);
    fine = (4 * bin + (near & -(int32_t)(bin < 16))) | ((side >> 31) & DOWN);
    if (!is_by_reach) return fine;
  }
  NUMBER side = sum * 16 - p, far = NAMED(magnitude)(side);
  if (is_by_reach) {
    NUMBER above = high * 64 - p, below = p - low * 64;
    far = side < 0 ? above : below;
  }
  int32_t x = ((int32_t)NAMED(least)(far >> c->side_shift, (1 << 20) - 1) * c->far_scale) >> c->end_shift;
  /* e is below 2^27: twelve times it fit. */
  int32_t sigma = is_by_reach ? (x > 2 * e) + (x > 6 * e) + (x > 12 * e) : (x > e) + (4 * x > 11 * e) + (x > 6 * e);
  int32_t context = (4 * bin + sigma) | (int32_t)((side >> 31) & DOWN);
  return is_fine && bin < 16 ? fine : context;
}

static ALWAYS_INLINE void NAMED(look)(const NAMED(work) * w, int plane, int32_t i, int32_t n, int is_fine, int is_by_reach) {
  const rapid_scale scale = w->unit->scale;
  int32_t f[9];
  for (int k = 0; k < 9; k++) f[k] = w->features[plane][k];
  const int32_t *a = ROW(A, 0), *down = ROW(A, 1), *h_up = ROW(HH, -1), *h = ROW(HH, 0);
  const int32_t *bends = NAMED(row_of)(w, w->bends, i), *low_bends = NAMED(row_of)(w, w->bends, i + 1);
  const int32_t *north = ERRORS(plane, -1), *far_north = ERRORS(plane, -2);
  const int32_t *e_up = ERRORS(HH, -1), *e = ERRORS(HH, 0), *e_down = ERRORS(HH, 1);
  const int32_t *g = ERRORS(HL, 0), *g_down = ERRORS(HL, 1);
  NUMBER *predicted = w->predicted;
  int32_t *contexts = w->contexts;
  IVDEP for (int32_t j = 0; j < n; j++) {
    int32_t c1 = FIRST(a, j), c2, c3, c4;
    int32_t expected = f[1] * north[j] + f[2] * (north[j - 1] + north[j + 1]) + f[3] * far_north[j];
    NUMBER twist;
    if (plane == HH) {
      c2 = SECOND(a, j), c3 = FIRST(down, j), c4 = SECOND(down, j);
      twist = (NUMBER)c1 + c4 - c2 - c3;
      expected += f[6] * (bends[j] + bends[j + 1] + low_bends[j] + low_bends[j + 1]);
    } else if (plane == HL) {
      c2 = SECOND(a, j), c3 = FIRST(h_up, j), c4 = FIRST(h, j);
      twist = (NUMBER)c1 + c2 - c3 - c4;
      expected += f[6] * (bends[j] + bends[j + 1]) + f[7] * (e_up[j] + e[j]) +
                  f[8] * (e_up[j - 1] + e[j - 1] + e_up[j + 1] + e[j + 1]);
    } else {
      c2 = FIRST(down, j), c3 = FIRST(h, j - 1), c4 = SECOND(h, j - 1);
      twist = (NUMBER)c1 + c2 - c3 - c4;
      expected += f[6] * (bends[j] + low_bends[j]) + f[7] * (e[j - 1] + e[j] + g[j - 1] + g[j] + g_down[j - 1] + g_down[j]) +
                  f[8] * (e_up[j - 1] + e_up[j] + e_down[j - 1] + e_down[j]);
    }
    NUMBER low = min_i32(min_i32(c1, c2), min_i32(c3, c4)), high = max_i32(max_i32(c1, c2), max_i32(c3, c4));
    NUMBER p = NAMED(least)(NAMED(most)(predicted[j], low * 64), high * 64);
    predicted[j] = p;
    contexts[j] = NAMED(context_of)(&scale, f, is_fine, is_by_reach, p, low, high, (NUMBER)c1 + c2 + c3 + c4, twist, expected);
  }
}

/* The same of n shared samples, which have no errors and bends around them. */
static ALWAYS_INLINE void NAMED(look_at_shared)(const NAMED(work) * w, int32_t n, int is_fine, int is_by_reach) {
  const rapid_scale scale = w->unit->scale;
  int32_t f[9];
  for (int k = 0; k < 9; k++) f[k] = w->features[SHARED][k];
  const NUMBER *RESTRICT sum = w->sum, *RESTRICT twist = w->twist;
  const int32_t *RESTRICT least = w->least, *RESTRICT most = w->most;
  NUMBER *RESTRICT predicted = w->predicted;
  int32_t *RESTRICT contexts = w->contexts;
  IVDEP for (int32_t j = 0; j < n; j++) {
    NUMBER p = NAMED(least)(NAMED(most)(predicted[j], (NUMBER)least[j] * 64), (NUMBER)most[j] * 64);
    predicted[j] = p;
    contexts[j] = NAMED(context_of)(&scale, f, is_fine, is_by_reach, p, least[j], most[j], sum[j], twist[j], 0);
  }
}

/* A loop for each plane and kind of contexts; SMALL: one that asks for each sample. */
static void NAMED(fill_contexts)(const NAMED(work) * w, int plane, int32_t i, int32_t n) {
  const rapid_scale *c = &w->unit->scale;
#define LOOK(is_fine, is_by_reach) \
  switch (plane) { \
    case HH: NAMED(look)(w, HH, i, n, is_fine, is_by_reach); break; \
    case HL: NAMED(look)(w, HL, i, n, is_fine, is_by_reach); break; \
    case LH: NAMED(look)(w, LH, i, n, is_fine, is_by_reach); break; \
    default: NAMED(look_at_shared)(w, n, is_fine, is_by_reach); \
  }
#ifdef SMALL
  if (plane == SHARED) {
    NAMED(look_at_shared)(w, n, c->is_fine, c->is_by_reach);
  } else {
    NAMED(look)(w, plane, i, n, c->is_fine, c->is_by_reach);
  }
#else
  if (c->is_fine && c->is_by_reach) {
    LOOK(1, 1);
  } else if (c->is_fine) {
    LOOK(1, 0);
  } else if (c->is_by_reach) {
    LOOK(0, 1);
  } else {
    LOOK(0, 0);
  }
#endif
#undef LOOK
}
#undef ROW
#undef ERRORS

/* ---- Details (R.8, R.9) ---- */

static ISA(span) NAMED(begin_span)(const NAMED(work) * w, const NAMED(row) * r) {
  ISA(span) s = {w->details + r->first, w->contexts + r->first, r->stop - r->first, &w->unit->streams, 0};
  const uint8_t *valid = r->valid ? r->valid + (size_t)r->first * (size_t)r->step : NULL;
  if (!valid || ISA(count_valid)(valid, s.n, (size_t)r->step) == s.n) return s;
  s.n = PACK(s.contexts, valid, (size_t)r->step, s.n, w->packed_contexts);
  s.details = w->packed_details;
  s.contexts = w->packed_contexts;
  return s;
}

/* Raw bits of a span; details of voids between. */
static void NAMED(end_span)(const NAMED(work) * w, const NAMED(row) * r, const ISA(span) * s) {
  if (s->has_raw) READ_RAW(s->contexts, s->details, s->n, w->unit->scale.most_detail, s->streams);
  int32_t *details = w->details + r->first;
  if (s->details == details) return;
  w->packed_details[s->n] = 0;
  UNPACK(w->packed_details, r->valid + (size_t)r->first * (size_t)r->step, (size_t)r->step, r->stop - r->first, details);
}

static void NAMED(read_details)(const NAMED(work) * w, const NAMED(row) * r) {
  if (r->first >= r->stop) return;
  ISA(span) s = NAMED(begin_span)(w, r);
  ISA(read_span)(&s, w->unit->tables->slots);
  NAMED(end_span)(w, r, &s);
}

/* ---- Heights (R.6) ---- */

/* Heights and errors of samples first ... stop - 1 of a row. */
static void NAMED(finish_row)(const NAMED(work) * w, int32_t first, int32_t stop, int32_t *RESTRICT own, int32_t *RESTRICT error) {
  const NUMBER *RESTRICT predicted = w->predicted;
  const int32_t *RESTRICT contexts = w->contexts, *RESTRICT details = w->details;
  const rapid_scale *c = &w->unit->scale;
  const NUMBER quantum = c->step, low = c->low, high = c->high;
  const int shift = c->log2;
  IVDEP for (int32_t j = first; j < stop; j++) {
    NUMBER change = (NUMBER)details[j] * quantum, whole = (predicted[j] + 32) >> 6;
    NUMBER height = contexts[j] & DOWN ? whole - change : whole + change;
    NUMBER held = NAMED(least)(NAMED(most)(height, low), high);
    own[j] = (int32_t)held;
    NUMBER distance = NAMED(magnitude)(held * 64 - predicted[j]) >> shift;
    error[j] = (int32_t)NAMED(least)(distance, (1 << 18) - 1);
  }
}

/* The errors of known samples, whose heights are there. */
static void NAMED(note_errors)(const NAMED(work) * w, int32_t first, int32_t stop, const int32_t *own, int32_t *error) {
  for (int32_t j = first; j < stop; j++) {
    NUMBER distance = NAMED(magnitude)((NUMBER)own[j] * 64 - w->predicted[j]) >> w->unit->scale.log2;
    error[j] = (int32_t)NAMED(least)(distance, (1 << 18) - 1);
  }
}

/* ---- Lattices (R.5) ---- */

static void NAMED(take_class)(NAMED(work) * w, int32_t log2_stride) {
  const rapid_unit *u = w->unit;
  int which = min_i32(max_i32(u->tables->k_max - u->job->level + log2_stride, 0), 3);
  w->stencils = u->tables->stencils[which];
  w->features = u->tables->features[which];
}

/* A row of plane A and what lies around it, mirrored where the lattice ends. */
static void NAMED(load_coarse)(NAMED(work) * w, int32_t row) {
  const rapid_scale *c = &w->unit->scale;
  const NAMED(source) *a = &w->source;
  int32_t n_cols = w->part.n_cols, n = (n_cols + 1) >> 1;
  const NUMBER low = c->low, high = c->high, lift = a->shorts ? c->origin - a->origin : c->origin;
  ptrdiff_t from = (ISA(fold)(2 * row, w->part.n_rows) >> 1) * a->row_step;
  int32_t *RESTRICT to = NAMED(open_row)(w, A, row);
  if (a->shorts) {
    const int16_t *RESTRICT shorts = a->shorts + from;
    IVDEP for (int32_t j = 0; j < n; j++) to[j] = (int32_t)NAMED(least)(NAMED(most)((NUMBER)shorts[j] - lift, low), high);
  } else if (a->col_step == 1) {
    const int32_t *RESTRICT heights = a->heights + from;
    IVDEP for (int32_t j = 0; j < n; j++) to[j] = (int32_t)NAMED(least)(NAMED(most)((NUMBER)heights[j] - lift, low), high);
  } else {
    for (int32_t j = 0; j < n; j++) to[j] = NAMED(inside)(w, a->heights[from + j * a->col_step]);
  }
  for (int32_t k = 1; k <= MARGIN; k++) {
    to[-k] = to[ISA(fold)(-2 * k, n_cols) >> 1];
    to[n - 1 + k] = to[ISA(fold)(2 * (n - 1 + k), n_cols) >> 1];
  }
  NAMED(close_row)(w, A, row, n);
}

/* Curvatures of a row of plane A, and one sample beyond it (R.7). */
static void NAMED(bend_coarse)(const NAMED(work) * w, int32_t row, int32_t n_even, int32_t n) {
  const rapid_scale *c = &w->unit->scale;
  int32_t *RESTRICT bends = NAMED(row_of)(w, w->bends, row);
  if (row >= n_even) {
    memcpy(bends, NAMED(row_of)(w, w->bends, row - 1), sizeof *bends * (size_t)(n + 1));
    return;
  }
  const int32_t *a[5]; /* rows of A */
  for (int k = 0; k < 5; k++) a[k] = NAMED(row_of)(w, w->planes[A], row - 2 + k);
  const int32_t *RESTRICT at = a[2], *RESTRICT top = a[0], *RESTRICT up = a[1], *RESTRICT down = a[3], *RESTRICT low = a[4];
  const int shift = c->range_shift;
  const int32_t most = c->most_range;
  IVDEP for (int32_t j = 0; j < n; j++) {
    NUMBER middle = FIRST(at, j);
    NUMBER across = (NUMBER)FIRST(at, j - 2) + FIRST(at, j + 2) - 4 * ((NUMBER)SECOND(at, j - 2) + SECOND(at, j)) + 6 * middle;
    NUMBER along = (NUMBER)FIRST(top, j) + FIRST(low, j) - 4 * ((NUMBER)FIRST(up, j) + FIRST(down, j)) + 6 * middle;
    NUMBER bend = (NAMED(magnitude)(across) + NAMED(magnitude)(along)) >> shift;
    bends[j] = (int32_t)NAMED(least)(bend, most);
  }
  bends[n] = bends[n - 1];
}

static void NAMED(fill_means)(const NAMED(work) * w, int plane, int32_t row, int32_t from, int32_t n) {
  const int32_t *a = NAMED(row_of)(w, w->planes[A], from), *b = plane == HL ? a : NAMED(row_of)(w, w->planes[A], from + 1);
  int32_t *to = NAMED(open_row)(w, plane, row);
  for (int32_t j = 0; j < n; j++) {
    /* Of HL and LH the same two samples twice: (2 (a + b) + 2) >> 2. */
    NUMBER left = (NUMBER)FIRST(a, j) + FIRST(b, j), right = plane == LH ? left : (NUMBER)SECOND(a, j) + SECOND(b, j);
    to[j] = (int32_t)((left + right + 2) >> 2);
  }
  NAMED(extend)(to, n);
  NAMED(close_row)(w, plane, row, n);
}

static int NAMED(is_empty)(const NAMED(work) * w, int plane) { return w->sizes[plane][0] == 0 || w->sizes[plane][1] == 0; }

static void NAMED(forget_errors)(const NAMED(work) * w, int plane, int32_t row) {
  memset(NAMED(row_of)(w, w->errors[plane], row) - MARGIN, 0, sizeof(int32_t) * (size_t)w->stride);
}

/* Plane A goes to the region as it is read: inherited samples are clamped (R.2). */
static void NAMED(store_coarse)(const NAMED(work) * w, int32_t row, int32_t n) {
  const layer *l = w->unit->job->out;
  const int32_t *from = NAMED(row_of)(w, w->planes[A], row), stride = w->part.stride;
  REGION *to = w->heights + (l->rows.core + 2 * row * stride) * w->pitch + l->cols.core;
  for (int32_t j = 0; j < n; j++) to[(ptrdiff_t)2 * j * stride] = (REGION)(FIRST(from, j) + w->lift);
}

/* Rows that the lattice's row t of HH, row t - 1 of HL and row t - 2 of LH need: of A, its bends, of empty planes. */
static void NAMED(advance)(NAMED(work) * w, int32_t t) {
  const NAMED(part) *p = &w->part;
  int32_t n_even = (p->n_rows + 1) >> 1, n = (p->n_cols + 1) >> 1, stop = min_i32(t + 4, n_even + MARGIN);
  for (; w->loaded < stop; w->loaded++) {
    int32_t row = w->loaded;
    NAMED(load_coarse)(w, row);
    if (!p->is_whole && row >= 0 && row < n_even) NAMED(store_coarse)(w, row, n);
    for (int plane = HH; row > -MARGIN && plane <= LH; plane++) {
      if (!NAMED(is_empty)(w, plane)) continue; /* means, without errors */
      NAMED(forget_errors)(w, plane, row - 1);
      NAMED(fill_means)(w, plane, row - 1, row - 1, plane == HH ? max_i32(p->n_cols >> 1, 1) : 1);
    }
  }
  for (; w->bent <= min_i32(t + 1, n_even); w->bent++) NAMED(bend_coarse)(w, w->bent, n_even, n);
}

/* Predict a row, and find where its symbols are. */
static NAMED(row) NAMED(begin_row)(const NAMED(work) * w, int plane, int32_t i) {
  const layer *l = w->unit->job->out;
  const NAMED(part) *p = &w->part;
  int32_t n = w->sizes[plane][1], lattice_row = 2 * i + (plane == HL ? 0 : 1), col = plane == LH ? 0 : 1;
  NAMED(predict)(w, plane, i, n);
  NAMED(fill_contexts)(w, plane, i, n);
  NAMED(row) r;
  r.n = n;
  r.start = (l->rows.core + (ptrdiff_t)lattice_row * p->stride) * w->pitch + l->cols.core + (ptrdiff_t)col * p->stride;
  r.step = 2 * (ptrdiff_t)p->stride;
  r.valid = w->valid ? w->valid + r.start : NULL;
  r.first = min_i32((p->known_cols[0] + 1 - col) >> 1, n);
  r.stop = max_i32(n - ((p->known_cols[1] + 1 - ((p->n_cols - 1 - col) & 1)) >> 1), r.first);
  if (lattice_row < p->known_rows[0] || lattice_row >= p->n_rows - p->known_rows[1]) r.first = r.stop = n;
  return r;
}

/* Heights of a row whose details are there. */
static void NAMED(end_row)(const NAMED(work) * w, int plane, int32_t i, const NAMED(row) * r) {
  int32_t *own = NAMED(open_row)(w, plane, i), *error = NAMED(row_of)(w, w->errors[plane], i);
  REGION *heights = w->heights + r->start;
  NAMED(finish_row)(w, r->first, r->stop, own, error);
  if (w->unit->job->corrections) {
    for (int32_t j = r->first; j < r->stop; j++) own[j] = NAMED(correct)(w, (size_t)(r->start + j * r->step), own[j]);
    NAMED(note_errors)(w, r->first, r->stop, own, error);
  }
  for (int32_t j = r->first; !w->part.is_whole && j < r->stop; j++) heights[j * r->step] = (REGION)(own[j] + w->lift);
  const int32_t known[2][2] = {{0, r->first}, {r->stop, r->n}};
  for (int side = 0; side < 2; side++) {
    int32_t first = known[side][0], stop = known[side][1];
    for (int32_t j = first; j < stop; j++) own[j] = NAMED(stored)(w, (size_t)(r->start + j * r->step));
    NAMED(note_errors)(w, first, stop, own, error);
  }
}

/* Make a row readable beside it, and above and below the plane. */
static void NAMED(surround)(const NAMED(work) * w, int plane, int32_t i, int32_t n) {
  int32_t *arrays[2] = {w->planes[plane], w->errors[plane]}, n_rows = w->sizes[plane][0];
  NAMED(extend)(NAMED(open_row)(w, plane, i), n);
  NAMED(extend)(NAMED(row_of)(w, w->errors[plane], i), n);
  NAMED(close_row)(w, plane, i, n);
  size_t n_bytes = sizeof(int32_t) * (size_t)w->stride;
  for (int k = 0; k < 2 && (i == 0 || i == n_rows - 1); k++) {
    const int32_t *from = NAMED(row_of)(w, arrays[k], i) - MARGIN;
    for (int32_t m = 1; i == 0 && m <= 3; m++) memcpy(NAMED(row_of)(w, arrays[k], -m) - MARGIN, from, n_bytes);
    for (int32_t m = 1; i == n_rows - 1 && m <= 2; m++) memcpy(NAMED(row_of)(w, arrays[k], i + m) - MARGIN, from, n_bytes);
  }
}

/* A row of the region: samples of two planes in turns. */
static void NAMED(store_row)(const NAMED(work) * w, int plane, int32_t i) {
  const layer *l = w->unit->job->out;
  const int32_t *RESTRICT even = NAMED(row_of)(w, w->planes[plane == HL ? A : LH], i);
  const int32_t *RESTRICT odd = NAMED(row_of)(w, w->planes[plane == HL ? HL : HH], i);
  REGION *RESTRICT to = w->heights + (ptrdiff_t)(l->rows.core + 2 * i + (plane == LH)) * w->pitch + l->cols.core;
  int32_t n_odd = w->part.n_cols >> 1;
  const int32_t lift = w->lift;
#ifdef SHORT
  ISA(store_in_turns)(to, even, odd, n_odd);
#else
  IVDEP for (int32_t j = 0; j < n_odd; j++) {
    to[2 * j] = even[j] + lift;
    to[2 * j + 1] = odd[j] + lift;
  }
#endif
  if (w->part.n_cols & 1) to[2 * n_odd] = (REGION)(FIRST(even, n_odd) + lift);
}

static void NAMED(settle_row)(const NAMED(work) * w, int plane, int32_t i) {
  NAMED(surround)(w, plane, i, w->sizes[plane][1]);
  if (w->part.is_whole && plane != HH) NAMED(store_row)(w, plane, i);
}

/* Is row i of a plane there? */
static int NAMED(has_row)(const NAMED(work) * w, int plane, int32_t i) {
  return i >= 0 && i < w->sizes[plane][0] && w->sizes[plane][1] > 0;
}

static void NAMED(begin_lattice)(NAMED(work) * w) {
  NAMED(part) *p = &w->part;
  int32_t n_even = (p->n_rows + 1) >> 1, n = (p->n_cols + 1) >> 1;
  p->is_whole = p->stride == 1 && p->n_rows > 1 && p->n_cols > 1;
  const int32_t sizes[3][2] = {{p->n_rows >> 1, p->n_cols >> 1}, {n_even, p->n_cols >> 1}, {p->n_rows >> 1, n}};
  memcpy(w->sizes, sizes, sizeof sizes);
  w->loaded = -MARGIN;
  w->bent = 0;
  NAMED(advance)(w, 0);
  for (int plane = HH; plane <= LH; plane++) { /* heights above the first rows are means, errors 0 */
    if (NAMED(is_empty)(w, plane)) continue;
    for (int32_t row = -MARGIN; row < 0; row++) NAMED(forget_errors)(w, plane, row);
    NAMED(fill_means)(w, plane, -1, 0, sizes[plane][1]);
  }
}

static void NAMED(decode_lattice)(NAMED(work) * w, int32_t n_turns) {
  NAMED(begin_lattice)(w);
  for (int32_t t = 0; t < n_turns; t++) {
    NAMED(advance)(w, t);
    for (int plane = HH; plane <= LH; plane++) {
      int32_t i = t - plane;
      if (!NAMED(has_row)(w, plane, i)) continue;
      NAMED(row) r = NAMED(begin_row)(w, plane, i);
      NAMED(read_details)(w, &r);
      NAMED(end_row)(w, plane, i, &r);
      NAMED(settle_row)(w, plane, i);
    }
  }
}

/* ---- Shared samples (R.3) ---- */

/* Decode a row of n samples at w->places, which is predicted. */
static void NAMED(decode_places)(NAMED(work) * w, int32_t n) {
  for (int32_t j = 0; w->valid && j < n; j++) w->line_valid[j] = w->valid[w->places[j]];
  const NAMED(row) r = {0, n, n, 0, 1, w->valid ? w->line_valid : NULL};
  NAMED(fill_contexts)(w, SHARED, 0, n);
  NAMED(read_details)(w, &r);
  NAMED(finish_row)(w, 0, n, w->own, w->least); /* its errors are nobody's */
  for (int32_t j = 0; j < n; j++) {
    w->heights[w->places[j]] = (REGION)(NAMED(correct)(w, w->places[j], w->own[j]) + w->lift);
    w->known[w->places[j]] = 1;
  }
}

static void NAMED(set)(NAMED(work) * w, int32_t j, int32_t least, int32_t most, NUMBER sum, NUMBER predicted, NUMBER twist) {
  w->least[j] = least;
  w->most[j] = most;
  w->sum[j] = sum;
  w->predicted[j] = predicted;
  w->twist[j] = twist;
}

static int32_t NAMED(above)(const NAMED(work) * w, int32_t row, int32_t col) {
  return NAMED(inside)(w, parent_height(&w->unit->job->parent, row, col));
}

static void NAMED(decode_corners)(NAMED(work) * w, const shared_lines *rows, const shared_lines *cols) {
  const job *j = w->unit->job;
  const layer *l = j->out;
  int32_t n = 0;
  for (int side = 0; side < rows->n_sides; side++) {
    for (int other = 0; other < cols->n_sides; other++) {
      for (int32_t r = rows->first[side]; r <= rows->last[side]; r++) {
        for (int32_t c = cols->first[other]; c <= cols->last[other]; c++) {
          size_t at = (size_t)r * (size_t)w->pitch + (size_t)c;
          if (w->known[at]) continue;
          w->known[at] = 1;
          uint32_t row = l->rows.first + (uint32_t)r, col = l->cols.first + (uint32_t)c;
          int32_t top = line_above(row, 0, j->parent.first_row, j->parent.n_rows);
          int32_t bottom = line_above(row, 1, j->parent.first_row, j->parent.n_rows);
          int32_t left = line_above(col, 0, j->parent.first_col, j->parent.n_cols);
          int32_t right = line_above(col, 1, j->parent.first_col, j->parent.n_cols);
          int32_t p = NAMED(above)(w, top, left), q = NAMED(above)(w, top, right);
          if ((row | col) % 2 == 0) {
            w->heights[at] = (REGION)(p + w->lift);
            continue;
          }
          int32_t x = NAMED(above)(w, bottom, left), y = NAMED(above)(w, bottom, right);
          NUMBER sum = (NUMBER)p + q + x + y;
          NAMED(set)(w, n, min_i32(min_i32(p, q), min_i32(x, y)), max_i32(max_i32(p, q), max_i32(x, y)), sum, 16 * sum,
                     (NUMBER)p - q - x + y);
          w->places[n++] = at;
          if (n == CORNER_ROW) {
            NAMED(decode_places)(w, n);
            n = 0;
          }
        }
      }
    }
  }
  NAMED(decode_places)(w, n);
}

/* Samples of places outside, each side one, and a second one after (R.3). line[k + 1] is index k. */
static void NAMED(extend_line)(NUMBER *line, int32_t n) {
  line[0] = line[1 + min_i32(1, n - 1)];
  line[n + 1] = line[1 + max_i32(n - 2, 0)];
  line[n + 2] = line[1 + max_i32(n - 3, 0)];
}

/* A line of the region along an axis, near a side that is shared: of a row (is_row) or a column. */
static void NAMED(decode_line)(NAMED(work) * w, int32_t number, int is_row) {
  const job *j = w->unit->job;
  const parent *p = &j->parent;
  const axis *across = is_row ? &j->out->rows : &j->out->cols, *along = is_row ? &j->out->cols : &j->out->rows;
  uint32_t first_across = is_row ? p->first_row : p->first_col, place = across->first + (uint32_t)number;
  int32_t n_across = is_row ? p->n_rows : p->n_cols, n_along = is_row ? p->n_cols : p->n_rows;
  int32_t before = line_above(place, 0, first_across, n_across), after = line_above(place, 1, first_across, n_across);
  int32_t from = line_above(along->core_first, 0, is_row ? p->first_col : p->first_row, n_along);
  size_t pitch = (size_t)w->pitch, core = (size_t)along->core, step = is_row ? 1 : pitch;
  size_t start = is_row ? (size_t)number * pitch + core : core * pitch + (size_t)number;
  int32_t length = along->n_core, n = (length + 1) >> 1, m = 0;
  NUMBER *line = w->line;
  for (int32_t k = 0; k < n; k++) {
    line[k + 1] = is_row ? NAMED(above)(w, before, from + k) : NAMED(above)(w, from + k, before);
  }
  if (place & 1) {
    for (int32_t k = 0; k < n; k++) {
      int32_t u = (int32_t)line[k + 1], v = is_row ? NAMED(above)(w, after, from + k) : NAMED(above)(w, from + k, after);
      w->least[k] = min_i32(u, v);
      w->most[k] = max_i32(u, v);
      line[k + 1] += v;
    }
    NAMED(extend_line)(line, n);
    for (int32_t k = 0; k < n; k++) {
      size_t at = start + 2 * (size_t)k * step;
      if (w->known[at]) continue;
      NUMBER t = line[k + 1];
      NAMED(set)(w, m, w->least[k], w->most[k], 2 * t, 32 * t, line[k] - 2 * t + line[k + 2]); /* m <= k */
      w->places[m++] = at;
    }
    NAMED(decode_places)(w, m);
  } else {
    for (int32_t k = 0; k < n; k++) {
      size_t at = start + 2 * (size_t)k * step;
      if (w->known[at]) continue;
      w->known[at] = 1;
      w->heights[at] = (REGION)(line[k + 1] + w->lift);
    }
  }
  for (int32_t k = 0; k < n; k++) line[k + 1] = (NUMBER)w->heights[start + 2 * (size_t)k * step] - w->lift;
  NAMED(extend_line)(line, n);
  m = 0;
  for (int32_t k = 0; 2 * k + 1 < length; k++) {
    size_t at = start + (2 * (size_t)k + 1) * step;
    if (w->known[at]) continue;
    int32_t a = (int32_t)line[k], b = (int32_t)line[k + 1], c = (int32_t)line[k + 2], d = (int32_t)line[k + 3];
    NUMBER middle = (NUMBER)b + c;
    NAMED(set)(w, m, min_i32(min_i32(a, b), min_i32(c, d)), max_i32(max_i32(a, b), max_i32(c, d)), 2 * middle,
               4 * (9 * middle - a - d), (NUMBER)a - b - c + d);
    w->places[m++] = at;
  }
  NAMED(decode_places)(w, m);
}

static void NAMED(decode_lines)(NAMED(work) * w, const shared_lines *lines, int are_rows) {
  int32_t done = -1; /* lines of both sides may be the same: those behind the last one are new */
  for (int side = 0; side < lines->n_sides; side++) {
    for (int32_t i = max_i32(lines->first[side], done + 1); i <= lines->last[side]; i++) {
      NAMED(decode_line)(w, i, are_rows);
      done = i;
    }
  }
}

/* ---- Units ---- */

/* Lay out the memory of a unit. */
static twz_status NAMED(begin)(NAMED(work) * w, rapid_unit *u, twz_error *error) {
  const layer *l = u->job->out;
  size_t n_even = (size_t)(l->rows.n_core + 1) / 2, n = (size_t)(l->cols.n_core + 1) / 2;
  size_t stride = (n + 2 * MARGIN + 15) / 16 * 16, n_plane = 4 * HELD_ROWS * stride;
  size_t n_row = (n_even > n ? n_even : n) + CORNER_ROW + 2 * MARGIN;
  size_t n_region = (size_t)l->rows.n * (size_t)l->cols.n;
  size_t bytes = 8 * n_plane + n_row * (4 * sizeof(NUMBER) + 7 * 4 + sizeof(size_t) + 1) + n_region;
  TRY(scratch_reserve(u->scratch, bytes + 24 * SCRATCH_ALIGN, error));
  memset(w, 0, sizeof *w);
  w->unit = u;
  w->stride = (ptrdiff_t)stride;
#ifdef SHORT
  w->heights = l->shorts;
#else
  w->heights = l->heights;
  w->lift = u->scale.origin;
#endif
  w->valid = l->valid;
  w->pitch = l->cols.n;
  scratch *s = u->scratch;
  for (int i = 0; i < 4; i++) w->planes[i] = scratch_take(s, n_plane);
  for (int i = 0; i < 3; i++) w->errors[i] = scratch_take(s, n_plane);
  w->bends = scratch_take(s, n_plane);
  NUMBER **numbers[4] = {&w->predicted, &w->sum, &w->twist, &w->line};
  int32_t **whole[7] = {&w->contexts, &w->packed_contexts, &w->details, &w->packed_details, &w->own, &w->least, &w->most};
  for (int i = 0; i < 4; i++) *numbers[i] = scratch_take(s, n_row * sizeof(NUMBER));
  for (int i = 0; i < 7; i++) *whole[i] = scratch_take(s, n_row * 4);
  w->own += MARGIN;
  w->places = scratch_take(s, n_row * sizeof(size_t));
  w->line_valid = scratch_take(s, n_row);
  w->known = scratch_take(s, n_region);
  return TWZ_OK;
}

/* Decode what units share, and find the lattice that is left. */
static void NAMED(begin_group)(NAMED(work) * w) {
  const job *j = w->unit->job;
  const layer *l = j->out, *above = j->parent.layer;
  NAMED(take_class)(w, 0);
  shared_lines rows, cols;
  find_shared_lines(&rows, &l->rows, j->file->grid.rings);
  find_shared_lines(&cols, &l->cols, j->file->grid.rings);
  for (int side = 0; side < rows.n_sides; side++) {
    memset(w->known + rows.first[side] * w->pitch, 0, (size_t)((rows.last[side] - rows.first[side] + 1) * w->pitch));
  }
  for (int32_t r = 0; r < l->rows.n; r++) {
    for (int side = 0; side < cols.n_sides; side++) {
      memset(w->known + r * w->pitch + cols.first[side], 0, (size_t)(cols.last[side] - cols.first[side] + 1));
    }
  }
  NAMED(decode_corners)(w, &rows, &cols);
  NAMED(decode_lines)(w, &rows, 1);
  NAMED(decode_lines)(w, &cols, 0);
  int32_t known = j->file->grid.rings + 1;
  const NAMED(part) left = {1, l->rows.n_core, l->cols.n_core, {l->rows.shared[0] ? known : 0, l->rows.shared[1] ? known : 0},
                            {l->cols.shared[0] ? known : 0, l->cols.shared[1] ? known : 0}, 0};
  w->part = left;
  ptrdiff_t row = j->parent.row + (ptrdiff_t)(l->rows.core_first / 2 - j->parent.first_row);
  ptrdiff_t col = j->parent.col + (ptrdiff_t)(l->cols.core_first / 2 - j->parent.first_col), at = row * above->cols.n + col;
  const NAMED(source) source = {above->shorts ? NULL : above->heights + at, above->shorts ? above->shorts + at : NULL,
                                above->origin, above->cols.n, 1};
  w->source = source;
}

#ifdef SHORT
static twz_status NAMED(decode)(rapid_unit *u, twz_error *error) {
  NAMED(work) w;
  TRY(NAMED(begin)(&w, u, error));
  NAMED(begin_group)(&w);
  NAMED(decode_lattice)(&w, u->n_turns);
  return TWZ_OK;
}

/* Groups row by row: symbols of one are read while those of the others wait for theirs. */
static twz_status NAMED(decode_groups)(rapid_unit *units, int n_units, twz_error *error) {
  NAMED(work) works[MOST_TOGETHER];
  int32_t n_turns = 0;
  for (int k = 0; k < n_units; k++) {
    TRY(NAMED(begin)(&works[k], &units[k], error));
    NAMED(begin_group)(&works[k]);
    NAMED(begin_lattice)(&works[k]);
    n_turns = max_i32(n_turns, units[k].n_turns);
  }
  for (int32_t t = 0; t < n_turns; t++) {
    for (int k = 0; k < n_units; k++) {
      if (t < units[k].n_turns) NAMED(advance)(&works[k], t);
    }
    for (int plane = HH; plane <= LH; plane++) {
      NAMED(row) rows[MOST_TOGETHER];
      ISA(span) spans[MOST_TOGETHER];
      NAMED(work) *who[MOST_TOGETHER]; /* units that have such a row */
      int32_t i = t - plane, n = 0;
      for (int k = 0; k < n_units; k++) {
        if (t >= units[k].n_turns || !NAMED(has_row)(&works[k], plane, i)) continue;
        rows[n] = NAMED(begin_row)(&works[k], plane, i);
        spans[n] = NAMED(begin_span)(&works[k], &rows[n]);
        who[n++] = &works[k];
      }
      if (n) ISA(read_vectors)(spans, n, units[0].tables->slots);
      for (int m = 0; m < n; m++) {
        NAMED(end_span)(who[m], &rows[m], &spans[m]);
        NAMED(end_row)(who[m], plane, i, &rows[m]);
      }
      for (int m = 0; m < n; m++) NAMED(settle_row)(who[m], plane, i);
    }
  }
  return TWZ_OK;
}
#else
/* R.4. */
static void NAMED(decode_root)(NAMED(work) * w) {
  rapid_unit *u = w->unit;
  const rapid_scale *c = &u->scale;
  const layer *l = u->job->out;
  int32_t stride = 1, log2 = 0;
  while (stride < max_i32(l->rows.n_core, l->cols.n_core) - 1) {
    stride *= 2;
    log2++;
  }
  int64_t range = (int64_t)c->high - c->low;
  int n_bits = bit_length((uint64_t)(range / c->step));
  int32_t half = c->step >> 1;
  for (int32_t i = 0; i < l->rows.n_core; i += stride) {
    for (int32_t j = 0; j < l->cols.n_core; j += stride) {
      size_t at = (size_t)(l->rows.core + i) * (size_t)w->pitch + (size_t)(l->cols.core + j);
      int32_t height = (int32_t)shift_right((int64_t)c->low + c->high, 1);
      if (!w->valid || w->valid[at]) {
        int64_t index = (int64_t)ISA(take_raw)(&u->streams, n_bits);
        height = (int32_t)min_i64(c->low + index * c->step + half, c->high);
      }
      w->heights[at] = NAMED(correct)(w, at, height);
    }
  }
  for (; stride > 1; log2--) {
    const NAMED(source) source = {w->heights + l->rows.core * w->pitch + l->cols.core, NULL, 0, stride * w->pitch, stride};
    w->source = source;
    stride /= 2;
    const NAMED(part) part = {stride, (l->rows.n_core - 1) / stride + 1, (l->cols.n_core - 1) / stride + 1, {0, 0}, {0, 0}, 0};
    w->part = part;
    NAMED(take_class)(w, log2 - 1);
    NAMED(decode_lattice)(w, ((part.n_rows + 1) >> 1) + 2);
  }
}

static twz_status NAMED(decode)(rapid_unit *u, twz_error *error) {
  NAMED(work) w;
  TRY(NAMED(begin)(&w, u, error));
  if (u->job->parent.layer) {
    NAMED(begin_group)(&w);
    NAMED(decode_lattice)(&w, u->n_turns);
  } else {
    NAMED(decode_root)(&w);
  }
  return TWZ_OK;
}
#endif
#undef FIRST
#undef SECOND
#undef REGION
