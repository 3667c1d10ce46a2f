/* The header (FORMAT §4.1) and the grid of blocks that follows from it (§2). */
#include <math.h>

#include "internal.h"

static const uint8_t MAGIC[8] = {0x89, 0x54, 0x57, 0x5A, 0x0D, 0x0A, 0x1A, 0x0A};

size_t dtype_size(int dtype) {
  static const uint8_t SIZES[] = {[TWZ_UINT8] = 1, [TWZ_UINT16] = 2, [TWZ_INT16] = 2, [TWZ_INT32] = 4, [TWZ_FLOAT32] = 4, [TWZ_FLOAT64] = 8};
  return dtype <= TWZ_FLOAT64 ? SIZES[dtype] : 0;
}

int dtype_is_float(int dtype) { return dtype == TWZ_FLOAT32 || dtype == TWZ_FLOAT64; }

void dtype_range(int dtype, int64_t *low, int64_t *high) {
  int64_t n = dtype_is_float(dtype) ? 1 : (int64_t)1 << 8 * dtype_size(dtype); /* of its numbers */
  *low = dtype == TWZ_INT16 || dtype == TWZ_INT32 ? -n / 2 : 0;
  *high = *low + n - 1;
}

static uint64_t gcd(uint64_t a, uint64_t b) {
  while (b) {
    uint64_t rest = a % b;
    a = b;
    b = rest;
  }
  return a;
}

static double load_double(const uint8_t *p) {
  uint64_t bits = load_u64(p);
  double x;
  memcpy(&x, &bits, 8);
  return x;
}

static twz_status read_start(const uint8_t *bytes, const crc_tables *crc, twz_error *error) {
  REQUIRE(memcmp(bytes, MAGIC, 8) == 0, error, "this is no .twz file: it does not begin with the magic bytes");
  if (bytes[8] != FORMAT_VERSION) {
    /* If ours makes the checksum right, the byte is damaged: headers have checksums of their own version. */
    uint8_t first[124];
    memcpy(first, bytes, sizeof first);
    first[8] = FORMAT_VERSION;
    REQUIRE(crc32_of(crc, first, sizeof first) != load_u32(bytes + 124), error,
            "byte 8 is damaged: it says format version %d, and the checksum is that of version %d", bytes[8], FORMAT_VERSION);
    return twz_fail(error, TWZ_UNSUPPORTED, "found format version %d, expected %d%s", bytes[8], FORMAT_VERSION,
                    bytes[8] < FORMAT_VERSION ? ": made by a development build: compress the raster again"
                                              : ", which a newer release may know");
  }
  REQUIRE(load_u16(bytes + 10) >= HEADER_SIZE, error, "header_size %d, less than 128", load_u16(bytes + 10));
  REQUIRE(crc_matches(crc, bytes, 124, load_u32(bytes + 124)), error, "the header's checksum is wrong");
  return TWZ_OK;
}

static twz_status check_known(const uint8_t *bytes, twz_error *error) {
  static const char NEWER[] = "%s %u, which a newer release may know";
  uint32_t others = load_u32(bytes + 12) & ~(uint32_t)KNOWN_FEATURES;
  REQUIRE_KNOWN(others == 0, error, NEWER, "feature bits", others);
  REQUIRE_KNOWN(bytes[9] == 0, error, NEWER, "reserved byte", bytes[9]);
  REQUIRE_KNOWN(bytes[38] == 0 && bytes[39] == 0, error, NEWER, "padding", load_u16(bytes + 38));
  REQUIRE_KNOWN(bytes[37] <= 6, error, NEWER, "mesh", bytes[37]);
  REQUIRE_KNOWN(bytes[34] < N_METHODS, error, NEWER, "method", bytes[34]);
  REQUIRE_KNOWN(dtype_size(bytes[35]) != 0, error, NEWER, "dtype", bytes[35]);
  REQUIRE_KNOWN(bytes[36] <= 9, error, NEWER, "effort", bytes[36]);
  return TWZ_OK;
}

static twz_status check_sizes(const header *h, uint64_t file_size, twz_error *error) {
  REQUIRE(h->file_size < (uint64_t)1 << 63, error, "file_size of 2^63 or more");
  REQUIRE(h->n_rows >= 1 && h->n_cols >= 1 && h->n_rows <= 1u << 31 && h->n_cols <= 1u << 31, error,
          "%u rows and %u columns, not 1 to 2^31 each", h->n_rows, h->n_cols);
  REQUIRE((uint64_t)h->n_rows * h->n_cols <= (uint64_t)1 << 50, error, "%u x %u samples are more than 2^50",
          h->n_rows, h->n_cols);
  REQUIRE(h->block_log2 >= 5 && h->block_log2 <= 10, error, "block_log2 %d, not 5 to 10", h->block_log2);
  REQUIRE(h->border_rings == 1 || h->border_rings == 3, error, "border_rings %d, not 1 or 3",
          h->border_rings);
  REQUIRE((h->method != TWZ_CDF53 && h->method != TWZ_RAPID) || h->border_rings == 1, error, "border_rings 3 with this method");
  REQUIRE(h->metadata_length >= 1 && h->metadata_length <= 1u << 20, error,
          "metadata_length %u, not 1 to 2^20", h->metadata_length);
  REQUIRE(h->parameters_length <= 1u << 16, error, "parameters_length %u, more than 2^16",
          h->parameters_length);
  REQUIRE(h->top_page_length >= 1 && h->top_page_length <= 1u << 15, error,
          "top_page_length %u, not 1 to 2^15", h->top_page_length);
  uint64_t before = (uint64_t)h->header_size + h->metadata_length + h->parameters_length + h->top_page_length;
  if (h->features & DIGESTS) before += LEAST_DIGESTS;
  REQUIRE(before <= h->file_size, error, "metadata, parameters and top page go beyond file_size");
  REQUIRE(h->file_size == file_size, error, "the file has %llu bytes, its header says %llu",
          (unsigned long long)file_size, (unsigned long long)h->file_size);
  return TWZ_OK;
}

