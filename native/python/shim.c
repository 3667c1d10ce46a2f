/*
 * What Python needs beside terrainwave.h: the digest it compares before it trusts the library, locks for
 * each file, and memory that goes from file to file.
 */
#include <stdlib.h>

#include "encode.h"
#include "encode_measure.h"
#include "encode_pyramid.h"
#include "encode_tables.h"
#include "internal.h"

TWZ_API const char *twz_python_sources(void);
TWZ_API twz_locks *twz_python_locks_new(void);
TWZ_API void twz_python_locks_free(twz_locks *locks);
TWZ_API const twz_allocator *twz_python_allocator(void);
TWZ_API twz_status twz_python_tables_new(int32_t k_max, int32_t cut, int32_t has_slots, const int64_t *stencils, const int64_t *weights,
                                         const uint32_t *freqs, const uint32_t *starts, encode_tables **made, twz_error *error);
TWZ_API void twz_python_tables_free(encode_tables *tables);
TWZ_API twz_status twz_python_encoder_new(twz_encoder **made, twz_error *error);
TWZ_API void twz_python_encoder_free(twz_encoder *encoder);
TWZ_API twz_status twz_python_encode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error);
TWZ_API twz_status twz_python_decode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error);
TWZ_API twz_status twz_python_code_tables(tables_job *job, twz_error *error);
TWZ_API twz_status twz_python_encode_mask(twz_encoder *encoder, mask_job *job, twz_error *error);
TWZ_API uint64_t twz_python_mask_words(const uint8_t *models, const uint8_t *values, uint64_t n, const uint32_t *freqs, uint32_t n_states,
                                       uint32_t *states, uint8_t *words);
TWZ_API void twz_python_quantise(int type, const void *raw, const uint8_t *valid, size_t n, int is_whole, int64_t numerator,
                                 int64_t denominator, int64_t base, int32_t *quanta);
TWZ_API void twz_python_push(const int32_t *fine, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col, int64_t *lines,
                             int32_t to_rows, int32_t to_cols, int32_t *values, uint8_t *known);
TWZ_API void twz_python_pull(const int32_t *coarse, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col,
                             int32_t to_rows, int32_t to_cols, const uint8_t *known, int32_t *values);
TWZ_API void twz_python_dequantise(int type, const int32_t *quanta, size_t n, int64_t numerator, int64_t denominator, int64_t base,
                                   int64_t low, int64_t high, void *heights);
TWZ_API void twz_python_range_and_error(const int32_t *originals, const uint8_t *valid, const int32_t *decoded, int64_t original_cols,
                                        int64_t decoded_cols, int32_t row, int32_t col, int32_t n_rows, int32_t n_cols, int32_t *found);
TWZ_API int64_t twz_python_largest_deviation(const deviation_job *job, int is_short);
TWZ_API void twz_python_count_seen(const int32_t *features, const int32_t *details, const uint8_t *is_coded, size_t n,
                                   const int32_t *weights, int least_cut, int most_cut, int64_t *pairs, int64_t *singles, int64_t *escaped);

/* The digest of the sources that this library is built of (src/terrainwave/native_sources.py). */
const char *twz_python_sources(void) { return TWZ_SOURCES; }

#if defined(_WIN32)
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
typedef SRWLOCK mutex;
static mutex spare_lock = SRWLOCK_INIT;
static int try_lock(mutex *m) { return TryAcquireSRWLockExclusive(m); }
static int begin(mutex *m) { InitializeSRWLock(m); return 0; }
static void end(mutex *m) { (void)m; }
static void lock(void *m) { AcquireSRWLockExclusive(m); }
static void unlock(void *m) { ReleaseSRWLockExclusive(m); }
#else
#include <pthread.h>
typedef pthread_mutex_t mutex;
static mutex spare_lock = PTHREAD_MUTEX_INITIALIZER;
static int try_lock(mutex *m) { return pthread_mutex_trylock(m) == 0; }
static int begin(mutex *m) { return pthread_mutex_init(m, NULL); }
static void end(mutex *m) { pthread_mutex_destroy(m); }
static void lock(void *m) { pthread_mutex_lock(m); }
static void unlock(void *m) { pthread_mutex_unlock(m); }
#endif

/* Locks for one file, which outlive it; NULL where there is no memory. */
twz_locks *twz_python_locks_new(void) {
  twz_locks *locks = calloc(1, sizeof *locks);
  mutex *m = malloc(sizeof *m);
  if (!locks || !m || begin(m) != 0) {
    free(locks);
    free(m);
    return NULL;
  }
  locks->context = m;
  locks->lock = lock;
  locks->unlock = unlock;
  return locks;
}

void twz_python_locks_free(twz_locks *locks) {
  if (!locks) return;
  end(locks->context);
  free(locks->context);
  free(locks);
}

/*
 * Memory. What a process has not touched before costs it a page fault every 4 KB, a sixth of the time of
 * a window; so large pieces stay when they are released, for whichever file asks next.
 *
 * Nobody waits for the lock: a fork may have left it locked for ever, and malloc is there.
 */
enum { HEAD = 64, PIECE = 1 << 16, MOST_SPARE = 256 };
#define MOST_KEPT ((size_t)64 << 20)

typedef struct head {
  size_t capacity; /* of the piece behind it; 0: a small one, which malloc keeps by itself */
} head;

static head *spare[MOST_SPARE];
static size_t n_spare, n_kept;

