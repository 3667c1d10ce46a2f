// Prototype of rapid2: whole files (units of 512 cells, all levels, shared lines, voids, one 16-bit path).
#include <immintrin.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#define V __m256i
#define LD(p) _mm256_loadu_si256((const V *)(p))
#define ST(p, v) _mm256_storeu_si256((V *)(p), v)
enum { HH, HL, LH };
#define NT 128           // tables: pairs 0..63, singles 64..127; 127: nothing coded
#define ESC 126          // singles of escaped pairs
#define LOGM 12
#define M (1 << LOGM)
#define C0 28
#define CELLS 256        // plane columns of a unit at most (+1)
#define STR 352          // of rings
#define PAD 32
#define LIM 8191
#define LANES 32

typedef struct { int16_t w[3][24]; double ew[3][4]; int32_t v0[3]; int16_t v1[3], v2[3], v3[3]; int g; } cls;
typedef struct { uint32_t slots[NT][M]; uint32_t vals[512]; int cut; } tables;
typedef struct {
  int16_t a[32][STR], h[3][16][STR];   // heights of planes
  int16_t rng[32][STR], bend[32][STR];
  int16_t absq[3][16][STR];
  int8_t q8[8 * 272 + 64];
  int16_t q16[3][16][STR];
  int32_t q32[3][16][STR];
  uint8_t pc[8 * 144 + 64], sc[8 * 272 + 64];
  int32_t list[8 * 272 + 64];
  int16_t P[STR], S[STR];
} scratch;
typedef struct { const uint8_t *words, *raw; uint64_t bits; uint32_t st[LANES]; } stream;
typedef struct {
  int R, C;             // samples of the lattice
  const int32_t *par; int ps;   // parent heights
  const uint8_t *mask; int ms;  // of the lattice's samples, or NULL
  const int32_t *line[4];       // known: north, south (odd columns), west, east (odd rows); or NULL
  int32_t *out; int os;
  int n, wide, s, o, lo, hi;
} unit;

static double cpu(void) { struct timespec t; clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t); return t.tv_sec + 1e-9 * t.tv_nsec; }
static int fold(int i, int n) { if (n == 1) return 0; int p = 2 * (n - 1); i %= p; if (i < 0) i += p; return i < p - i ? i : p - i; }
static int clampi(int x, int a, int b) { return x < a ? a : x > b ? b : x; }
static int rows_of(const unit *u, int p) { return p == HL ? (u->R + 1) / 2 : u->R / 2; }
static int cols_of(const unit *u, int p) { return p == LH ? (u->C + 1) / 2 : u->C / 2; }

// --- planes in rings ---
static int16_t *A_(scratch *s, int i) { return s->a[i & 31] + PAD; }
static int16_t *H_(scratch *s, const unit *u, int p, int i) { return s->h[p][clampi(i, 0, rows_of(u, p) - 1) & 15] + PAD; }

static void load_a(scratch *s, const unit *u, int i) {
  int ra = (u->R + 1) / 2, ca = (u->C + 1) / 2, src = fold(2 * i, u->R) / 2;
  if (src > ra - 1) src = ra - 1;
  const int32_t *from = u->par + (size_t)src * u->ps; int16_t *to = A_(s, i);
  const V o = _mm256_set1_epi32(u->o), hi = _mm256_set1_epi16(LIM), lo = _mm256_set1_epi16(-LIM), bl = _mm256_set1_epi32(u->lo), bh = _mm256_set1_epi32(u->hi);
  const __m128i sh = _mm_cvtsi32_si128(u->s);
  for (int j = 0; j < ca; j += 16) {
    V x = _mm256_sub_epi32(_mm256_min_epi32(_mm256_max_epi32(LD(from + j), bl), bh), o), y = _mm256_sub_epi32(_mm256_min_epi32(_mm256_max_epi32(LD(from + j + 8), bl), bh), o);
    V z = _mm256_permute4x64_epi64(_mm256_packs_epi32(_mm256_sra_epi32(x, sh), _mm256_sra_epi32(y, sh)), 0xD8);
    ST(to + j, _mm256_min_epi16(_mm256_max_epi16(z, lo), hi));
  }
  for (int k = 1; k <= 4; k++) { to[-k] = to[clampi(fold(-2 * k, u->C) / 2, 0, ca - 1)]; to[ca - 1 + k] = to[clampi(fold(2 * (ca - 1 + k), u->C) / 2, 0, ca - 1)]; }
}
static void features(scratch *s, const unit *u, int i) {   // range of cells (i, j), bend of samples (i, j), j from -1
  int ca = (u->C + 1) / 2; const int16_t *t = A_(s, i - 1), *a = A_(s, i), *d = A_(s, i + 1); int16_t *r = s->rng[i & 31] + PAD, *b = s->bend[i & 31] + PAD;
  const V lim = _mm256_set1_epi16(LIM);
  for (int j = -1; j <= ca; j += 16) {
    V x = LD(a + j), y = LD(a + j + 1), z = LD(d + j), w = LD(d + j + 1);
    ST(r + j, _mm256_sub_epi16(_mm256_max_epi16(_mm256_max_epi16(x, y), _mm256_max_epi16(z, w)), _mm256_min_epi16(_mm256_min_epi16(x, y), _mm256_min_epi16(z, w))));
    V m = _mm256_add_epi16(x, x);
    V p = _mm256_abs_epi16(_mm256_subs_epi16(_mm256_adds_epi16(LD(a + j - 1), y), m)), q = _mm256_abs_epi16(_mm256_subs_epi16(_mm256_adds_epi16(LD(t + j), z), m));
    ST(b + j, _mm256_min_epu16(_mm256_adds_epu16(p, q), lim));
  }
}

