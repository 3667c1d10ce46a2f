/* What Python needs beside terrainwave.h: the numbers it compares before it trusts the library, and locks. */
#include <stdlib.h>

#include "internal.h"

/* Raised whenever what src/terrainwave/read/native.py calls changes its meaning or layout. */
enum { PYTHON_ABI = 1 };

TWZ_API int twz_python_abi(void);
TWZ_API uint32_t twz_python_features(void);
TWZ_API twz_locks *twz_python_locks_new(void);
TWZ_API void twz_python_locks_free(twz_locks *locks);

int twz_python_abi(void) { return PYTHON_ABI; }

/* The feature bits of headers that this library reads. */
uint32_t twz_python_features(void) { return KNOWN_FEATURES; }

#if defined(_WIN32)
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
typedef SRWLOCK mutex;
static int begin(mutex *m) { InitializeSRWLock(m); return 0; }
static void end(mutex *m) { (void)m; }
static void lock(void *m) { AcquireSRWLockExclusive(m); }
static void unlock(void *m) { ReleaseSRWLockExclusive(m); }
#else
#include <pthread.h>
typedef pthread_mutex_t mutex;
static int begin(mutex *m) { return pthread_mutex_init(m, NULL); }
static void end(mutex *m) { pthread_mutex_destroy(m); }
static void lock(void *m) { pthread_mutex_lock(m); }
static void unlock(void *m) { pthread_mutex_unlock(m); }
#endif

/* Locks for one file, which outlive it; NULL where there is no memory. */
twz_locks *twz_python_locks_new(void) {
  twz_locks *locks = malloc(sizeof *locks);
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
