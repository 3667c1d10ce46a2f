/* Strict JSON (FORMAT §4.2): keys once, finite numbers, whole characters, nesting of at most 16. */
#include <math.h>
#include <stdlib.h>

#include "internal.h"

enum { DEEPEST = 16, PAGE_BYTES = 4096 };

typedef struct json_page {
  struct json_page *next;
  size_t used, size;
} json_page;

typedef struct parser {
  json_document *document;
  const char *text;
  size_t n, at;
  twz_error *error;
} parser;

/* Memory that json_free releases as a whole; NULL: none. */
static void *keep(json_document *d, size_t n) {
  n = (n + 15) / 16 * 16;
  json_page *page = d->pages;
  if (!page || n > page->size - page->used) {
    size_t size = n > PAGE_BYTES ? n : PAGE_BYTES;
    size_t head = (sizeof(json_page) + 15) / 16 * 16;
    page = twz_allocate(d->allocator, head + size);
    if (!page) return NULL;
    page->next = d->pages;
    page->size = head + size;
    page->used = head;
    d->pages = page;
  }
  void *kept = (char *)page + page->used;
  page->used += n;
  return kept;
}

void json_free(json_document *d) {
  while (d->pages) {
    json_page *page = d->pages;
    d->pages = page->next;
    twz_release(d->allocator, page);
  }
  d->root = NULL;
}

const json_value *json_member(const json_value *object, const char *key) {
  for (const json_value *m = object->first; m; m = m->next) {
    if (strcmp(m->key, key) == 0) return m->kind == JSON_NULL ? NULL : m;
  }
  return NULL;
}

#define BAD(p, what) \
  twz_fail((p)->error, TWZ_CORRUPT, "metadata, byte %llu: %s", (unsigned long long)(p)->at, what)

static int peek(parser *p) {
  while (p->at < p->n && strchr(" \t\n\r", p->text[p->at]) && p->text[p->at]) p->at++;
  return p->at < p->n ? (unsigned char)p->text[p->at] : -1;
}

/* ---- Numbers ---- */

/* 0.d1 d2 d3 ... * 10^point. Of a number of MOST_DIGITS digits, halving it makes no more than DECIMAL: one for each bit. */
enum { MOST_DIGITS = 800, DECIMAL = 2048, MOST_SHIFT = 56, ROOM = 20 };
typedef struct decimal {
  uint8_t digit[DECIMAL];
  int n, point;
} decimal;

/* Multiply what is not 0 by 2^shift, |shift| <= MOST_SHIFT. */
static void decimal_shift(decimal *d, int shift) {
  uint8_t result[ROOM + DECIMAL]; /* room for digits in front */
  int first = ROOM, end = ROOM;
  if (shift >= 0) {
    uint64_t carry = 0;
    end += d->n;
    for (int i = d->n - 1; i >= 0 || carry; i--, carry /= 10) {
      if (i >= 0) carry += (uint64_t)d->digit[i] << shift;
      first = ROOM + i;
      result[first] = (uint8_t)(carry % 10);
    }
  } else {
    uint64_t rest = 0;
    for (int i = 0; end < ROOM + DECIMAL && (i < d->n || rest); i++) {
      rest = rest * 10 + (i < d->n ? d->digit[i] : 0);
      result[end++] = (uint8_t)(rest >> -shift);
      rest &= ((uint64_t)1 << -shift) - 1;
    }
  }
  while (first < end && result[first] == 0) first++;
  while (end > first && result[end - 1] == 0) end--;
  d->n = end - first;
  d->point += ROOM - first;
  memcpy(d->digit, result + first, (size_t)d->n);
}

/* The double nearest to a number, which is changed; ties to even; infinite where it is too large. No strtod: it reads
 * the point of the locale. */
