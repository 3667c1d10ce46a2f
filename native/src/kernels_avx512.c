#define ISA(name) name##_avx512
#include "rapid_unit.h"
#include "heights_rows.h"

const row_kernels kernels_avx512 = {
    TWZ_KERNELS_AVX512, ISA(decode_rapid),
    ISA(write_sums), ISA(write_products), ISA(widen), ISA(add_shorts)};
