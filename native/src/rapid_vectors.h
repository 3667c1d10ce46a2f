/* Eight states of method rapid at once, of one unit or several in turns, and other loops: included by rapid_unit.h where there is AVX2. */

/* Where a stream is: its states, the first sample's first, the words taken, and which samples have raw bits. */
typedef struct ISA(lanes) {
  __m256i x, raw;
  const uint8_t *words, *at;
} ISA(lanes);

/*
 * Symbols of eight samples (R.8): symbol number k is of state k mod 8. Lanes from the first sample's state on;
 * of the last samples less than eight are active.
 */
static ALWAYS_INLINE void ISA(step)(ISA(lanes) * l, const ISA(span) * s, int32_t j, int is_full, __m256i active,
                                    const uint32_t *slots) {
  const __m256i x = l->x;
  __m256i c = is_full ? _mm256_loadu_si256((const __m256i *)(s->contexts + j)) : _mm256_maskload_epi32(s->contexts + j, active);
  c = _mm256_and_si256(c, _mm256_set1_epi32(DOWN - 1));
  __m256i slot = _mm256_or_si256(_mm256_slli_epi32(c, 11), _mm256_and_si256(x, _mm256_set1_epi32(SLOTS - 1)));
  __m256i entry = _mm256_i32gather_epi32((const int *)slots, slot, 4);
  __m256i symbol = _mm256_and_si256(entry, _mm256_set1_epi32(63));
  __m256i frequency = _mm256_and_si256(_mm256_srli_epi32(entry, 6), _mm256_set1_epi32(4095));
  __m256i next = _mm256_add_epi32(_mm256_mullo_epi32(frequency, _mm256_srli_epi32(x, 11)), _mm256_srli_epi32(entry, 18));
  __m256i detail = _mm256_sub_epi32(symbol, _mm256_set1_epi32(ZERO_SYMBOL));
  __m256i raw = _mm256_or_si256(_mm256_cmpgt_epi32(c, _mm256_set1_epi32(FIRST_RAW - 1)),
                                _mm256_cmpeq_epi32(symbol, _mm256_setzero_si256()));
  if (is_full) {
    _mm256_storeu_si256((__m256i *)(s->details + j), detail);
  } else {
    _mm256_maskstore_epi32(s->details + j, active, detail);
    raw = _mm256_and_si256(raw, active);
  }
  l->raw = _mm256_or_si256(l->raw, raw);
  __m128i words = _mm_loadu_si128((const __m128i *)l->at);
#if defined(__AVX512VBMI2__) && defined(__AVX512VL__)
  __mmask8 takes = _mm256_cmplt_epu32_mask(next, _mm256_set1_epi32(65536));
  if (!is_full) takes &= _mm256_movepi32_mask(active);
  __m256i word = _mm256_cvtepu16_epi32(_mm_maskz_expand_epi16(takes, words));
  next = _mm256_mask_or_epi32(next, takes, _mm256_slli_epi32(next, 16), word);
  unsigned mask = takes;
#else
  __m256i takes = _mm256_cmpeq_epi32(_mm256_srli_epi32(next, 16), _mm256_setzero_si256());
  if (!is_full) takes = _mm256_and_si256(takes, active);
  unsigned mask = (unsigned)_mm256_movemask_ps(_mm256_castsi256_ps(takes));
  __m256i order = _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)s->streams->expand[mask]));
  __m256i word = _mm256_permutevar8x32_epi32(_mm256_cvtepu16_epi32(words), order);
  next = _mm256_blendv_epi8(next, _mm256_or_si256(_mm256_slli_epi32(next, 16), word), takes);
#endif
  l->at += 2 * (unsigned)_mm_popcnt_u32(mask);
  l->x = is_full ? next : _mm256_blendv_epi8(x, next, active);
}

static ALWAYS_INLINE __m256i ISA(rotated)(const rapid_streams *z, int sign) {
  const __m256i lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
  int rotation = sign * (int)(z->n_symbols & 7);
  return _mm256_and_si256(_mm256_add_epi32(lanes, _mm256_set1_epi32(rotation)), _mm256_set1_epi32(7));
}

static ALWAYS_INLINE void ISA(begin_lanes)(ISA(lanes) * l, const rapid_streams *z) {
  l->x = _mm256_permutevar8x32_epi32(_mm256_loadu_si256((const __m256i *)z->states), ISA(rotated)(z, 1));
  l->raw = _mm256_setzero_si256();
  l->words = l->at = z->words + 2 * min_size(z->n_words_used, z->n_words); /* a row takes a word a sample: PAYLOAD_SLACK */
}