static double nearest_double(decimal *d) {
  if (d->n == 0 || d->point < -330) return 0;
  if (d->point > 310) return HUGE_VAL;
  int exponent = 0; /* to 1/2 <= d < 1, times 2^exponent; a digit is more than 3 bits */
  while (d->point != 0 || d->digit[0] < 5) {
    int shift = d->point > 0 ? -max_i32(3 * (d->point - 1), 1) : max_i32(-3 * d->point, 1);
    shift = max_i32(min_i32(shift, MOST_SHIFT), -MOST_SHIFT);
    decimal_shift(d, shift);
    exponent -= shift;
  }
  int n_bits = min_i32(53, 53 + 1021 + exponent); /* fewer below 2^-1022 */
  if (n_bits < 0) return 0;
  decimal_shift(d, n_bits);
  uint64_t whole = 0;
  for (int i = 0; i < d->point; i++) whole = whole * 10 + (i < d->n ? d->digit[i] : 0);
  int next = d->point < d->n ? d->digit[d->point] : 0;
  if (next > 5 || (next == 5 && (d->n > d->point + 1 || whole % 2))) whole++;
  return ldexp((double)whole, exponent - n_bits);
}

static int is_digit(const parser *p) {
  return p->at < p->n && p->text[p->at] >= '0' && p->text[p->at] <= '9';
}

/* The digits of a number of JSON; its sign is left out. */
static void read_decimal(const char *text, size_t n, decimal *d) {
  int64_t point = 0; /* d's, which exponents may take anywhere */
  int is_cut = 0, is_fraction = 0;
  size_t at = text[0] == '-';
  d->n = 0;
  for (; at < n && text[at] != 'e' && text[at] != 'E'; at++) {
    if (text[at] == '.') {
      is_fraction = 1;
    } else if (d->n == 0 && text[at] == '0') { /* a leading 0 */
      point -= is_fraction;
    } else {
      point += !is_fraction;
      if (d->n < MOST_DIGITS) {
        d->digit[d->n++] = (uint8_t)(text[at] - '0');
      } else {
        is_cut |= text[at] != '0';
      }
    }
  }
  int is_down = at + 1 < n && text[at + 1] == '-';
  int64_t exponent = 0;
  for (at += 1; at < n; at++) {
    if (text[at] >= '0' && exponent < 10000000) exponent = exponent * 10 + (text[at] - '0');
  }
  if (is_cut) d->digit[d->n++] = 1; /* more than nothing */
  while (d->n > 0 && d->digit[d->n - 1] == 0) d->n--;
  d->point = (int)clamp_i64(point + (is_down ? -exponent : exponent), -1000, 1000);
}

/* Is a number at least the one of these digits, the last of which is not 0? */
static int reaches(const decimal *d, const char *digits, int point) {
  int n = (int)strlen(digits);
  if (d->n == 0 || d->point != point) return d->n > 0 && d->point > point;
  for (int i = 0; i < min_i32(d->n, n); i++) {
    if (d->digit[i] != digits[i] - '0') return d->digit[i] > digits[i] - '0';
  }
  return d->n >= n;
}

double json_number(const json_value *value) {
  decimal d;
  read_decimal(value->number, value->n_number, &d);
  double x = nearest_double(&d);
  return value->number[0] == '-' ? -x : x;
}

/* Check a number, whose value few ask for: to find it takes time. */
static twz_status read_number(parser *p, json_value *value) {
  static const char BEYOND_U64[] = "18446744073709551617", /* and from here on numbers become infinite: */
      INFINITE[] =
      "17976931348623158079372897140530341507993413271003782693617377898044496829276475094664901797758720709633028641"
      "66928879109465555478519404026306574886715058206819089020007083836762738548458177115317644757302700698555713669"
      "59622842914819860834936475292719074168444365510704342711559699508093042880177904174497792";
  size_t start = p->at;
  int is_integer = 1;
  p->at += p->text[p->at] == '-';
  if (!is_digit(p)) return BAD(p, "a number has no digit");
  int starts_with_0 = p->text[p->at] == '0';
  p->at++;
  if (starts_with_0 && is_digit(p)) return BAD(p, "a number begins with 0");
  while (is_digit(p)) p->at++;
  if (p->at < p->n && p->text[p->at] == '.') {
    is_integer = 0;
    p->at++;
    if (!is_digit(p)) return BAD(p, "no digit after a point");
    while (is_digit(p)) p->at++;
  }
  if (p->at < p->n && (p->text[p->at] == 'e' || p->text[p->at] == 'E')) {
    is_integer = 0;
    p->at++;
    p->at += p->at < p->n && (p->text[p->at] == '-' || p->text[p->at] == '+');
    if (!is_digit(p)) return BAD(p, "an exponent has no digit");
    while (is_digit(p)) p->at++;
  }
  value->kind = JSON_NUMBER;
  value->number = p->text + start;
  value->n_number = p->at - start;
  decimal d;
  read_decimal(value->number, value->n_number, &d);
  value->is_beyond_u64 = is_integer && reaches(&d, BEYOND_U64, 20);
  if (reaches(&d, INFINITE, 309)) return BAD(p, "a number without finite binary64 value");
  return TWZ_OK;
}

