/* Raw heights of the plain cases, compiled for a set of instructions: see write_plain of heights.c. */

static void ISA(write_sums)(int dtype, void *out, const int32_t *RESTRICT quanta, size_t n, uint32_t base) {
  if (dtype == TWZ_INT16 || dtype == TWZ_UINT16) {
    uint16_t *RESTRICT to = out;
    for (size_t i = 0; i < n; i++) to[i] = (uint16_t)(base + (uint32_t)quanta[i]);
  } else if (dtype == TWZ_UINT8) {
    uint8_t *RESTRICT to = out;
    for (size_t i = 0; i < n; i++) to[i] = (uint8_t)(base + (uint32_t)quanta[i]);
  } else {
    uint32_t *RESTRICT to = out;
    for (size_t i = 0; i < n; i++) to[i] = base + (uint32_t)quanta[i];
  }
}

static void ISA(write_products)(int dtype, void *out, const int32_t *RESTRICT quanta, size_t n, double base, double num, double den) {
  if (dtype == TWZ_FLOAT32) {
    float *RESTRICT to = out;
    for (size_t i = 0; i < n; i++) to[i] = (float)((base + quanta[i]) * num / den);
  } else {
    double *RESTRICT to = out;
    for (size_t i = 0; i < n; i++) to[i] = (base + quanta[i]) * num / den;
  }
}

static void ISA(widen)(int32_t *RESTRICT to, const int16_t *RESTRICT from, size_t n, int32_t origin) {
  for (size_t i = 0; i < n; i++) to[i] = from[i] + origin;
}

static void ISA(add_shorts)(uint16_t *RESTRICT to, const int16_t *RESTRICT from, size_t n, uint32_t base) {
  const uint16_t low = (uint16_t)base;
  for (size_t i = 0; i < n; i++) to[i] = (uint16_t)(low + (uint16_t)from[i]);
}