/* Samples of n spans in turns, from number j on, until the last one, which is the shortest, is read. */
static ALWAYS_INLINE int32_t ISA(read_in_turns)(ISA(lanes) * l, ISA(span) *const *spans, int n, int32_t j,
                                                const uint32_t *slots) {
  const __m256i lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), all = _mm256_set1_epi32(-1);
  ISA(span) *s = spans[n - 1];
  for (; j + 8 <= s->n; j += 8) {
    for (int k = 0; k < n; k++) ISA(step)(&l[k], spans[k], j, 1, all, slots);
  }
  ISA(lanes) *own = &l[n - 1];
  if (j < s->n) ISA(step)(own, s, j, 0, _mm256_cmpgt_epi32(_mm256_set1_epi32(s->n - j), lanes), slots);
  rapid_streams *z = s->streams;
  _mm256_storeu_si256((__m256i *)z->states, _mm256_permutevar8x32_epi32(own->x, ISA(rotated)(z, -1)));
  s->has_raw = !_mm256_testz_si256(own->raw, own->raw);
  z->n_words_used += (size_t)(own->at - own->words) / 2;
  z->n_symbols += (size_t)s->n;
  return j;
}

/* R.9, as read_raw: eight details at once, unless one is an escape. */
static void ISA(read_raw_vectors)(const int32_t *contexts, int32_t *details, int32_t n, int64_t most, rapid_streams *z) {
  const __m256i none = _mm256_setzero_si256(), high = _mm256_set1_epi32((int)most), low = _mm256_sub_epi32(none, high);
  int32_t j = 0;
  for (; j + 8 <= n; j += 8) {
    __m256i detail = _mm256_loadu_si256((const __m256i *)(details + j));
    __m256i escapes = _mm256_cmpeq_epi32(detail, _mm256_set1_epi32(-ZERO_SYMBOL));
    if (!_mm256_testz_si256(escapes, escapes)) {
      ISA(read_raw)(contexts + j, details + j, 8, most, z);
      continue;
    }
    __m256i context = _mm256_and_si256(_mm256_loadu_si256((const __m256i *)(contexts + j)), _mm256_set1_epi32(DOWN - 1));
    __m256i n_bits = _mm256_max_epi32(_mm256_sub_epi32(_mm256_srli_epi32(context, 3), _mm256_set1_epi32(8)), none);
    if (_mm256_testz_si256(n_bits, n_bits)) continue;
    /* Sums of numbers of bits, up to and with each lane; at most 13 bits a lane. */
    __m256i sums = _mm256_add_epi32(n_bits, _mm256_slli_si256(n_bits, 4));
    sums = _mm256_add_epi32(sums, _mm256_slli_si256(sums, 8));
    __m256i half = _mm256_shuffle_epi32(_mm256_permute2x128_si256(sums, sums, 8), 255);
    sums = _mm256_add_epi32(sums, half);
    __m256i from = _mm256_add_epi32(_mm256_sub_epi32(sums, n_bits), _mm256_set1_epi32((int)(z->n_bits & 7)));
    const uint8_t *at = z->raw + min_size(z->n_bits >> 3, z->n_raw); /* PAYLOAD_SLACK is behind it */
    __m256i held = _mm256_i32gather_epi32((const int *)(const void *)at, _mm256_srli_epi32(from, 3), 1);
    held = _mm256_srlv_epi32(held, _mm256_and_si256(from, _mm256_set1_epi32(7)));
    __m256i above = _mm256_sllv_epi32(_mm256_set1_epi32(-1), n_bits);
    __m256i whole = _mm256_or_si256(_mm256_sllv_epi32(detail, n_bits), _mm256_andnot_si256(above, held));
    whole = _mm256_max_epi32(_mm256_min_epi32(whole, high), low);
    detail = _mm256_blendv_epi8(whole, detail, _mm256_cmpeq_epi32(n_bits, none));
    _mm256_storeu_si256((__m256i *)(details + j), detail);
    z->n_bits += (size_t)_mm256_extract_epi32(sums, 7);
  }
  ISA(read_raw)(contexts + j, details + j, n - j, most, z);
}

