#define ISA(name) name##_baseline
#include "rapid_unit.h"
#include "heights_rows.h"
#include "mask_rows.h"
#ifdef TWZ_ENCODER
#include "encode_fit_rows.h"
#include "encode_rows.h"
#define ENCODER , ISA(encode_lattice), ISA(fit_errors), ISA(fit_products)
#else
#define ENCODER
#endif

const row_kernels kernels_baseline = {
    TWZ_KERNELS_BASELINE, ISA(decode_rapid), ISA(decode_mask),
    ISA(write_sums), ISA(write_products), ISA(widen), ISA(add_shorts) ENCODER};
