/* Which instructions this processor has. */
#include "kernels.h"

#ifdef TWZ_HAVE_X86
#if defined(_MSC_VER)
#include <intrin.h>
static int has_bit(int leaf, int which, int bit) {
  int found[4];
  __cpuidex(found, leaf, 0);
  return found[which] >> bit & 1;
}
/* The system keeps registers of 256 (512) bits for threads. */
static int keeps(unsigned bits) { return has_bit(1, 2, 27) && ((unsigned)_xgetbv(0) & bits) == bits; }
static int has_avx2(void) { return keeps(6) && has_bit(7, 1, 5) && has_bit(7, 1, 8); }
static int has_avx512(void) {
  return has_avx2() && keeps(0xE6) && has_bit(7, 1, 16) && has_bit(7, 1, 17) && has_bit(7, 1, 30) &&
         has_bit(7, 1, 31) && has_bit(7, 2, 6) && has_bit(7, 2, 11);
}
#else
static int has_avx2(void) { return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("bmi2"); }
static int has_avx512(void) {
  return has_avx2() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
         __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
         __builtin_cpu_supports("avx512vbmi2") && __builtin_cpu_supports("avx512vnni");
}
#endif
#endif

const row_kernels *find_kernels(twz_kernels kind) {
#ifdef TWZ_HAVE_X86
  int is_auto = kind == TWZ_KERNELS_AUTO;
  if ((is_auto || kind == TWZ_KERNELS_AVX512) && has_avx512()) return &kernels_avx512;
  if ((is_auto || kind == TWZ_KERNELS_AVX2) && has_avx2()) return &kernels_avx2;
#endif
  return kind == TWZ_KERNELS_AUTO || kind == TWZ_KERNELS_BASELINE ? &kernels_baseline : NULL;
}