// --- prediction: P in quarters, side as a mask ---
typedef struct { const int16_t *p; int16_t a, b; } tap;
static inline __attribute__((always_inline)) void predict(scratch *s, int n, const tap *t, const int nt, const int16_t *c1, const int16_t *c2, const int16_t *c3, const int16_t *c4, int fine) {
  V W[14]; for (int k = 0; k < nt; k++) W[k] = _mm256_set1_epi32((uint16_t)t[k].a | (uint32_t)(uint16_t)t[k].b << 16);
  for (int o = 0; o < n; o += 16) {
    V e = _mm256_setzero_si256(), d = e;
    for (int k = 0; k < nt; k++) { e = _mm256_add_epi32(e, _mm256_madd_epi16(LD(t[k].p + o), W[k])); d = _mm256_add_epi32(d, _mm256_madd_epi16(LD(t[k].p + o + 1), W[k])); }
    V P = _mm256_blend_epi16(_mm256_srli_epi32(_mm256_slli_epi32(e, 6), 16), _mm256_slli_epi32(_mm256_srai_epi32(d, 10), 16), 0xAA);
    V x1 = LD(c1 + o), x2 = LD(c2 + o), x3 = LD(c3 + o), x4 = LD(c4 + o);
    V lo = _mm256_min_epi16(_mm256_min_epi16(x1, x2), _mm256_min_epi16(x3, x4)), hi = _mm256_max_epi16(_mm256_max_epi16(x1, x2), _mm256_max_epi16(x3, x4));
    P = _mm256_min_epi16(_mm256_max_epi16(P, _mm256_slli_epi16(lo, 2)), _mm256_slli_epi16(hi, 2));
    V w = _mm256_srai_epi16(_mm256_add_epi16(P, _mm256_set1_epi16(2)), 2), S;
    if (fine) S = _mm256_cmpgt_epi16(_mm256_slli_epi16(w, 2), P);
    else S = _mm256_cmpgt_epi16(P, _mm256_add_epi16(_mm256_add_epi16(x1, x2), _mm256_add_epi16(x3, x4)));
    ST(s->P + o, P); ST(s->S + o, S);
  }
}
static void predict_row(scratch *s, const unit *u, const cls *k, int p, int i) {
  const int16_t *v = k->w[p], *up = A_(s, i - 1), *at = A_(s, i), *dn = A_(s, i + 1), *lw = A_(s, i + 2);
  const int16_t *h2 = H_(s, u, HH, i - 2), *h1 = H_(s, u, HH, i - 1), *h = H_(s, u, HH, i), *hd = H_(s, u, HH, i + 1);
  int n = cols_of(u, p), fine = u->n <= 3;
  if (p == HH) {
    const tap t[8] = {{up - 1, v[0], v[1]}, {up + 1, v[2], v[3]}, {at - 1, v[4], v[5]}, {at + 1, v[6], v[7]}, {dn - 1, v[8], v[9]}, {dn + 1, v[10], v[11]}, {lw - 1, v[12], v[13]}, {lw + 1, v[14], v[15]}};
    if (fine) predict(s, n, t, 8, at, at + 1, dn, dn + 1, 1); else predict(s, n, t, 8, at, at + 1, dn, dn + 1, 0);
  } else if (p == HL) {
    // taps: A (0,-1)(0,0)(0,1)(0,2)(-1,0)(-1,1)(1,0)(1,1) HH (-1,-1)(-1,0)(-1,1)(0,-1)(0,0)(0,1)(-2,0)(1,0) A (-1,-1)(-1,2)(1,-1)(1,2)
    const tap t[12] = {{at - 1, v[0], v[1]}, {at + 1, v[2], v[3]}, {up - 1, v[16], v[4]}, {up + 1, v[5], v[17]}, {dn - 1, v[18], v[6]}, {dn + 1, v[7], v[19]},
      {h1 - 1, v[8], v[9]}, {h1 + 1, v[10], 0}, {h - 1, v[11], v[12]}, {h + 1, v[13], 0}, {h2, v[14], 0}, {hd, v[15], 0}};
    if (fine) predict(s, n, t, 12, at, at + 1, h1, h, 1); else predict(s, n, t, 12, at, at + 1, h1, h, 0);
  } else {
    // A (-1,0)(0,0)(1,0)(2,0)(0,-1)(0,1)(1,-1)(1,1) HH (0,-2)(0,-1)(0,0)(0,1)(-1,-1)(-1,0)(1,-1)(1,0) HL (0,-1)(0,0)(1,-1)(1,0) A (-1,-1)(2,-1)(-1,1)(2,1)
    const int16_t *l = H_(s, u, HL, i), *ld = H_(s, u, HL, i + 1);
    const tap t[14] = {{up - 1, v[20], v[0]}, {up + 1, v[22], 0}, {at - 1, v[4], v[1]}, {at + 1, v[5], 0}, {dn - 1, v[6], v[2]}, {dn + 1, v[7], 0}, {lw - 1, v[21], v[3]},
      {lw + 1, v[23], 0}, {h - 2, v[8], v[9]}, {h, v[10], v[11]}, {h1 - 1, v[12], v[13]}, {hd - 1, v[14], v[15]}, {l - 1, v[16], v[17]}, {ld - 1, v[18], v[19]}};
    if (fine) predict(s, n, t, 14, at, dn, h - 1, h, 1); else predict(s, n, t, 14, at, dn, h - 1, h, 0);
  }
}

// --- heights of a row: narrow (16 bits) or wide (32) ; the row's plane and its 32-bit heights in `to` ---
static void edge(int16_t *r, int n) { for (int k = 1; k <= 4; k++) { r[-k] = r[0]; r[n - 1 + k] = r[n - 1]; } }
static void finish_narrow(scratch *s, const unit *u, int p, int i, int n) {
  int16_t *own = s->h[p][i & 15] + PAD; const int16_t *q = s->q16[p][i & 15];
  const V N = _mm256_set1_epi16(u->n), lo = _mm256_set1_epi16(u->lo - u->o), hi = _mm256_set1_epi16(u->hi - u->o), two = _mm256_set1_epi16(2);
  for (int o = 0; o < n; o += 16) {
    V S = LD(s->S + o), d = _mm256_sub_epi16(_mm256_xor_si256(LD(q + o), S), S), w = _mm256_srai_epi16(_mm256_add_epi16(LD(s->P + o), two), 2);
    V x = _mm256_adds_epi16(w, _mm256_mullo_epi16(d, N)); ST(own + o, _mm256_min_epi16(_mm256_max_epi16(x, lo), hi));
  }
}
static void finish_wide(scratch *s, const unit *u, int p, int i, int n, int32_t *to) {
  int16_t *own = s->h[p][i & 15] + PAD; const int32_t *q = s->q32[p][i & 15];
  const V N = _mm256_set1_epi32(u->n), lo = _mm256_set1_epi32(u->lo), hi = _mm256_set1_epi32(u->hi), two = _mm256_set1_epi32(2), O = _mm256_set1_epi32(u->o), l16 = _mm256_set1_epi16(-LIM), h16 = _mm256_set1_epi16(LIM);
  const __m128i sh = _mm_cvtsi32_si128(u->s);
  for (int o = 0; o < n; o += 16) {
    V y[2];
    for (int k = 0; k < 2; k++) {
      V P = _mm256_cvtepi16_epi32(_mm_loadu_si128((const __m128i *)(s->P + o + 8 * k))), S = _mm256_cvtepi16_epi32(_mm_loadu_si128((const __m128i *)(s->S + o + 8 * k)));
      V d = LD(q + o + 8 * k); d = _mm256_sub_epi32(_mm256_xor_si256(d, S), S);
      V w = _mm256_srai_epi32(_mm256_add_epi32(_mm256_sll_epi32(P, sh), two), 2);
      V x = _mm256_add_epi32(_mm256_add_epi32(w, O), _mm256_mullo_epi32(d, N));
      x = _mm256_min_epi32(_mm256_max_epi32(x, lo), hi); ST(to + o + 8 * k, x);
      y[k] = _mm256_sra_epi32(_mm256_sub_epi32(x, O), sh);
    }
    V z = _mm256_permute4x64_epi64(_mm256_packs_epi32(y[0], y[1]), 0xD8); ST(own + o, _mm256_min_epi16(_mm256_max_epi16(z, l16), h16));
  }
}

