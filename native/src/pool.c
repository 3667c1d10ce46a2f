/* A pool of threads, for callers that have none. */
#include <stdlib.h>

#include "internal.h"

#if defined(TWZ_NO_THREADS)

twz_status twz_pool_new(size_t n_threads, twz_pool **pool, twz_error *error) {
  (void)n_threads;
  *pool = NULL;
  return twz_fail(error, TWZ_UNSUPPORTED, "this library was built without threads");
}
void twz_pool_free(twz_pool *pool) { (void)pool; }
const twz_workers *twz_pool_workers(twz_pool *pool) { (void)pool; return NULL; }

#else

#if defined(_WIN32)
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
typedef HANDLE thread;
typedef CRITICAL_SECTION mutex;
typedef CONDITION_VARIABLE condition;
#define mutex_init(m) InitializeCriticalSection(m)
#define mutex_destroy(m) DeleteCriticalSection(m)
#define mutex_lock(m) EnterCriticalSection(m)
#define mutex_unlock(m) LeaveCriticalSection(m)
#define condition_init(c) InitializeConditionVariable(c)
#define condition_destroy(c) ((void)(c))
#define condition_wait(c, m) SleepConditionVariableCS(c, m, INFINITE)
#define condition_wake_all(c) WakeAllConditionVariable(c)
#define THREAD_FUNCTION static DWORD WINAPI
#define THREAD_RESULT 0
static int thread_start(thread *t, DWORD(WINAPI *run)(void *), void *argument) {
  *t = CreateThread(NULL, 0, run, argument, 0, NULL);
  return *t != NULL;
}
static void thread_join(thread t) {
  WaitForSingleObject(t, INFINITE);
  CloseHandle(t);
}
static size_t n_processors(void) {
  SYSTEM_INFO info;
  GetSystemInfo(&info);
  return info.dwNumberOfProcessors;
}
#else
#include <pthread.h>
#include <unistd.h>
typedef pthread_t thread;
typedef pthread_mutex_t mutex;
typedef pthread_cond_t condition;
#define mutex_init(m) pthread_mutex_init(m, NULL)
#define mutex_destroy(m) pthread_mutex_destroy(m)
#define mutex_lock(m) pthread_mutex_lock(m)
#define mutex_unlock(m) pthread_mutex_unlock(m)
#define condition_init(c) pthread_cond_init(c, NULL)
#define condition_destroy(c) pthread_cond_destroy(c)
#define condition_wait(c, m) pthread_cond_wait(c, m)
#define condition_wake_all(c) pthread_cond_broadcast(c)
#define THREAD_FUNCTION static void *
#define THREAD_RESULT NULL
static int thread_start(thread *t, void *(*run)(void *), void *argument) {
  return pthread_create(t, NULL, run, argument) == 0;
}
static void thread_join(thread t) { pthread_join(t, NULL); }
static size_t n_processors(void) {
  long n = sysconf(_SC_NPROCESSORS_ONLN);
  return n > 0 ? (size_t)n : 1;
}
#endif

typedef struct helper {
  twz_pool *pool;
  thread thread;
  size_t worker;
} helper;

struct twz_pool {
  twz_workers workers;
  helper *helpers; /* n_helpers of them; the caller is worker 0 */
  size_t n_helpers;
  mutex lock;
  condition work, done;
  int is_ending;
  uint64_t round; /* of work that was given out */
  size_t n, next, n_busy;
  twz_task task;
  void *argument;
};

/* Take indices until there are none; called and left with the lock held. */
static void work_off(twz_pool *p, size_t worker) {
  while (p->next < p->n) {
    size_t index = p->next++;
    mutex_unlock(&p->lock);
    p->task(p->argument, index, worker);
    mutex_lock(&p->lock);
  }
}

THREAD_FUNCTION help(void *argument) {
  helper *h = argument;
  twz_pool *p = h->pool;
  uint64_t seen = 0;
  mutex_lock(&p->lock);
  while (!p->is_ending) {
    if (p->round == seen) {
      condition_wait(&p->work, &p->lock);
      continue;
    }
    seen = p->round;
    p->n_busy++;
    work_off(p, h->worker);
    if (--p->n_busy == 0) condition_wake_all(&p->done);
  }
  mutex_unlock(&p->lock);
  return THREAD_RESULT;
}

static void run_pool(void *context, size_t n, twz_task task, void *argument) {
  twz_pool *p = context;
  mutex_lock(&p->lock);
  p->task = task;
  p->argument = argument;
  p->n = n;
  p->next = 0;
  p->round++;
  condition_wake_all(&p->work);
  work_off(p, 0);
  while (p->n_busy > 0) condition_wait(&p->done, &p->lock);
  mutex_unlock(&p->lock);
}

void twz_pool_free(twz_pool *p) {
  if (!p) return;
  mutex_lock(&p->lock);
  p->is_ending = 1;
  condition_wake_all(&p->work);
  mutex_unlock(&p->lock);
  for (size_t i = 0; i < p->n_helpers; i++) thread_join(p->helpers[i].thread);
  condition_destroy(&p->work);
  condition_destroy(&p->done);
  mutex_destroy(&p->lock);
  free(p->helpers);
  free(p);
}

twz_status twz_pool_new(size_t n_threads, twz_pool **pool, twz_error *error) {
  *pool = NULL;
  if (n_threads == 0) n_threads = n_processors();
  twz_pool *p = calloc(1, sizeof *p);
  if (!p) return twz_no_memory(error, sizeof *p);
  mutex_init(&p->lock);
  condition_init(&p->work);
  condition_init(&p->done);
  p->workers.size = sizeof p->workers;
  p->workers.context = p;
  p->workers.run = run_pool;
  p->helpers = calloc(n_threads, sizeof *p->helpers);
  for (size_t i = 0; p->helpers && i + 1 < n_threads; i++) {
    helper *h = &p->helpers[i];
    h->pool = p;
    h->worker = i + 1;
    if (!thread_start(&h->thread, help, h)) break; /* fewer do the same */
    p->n_helpers++;
  }
  p->workers.n_workers = p->n_helpers + 1;
  if (!p->helpers) {
    twz_pool_free(p);
    return twz_no_memory(error, n_threads * sizeof *p->helpers);
  }
  *pool = p;
  return TWZ_OK;
}

const twz_workers *twz_pool_workers(twz_pool *p) { return &p->workers; }

#endif