/* The spare piece that is least too large, by a quarter at most. */
static head *take_spare(size_t n) {
  head *found = NULL;
  if (!try_lock(&spare_lock)) return NULL;
  size_t best = MOST_SPARE;
  for (size_t i = 0; i < n_spare; i++) {
    size_t capacity = spare[i]->capacity;
    if (capacity < n || capacity - n > n / 4) continue;
    if (best == MOST_SPARE || capacity < spare[best]->capacity) best = i;
  }
  if (best < MOST_SPARE) {
    found = spare[best];
    n_kept -= found->capacity;
    spare[best] = spare[--n_spare];
  }
  unlock(&spare_lock);
  return found;
}

static int keep_spare(head *h) {
  if (h->capacity == 0 || !try_lock(&spare_lock)) return 0;
  int is_kept = n_spare < MOST_SPARE && h->capacity <= MOST_KEPT - n_kept;
  if (is_kept) {
    n_kept += h->capacity;
    spare[n_spare++] = h;
  }
  unlock(&spare_lock);
  return is_kept;
}

static void *allocate(void *context, size_t n_bytes) {
  (void)context;
  if (n_bytes > SIZE_MAX - HEAD - PIECE) return NULL;
  size_t capacity = n_bytes < PIECE / 2 ? 0 : (n_bytes + PIECE - 1) / PIECE * PIECE;
  head *h = capacity ? take_spare(capacity) : NULL;
  if (!h) {
    h = malloc(HEAD + (capacity ? capacity : n_bytes));
    if (!h) return NULL;
    h->capacity = capacity;
  }
  return (char *)h + HEAD;
}

static void release(void *context, void *memory) {
  (void)context;
  if (!memory) return;
  head *h = (head *)(void *)((char *)memory - HEAD);
  if (!keep_spare(h)) free(h);
}

/* For twz_options.allocator. */
const twz_allocator *twz_python_allocator(void) {
  static const twz_allocator allocator = {.allocate = allocate, .release = release};
  return &allocator;
}

/* The encoder (encode.h). */
twz_status twz_python_tables_new(int32_t k_max, int32_t cut, int32_t has_slots, const int64_t *stencils, const int64_t *weights, const uint32_t *freqs,
                                 const uint32_t *starts, encode_tables **made, twz_error *error) {
  static const twz_allocator plain; /* most of it is never touched: malloc maps no pages for that */
  return encode_tables_new(&plain, k_max, cut, has_slots, stencils, weights, freqs, starts, made, error);
}

void twz_python_tables_free(encode_tables *tables) { encode_tables_free(tables); }

twz_status twz_python_encoder_new(twz_encoder **made, twz_error *error) {
  return encoder_new(twz_python_allocator(), TWZ_KERNELS_AUTO, made, error);
}

void twz_python_encoder_free(twz_encoder *encoder) { encoder_free(encoder); }

twz_status twz_python_encode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error) {
  return encode_rapid(encoder, tables, job, error);
}

twz_status twz_python_decode(twz_encoder *encoder, const encode_tables *tables, encode_job *job, twz_error *error) {
  return decode_lone(encoder, tables, job, error);
}

twz_status twz_python_code_tables(tables_job *job, twz_error *error) { return code_tables(job, error); }
twz_status twz_python_encode_mask(twz_encoder *encoder, mask_job *job, twz_error *error) { return encode_mask(encoder, job, error); }

uint64_t twz_python_mask_words(const uint8_t *models, const uint8_t *values, uint64_t n, const uint32_t *freqs, uint32_t n_states,
                               uint32_t *states, uint8_t *words) {
  return encode_mask_bits(models, values, n, freqs, n_states, states, words);
}

void twz_python_quantise(int type, const void *raw, const uint8_t *valid, size_t n, int is_whole, int64_t numerator,
                         int64_t denominator, int64_t base, int32_t *quanta) {
  quantise_heights(type, raw, valid, n, is_whole, numerator, denominator, base, quanta);
}

void twz_python_push(const int32_t *fine, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col, int64_t *lines,
                     int32_t to_rows, int32_t to_cols, int32_t *values, uint8_t *known) {
  push_heights(fine, n_rows, n_cols, first_row, first_col, lines, to_rows, to_cols, values, known);
}

void twz_python_pull(const int32_t *coarse, int32_t n_rows, int32_t n_cols, int32_t first_row, int32_t first_col, int32_t to_rows,
                     int32_t to_cols, const uint8_t *known, int32_t *values) {
  pull_heights(coarse, n_rows, n_cols, first_row, first_col, to_rows, to_cols, known, values);
}

void twz_python_dequantise(int type, const int32_t *quanta, size_t n, int64_t numerator, int64_t denominator, int64_t base, int64_t low,
                           int64_t high, void *heights) {
  dequantise_heights(type, quanta, n, numerator, denominator, base, low, high, heights);
}

void twz_python_range_and_error(const int32_t *originals, const uint8_t *valid, const int32_t *decoded, int64_t original_cols,
                                int64_t decoded_cols, int32_t row, int32_t col, int32_t n_rows, int32_t n_cols, int32_t *found) {
  range_and_error(originals, valid, decoded, (ptrdiff_t)original_cols, (ptrdiff_t)decoded_cols, row, col, n_rows, n_cols, found);
}

int64_t twz_python_largest_deviation(const deviation_job *job, int is_short) { return largest_deviation(job, is_short); }

void twz_python_count_seen(const int32_t *features, const int32_t *details, const uint8_t *is_coded, size_t n, const int32_t *weights,
                           int least_cut, int most_cut, int64_t *pairs, int64_t *singles, int64_t *escaped) {
  count_seen(features, details, is_coded, n, weights, least_cut, most_cut, pairs, singles, escaped);
}