// --- classes ---
static inline V class_of(V E) {
  V c = _mm256_srli_epi32(_mm256_castps_si256(_mm256_cvtepi32_ps(_mm256_max_epi32(_mm256_andnot_si256(_mm256_srli_epi32(E, 2), E), _mm256_set1_epi32(1)))), 22);
  return _mm256_min_epi32(_mm256_sub_epi32(c, _mm256_set1_epi32(254)), _mm256_set1_epi32(59));
}
static void class_row(scratch *s, const unit *u, const cls *k, int p, int i, int c0, int n, uint8_t *pc, uint8_t *sc) {
  const int16_t *r0 = s->rng[i & 31] + PAD + c0, *r1 = s->rng[(i - 1) & 31] + PAD + c0, *b0 = s->bend[i & 31] + PAD + c0, *b1 = s->bend[(i + 1) & 31] + PAD + c0;
  const int16_t *nh = s->absq[HH][i & 15] + PAD + c0, *nu = s->absq[HH][(i - 1) & 15] + PAD + c0, *nl = s->absq[HL][i & 15] + PAD + c0, *nd = s->absq[HL][(i + 1) & 15] + PAD + c0;
  static const int16_t none[STR]; if (i == 0) nu = none + PAD; if (i + 1 >= rows_of(u, HL)) nd = none + PAD;
  const V vb = _mm256_set1_epi32((uint16_t)k->v1[p] | (uint32_t)k->v2[p] << 16), vn = _mm256_set1_epi32((uint16_t)k->v3[p]), v0 = _mm256_set1_epi32(k->v0[p]), z = _mm256_setzero_si256();
  const __m128i g = _mm_cvtsi32_si128(k->g);
  for (int o = 0; o < n; o += 16) {
    V r, b, q;
    if (p == HH) { r = LD(r0 + o); b = _mm256_add_epi16(_mm256_add_epi16(LD(b0 + o), LD(b0 + o + 1)), _mm256_add_epi16(LD(b1 + o), LD(b1 + o + 1))); q = z; }
    else if (p == HL) { r = _mm256_add_epi16(LD(r0 + o), LD(r1 + o)); b = _mm256_add_epi16(LD(b0 + o), LD(b0 + o + 1)); q = _mm256_add_epi16(LD(nu + o), LD(nh + o)); }
    else { r = _mm256_add_epi16(LD(r0 + o), LD(r0 + o - 1)); b = _mm256_add_epi16(LD(b0 + o), LD(b1 + o)); q = _mm256_add_epi16(_mm256_add_epi16(_mm256_add_epi16(LD(nh + o), LD(nh + o - 1)), _mm256_add_epi16(LD(nl + o), LD(nl + o - 1))), _mm256_add_epi16(LD(nd + o), LD(nd + o - 1))); }
    V e = _mm256_add_epi32(_mm256_srl_epi32(_mm256_madd_epi16(_mm256_unpacklo_epi16(r, b), vb), g), v0), f = _mm256_add_epi32(_mm256_srl_epi32(_mm256_madd_epi16(_mm256_unpackhi_epi16(r, b), vb), g), v0);
    if (p != HH) { e = _mm256_add_epi32(e, _mm256_madd_epi16(_mm256_unpacklo_epi16(q, z), vn)); f = _mm256_add_epi32(f, _mm256_madd_epi16(_mm256_unpackhi_epi16(q, z), vn)); }
    V c = _mm256_packs_epi32(class_of(e), class_of(f));
    _mm_storeu_si128((__m128i *)(sc + o), _mm256_castsi256_si128(_mm256_permute4x64_epi64(_mm256_packus_epi16(c, c), 0xD8)));
    V h = class_of(_mm256_srli_epi32(_mm256_hadd_epi32(e, f), 1));
    h = _mm256_packus_epi16(_mm256_packs_epi32(h, h), z); 
    int32_t a = _mm256_extract_epi32(h, 0), d = _mm256_extract_epi32(h, 4); memcpy(pc + o / 2, &a, 4); memcpy(pc + o / 2 + 4, &d, 4);
  }
}
// voids and known samples: class 0xFF
static void hide(const unit *u, int p, int i, int c0, int n, uint8_t *pc, uint8_t *sc) {
  const uint8_t *m = u->mask + (size_t)(p == HL ? 2 * i : 2 * i + 1) * u->ms + (p == LH ? 0 : 1) + 2 * c0;
  for (int j = 0; j < n; j += 2) { int a = m[2 * j], b = j + 1 < n && m[2 * j + 2]; if (!(a && b)) { if (!a) sc[j] = 0xFF; if (!b) sc[j + 1] = 0xFF; if (!a && !b) pc[j / 2] = 0xFF; } }
}

// --- symbols ---
static uint8_t EXP[256][8], SHUF[16][16]; static int32_t PERM[16][8]; static int OUTB[16];
static void init_luts(void) {
  for (int m = 0; m < 256; m++) for (int l = 0, b = 0; l < 8; l++) { EXP[m][l] = b; b += m >> l & 1; }
  for (int m = 0; m < 16; m++) { int k = 0; for (int l = 0; l < 8; l++) if (!((l & 1) && (m >> (l / 2) & 1))) PERM[m][k++] = l; for (; k < 8; k++) PERM[m][k] = 7;
    int o = 0; for (int l = 0; l < 4; l++) for (int b = 0; b < ((m >> l & 1) ? 2 : 1); b++) SHUF[m][o++] = 4 * l + b; OUTB[m] = o; for (; o < 16; o++) SHUF[m][o] = 0x80; }
}
static int build_list(scratch *s, const tables *t, int G, int *anyk) {
  int m = 0; V ak = _mm256_setzero_si256(); const V z = ak, m127 = _mm256_set1_epi32(127), b64 = _mm256_set1_epi32(64);
  for (int g = 0; g < G; g += 4) {
    int32_t w; memcpy(&w, s->pc + g, 4); __m128i c4 = _mm_cvtepi8_epi32(_mm_cvtsi32_si128(w)); V c2 = _mm256_cvtepi8_epi32(_mm_loadl_epi64((const __m128i *)(s->sc + 2 * g)));
    __m128i pair = _mm_cmpgt_epi32(_mm_set1_epi32(t->cut), c4); unsigned q = _mm_movemask_ps(_mm_castsi128_ps(pair)); V qm = _mm256_cvtepi32_epi64(pair);
    V e = _mm256_and_si256(_mm256_blendv_epi8(_mm256_or_si256(c2, b64), _mm256_and_si256(_mm256_cvtepi32_epi64(c4), _mm256_set1_epi32(63)), qm), m127);
    ak = _mm256_or_si256(ak, _mm256_andnot_si256(qm, _mm256_cmpgt_epi32(c2, _mm256_set1_epi32(C0 + 5))));
    ST(s->list + m, _mm256_permutevar8x32_epi32(e, LD(PERM[q])));
    if (g + 4 > G) { int left = G - g; m += 2 * left - _mm_popcnt_u32(q & ((1 << left) - 1)); } else m += 8 - _mm_popcnt_u32(q);
  }
  *anyk = !_mm256_testz_si256(ak, ak); (void)z; return m;
}
static uint32_t look1(stream *r, const tables *t, int ti, int lane) {
  uint32_t x = r->st[lane], e = t->slots[ti][x & (M - 1)], nx = ((e >> 8 & 4095) + 1) * (x >> LOGM) + (e >> 20);
  if (nx < 65536) { uint16_t w; memcpy(&w, r->words, 2); nx = nx << 16 | w; r->words += 2; }
  r->st[lane] = nx; return t->vals[(ti >= 64 ? 256 : 0) + (e & 255)];
}
static uint64_t take(stream *r, int n) { uint64_t b; memcpy(&b, r->raw + (r->bits >> 3), 8); b >>= r->bits & 7; r->bits += n; return b & ((1ull << n) - 1); }
static int bits_of(int c) { return c > C0 + 5 && c < 64 ? (c - C0 - 4) >> 1 : 0; }
static V actmask(int m) { return _mm256_cmpgt_epi32(_mm256_set1_epi32(m), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7)); }
#define STEP(xv, cvec, full, act, out, pm) { \
  V slot = _mm256_or_si256(_mm256_slli_epi32(cvec, LOGM), _mm256_and_si256(xv, _mm256_set1_epi32(M - 1))); V e = _mm256_i32gather_epi32((const int *)t->slots[0], slot, 4); \
  V hi = _mm256_srli_epi32(xv, LOGM); pm = _mm256_and_si256(cvec, _mm256_set1_epi32(64)); \
  V nx = _mm256_add_epi32(_mm256_add_epi32(_mm256_mullo_epi32(_mm256_and_si256(_mm256_srli_epi32(e, 8), _mm256_set1_epi32(4095)), hi), hi), _mm256_srli_epi32(e, 20)); \
  out = _mm256_i32gather_epi32((const int *)t->vals, _mm256_add_epi32(_mm256_and_si256(e, _mm256_set1_epi32(255)), _mm256_slli_epi32(pm, 2)), 4); \
  V tk = _mm256_cmpeq_epi32(_mm256_srli_epi32(nx, 16), _mm256_setzero_si256()); if (!full) tk = _mm256_and_si256(tk, act); \
  unsigned mm = _mm256_movemask_ps(_mm256_castsi256_ps(tk)); \
  V wd = _mm256_permutevar8x32_epi32(_mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i *)at)), _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)EXP[mm]))); \
  nx = _mm256_blendv_epi8(nx, _mm256_or_si256(_mm256_slli_epi32(nx, 16), wd), tk); at += 2 * _mm_popcnt_u32(mm); xv = full ? nx : _mm256_blendv_epi8(xv, nx, act); }