static twz_status check_numbers(const header *h, uint32_t step, uint32_t mesh_tolerance, twz_error *error) {
  const uint64_t most = ((uint64_t)1 << 63) - 1;
  REQUIRE(h->mesh != 0 || mesh_tolerance == 0, error, "a mesh_tolerance without meshes");
  REQUIRE(h->mesh != 6 || h->method == TWZ_CDF53, error, "mesh 6 with another method than cdf53");
  REQUIRE(h->quantum_num >= 1 && h->quantum_num <= most && h->quantum_den >= 1 && h->quantum_den <= most,
          error, "numbers of the quantum are not 1 to 2^63 - 1");
  REQUIRE(gcd(h->quantum_num, h->quantum_den) == 1, error, "the quantum is not in lowest terms");
  REQUIRE(h->quantum_num <= most / (magnitude_of(h->base) + ((uint64_t)1 << 31)), error, "base times quantum_num is too large");
  REQUIRE(step % 2 == 1 && step < 1u << 31, error, "step %u is not odd and below 2^31", step);
  int has_heights = -(1 << 30) <= h->z_min && h->z_min <= h->z_max && h->z_max <= 1 << 30 &&
                    (int64_t)h->z_max - h->z_min < 1 << 30;
  REQUIRE(has_heights || (h->z_min == 0 && h->z_max == -1), error, "z_min %d and z_max %d", h->z_min, h->z_max);
  REQUIRE(isfinite(h->max_error) && h->max_error >= 0, error, "max_error is not finite and at least 0");
  REQUIRE(h->effective_bound >= 0 && h->effective_bound <= h->max_error, error,
          "effective_bound is not 0 to max_error");
  REQUIRE(isfinite(h->rho) && h->rho >= 0, error, "rho is not finite and at least 0");
  return TWZ_OK;
}

static twz_status check_features(const header *h, twz_error *error) {
  int may_be_corrected = (h->method == TWZ_RAPID || h->method == TWZ_PREDICTIVE) && h->step >= 3;
  REQUIRE(!(h->features & FAITHFUL) || h->method == TWZ_CDF97, error, "a faithful file of another method than cdf97");
  REQUIRE(h->z_min <= h->z_max || (h->features & VOIDS), error, "no sample is valid, and none may be void");
  REQUIRE_KNOWN(!(h->features & CORRECTIONS) || may_be_corrected, error,
                "corrections (feature bit 3) of this method or of step 1, which a newer release may know");
  if (h->features & REMAINDERS) {
    REQUIRE(dtype_is_float(h->dtype) || h->dtype == TWZ_INT32, error, "remainders of 8 or 16 bits");
    REQUIRE(h->method != TWZ_CDF53, error, "remainders with method cdf53");
    REQUIRE(h->step == 1 && h->effective_bound == 0, error, "remainders beside a step or a bound");
  } else {
    REQUIRE(h->rho <= h->max_error, error, "rho is above max_error");
  }
  return TWZ_OK;
}

twz_status read_header(header *h, const uint8_t *bytes, uint64_t file_size, const crc_tables *crc,
                       twz_error *error) {
  TRY(read_start(bytes, crc, error));
  TRY(check_known(bytes, error));
  uint32_t step = load_u32(bytes + 64);
  h->header_size = load_u16(bytes + 10);
  h->features = load_u32(bytes + 12);
  h->file_size = load_u64(bytes + 16);
  h->n_rows = load_u32(bytes + 24);
  h->n_cols = load_u32(bytes + 28);
  h->block_log2 = bytes[32];
  h->border_rings = bytes[33];
  h->method = bytes[34];
  h->dtype = bytes[35];
  h->mesh = bytes[37];
  h->quantum_num = load_u64(bytes + 40);
  h->quantum_den = load_u64(bytes + 48);
  h->base = (int64_t)load_u64(bytes + 56);
  h->step = (int32_t)(step & 0x7FFFFFFF);
  h->z_min = (int32_t)load_u32(bytes + 68);
  h->z_max = (int32_t)load_u32(bytes + 72);
  h->metadata_length = load_u32(bytes + 76);
  h->max_error = load_double(bytes + 80);
  h->effective_bound = load_double(bytes + 88);
  h->rho = load_double(bytes + 96);
  h->metadata_crc = load_u32(bytes + 104);
  h->parameters_length = load_u32(bytes + 108);
  h->parameters_crc = load_u32(bytes + 112);
  h->top_page_length = load_u32(bytes + 116);
  TRY(check_sizes(h, file_size, error));
  TRY(check_numbers(h, step, load_u32(bytes + 120), error));
  return check_features(h, error);
}