#if defined(__AVX512F__)
#define VECTOR __m512i
#define V(name) _mm512_##name
#define LOAD(at) _mm512_loadu_si512(at)
#define STORE(at, v) _mm512_storeu_si512(at, v)
#define JOIN(low, high) _mm512_mask_blend_epi16(0xAAAAAAAAu, low, _mm512_slli_epi32(high, 16))
#else
#define VECTOR __m256i
#define V(name) _mm256_##name
#define LOAD(at) _mm256_loadu_si256((const __m256i *)(at))
#define STORE(at, v) _mm256_storeu_si256((__m256i *)(at), v)
#define JOIN(low, high) _mm256_blend_epi16(low, _mm256_slli_epi32(high, 16), 0xAA)
#endif
#if defined(__AVX512VNNI__)
#define ADD_PRODUCTS(sum, a, b) _mm512_dpwssd_epi32(sum, a, b)
#else
#define ADD_PRODUCTS(sum, a, b) V(add_epi32)(sum, V(madd_epi16)(a, b))
#endif

/* A whole vector is written: rows end with room for one. */
static ALWAYS_INLINE void ISA(predict_taps)(int32_t n, const ISA(pair_of_taps) * taps, int n_taps, int32_t *predicted) {
  enum { LANES = sizeof(VECTOR) / 4 };
  VECTOR weights[14];
  for (int k = 0; k < n_taps; k++) {
    weights[k] = V(set1_epi32)((int)(((uint32_t)(uint16_t)taps[k].first) | (uint32_t)(uint16_t)taps[k].second << 16));
  }
  for (int32_t j = 0; j < n; j += LANES) {
    VECTOR sum = V(set1_epi32)(32), other = V(set1_epi32)(0);
    for (int k = 0; k < n_taps; k += 2) {
      sum = ADD_PRODUCTS(sum, LOAD(taps[k].at + j), weights[k]);
      other = ADD_PRODUCTS(other, LOAD(taps[k + 1].at + j), weights[k + 1]);
    }
    STORE(predicted + j, V(srai_epi32)(V(add_epi32)(sum, other), 6));
  }
}

/* The lower halves of n cells of two rows, in turns. */
static ALWAYS_INLINE void ISA(store_in_turns)(int16_t *to, const int32_t *even, const int32_t *odd, int32_t n) {
  enum { LANES = sizeof(VECTOR) / 4 };
  int32_t j = 0;
  for (; j + LANES <= n; j += LANES) STORE(to + 2 * j, JOIN(LOAD(even + j), LOAD(odd + j)));
  for (; j < n; j++) {
    to[2 * j] = (int16_t)even[j];
    to[2 * j + 1] = (int16_t)odd[j];
  }
}
#undef VECTOR
#undef V
#undef LOAD
#undef STORE
#undef JOIN
#undef ADD_PRODUCTS

/* Contexts of valid samples among n, one behind the other, and their details back; a vector more is written. */
#define READ_RAW ISA(read_raw_vectors)
#if defined(__AVX512F__)
static ALWAYS_INLINE __mmask16 ISA(valid_lanes)(const uint8_t *valid, size_t step) {
  if (step == 1) {
    __m128i bytes = _mm_loadu_si128((const __m128i *)valid);
    return _mm_test_epi8_mask(bytes, bytes);
  }
  __m256i bytes = _mm256_loadu_si256((const __m256i *)valid);
  return (__mmask16)_pext_u32(_mm256_test_epi8_mask(bytes, bytes), 0x55555555u);
}

static int32_t ISA(pack)(const int32_t *contexts, const uint8_t *valid, size_t step, int32_t n, int32_t *packed) {
  int32_t j = 0, n_packed = 0;
  for (; step <= 2 && j + 16 < n; j += 16) { /* what is read is followed by a sample */
    __mmask16 lanes = ISA(valid_lanes)(valid + (size_t)j * step, step);
    _mm512_storeu_si512(packed + n_packed, _mm512_maskz_compress_epi32(lanes, _mm512_loadu_si512(contexts + j)));
    n_packed += (int32_t)_mm_popcnt_u32(lanes);
  }
  return n_packed + ISA(pack_plain)(contexts + j, valid + (size_t)j * step, step, n - j, packed + n_packed);
}

static void ISA(unpack)(const int32_t *packed, const uint8_t *valid, size_t step, int32_t n, int32_t *details) {
  int32_t j = 0;
  for (; step <= 2 && j + 16 < n; j += 16) {
    __mmask16 lanes = ISA(valid_lanes)(valid + (size_t)j * step, step);
    _mm512_storeu_si512(details + j, _mm512_maskz_expand_epi32(lanes, _mm512_loadu_si512(packed)));
    packed += _mm_popcnt_u32(lanes);
  }
  ISA(unpack_plain)(packed, valid + (size_t)j * step, step, n - j, details + j);
}
#define PACK ISA(pack)
#define UNPACK ISA(unpack)
#else
#define PACK ISA(pack_plain)
#define UNPACK ISA(unpack_plain)
#endif