#define PUT8 { unsigned k = ~_mm256_movemask_ps(_mm256_castsi256_ps(_mm256_slli_epi32(pm, 25))); _mm_storeu_si128((__m128i *)o, _mm_shuffle_epi8(_mm256_castsi256_si128(v), _mm_loadu_si128((const __m128i *)SHUF[k & 15]))); o += OUTB[k & 15]; \
   _mm_storeu_si128((__m128i *)o, _mm_shuffle_epi8(_mm256_extracti128_si256(v, 1), _mm_loadu_si128((const __m128i *)SHUF[k >> 4 & 15]))); o += OUTB[k >> 4 & 15]; seen = _mm256_or_si256(seen, _mm256_cmpeq_epi8(v, e80)); }
// Reads a strip: q8 of 2 G samples. Gives whether wide values follow in `extra`.
static int read_strip(scratch *s, stream *r, const tables *t, int G) {
  int anyk, m = build_list(s, t, G, &anyk); const uint8_t *at = r->words; uint8_t *o = (uint8_t *)s->q8; V x0 = LD(r->st), x1 = LD(r->st + 8), x2 = LD(r->st + 16), x3 = LD(r->st + 24);
  const V e80 = _mm256_set1_epi32((int)0x80808080); V seen = _mm256_setzero_si256(), v, pm, z = seen; int j = 0;
  for (; j + 32 <= m; j += 32) { V c = LD(s->list + j); STEP(x0, c, 1, z, v, pm) PUT8 c = LD(s->list + j + 8); STEP(x1, c, 1, z, v, pm) PUT8 c = LD(s->list + j + 16); STEP(x2, c, 1, z, v, pm) PUT8 c = LD(s->list + j + 24); STEP(x3, c, 1, z, v, pm) PUT8 }
#define PART(X) if (j + 8 <= m) { V c = LD(s->list + j); STEP(X, c, 1, z, v, pm) PUT8 j += 8; } else if (j < m) { V a = actmask(m - j); V c = _mm256_and_si256(LD(s->list + j), a); STEP(X, c, 0, a, v, pm) v = _mm256_and_si256(v, a); PUT8 j += 8; }
  PART(x0) PART(x1) PART(x2) PART(x3)
  ST(r->st, x0); ST(r->st + 8, x1); ST(r->st + 16, x2); ST(r->st + 24, x3); r->words = at;
  return (_mm256_movemask_epi8(seen) != 0 ? 1 : 0) | (anyk ? 2 : 0);
}
static int32_t EX[8 * 272 + 64];
// details beyond 8 bits: escapes of pairs, raw bits, escapes of singles, into EX
static void after(scratch *s, stream *r, const tables *t, int G, int how) {
  int8_t *q = s->q8;
  if (how & 1) { int lane = 0; for (int g = 0; g < G; g++) if ((int8_t)s->pc[g] < t->cut && q[2 * g] == -128) { for (int h = 0; h < 2; h++) { q[2 * g + h] = (int8_t)look1(r, t, ESC, lane); lane = (lane + 1) & (LANES - 1); } } }
  for (int j = 0; j < 2 * G; j += 16) { V x = _mm256_cvtepi8_epi32(_mm_loadl_epi64((const __m128i *)(q + j))), y = _mm256_cvtepi8_epi32(_mm_loadl_epi64((const __m128i *)(q + j + 8))); ST(EX + j, x); ST(EX + j + 8, y); }
  if (how & 2) {
    const V z = _mm256_setzero_si256();
    for (int j = 0; j < 2 * G; j += 8) {
      V sc = _mm256_cvtepi8_epi32(_mm_loadl_epi64((const __m128i *)(s->sc + j))); int32_t w; memcpy(&w, s->pc + j / 2, 4);
      V pm = _mm256_cvtepi32_epi64(_mm_cmpgt_epi32(_mm_set1_epi32(t->cut), _mm_cvtepi8_epi32(_mm_cvtsi32_si128(w)))); pm = _mm256_or_si256(pm, _mm256_slli_epi64(pm, 32));
      V k = _mm256_andnot_si256(pm, _mm256_max_epi32(_mm256_srai_epi32(_mm256_sub_epi32(sc, _mm256_set1_epi32(C0 + 4)), 1), z));
      if (j + 8 > 2 * G) k = _mm256_and_si256(k, actmask(2 * G - j));
      if (_mm256_testz_si256(k, k)) continue;
      V su = _mm256_add_epi32(k, _mm256_slli_si256(k, 4)); su = _mm256_add_epi32(su, _mm256_slli_si256(su, 8));
      V carry = _mm256_shuffle_epi32(_mm256_permute2x128_si256(su, su, 8), 255); su = _mm256_add_epi32(su, carry);
      int total = _mm256_extract_epi32(su, 7); V b = _mm256_add_epi32(_mm256_sub_epi32(su, k), _mm256_set1_epi32(r->bits & 7));
      V raw = _mm256_i32gather_epi32((const int *)(r->raw + (r->bits >> 3)), _mm256_srli_epi32(b, 3), 1);
      raw = _mm256_srlv_epi32(raw, _mm256_and_si256(b, _mm256_set1_epi32(7))); raw = _mm256_andnot_si256(_mm256_sllv_epi32(_mm256_set1_epi32(-1), k), raw);
      ST(EX + j, _mm256_or_si256(_mm256_sllv_epi32(LD(EX + j), k), raw)); r->bits += total;
    }
  }
  const V e80 = _mm256_set1_epi8(-128);
  if (how & 1) for (int jj = 0; jj < 2 * G; jj += 32) {
    unsigned mm = _mm256_movemask_epi8(_mm256_cmpeq_epi8(LD(q + jj), e80)); if (2 * G - jj < 32) mm &= (1u << (2 * G - jj)) - 1;
    while (mm) { int j = jj + __builtin_ctz(mm); mm &= mm - 1; int k = (int8_t)s->pc[j / 2] < t->cut ? 0 : bits_of(s->sc[j]); int L = (int)take(r, 5); uint64_t x = take(r, L + 1); int64_t v = ((1ll << L) - 1) + (int64_t)(x >> 1) + 32; int low = k ? EX[j] & ((1 << k) - 1) : 0;
      EX[j] = (int32_t)((uint32_t)((x & 1 ? -v : v) << k) | (uint32_t)low); } }
}
// details of a strip into rings; abs for `near`
static void spread(scratch *s, const unit *u, int p, int i0, int i1, int c0, int n, int how) {
  int G2 = (n + 1) / 2 * 2, total = cols_of(u, p); const V lim = _mm256_set1_epi16(4095);
  for (int i = i0; i < i1; i++) {
    int16_t *q = s->q16[p][i & 15], *b = s->absq[p][i & 15] + PAD; const int8_t *from = s->q8 + (i - i0) * G2; const int32_t *f32 = EX + (i - i0) * G2;
    if (!how) for (int j = 0; j < n; j += 16) { V x = _mm256_cvtepi8_epi16(_mm_loadu_si128((const __m128i *)(from + j))); ST(q + c0 + j, x); ST(b + c0 + j, _mm256_abs_epi16(x)); }
    else for (int j = 0; j < n; j += 16) { V x = _mm256_permute4x64_epi64(_mm256_packs_epi32(LD(f32 + j), LD(f32 + j + 8)), 0xD8); ST(q + c0 + j, x); ST(b + c0 + j, _mm256_min_epu16(_mm256_abs_epi16(x), lim)); }
    if (c0) { q[0] = 0; b[0] = 0; }
    for (int j = c0 + n; j < total + 4; j++) { q[j] = 0; b[j] = 0; }
    b[-1] = b[-2] = 0;
    if (u->wide) { int32_t *w = s->q32[p][i & 15]; if (how) memcpy(w + c0, f32, 4 * n); else for (int j = 0; j < n; j++) w[c0 + j] = from[j]; if (c0) w[0] = 0; for (int j = c0 + n; j < total; j++) w[j] = 0; }
  }
}
static void known_row(scratch *s, const unit *u, int i) {   // HL row known: no details
  int p = HL; memset(s->q16[p][i & 15], 0, 2 * STR); memset(s->absq[p][i & 15], 0, 2 * STR); memset(s->q32[p][i & 15], 0, 4 * STR);
}
static int32_t narrow(const unit *u, int32_t x) { return clampi((x - u->o) >> u->s, -LIM, LIM); }