/* ---- Strings ---- */

static int hex4(const parser *p, size_t at, uint32_t *code) {
  static const char DIGITS[] = "0123456789abcdefABCDEF";
  *code = 0;
  if (p->n - at < 4) return 0;
  for (size_t i = at; i < at + 4; i++) {
    const char *found = p->text[i] ? strchr(DIGITS, p->text[i]) : NULL;
    if (!found) return 0;
    uint32_t digit = (uint32_t)(found - DIGITS);
    *code = *code * 16 + (digit < 16 ? digit : digit - 6);
  }
  return 1;
}

static char *put_utf8(char *to, uint32_t code) {
  static const uint8_t FIRST[4] = {0, 0xC0, 0xE0, 0xF0}; /* by bytes that follow */
  int n_more = (code >= 0x80) + (code >= 0x800) + (code >= 0x10000);
  *to++ = (char)(FIRST[n_more] | code >> (6 * n_more));
  while (n_more-- > 0) *to++ = (char)(0x80 | (code >> (6 * n_more) & 63));
  return to;
}

/* Decode a string; *length is without the NUL behind it. */
static twz_status read_string(parser *p, const char **string, size_t *length) {
  if (peek(p) != '"') return BAD(p, "no string");
  size_t first = ++p->at, stop = first;
  while (stop < p->n && p->text[stop] != '"') stop += p->text[stop] == '\\' ? 2 : 1;
  if (stop >= p->n) return BAD(p, "a string without end");
  char *start = keep(p->document, stop - first + 1); /* escapes are longer than what they stand for */
  if (!start) return twz_no_memory(p->error, stop - first + 1);
  char *to = start;
  while (p->at < stop) {
    char c = p->text[p->at++];
    if ((unsigned char)c < 0x20) return BAD(p, "a control character in a string");
    if (c != '\\') {
      *to++ = c;
      continue;
    }
    c = p->text[p->at++];
    static const char NAMES[] = "\"\\/bfnrt", VALUES[] = "\"\\/\b\f\n\r\t";
    const char *found = c ? strchr(NAMES, c) : NULL;
    if (found) {
      *to++ = VALUES[found - NAMES];
      continue;
    }
    uint32_t code, low;
    if (c != 'u' || !hex4(p, p->at, &code)) return BAD(p, "an escape that JSON does not have");
    p->at += 4;
    if (code >= 0xD800 && code < 0xE000) {
      int is_pair = code < 0xDC00 && p->n - p->at >= 6 && p->text[p->at] == '\\' &&
                    p->text[p->at + 1] == 'u' && hex4(p, p->at + 2, &low) && low >= 0xDC00 && low < 0xE000;
      if (!is_pair) return BAD(p, "a lone surrogate");
      p->at += 6;
      code = 0x10000 + ((code - 0xD800) << 10) + (low - 0xDC00);
    }
    to = put_utf8(to, code);
  }
  *to = 0;
  p->at = stop + 1;
  *string = start;
  *length = (size_t)(to - start);
  return TWZ_OK;
}

/* ---- Values ---- */

static twz_status read_value(parser *p, int depth, json_value **found);

static twz_status read_members(parser *p, int depth, json_value *parent) {
  char close = parent->kind == JSON_OBJECT ? '}' : ']';
  if (depth > DEEPEST) return BAD(p, "brackets nested deeper than 16");
  p->at++;
  if (peek(p) == close) {
    p->at++;
    return TWZ_OK;
  }
  json_value **next = &parent->first;
  for (;;) {
    const char *key = NULL;
    size_t length = 0;
    if (parent->kind == JSON_OBJECT) {
      TRY(read_string(p, &key, &length));
      if (peek(p) != ':') return BAD(p, "no colon after a key");
      p->at++;
    }
    TRY(read_value(p, depth, next));
    (*next)->key = key;
    (*next)->key_length = length;
    next = &(*next)->next;
    int c = peek(p);
    p->at++;
    if (c == close) return TWZ_OK;
    if (c != ',') return BAD(p, "no comma between values");
  }
}

