/*
 * What Python needs beside terrainwave.h: the digest it compares before it trusts the library, locks for
 * each file, and memory that goes from file to file.
 */
#include <stdlib.h>

#include "encode.h"
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

