/* What the parts of the library share. FORMAT is docs/FORMAT.md; its sections are cited by number. */
#ifndef TWZ_INTERNAL_H
#define TWZ_INTERNAL_H

#include <stdint.h>
#include <string.h>

#include "terrainwave.h"

#if defined(__GNUC__)
#define TWZ_PRINTF(which, first) __attribute__((format(printf, which, first)))
#else
#define TWZ_PRINTF(which, first)
#endif
#if defined(_MSC_VER)
#define RESTRICT __restrict
#define ALWAYS_INLINE __forceinline
#else
#define RESTRICT restrict
#define ALWAYS_INLINE inline __attribute__((always_inline))
#endif

/* Seen from outside where the library is that of the Python package (python/CMakeLists.txt). */
#ifdef TWZ_FOR_PYTHON
#define PYTHON_API TWZ_API
#else
#define PYTHON_API
#endif

/* Compiled for AVX2, too: the system's loader chooses. Without FMA, so results are equal. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__gnu_linux__) && !defined(TWZ_SANITIZED) && \
    !defined(__SANITIZE_THREAD__) && !defined(__SANITIZE_ADDRESS__)
#define ALSO_AVX2 __attribute__((target_clones("default", "avx2")))
#else
#define ALSO_AVX2
#endif

/* ---- Small things --------------------------------------------------------------------------- */

