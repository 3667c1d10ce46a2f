/* Kernels for each set of instructions: the same source, compiled for each; equal results. */
#ifndef TWZ_KERNELS_H
#define TWZ_KERNELS_H

#ifdef TWZ_ENCODER
#include "encode.h"
#else
#include "rapid.h"
#endif

struct lattice;
struct above;
struct bits;
/* Decode the samples of a region into its cells (mask.h): below known ones, or those of a root (a NULL); b NULL: without a section. */
typedef void (*mask_decoder)(struct lattice *l, const struct above *a, struct bits *b, uint8_t *coarser, int is_finest);

typedef struct row_kernels {
  twz_kernels kind;
  rapid_decoder decode_rapid;
  mask_decoder decode_mask;
  void (*write_sums)(int dtype, void *out, const int32_t *quanta, size_t n, uint32_t base);
  void (*write_products)(int dtype, void *out, const int32_t *quanta, size_t n, double base, double num, double den);
  void (*widen)(int32_t *to, const int16_t *from, size_t n, int32_t origin);
  void (*add_shorts)(uint16_t *to, const int16_t *from, size_t n, uint32_t base);
#ifdef TWZ_ENCODER
  rapid_encoder encode_lattice;
  void (*fit_errors)(const double *values, int64_t n, int64_t step, const double *weights, int32_t n_sets, double whole, double unit,
                     double *errors);
  void (*fit_products)(const double *values, int64_t n, int64_t step, const double *roots, double unit, double *products);
#endif
} row_kernels;

extern const row_kernels kernels_baseline;
#ifdef TWZ_HAVE_X86
extern const row_kernels kernels_avx2, kernels_avx512;
#endif

/* What was asked for, or the best; NULL: this processor or build has it not. */
const row_kernels *find_kernels(twz_kernels kind);

#endif