static twz_status read_value(parser *p, int depth, json_value **found) {
  json_value *value = keep(p->document, sizeof *value);
  if (!value) return twz_no_memory(p->error, sizeof *value);
  memset(value, 0, sizeof *value);
  *found = value;
  int c = peek(p);
  if (c == '{' || c == '[') {
    value->kind = c == '{' ? JSON_OBJECT : JSON_ARRAY;
    return read_members(p, depth + 1, value);
  }
  if (c == '"') {
    value->kind = JSON_STRING;
    return read_string(p, &value->string, &value->n_string);
  }
  if (c == '-' || (c >= '0' && c <= '9')) return read_number(p, value);
  static const char *const WORDS[] = {"null", "true", "false"};
  for (int i = 0; i < 3; i++) {
    size_t n = strlen(WORDS[i]);
    if (p->n - p->at >= n && memcmp(p->text + p->at, WORDS[i], n) == 0) {
      p->at += n;
      value->kind = i ? JSON_BOOL : JSON_NULL;
      return TWZ_OK;
    }
  }
  return BAD(p, "no value");
}

static int compare_keys(const void *a, const void *b) {
  const json_value *x = *(const json_value *const *)a, *y = *(const json_value *const *)b;
  if (x->key_length != y->key_length) return x->key_length < y->key_length ? -1 : 1;
  return memcmp(x->key, y->key, x->key_length);
}

/* No key twice, in this value and those in it; sorting bounds the time of a million keys. */
static twz_status check_keys(parser *p, const json_value *value) {
  size_t n = 0;
  for (const json_value *m = value->first; m; m = m->next) {
    n++;
    TRY(check_keys(p, m));
  }
  if (value->kind != JSON_OBJECT || n < 2) return TWZ_OK;
  const json_value **sorted = twz_allocate(p->document->allocator, n * sizeof *sorted);
  if (!sorted) return twz_no_memory(p->error, n * sizeof *sorted);
  n = 0;
  for (const json_value *m = value->first; m; m = m->next) sorted[n++] = m;
  qsort(sorted, n, sizeof *sorted, compare_keys);
  int is_twice = 0;
  for (size_t i = 1; i < n; i++) is_twice |= compare_keys(&sorted[i - 1], &sorted[i]) == 0;
  twz_release(p->document->allocator, sorted);
  return is_twice ? twz_fail(p->error, TWZ_CORRUPT, "metadata: a key occurs twice in one object") : TWZ_OK;
}

static int is_utf8(const unsigned char *s, size_t n) {
  for (size_t i = 0; i < n;) {
    unsigned char c = s[i++];
    if (c < 0x80) continue;
    int more = c >= 0xC2 && c < 0xE0 ? 1 : c >= 0xE0 && c < 0xF0 ? 2 : c >= 0xF0 && c < 0xF5 ? 3 : 0;
    if (!more || n - i < (size_t)more) return 0;
    unsigned char low = c == 0xE0 ? 0xA0 : c == 0xF0 ? 0x90 : 0x80;
    unsigned char high = c == 0xED ? 0x9F : c == 0xF4 ? 0x8F : 0xBF; /* no surrogates, at most 10FFFF */
    for (; more; more--, i++, low = 0x80, high = 0xBF) {
      if (s[i] < low || s[i] > high) return 0;
    }
  }
  return 1;
}

twz_status json_parse(json_document *document, const char *text, size_t n, twz_error *error) {
  parser p = {document, text, n, 0, error};
  if (!is_utf8((const unsigned char *)text, n)) return BAD(&p, "no UTF-8");
  TRY(read_value(&p, 0, &document->root));
  if (peek(&p) >= 0) return BAD(&p, "text after the end");
  if (document->root->kind != JSON_OBJECT) return BAD(&p, "no JSON object");
  return check_keys(&p, document->root);
}