static void store(scratch *s, const unit *u, int r, const int16_t *ev, const int16_t *od, int ne, int no) {   // narrow
  int32_t *to = u->out + (size_t)r * u->os; const V O = _mm256_set1_epi32(u->o);
  for (int j = 0; j < no; j += 8) {
    __m128i a = _mm_loadu_si128((const __m128i *)(ev + j)), b = _mm_loadu_si128((const __m128i *)(od + j));
    ST(to + 2 * j, _mm256_add_epi32(_mm256_cvtepi16_epi32(_mm_unpacklo_epi16(a, b)), O)); ST(to + 2 * j + 8, _mm256_add_epi32(_mm256_cvtepi16_epi32(_mm_unpackhi_epi16(a, b)), O));
  }
  if (ne > no) to[2 * no] = ev[no] + u->o;
}
// where 8 more samples than a row may be written, rows go from top to bottom: the next row overwrites
static void decode(scratch *s, const unit *u, const cls *k, const tables *t, stream *r) {
  int ra = (u->R + 1) / 2, ca = (u->C + 1) / 2, rows[3], cols[3], a_ready = -4, f_ready = -1;
  for (int p = 0; p < 3; p++) { rows[p] = rows_of(u, p); cols[p] = cols_of(u, p); }
  static int32_t wide_rows[3][16][STR];
  int hl0 = u->line[0] ? 1 : 0, hl1 = u->line[1] ? ra - 1 : ra, lc0 = u->line[2] ? 1 : 0, lc1 = u->line[3] ? ca - 1 : ca;
  int done[3] = {0, 0, 0};
  for (int b = 0; done[HL] < rows[HL] || done[LH] < rows[LH] || done[HH] < rows[HH]; b++) {
    for (; a_ready < ra + 3 && a_ready < 8 * b + 13; a_ready++) load_a(s, u, a_ready);
    for (; f_ready <= ra && f_ready <= 8 * b + 8; f_ready++) features(s, u, f_ready);
    for (int p = 0; p < 3; p++) {
      int i0 = 8 * b - (p == LH), i1 = i0 + 8; if (i0 < 0) i0 = 0; if (i1 > rows[p]) i1 = rows[p];
      if (p == HL) { if (i0 == 0 && hl0 && i1 > 0) { known_row(s, u, 0); i0 = 1; } if (hl1 < ra && i1 == ra && i0 < i1) { known_row(s, u, ra - 1); i1 = ra - 1; } }
      if (i0 >= i1) continue;
      int c0 = p == LH ? lc0 : 0, n = (p == LH ? lc1 : cols[p]) - c0; if (n <= 0) continue;
      int G = (n + 1) / 2;
      for (int i = i0; i < i1; i++) { uint8_t *pc = s->pc + (i - i0) * G, *sc = s->sc + (i - i0) * 2 * G; class_row(s, u, k, p, i, c0, n, pc, sc); if (n & 1) { sc[n] = 0xFF; } if (u->mask) hide(u, p, i, c0, n, pc, sc); }
      int how = read_strip(s, r, t, G * (i1 - i0)); if (how) after(s, r, t, G * (i1 - i0), how); spread(s, u, p, i0, i1, c0, n, how);
    }
    int ready[3]; ready[HH] = clampi(8 * b + 8, 0, rows[HH]); ready[HL] = ready[HH] == rows[HH] ? clampi(8 * b + 8, 0, rows[HL]) : clampi(8 * b + 7, 0, rows[HL]);
    ready[LH] = ready[HL] == rows[HL] ? clampi(8 * b + 7, 0, rows[LH]) : clampi(8 * b + 6, 0, rows[LH]);
    for (int p = 0; p < 3; p++) for (; done[p] < ready[p]; done[p]++) {
      int i = done[p], n = cols[p]; int16_t *own = s->h[p][i & 15] + PAD; int32_t *wr = wide_rows[p][i & 15];
      if (p == HL && ((i == 0 && u->line[0]) || (i == ra - 1 && u->line[1]))) { const int32_t *l = u->line[i == 0 && u->line[0] ? 0 : 1]; for (int j = 0; j < n; j++) { own[j] = narrow(u, l[j]); wr[j] = l[j]; } }
      else if (n) { predict_row(s, u, k, p, i); if (u->wide) finish_wide(s, u, p, i, n, wr); else finish_narrow(s, u, p, i, n); }
      if (p == LH) { if (u->line[2]) { own[0] = narrow(u, u->line[2][i]); wr[0] = u->line[2][i]; } if (u->line[3]) { own[ca - 1] = narrow(u, u->line[3][i]); wr[ca - 1] = u->line[3][i]; } }
      if (n) edge(own, n);
      if (p == HH) continue;
      if (!u->wide) { if (p == HL) store(s, u, 2 * i, A_(s, i), own, ca, cols[HL]); else store(s, u, 2 * i + 1, own, s->h[HH][i & 15] + PAD, ca, cols[HL]); }
      else { int32_t *to = u->out + (size_t)(p == HL ? 2 * i : 2 * i + 1) * u->os; const int32_t *ev = p == HL ? u->par + (size_t)i * u->ps : wr, *od = p == HL ? wr : wide_rows[HH][i & 15];
        for (int j = 0; j < cols[HL]; j++) { to[2 * j] = ev[j]; to[2 * j + 1] = od[j]; } if (ca > cols[HL]) to[2 * cols[HL]] = ev[cols[HL]]; }
    }
  }
}