/* §4.8: whatever their names, which no reader needs to know. */
twz_status check_optional_sections(const header *h, const uint8_t *bytes, const crc_tables *crc, twz_error *error) {
  enum { SECTION_HEAD = 12 };
  for (uint32_t at = HEADER_SIZE; at < h->header_size;) {
    REQUIRE(h->header_size - at >= SECTION_HEAD, error, "the head of an optional section is cut short");
    uint32_t name = load_u32(bytes + at), n = load_u32(bytes + at + 4), start = at + SECTION_HEAD;
    REQUIRE(n <= h->header_size - start, error, "an optional section reaches beyond the header");
    for (uint32_t other = HEADER_SIZE; other < at; other += SECTION_HEAD + load_u32(bytes + other + 4)) {
      REQUIRE(load_u32(bytes + other) != name, error, "an optional section comes twice");
    }
    REQUIRE(crc_matches(crc, bytes + start, n, load_u32(bytes + at + 8)), error,
            "the checksum of an optional section is wrong");
    at = start + n;
  }
  return TWZ_OK;
}

/* ---- Grid ---- */

/* ceil((n - 1) / 2^j) */
static uint32_t cells(uint32_t n, int j) {
  return (uint32_t)((((uint64_t)n - 1) + (((uint64_t)1 << j) - 1)) >> j);
}

void grid_init(grid *g, const header *h) {
  g->n_rows = h->n_rows;
  g->n_cols = h->n_cols;
  g->block_log2 = h->block_log2;
  g->rings = (h->border_rings - 1) / 2;
  g->has_digests = (h->features & DIGESTS) != 0;
  g->k_max = 0;
  uint32_t most = h->n_rows > h->n_cols ? h->n_rows : h->n_cols;
  while (cells(most, g->k_max) > 1u << g->block_log2) g->k_max++;
  g->tile_levels = g->first_tiles = 0;
  if (h->method == TWZ_CDF53) { /* C.2 */
    g->tile_levels = max_i32(1, 10 - g->block_log2);
    g->first_tiles = g->k_max % g->tile_levels;
  }
}

uint32_t level_size(const grid *g, uint32_t n, int level) { return ((n - 1) >> (g->k_max - level)) + 1; }

uint32_t n_blocks(const grid *g, uint32_t n, int level) {
  uint32_t size = 1u << g->block_log2, n_cells = cells(n, g->k_max - level);
  return n_cells <= size ? 1 : (n_cells + size - 1) >> g->block_log2;
}

int key_level_of(const grid *g, int level) {
  if (g->tile_levels == 0) return level - 1;
  if (level <= g->first_tiles) return -1;
  return g->first_tiles + (level - 1 - g->first_tiles) / g->tile_levels * g->tile_levels;
}

place parent_unit(const grid *g, place key) {
  place up = {key_level_of(g, key.level), 0, 0};
  if (up.level >= 0) {
    up.row = key.row >> (key.level - up.level);
    up.col = key.col >> (key.level - up.level);
  }
  return up;
}

int first_level_of(place key) { return key.level + 1; }

int last_level_of(const grid *g, place key) {
  if (g->tile_levels == 0) return key.level + 1;
  return key.level < 0 ? g->first_tiles : key.level + g->tile_levels;
}

static axis unit_axis(const grid *g, uint32_t n, uint32_t at, int key_level, int level) {
  axis a;
  uint32_t samples = level_size(g, n, level);
  /* Cells of the core: those of a block of the key's level; of the root key one block of level 0. */
  int shift = g->block_log2 + level - max_i32(key_level, 0);
  uint64_t first = (uint64_t)at << shift, last = min_u64(((uint64_t)at + 1) << shift, samples - 1);
  a.core_first = (uint32_t)first;
  a.n_core = (int32_t)(last - first + 1);
  a.shared[0] = at > 0;
  a.shared[1] = key_level >= 0 && at + 1 < n_blocks(g, n, key_level);
  uint32_t before = min_u32((uint32_t)g->rings, a.core_first);
  uint32_t after = (uint32_t)min_u64((uint64_t)g->rings, samples - 1 - last);
  a.first = a.core_first - before;
  a.core = (int32_t)before;
  a.n = a.n_core + (int32_t)before + (int32_t)after;
  return a;
}

void unit_axes(const grid *g, place key, int level, axis *rows, axis *cols) {
  *rows = unit_axis(g, g->n_rows, key.row, key.level, level);
  *cols = unit_axis(g, g->n_cols, key.col, key.level, level);
}
