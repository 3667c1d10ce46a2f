#define ISA(name) name##_baseline
#include "rapid_unit.h"
#include "heights_rows.h"

const row_kernels kernels_baseline = {
    TWZ_KERNELS_BASELINE, ISA(decode_rapid),
    ISA(write_sums), ISA(write_products), ISA(widen), ISA(add_shorts)};