// ------------------------------------------------ encoder ------------------------------------------------
typedef struct { uint8_t t, s, lane; } sym;
typedef struct { sym *list; size_t n, room; uint8_t *raw; uint64_t bits, rawroom; } coded;
static uint32_t CNT[NT][256]; static double GQ[64][2];
static int PS(int a, int b) { return (a + 7) * 15 + b + 7; }
static void put(coded *e, uint64_t v, int n) { if ((e->bits + n) / 8 + 16 > e->rawroom) { e->raw = realloc(e->raw, 2 * e->rawroom); memset(e->raw + e->rawroom, 0, e->rawroom); e->rawroom *= 2; } for (int i = 0; i < n; i++, e->bits++) if (v >> i & 1) e->raw[e->bits >> 3] |= 1 << (e->bits & 7); }
static void add(coded *e, int t, int s, int lane) { if (e->n == e->room) e->list = realloc(e->list, sizeof(sym) * (e->room *= 2)); e->list[e->n++] = (sym){t, s, lane}; CNT[t][s]++; }
static uint8_t RARE[64][256];
static int is_esc(int c, int a, int b) { return abs(a) > 7 || abs(b) > 7 || RARE[c][PS(a, b)]; }
static void emit(coded *e, scratch *s, const tables *t, int G, const int32_t *q) {
  int lane = 0;
  for (int g = 0; g < G; g++) { int c = (int8_t)s->pc[g];
    if (c < t->cut) { if (c < 0) { lane = (lane + 1) % LANES; add(e, 127, 0, 255); continue; } add(e, c, is_esc(c, q[2 * g], q[2 * g + 1]) ? 225 : PS(q[2 * g], q[2 * g + 1]), lane); lane = (lane + 1) % LANES; }
    else for (int h = 0; h < 2; h++) { int cc = (int8_t)s->sc[2 * g + h]; if (cc < 0) { add(e, 127, 0, 255); lane = (lane + 1) % LANES; continue; } int v = q[2 * g + h] >> bits_of(cc); add(e, 64 + cc, abs(v) > 31 ? 63 : v + 31, lane); lane = (lane + 1) % LANES; } }
  lane = 0;
  for (int g = 0; g < G; g++) { int c = (int8_t)s->pc[g]; if (c >= 0 && c < t->cut && is_esc(c, q[2 * g], q[2 * g + 1])) for (int h = 0; h < 2; h++) { int v = q[2 * g + h]; add(e, ESC, abs(v) > 31 ? 63 : v + 31, lane); lane = (lane + 1) % LANES; } }
  for (int j = 0; j < 2 * G; j++) { int c = (int8_t)s->pc[j / 2], k = c < t->cut ? 0 : bits_of(s->sc[j]); if (k) put(e, q[j] & ((1u << k) - 1), k); }
  for (int j = 0; j < 2 * G; j++) { int c = (int8_t)s->pc[j / 2], k = c < t->cut ? 0 : bits_of(s->sc[j]), v = q[j] >> k;
    int cc = (int8_t)s->sc[j]; if (c < 0 || (c >= t->cut && cc < 0)) continue;
    if (c < t->cut && !is_esc(c, q[j & ~1], q[j | 1])) continue;
    if (abs(v) > 31) { int w = abs(v) - 32, L = 0; while ((1ll << (L + 1)) - 1 <= w) L++; put(e, L, 5); put(e, (uint64_t)(w - ((1ll << L) - 1)) << 1 | (v < 0), L + 1); } }
}
// quantise a plane, whole; x: originals
static void encode(scratch *s, const unit *u, const cls *k, const tables *t, coded *e, const int32_t *x, int xs, int stats) {
  int ra = (u->R + 1) / 2, ca = (u->C + 1) / 2, rows[3], cols[3]; for (int p = 0; p < 3; p++) { rows[p] = rows_of(u, p); cols[p] = cols_of(u, p); }
  int32_t *Q[3], *Hs[3]; int half = u->n >> 1;
  // prediction needs rings: planes one after another, the ring refilled from Hs
  for (int p = 0; p < 3; p++) { Q[p] = calloc((size_t)rows[p] * cols[p] + 16, 4); Hs[p] = calloc((size_t)rows[p] * cols[p] + 16, 4); }
  for (int p = 0; p < 3; p++) for (int i = 0; i < rows[p] && cols[p]; i++) {
    for (int d = -1; d <= 2; d++) load_a(s, u, i + d);
    for (int q = 0; q < p; q++) for (int d = -2; d <= 1; d++) { int ii = clampi(i + d, 0, rows[q] - 1); if (rows[q] < 1 || cols[q] < 1) continue; int16_t *to = s->h[q][ii & 15] + PAD; for (int j = 0; j < cols[q]; j++) to[j] = narrow(u, Hs[q][(size_t)ii * cols[q] + j]); edge(to, cols[q]); }
    predict_row(s, u, k, p, i);
    int known = p == HL && ((i == 0 && u->line[0]) || (i == ra - 1 && u->line[1]));
    for (int j = 0; j < cols[p]; j++) {
      int r = p == HL ? 2 * i : 2 * i + 1, c = p == LH ? 2 * j : 2 * j + 1; size_t at = (size_t)i * cols[p] + j; const int32_t *l = NULL; int li = 0;
      if (known) l = u->line[i == 0 && u->line[0] ? 0 : 1], li = j; else if (p == LH && j == 0 && u->line[2]) l = u->line[2], li = i; else if (p == LH && j == ca - 1 && u->line[3]) l = u->line[3], li = i;
      if (l) { Hs[p][at] = l[li]; continue; }
      int64_t w = ((((int64_t)s->P[j] << u->s) + 2) >> 2) + u->o; int64_t q = 0;
      if (!u->mask || u->mask[(size_t)r * u->ms + c]) { int64_t d = (int64_t)x[(size_t)r * xs + c] - w; q = d >= 0 ? (d + half) / u->n : -((-d + half) / u->n); }
      int64_t h = w + q * u->n; Hs[p][at] = h < u->lo ? u->lo : h > u->hi ? u->hi : h; Q[p][at] = s->S[j] ? -q : q;
    }
  }
  for (int p = 0; p < 3; p++) for (int i = 0; i < rows[p]; i++) for (int j = 0; j < cols[p]; j++) u->out[(size_t)(p == HL ? 2 * i : 2 * i + 1) * u->os + (p == LH ? 2 * j : 2 * j + 1)] = Hs[p][(size_t)i * cols[p] + j];
  for (int i = 0; i < ra; i++) for (int j = 0; j < ca; j++) u->out[(size_t)2 * i * u->os + 2 * j] = clampi(u->par[(size_t)i * u->ps + j], u->lo, u->hi);
  // symbols
  int hl0 = u->line[0] ? 1 : 0, hl1 = u->line[1] ? ra - 1 : ra, lc0 = u->line[2] ? 1 : 0, lc1 = u->line[3] ? ca - 1 : ca, a_ready = -4, f_ready = -1; int32_t *flat = malloc(4 * (8 * 272 + 64));
  for (int b = 0; 8 * b - 1 < ra; b++) {
    for (; a_ready < ra + 3 && a_ready < 8 * b + 13; a_ready++) load_a(s, u, a_ready);
    for (; f_ready <= ra && f_ready <= 8 * b + 8; f_ready++) features(s, u, f_ready);
    for (int p = 0; p < 3; p++) {
      int i0 = 8 * b - (p == LH), i1 = i0 + 8; if (i0 < 0) i0 = 0; if (i1 > rows[p]) i1 = rows[p];
      if (p == HL) { if (i0 == 0 && hl0 && i1 > 0) { known_row(s, u, 0); i0 = 1; } if (hl1 < ra && i1 == ra && i0 < i1) { known_row(s, u, ra - 1); i1 = ra - 1; } }
      if (i0 >= i1) continue;
      int c0 = p == LH ? lc0 : 0, n = (p == LH ? lc1 : cols[p]) - c0; if (n <= 0) continue; int G = (n + 1) / 2;
      for (int i = i0; i < i1; i++) { uint8_t *pc = s->pc + (i - i0) * G, *sc = s->sc + (i - i0) * 2 * G; class_row(s, u, k, p, i, c0, n, pc, sc); if (n & 1) sc[n] = 0xFF; if (u->mask) hide(u, p, i, c0, n, pc, sc);
        for (int j = 0; j < 2 * G; j++) flat[(i - i0) * 2 * G + j] = j < n ? Q[p][(size_t)i * cols[p] + c0 + j] : 0;
        int16_t *bq = s->absq[p][i & 15] + PAD; memset(bq - 2, 0, 2 * (cols[p] + 8)); for (int j = 0; j < n; j++) { int a = abs(clampi(flat[(i - i0) * 2 * G + j], -32768, 32767)); bq[c0 + j] = a > 4095 ? 4095 : a; } }
      if (stats) { for (int g = 0; g < G * (i1 - i0); g++) { int c = (int8_t)s->pc[g]; if (c >= 0 && c < 64) { GQ[c][0]++; GQ[c][1] += abs(flat[2 * g]) > 7 || abs(flat[2 * g + 1]) > 7; } } }
      else emit(e, s, t, G * (i1 - i0), flat);
    }
  }
  free(flat); for (int p = 0; p < 3; p++) { free(Q[p]); free(Hs[p]); }
}
static void build(tables *t) {
  for (int c = 0; c < NT; c++) {
    double tot = 0; for (int s = 0; s < 256; s++) tot += CNT[c][s];
    uint32_t *sl = t->slots[c];
    if (c == 127 || c == 63 || tot == 0) { for (int y = 0; y < M; y++) sl[y] = 112u | (M - 1u) << 8 | (uint32_t)y << 20; continue; }
    int f[256], sum = 0, bs = 0;
    for (int s = 0; s < 256; s++) { f[s] = 0; if (CNT[c][s]) { f[s] = (int)(CNT[c][s] * (double)M / tot + .5); if (f[s] < 1) f[s] = 1; } sum += f[s]; if (f[s] > f[bs]) bs = s; }
    while (sum > M) { int d = 0; for (int s = 0; s < 256 && sum > M; s++) if (f[s] > 8) { int r = f[s] / 16; if (r < 1) r = 1; if (r > sum - M) r = sum - M; f[s] -= r; sum -= r; d = 1; } if (!d) for (int s = 0; s < 256 && sum > M; s++) if (f[s] > 1) { f[s]--; sum--; } }
    f[bs] += M - sum;
    for (int s = 0; s < 256; s++) for (int y = 0; y < f[s]; y++) *sl++ = (uint32_t)s | (uint32_t)(f[s] - 1) << 8 | (uint32_t)y << 20;
  }
}
typedef struct { uint8_t *bytes; size_t n, words; uint32_t st[LANES]; const uint8_t *w, *raw; } payload;
static uint32_t FS[NT][256], FC[NT][256];
static payload pack(coded *e) {
  uint16_t *buf = malloc(2 * e->n + 64); size_t nw = 0; payload p; for (int i = 0; i < LANES; i++) p.st[i] = 65536;
  for (size_t j = e->n; j-- > 0;) { sym z = e->list[j]; if (z.lane == 255) continue; uint32_t f = FS[z.t][z.s], c = FC[z.t][z.s], x = p.st[z.lane]; if ((uint64_t)x >= (uint64_t)f << (32 - LOGM)) { buf[nw++] = x; x >>= 16; } p.st[z.lane] = (x / f << LOGM) + c + x % f; }
  size_t rb = (e->bits + 7) / 8; p.bytes = calloc(2 * nw + rb + 128, 1); for (size_t j = 0; j < nw; j++) memcpy(p.bytes + 2 * j, buf + nw - 1 - j, 2); memcpy(p.bytes + 2 * nw + 32, e->raw, rb);
  p.w = p.bytes; p.raw = p.bytes + 2 * nw + 32; p.words = nw; p.n = 2 * nw + rb + 4 * LANES + 5; free(buf); return p;
}