static inline int32_t min_i32(int32_t a, int32_t b) { return a < b ? a : b; }
static inline int32_t max_i32(int32_t a, int32_t b) { return a > b ? a : b; }
static inline int64_t min_i64(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t max_i64(int64_t a, int64_t b) { return a > b ? a : b; }
static inline int64_t clamp_i64(int64_t x, int64_t low, int64_t high) {
  return min_i64(max_i64(x, low), high);
}
static inline int64_t abs_i64(int64_t a) { return a < 0 ? -a : a; }
static inline double abs_double(double a) { return a < 0 ? -a : a; } /* fabs is in libm, which is nowhere else needed */
static inline uint64_t magnitude_of(int64_t a) { return a < 0 ? (uint64_t)-(a + 1) + 1 : (uint64_t)a; } /* of -2^63, too */
static inline uint64_t min_u64(uint64_t a, uint64_t b) { return a < b ? a : b; }
static inline uint32_t min_u32(uint32_t a, uint32_t b) { return a < b ? a : b; }
static inline uint32_t max_u32(uint32_t a, uint32_t b) { return a > b ? a : b; }
static inline size_t min_size(size_t a, size_t b) { return a < b ? a : b; }
static inline size_t max_size(size_t a, size_t b) { return a > b ? a : b; }

/* floor(a / 2^n), also of negative numbers: what every compiler named here makes of >>. */
static inline int64_t shift_right(int64_t a, int n) { return a >> n; }
/* floor(a / b), b > 0. */
static inline int64_t floor_div(int64_t a, int64_t b) { return a / b - (a % b < 0); }

static inline int bit_length(uint64_t v) {
  int n = 0;
  for (; v; v >>= 1) n++;
  return n;
}

static inline uint16_t load_u16(const uint8_t *p) { return (uint16_t)(p[0] | p[1] << 8); }
static inline uint32_t load_u32(const uint8_t *p) {
  return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}
static inline uint64_t load_u64(const uint8_t *p) {
  return load_u32(p) | (uint64_t)load_u32(p + 4) << 32;
}

/* ---- Errors (bytes.c) ----------------------------------------------------------------------- */

/* Fill `error` (may be NULL) and return the status. */
twz_status twz_fail(twz_error *error, twz_status status, const char *format, ...) TWZ_PRINTF(3, 4);

#define REQUIRE(condition, error, ...) \
  do { \
    if (!(condition)) return twz_fail(error, TWZ_CORRUPT, __VA_ARGS__); \
  } while (0)
#define REQUIRE_KNOWN(condition, error, ...) \
  do { \
    if (!(condition)) return twz_fail(error, TWZ_UNSUPPORTED, __VA_ARGS__); \
  } while (0)
/* Copy a structure that begins with its size: what the caller knows of it, over the defaults in `to`. */
twz_status take_sized(void *to, size_t size, const void *given, const char *name, twz_error *error);

#define TRY(call) \
  do { \
    twz_status status_ = (call); \
    if (status_ != TWZ_OK) return status_; \
  } while (0)

/* ---- Memory --------------------------------------------------------------------------------- */

void *twz_allocate(const twz_allocator *a, size_t n_bytes); /* NULL: none; 0 bytes are one */
void *twz_allocate_zeros(const twz_allocator *a, size_t n_bytes);
void twz_release(const twz_allocator *a, void *memory);
twz_status twz_no_memory(twz_error *error, size_t n_bytes);

/* Much memory, that is soon written: of large pages, where the system has them and the caller has no allocator. */
void *twz_allocate_pages(const twz_allocator *a, size_t n_bytes);

/* Memory for one worker, kept from unit to unit: laid out anew by each. */
typedef struct scratch {
  const twz_allocator *allocator;
  uint8_t *memory;
  size_t size, used;
} scratch;

/* Make room for n_bytes in all, and begin at the start. */
twz_status scratch_reserve(scratch *s, size_t n_bytes, twz_error *error);
/* Take a part of what is reserved, aligned to 64. */
void *scratch_take(scratch *s, size_t n_bytes);
void scratch_free(scratch *s);
enum { SCRATCH_ALIGN = 64 };

/* ---- Bytes (bytes.c, inflate.c) ------------------------------------------------------------- */

typedef struct crc_tables {
  uint32_t of[16][256];
} crc_tables;

void crc_tables_fill(crc_tables *t);
uint32_t crc32_of(const crc_tables *t, const uint8_t *bytes, size_t n);

/* Fuzzers would not get past checksums: built for them, every one matches. */
#if defined(TWZ_FUZZING)
enum { CHECKSUMS_COUNT = 0 };
#else
enum { CHECKSUMS_COUNT = 1 };
#endif
static inline int crc_matches(const crc_tables *t, const uint8_t *bytes, size_t n, uint32_t stated) {
  return !CHECKSUMS_COUNT || crc32_of(t, bytes, n) == stated;
}

/* A section of bytes that is read from its start. */
typedef struct reader {
  const uint8_t *bytes;
  size_t n, at;
} reader;

/* Read a varint (§1.4). */
twz_status read_varint(reader *r, uint64_t *value, twz_error *error);
twz_status read_signed_varint(reader *r, int64_t *value, twz_error *error);
twz_status read_byte(reader *r, int *byte, twz_error *error);
/* Read a varint n and take n bytes as a section of its own. */
twz_status read_section(reader *r, reader *section, const char *name, twz_error *error);

/* A zlib stream (or a raw one, behind a dictionary) that fills its section and inflates to at most `limit`
 * bytes; *n_out says how many (§1.3). `out` has limit bytes. */
twz_status inflate_zlib(const uint8_t *bytes, size_t n, uint8_t *out, size_t limit, size_t *n_out,
                        const char *name, twz_error *error);
twz_status inflate_raw(const uint8_t *bytes, size_t n, const uint8_t *dictionary, size_t n_dictionary,
                       uint8_t *out, size_t limit, size_t *n_out, const char *name,
                       twz_error *error);

/* ---- JSON (json.c) -------------------------------------------------------------------------- */

typedef enum json_kind { JSON_NULL, JSON_BOOL, JSON_NUMBER, JSON_STRING, JSON_ARRAY, JSON_OBJECT } json_kind;

/* A value; members of arrays and objects are chained by `next`. */
typedef struct json_value {
  struct json_value *next, *first; /* first: of an array or object */
  const char *key;                 /* of a member of an object */
  size_t key_length;
  const char *string;              /* decoded, ends with NUL */
  size_t n_string;
  const char *number;              /* its text; json_number converts it */
  size_t n_number;
  json_kind kind;
  int is_beyond_u64;    /* of a number without fraction and exponent: magnitude above 2^64 */
} json_value;

typedef struct json_document {
  const twz_allocator *allocator;
  struct json_page *pages;
  json_value *root;
} json_document;

twz_status json_parse(json_document *document, const char *text, size_t n, twz_error *error);
void json_free(json_document *document);
double json_number(const json_value *value); /* the nearest one; ties to even */
const json_value *json_member(const json_value *object, const char *key); /* NULL: none or null */

/* ---- Header and grid (header.c) ------------------------------------------------------------- */

enum {
  HEADER_SIZE = 128, /* without optional sections */
  FIRST_READ = 16384,
  N_METHODS = 5,
  FORMAT_VERSION = 2,
  VOIDS = 1, /* feature bits */
  REMAINDERS = 2,
  FAITHFUL = 4,
  CORRECTIONS = 8,
  DIGESTS = 16,
  KNOWN_FEATURES = VOIDS | REMAINDERS | FAITHFUL | CORRECTIONS | DIGESTS,
  DIGEST_SIZE = 32, DIGESTS_TAIL = 8, LEAST_DIGESTS = DIGEST_SIZE + DIGESTS_TAIL /* §4.9 */
};

typedef struct header {
  uint32_t features;
  uint64_t file_size;
  uint32_t n_rows, n_cols;
  int block_log2, border_rings, method, dtype, mesh;
  uint64_t quantum_num, quantum_den;
  int64_t base;
  int32_t step; /* below 2^31 */
  int32_t z_min, z_max;
  double max_error, effective_bound, rho;
  uint32_t header_size, metadata_length, metadata_crc, parameters_length, parameters_crc, top_page_length;
} header;

twz_status read_header(header *h, const uint8_t *bytes, uint64_t file_size, const crc_tables *crc,
                       twz_error *error);
twz_status check_optional_sections(const header *h, const uint8_t *bytes, const crc_tables *crc, twz_error *error);
size_t dtype_size(int dtype);
int dtype_is_float(int dtype);
void dtype_range(int dtype, int64_t *low, int64_t *high);

/* A block or a key (§2.2, §2.4): level -1 is the key of the root, and the head of the top segment. */
typedef struct place {
  int level;
  uint32_t row, col;
} place;

typedef struct grid {
  uint32_t n_rows, n_cols;
  int k_max, block_log2, rings; /* rings: (border_rings - 1) / 2 */
  int tile_levels, first_tiles; /* cdf53: d and r of C.2; else 0 */
  int has_digests;              /* they follow the last segment (§4.9) */
} grid;

void grid_init(grid *g, const header *h);
uint32_t level_size(const grid *g, uint32_t n, int level);     /* samples along an axis */
uint32_t n_blocks(const grid *g, uint32_t n, int level);       /* along an axis of n samples */
int key_level_of(const grid *g, int level);                    /* of units that hold a level */
place parent_unit(const grid *g, place key);                   /* the unit that holds a key's block */
int first_level_of(place key);                                 /* levels that a unit holds */
int last_level_of(const grid *g, place key);

/* An axis of the region of a unit on one level (§2.4). */
typedef struct axis {
  uint32_t first;      /* first sample of the region, of the level */
  int32_t n;           /* samples of the region */
  int32_t core, n_core; /* where the core begins in the region */
  uint32_t core_first;
  int shared[2];
} axis;

void unit_axes(const grid *g, place key, int level, axis *rows, axis *cols);

/* ---- Segments (segment.c) ------------------------------------------------------------------- */

/* Keys of tables: objects begin with one. */
typedef struct entry {
  struct entry *next; /* of the same slot */
  place at;
} entry;

typedef struct table {
  entry **slots;
  size_t n_slots, n;
} table;

entry *table_find(const table *t, place at);
int table_insert(table *t, const twz_allocator *a, entry *e); /* 0: no memory */
void table_remove(table *t, entry *e);

typedef struct section_place {
  uint64_t offset;
  uint32_t length, crc;
} section_place;

typedef struct block_codes {
  uint8_t z_min, z_max, error, mesh_error;
} block_codes;

typedef struct child_place { /* of a child segment; page_length 0: absent */
  uint64_t offset, length; /* of its body */
  uint64_t page;           /* where its page lies */
  uint32_t page_length;
} child_place;

typedef struct segment {
  entry entry; /* the head */
  int n_keys, n_blocks, n_heads;
  place *keys, *blocks, *heads;
  section_place *payloads, *meshes; /* by key */
  block_codes *codes;      /* by block */
  child_place *children;   /* by head */
  uint64_t end, children_end;
} segment;

enum { MOST_KEYS = 85, MOST_BLOCKS = 340, MOST_HEADS = 256 };

/* What a segment lists, in the order of its page (§3.1). */
typedef struct segment_layout {
  int n_keys, n_blocks, n_heads;
  place keys[MOST_KEYS], blocks[MOST_BLOCKS], heads[MOST_HEADS];
} segment_layout;

void lay_out_segment(segment_layout *l, const grid *g, place head);
void order_of_file(const segment_layout *l, int *order); /* numbers of the keys in the order of their payloads (§3.2) */
place head_of_key(const grid *g, place key);
place parent_of_head(const grid *g, place head);
int index_of_place(const place *places, int n, place p); /* -1: not there */

/* What is known of the place of a segment's page. */
typedef struct page_place {
  uint64_t offset;
  uint64_t body, end;    /* of the segment's body; end 0 of the top one: see §3.5 */
  uint64_t siblings_end;
  uint32_t length;
} page_place;

/* What is known of a segment: itself, that it is absent, or whose page must be read first, and where that is. */
typedef enum segment_state { FOUND, ABSENT, MISSING } segment_state;
segment_state find_segment(const twz_file *f, place head, segment **s, page_place *page, place *missing);
place child_page(const segment *s, int i, page_place *page); /* of child number i, which is present; returns its head */

twz_status read_segment(segment **found, const grid *g, place head, const page_place *where,
                        const uint8_t *page, uint64_t file_size, const crc_tables *crc,
                        const twz_allocator *allocator, twz_error *error);

/* ---- Raw heights (heights.c) ---------------------------------------------------------------- */

struct row_kernels;

typedef struct heights {
  const struct row_kernels *kernels;
  int dtype, is_float, has_nodata, is_exact;
  int is_sum; /* raw heights are base and quanta, added up in 32 bits, and fit the dtype */
  int64_t base;
  uint64_t num, den;
  double nodata;        /* in the dtype */
  int64_t integer_nodata;
  int32_t first, last;  /* [a, b] of §5.1, first > last: there is none */
  int32_t z_min, z_max, step;
  int is_cdf53;
  int is_short;         /* of rapid: layers hold heights less the origin in 16 bits */
  int32_t origin;
} heights;

void heights_init(heights *h, const struct row_kernels *kernels, const header *of, int has_nodata, double nodata);
double raw_of_quantum(const heights *h, int64_t k);
/* ---- Units ---------------------------------------------------------------------------------- */

/* Some of a unit's samples: from a row and a column of its region up to others. */
typedef struct part {
  int32_t row, col, end_row, end_col;
} part;

static inline int part_has(part all, part wanted) {
  return all.row <= wanted.row && all.col <= wanted.col && all.end_row >= wanted.end_row && all.end_col >= wanted.end_col;
}

/* Samples of one level of a unit's region, row by row. */
typedef struct layer {
  axis rows, cols;
  int32_t *heights;     /* quanta (cdf53: steps) */
  int16_t *shorts;      /* or these, less the origin: of all units with samples of a file that is short */
  int32_t origin;       /* 0 of heights */
  part ready;           /* samples whose heights are wanted, or there */
  uint8_t *valid;       /* NULL: all are valid */
  uint8_t *own;         /* with feature bit 4; NULL: as valid */
  int64_t *remainders;  /* NULL: all are 0 */
} layer;

enum { MOST_LAYERS = 10 };

typedef struct unit {
  entry entry; /* the key */
  struct unit *newer, *older; /* in the cache, by use, while nobody uses it */
  size_t n_users, n_bytes;
  int is_cached;
  int is_void; /* no valid sample: layers have no arrays, heights are 0 */
  int is_written; /* raw heights went where its order says; layers have none */
  int first_level, n_layers;
  layer layers[MOST_LAYERS];
} unit;

static inline layer *layer_of(unit *u, int level) { return &u->layers[level - u->first_level]; }

static inline int32_t height_at(const layer *l, size_t at) { return l->shorts ? l->shorts[at] + l->origin : l->heights[at]; }
static inline int is_valid_at(const layer *l, size_t at) { return !l->valid || l->valid[at]; }
/* The place of a sample of the core in the region. */
static inline size_t core_at(const layer *l, int32_t row, int32_t col) {
  return (size_t)(l->rows.core + row) * (size_t)l->cols.n + (size_t)(l->cols.core + col);
}
/* ---- Methods -------------------------------------------------------------------------------- */

/* Bytes of a height in a layer. */
static inline size_t cell_size(const heights *h) { return h->is_short ? sizeof(int16_t) : sizeof(int32_t); }
/* Write n raw heights of a layer, from sample `at` on; l NULL: of a void unit. */
twz_status write_raw(const heights *h, void *out, const layer *l, size_t at, size_t n, twz_error *error);
/* Write what void samples hold where raw heights of a layer are; `out` is aligned. */
void fill_voids(const heights *h, void *out, const layer *l, size_t at, size_t n);
/* The quantum number of a sample: heights of cdf53 are not final. */
int32_t quantum_at(const heights *h, const layer *l, size_t at);

struct rapid_tables;
struct predictive_tables;
struct cdf97_tables;

/* Bytes behind a payload that may be read, whatever they are: loads need no check (R.12). */
enum { PAYLOAD_SLACK = 256 };

struct twz_file {
  twz_allocator allocator;
  twz_locks locks;
  uint64_t file_size, cache_bytes, max_bytes;
  const uint8_t *memory; /* all bytes of the file, if it was borrowed */
  const struct row_kernels *kernels;
  crc_tables crc;
  int32_t rates[256]; /* of models, by count (§6.1) */

  uint8_t *start; /* header, metadata, parameters, top page, while they come */
  size_t n_start, start_capacity;
  int is_open;

  header header;
  grid grid;
  heights heights;
  char *metadata;
  json_document json;
  const json_value **tags[2]; /* of the file and of its band, by number */
  size_t n_tags[2];
  twz_info info;
  struct rapid_tables *rapid;
  struct predictive_tables *predictive;
  struct cdf97_tables *cdf97;

  table segments, units;
  unit *newest, *oldest; /* of the units that nobody uses */
  uint64_t cached_bytes;
  scratch idle; /* of the last window that was decoded, for the next one */
};

/* Parent heights of a group: samples of the layer above, from (row, col) of its region on. */
typedef struct parent {
  const layer *layer; /* NULL: a root */
  int is_void;
  int32_t row, col;       /* of the first of the parent heights in the layer's region */
  int32_t n_rows, n_cols; /* of the parent heights */
  uint32_t first_row, first_col; /* of them on their level */
} parent;

/* Of one level of a unit: what a method needs. */
typedef struct job {
  const twz_file *file;
  place key;
  int level;
  layer *out; /* axes and validity are there, heights are to be filled */
  parent parent;
  const int32_t *corrections; /* of the region (§5.4); NULL: all are 0 */
  uint8_t *target;            /* of an order: heights go there as raw ones, not to `out` */
  ptrdiff_t target_stride;
} job;

/* A unit to be decoded: its key is in `unit`, the rest of which is filled. */
typedef struct order {
  unit *unit;
  const unit *above; /* the one that holds the key's block; NULL: none */
  const uint8_t *payload; /* with PAYLOAD_SLACK behind it */
  size_t n;
  uint8_t *target;        /* where raw heights of the first sample of the part that is ready may go at once; NULL: nowhere */
  ptrdiff_t target_stride;
} order;

/* Decode a unit. */
twz_status decode_unit(const twz_file *f, const order *o, scratch *s, twz_error *error);
/* How many bytes a unit takes, decoded. */
uint64_t unit_bytes(const twz_file *f, place key);

/*
 * Fill out->valid and out->own (mask.c) of a unit with a payload; NULL where all are 1. A section with bytes
 * NULL is not there.
 */
twz_status decode_validity(const twz_file *f, layer *out, const parent *p, int is_finest, const reader *section,
                           int *has_valid, scratch *s, twz_error *error);

/* Each fills the heights of the whole region from the bytes of the method. */
twz_status decode_store(const job *j, const reader *bytes, twz_error *error);
/* Methods rapid and predictive correct heights as they decode them (§5.4). */
static inline int64_t corrected(const job *j, size_t at, int64_t height, int64_t low, int64_t high) {
  return j->corrections ? clamp_i64(height + j->corrections[at], low, high) : height;
}
/* The part of the region that out->ready says. */
twz_status decode_rapid(const job *j, const reader *bytes, scratch *s, twz_error *error);
twz_status decode_predictive(const job *j, const reader *bytes, scratch *s, twz_error *error);
twz_status decode_cdf97(const job *j, const reader *bytes, scratch *s, twz_error *error);
/* A tile: all its levels, masks included. */
twz_status decode_cdf53(const twz_file *f, unit *u, const unit *above, const uint8_t *payload, size_t n,
                        scratch *s, twz_error *error);

twz_status rapid_tables_new(twz_file *f, const uint8_t *parameters, size_t n, twz_error *error);
twz_status predictive_tables_new(twz_file *f, const uint8_t *parameters, size_t n, twz_error *error);
twz_status cdf97_tables_new(twz_file *f, twz_error *error);

/* Opening (metadata.c, file.c). */
twz_status read_metadata(twz_file *f, const uint8_t *section, twz_error *error);
twz_status level_number(const twz_file *f, int level, int *found, twz_error *error);
void file_lock(twz_file *f);
void file_unlock(twz_file *f);
typedef twz_status (*need_function)(void *self, twz_range *ranges, size_t capacity, size_t *n, twz_error *error);
typedef twz_status (*feed_function)(void *self, uint64_t offset, const void *bytes, size_t n, twz_error *error);
twz_status load_all(const twz_allocator *a, need_function need, feed_function feed, void *self, twz_fetch fetch,
                    void *source, twz_error *error);

/* Read a range of the file, which may lie in memory. */
twz_status fetch_range(const twz_file *f, const twz_range *range, twz_fetch fetch, void *source, void *to, twz_error *error);

/* Tell who is to be told how far a call is (the workers' defaults are set); ends it if that is the answer. */
twz_status report(const twz_workers *w, uint64_t n_done, uint64_t n_all, twz_error *error);

/*
 * Windows of some units of a level: each is wanted by itself, as far as samples row, col ... end_row - 1, end_col - 1
 * go. Several may count the memory they take together, in *n_bytes. They can be loaded and decoded, not read.
 */
twz_status sparse_window_new(twz_file *f, int level, const twz_box *box, uint64_t *n_bytes, twz_window **window, twz_error *error);
void window_want(twz_window *w, place key, int64_t row, int64_t col, int64_t end_row, int64_t end_col);
const unit *window_unit(const twz_window *w, place key); /* decoded */
place unit_of_sample(const grid *g, int level, uint32_t row, uint32_t col);

/* Do units of a decoded window's level hold the same of the samples that they share (§2.4), and finite heights (§5.3)? */
twz_status check_window(const twz_window *w, twz_error *error);

/* The cache: units that are taken or given stay until they are left. */
unit *cache_take(twz_file *f, place key, part *wanted); /* NULL: it is not there, or not all that is wanted, which is then all */
unit *cache_give(twz_file *f, unit *u);
void cache_leave(twz_file *f, unit *u);
void unit_free(twz_file *f, unit *u); /* takes the lock */

/* The parent's line at or before (after) a line of the level, counted from the first parent height. */
static inline int32_t line_above(uint32_t line, int is_after, uint32_t first, int32_t n) {
  int64_t at = (int64_t)(((uint64_t)line + (is_after ? 1u : 0u)) >> 1) - first;
  return (int32_t)clamp_i64(at, 0, n - 1);
}

/* What the parent heights of a key are (§2.4), out of the unit that holds its block. */
parent parent_of(const twz_file *f, place key, const unit *above);

static inline int32_t parent_height(const parent *p, int32_t row, int32_t col) {
  if (p->is_void) return 0;
  return height_at(p->layer, (size_t)(p->row + row) * (size_t)p->layer->cols.n + (size_t)(p->col + col));
}

#endif