// ------------------------------------------------ a whole file ------------------------------------------------
static void prepare(cls *k, int n, int s) {   // whole numbers of the weights, for heights >> s
  // E in 2^-14 steps = ((v1 R + v2 B) >> g) + v3 N + v0
  double most = 0; for (int p = 0; p < 3; p++) for (int f = 1; f <= 2; f++) if (k->ew[p][f] > most) most = k->ew[p][f];
  double unit = 16384.0 * (1 << s) / n; int g = 0; while (g < 20 && most * unit * (1 << (g + 1)) < 8191) g++; k->g = g;
  for (int p = 0; p < 3; p++) { k->v0[p] = (int)(k->ew[p][0] * 0.05 * 16384 + .5) + 1; k->v1[p] = (int)fmin(k->ew[p][1] * unit * (1 << g) + .5, 8191); k->v2[p] = (int)fmin(k->ew[p][2] * unit * (1 << g) + .5, 8191); k->v3[p] = (int)fmin(k->ew[p][3] * 16384 + .5, 32767); }
}
static void code_line(const int32_t *x, const uint8_t *m, const int32_t *a, int na, int nodd, int n, int lo, int hi, int32_t *out) {
  for (int i = 0; i < nodd; i++) { int64_t h[4]; for (int k = 0; k < 4; k++) { int j = fold(i + k - 1, na); h[k] = a[j > na - 1 ? na - 1 : j]; }
    int64_t least = h[0], most = h[0]; for (int k = 1; k < 4; k++) { if (h[k] < least) least = h[k]; if (h[k] > most) most = h[k]; }
    int64_t P = (9 * (h[1] + h[2]) - h[0] - h[3]) >> 2; if (P < 4 * least) P = 4 * least; if (P > 4 * most) P = 4 * most;
    int64_t w = (P + 2) >> 2, d = x[i] - w, q = 0; if (!m || m[i]) q = d >= 0 ? (d + n / 2) / n : -((-d + n / 2) / n); int64_t y = w + q * n; out[i] = y < lo ? lo : y > hi ? hi : y; }
}
typedef struct { unit u; payload pl; int level, r, c; int32_t *linebuf; } job;
int main(int ac, char **av) {
  init_luts(); FILE *f = fopen(av[1], "rb"); int hd[8]; if (fread(hd, 4, 8, f) != 8) return 1;
  int H = hd[0], W = hd[1], n = hd[2], lo = hd[3], hi = hd[4], nl = hd[5], has_mask = hd[6], runs = ac > 2 ? atoi(av[2]) : 5; static cls K0[4];
  for (int k = 0; k < 4; k++) { if (fread(K0[k].w, 2, 72, f) != 72) return 1; if (fread(K0[k].ew, 8, 12, f) != 12) return 1; }
  int32_t *z = malloc(4 * (size_t)H * W); uint8_t *valid = malloc((size_t)H * W); if (fread(z, 4, (size_t)H * W, f) != (size_t)H * W || fread(valid, 1, (size_t)H * W, f) != (size_t)H * W) return 1; fclose(f);
  tables *t = aligned_alloc(64, (sizeof *t + 63) / 64 * 64); memset(t, 0, sizeof *t);
  for (int a = -7; a <= 7; a++) for (int b = -7; b <= 7; b++) t->vals[PS(a, b)] = (uint8_t)a | (uint8_t)b << 8; t->vals[225] = 0x8080; for (int a = -31; a <= 31; a++) t->vals[256 + a + 31] = (uint8_t)a; t->vals[256 + 63] = 0x80; t->vals[256 + 112] = 0;
  scratch *s = aligned_alloc(64, (sizeof *s + 63) / 64 * 64); memset(s, 0, sizeof *s);
  // levels: x[l], m[l], rec[l]
  int32_t **X = calloc(nl, sizeof *X), **rec = calloc(nl, sizeof *rec); uint8_t **Ms = calloc(nl, sizeof *Ms); int *hh = calloc(nl, 4), *ww = calloc(nl, 4);
  for (int l = 0; l < nl; l++) { int st = 1 << l, h = (H - 1) / st + 1, w = (W - 1) / st + 1; hh[l] = h; ww[l] = w; X[l] = malloc(4 * (size_t)h * (w + 64) + 4096); Ms[l] = calloc((size_t)h * w + 64, 1); rec[l] = calloc((size_t)h * (w + 64) + 4096, 4);
    for (int r = 0; r < h; r++) for (int c = 0; c < w; c++) { X[l][(size_t)r * w + c] = z[(size_t)r * st * W + (size_t)c * st]; Ms[l][(size_t)r * w + c] = valid[(size_t)r * st * W + (size_t)c * st]; } }
  job *jobs = NULL; int nj = 0; size_t lines_bits = 0;
  for (int pass = 0; pass < 3; pass++) {
    if (pass == 1) { t->cut = C0; for (int c = C0 - 1; c >= 0; c--) if (GQ[c][0] > 50 && GQ[c][1] > 0.03 * GQ[c][0]) t->cut = c; }
    if (pass == 2) { for (int c = 0; c < 64; c++) { double tot = 0; for (int y = 0; y < 256; y++) tot += CNT[c][y]; for (int y = 0; y < 225; y++) RARE[c][y] = CNT[c][y] * (double)M < 0.45 * tot; } memset(CNT, 0, sizeof CNT); }
    nj = 0; int top = nl - 1;
    for (size_t i = 0; i < (size_t)hh[top] * ww[top]; i++) { size_t at = i / ww[top] * (ww[top] + 64) + i % ww[top]; int q = lo + (X[top][i] - lo + n / 2) / n * n; rec[top][at] = Ms[top][i] ? clampi(q, lo, hi) : (lo + hi) >> 1; }
    coded *all = NULL; int nall = 0;
    for (int l = top - 1; l >= 0; l--) {
      int h = hh[l], w = ww[l], step = (h > w ? h : w) <= 257 ? 1 << 30 : 512;
      for (int r = 0; r < (h - 1 > 1 ? h - 1 : 1); r += step) for (int c = 0; c < (w - 1 > 1 ? w - 1 : 1); c += step) {
        jobs = realloc(jobs, sizeof(job) * (nj + 1)); job *j = &jobs[nj++]; memset(j, 0, sizeof *j); unit *u = &j->u; j->level = l; j->r = r; j->c = c;
        u->R = (h - r < 513 ? h - r : 513); u->C = (w - c < 513 ? w - c : 513); u->par = rec[l + 1] + (size_t)(r / 2) * (ww[l + 1] + 64) + c / 2; u->ps = ww[l + 1] + 64; u->ms = w; u->n = n; u->os = w + 64; u->out = rec[l] + (size_t)r * (w + 64) + c;
        int any = 0, all_ok = 1; for (int a = 0; a < u->R; a++) for (int b = 0; b < u->C; b++) { int v = Ms[l][(size_t)(r + a) * w + c + b]; any |= v; all_ok &= v; }
        u->mask = all_ok ? NULL : Ms[l] + (size_t)r * w + c;
        // origin, width
        int32_t a = 1 << 30, b = -(1 << 30), la = 1 << 30, lb = -(1 << 30); for (int i = 0; i < (u->R + 1) / 2; i++) for (int k = 0; k < (u->C + 1) / 2; k++) { int32_t y = u->par[(size_t)i * u->ps + k]; if (y < a) a = y; if (y > b) b = y; }
        for (int i = 0; i < u->R; i++) for (int k = 0; k < u->C; k++) if (Ms[l][(size_t)(r + i) * w + c + k]) { int32_t y = X[l][(size_t)(r + i) * w + c + k]; if (y < la) la = y; if (y > lb) lb = y; }
        u->o = (a + b) >> 1; if (la > a) la = a; if (lb < b) lb = b;
        if (la - n >= u->o - LIM && lb + n <= u->o + LIM && n <= LIM) { u->wide = 0; u->s = 0; u->lo = lo > u->o - LIM ? lo : u->o - LIM; u->hi = hi < u->o + LIM ? hi : u->o + LIM; }
        else { u->wide = 1; u->lo = lo; u->hi = hi; int need = lb - u->o > u->o - la ? lb - u->o : u->o - la; u->s = 0; while (need >> u->s > LIM) u->s++; }
        // shared lines
        j->linebuf = calloc(4 * 260, 4); static int32_t ev[600], od[600]; static uint8_t om[600];
        for (int side = 0; side < 4; side++) {
          int shared = side == 0 ? r > 0 : side == 1 ? r + 512 < h - 1 && u->R == 513 : side == 2 ? c > 0 : c + 512 < w - 1 && u->C == 513; if (!shared) continue;
          int len = side < 2 ? u->C : u->R, at = side == 0 || side == 2 ? 0 : 512; int na = (len + 1) / 2, no = len / 2;
          for (int i = 0; i < na; i++) ev[i] = side < 2 ? u->par[(size_t)(at / 2) * u->ps + i] : u->par[(size_t)i * u->ps + at / 2];
          for (int i = 0; i < no; i++) { size_t p = side < 2 ? (size_t)(r + at) * w + c + 2 * i + 1 : (size_t)(r + 2 * i + 1) * w + c + at; od[i] = X[l][p]; om[i] = Ms[l][p]; }
          code_line(od, om, ev, na, no, n, lo, hi, j->linebuf + 260 * side); u->line[side] = j->linebuf + 260 * side; lines_bits += pass == 2 ? no : 0;
        }
        cls k = K0[l < 3 ? l : 3]; prepare(&k, n, u->s);
        all = realloc(all, sizeof(coded) * (nall + 1)); coded *e = &all[nall++]; *e = (coded){malloc(sizeof(sym) * 1024), 0, 1024, calloc(1024, 1), 0, 1024};
        if (any) encode(s, u, &k, t, e, X[l] + (size_t)r * w + c, w, pass == 0); else { for (int i = 0; i < u->R; i++) for (int q = 0; q < u->C; q++) u->out[(size_t)i * u->os + q] = 0; }
      }
    }
    if (pass == 2) { build(t); for (int c = 0; c < NT; c++) for (int y = 0; y < M; y++) { uint32_t e = t->slots[c][y]; FS[c][e & 255] = (e >> 8 & 4095) + 1; if (e >> 20 == 0) FC[c][e & 255] = y; } for (int i = 0; i < nj; i++) jobs[i].pl = pack(&all[i]); double nlook = 0; size_t rb = 0; for (int i = 0; i < nall; i++) { nlook += all[i].n; rb += all[i].bits; } printf("lookups/sample %.3f raw bits/sample %.3f ", nlook / ((double)H * W), rb / ((double)H * W)); }
    for (int i = 0; i < nall; i++) { free(all[i].list); free(all[i].raw); } free(all);
  }
  size_t bytes = 0, nsym = 0; int nwide = 0, most = 0; for (int i = 0; i < nj; i++) { bytes += jobs[i].pl.n; nwide += jobs[i].u.wide; if (jobs[i].u.s > most) most = jobs[i].u.s; } for (int c = 0; c < NT - 1; c++) for (int y = 0; y < 256; y++) nsym += CNT[c][y] > 0;
  double N = (double)H * W; printf("%s n=%d units %d wide %d s<=%d cut %d: %.4f bits/sample (tables at 3 bits %.4f)\n", av[1], n, nj, nwide, most, t->cut, 8 * bytes / N + nsym * 3 / N, nsym * 3 / N);
  int worst = 0; for (size_t i = 0; i < (size_t)H * W; i++) if (valid[i]) { int d = abs(rec[0][i / W * (W + 64) + i % W] - z[i]); if (d > worst) worst = d; }
  int32_t *want = malloc(4 * (size_t)H * (W + 64)); memcpy(want, rec[0], 4 * (size_t)H * (W + 64));
  double best = 1e9, tot[99]; int bad = 0;
  for (int run = 0; run < runs; run++) {
    for (int l = 0; l < nl - 1; l++) memset(rec[l], 0x55, 4 * (size_t)hh[l] * (ww[l] + 64));
    double t0 = cpu();
    for (int i = 0; i < nj; i++) { job *j = &jobs[i]; cls k = K0[j->level < 3 ? j->level : 3]; prepare(&k, n, j->u.s); stream r = {j->pl.w, j->pl.raw, 0, {0}}; memcpy(r.st, j->pl.st, sizeof r.st);
      if (j->pl.n == 4 * LANES + 5 && j->u.mask) { int empty = j->pl.words == 0; if (empty) { int any = 0; for (int a = 0; a < j->u.R && !any; a++) any = memchr(j->u.mask + (size_t)a * j->u.ms, 1, j->u.C) != NULL; if (!any) { for (int a = 0; a < j->u.R; a++) memset(j->u.out + (size_t)a * j->u.os, 0, 4 * j->u.C); continue; } } }
      decode(s, &j->u, &k, t, &r);
      if (run == 0) { int ok = r.words == j->pl.w + 2 * j->pl.words; for (int q = 0; q < LANES; q++) ok &= r.st[q] == 65536; if (!ok) { bad++; if (bad < 5) printf("unit %d level %d (%d,%d) %dx%d: stream ends wrong: words %ld of %ld\n", i, j->level, j->r, j->c, j->u.R, j->u.C, (long)(r.words - j->pl.w) / 2, (long)j->pl.words); } } }
    tot[run] = cpu() - t0; if (tot[run] < best) best = tot[run];
  }
  size_t diff = 0; for (size_t i = 0; i < (size_t)H * W; i++) if (valid[i]) diff += rec[0][i / W * (W + 64) + i % W] != want[i / W * (W + 64) + i % W];
  for (int a = 0; a < runs; a++) for (int b = a + 1; b < runs; b++) if (tot[b] < tot[a]) { double x = tot[a]; tot[a] = tot[b]; tot[b] = x; }
  printf("  worst error %d (half %d) differing %zu bad units %d; decode min %.2f median %.2f ns/sample\n", worst, n / 2, diff, bad, 1e9 * best / N, 1e9 * tot[runs / 2] / N);
  return diff || bad || worst > n / 2;
}
