/* Metadata (FORMAT §4.2) and what twz_info says. */
#include <math.h>

#include "internal.h"
#include "tables.h"

enum { MOST_METADATA = 1 << 20 };

#define WRONG(error, key, what) twz_fail(error, TWZ_CORRUPT, "metadata: %s is not %s", key, what)

static twz_status take_string(const json_value *root, const char *key, const char **out, twz_error *error) {
  const json_value *v = json_member(root, key);
  if (v && v->kind != JSON_STRING) return WRONG(error, key, "a string");
  *out = v ? v->string : NULL;
  return TWZ_OK;
}

/* A number; whole ones lie within 2^64. */
static int is_number(const json_value *v) { return v->kind == JSON_NUMBER && !v->is_beyond_u64; }

static twz_status take_number(const json_value *root, const char *key, double *out, int *has, twz_error *error) {
  const json_value *v = json_member(root, key);
  if (v && !is_number(v)) return WRONG(error, key, "a number within 2^64");
  *has = v != NULL;
  if (v) *out = json_number(v);
  return TWZ_OK;
}

static twz_status take_word(const json_value *root, const char *key, const char *const *words, int n, int missing,
                            int *out, twz_error *error) {
  const json_value *v = json_member(root, key);
  *out = missing;
  if (!v) return TWZ_OK;
  for (int i = 0; v->kind == JSON_STRING && i < n; i++) {
    if (strcmp(v->string, words[i]) == 0) {
      *out = i;
      return TWZ_OK;
    }
  }
  return WRONG(error, key, "one of the words the format has for it");
}

/* On which side of originals heights lie; other words than the format's mean both. */
static int side_of(const json_value *root) {
  const json_value *v = json_member(root, "bound");
  if (!v || v->kind != JSON_STRING) return 0;
  return strcmp(v->string, "above") == 0 ? 1 : strcmp(v->string, "below") == 0 ? -1 : 0;
}

static twz_status take_tags(twz_file *f, int band, twz_error *error) {
  const char *key = band ? "band_tags" : "tags";
  const json_value *v = json_member(f->json.root, key);
  if (!v) return TWZ_OK;
  if (v->kind != JSON_OBJECT) return WRONG(error, key, "an object of strings");
  size_t n = 0;
  for (const json_value *m = v->first; m; m = m->next, n++) {
    if (m->kind != JSON_STRING) return WRONG(error, key, "an object of strings");
  }
  f->tags[band] = twz_allocate(&f->allocator, n * sizeof *f->tags[band]);
  if (!f->tags[band]) return twz_no_memory(error, n * sizeof *f->tags[band]);
  for (const json_value *m = v->first; m; m = m->next) f->tags[band][f->n_tags[band]++] = m;
  return TWZ_OK;
}

static twz_status take_nodata(const json_value *root, int dtype, double *nodata, int *has, twz_error *error) {
  const json_value *v = json_member(root, "nodata");
  *has = v != NULL;
  *nodata = NAN;
  if (!v) return TWZ_OK;
  int is_float = dtype_is_float(dtype);
  if (v->kind == JSON_STRING) {
    int is_nan = strcmp(v->string, "nan") == 0, is_up = strcmp(v->string, "inf") == 0;
    if (!is_float || !(is_nan || is_up || strcmp(v->string, "-inf") == 0)) {
      return WRONG(error, "nodata", "a number of the dtype");
    }
    *nodata = is_nan ? NAN : is_up ? HUGE_VAL : -HUGE_VAL;
    return TWZ_OK;
  }
  if (!is_number(v)) return WRONG(error, "nodata", "a number of the dtype");
  *nodata = json_number(v);
  if (is_float) {
    /* Half way from the greatest float32 to 2^128: from here on it rounds to infinity. */
    if (dtype == TWZ_FLOAT32 && abs_double(*nodata) >= 340282356779733661637539395458142568448.0) {
      return WRONG(error, "nodata", "a finite number of float32");
    }
    return TWZ_OK;
  }
  int64_t low, high;
  dtype_range(dtype, &low, &high);
  if (!(*nodata >= (double)low && *nodata <= (double)high) || *nodata != (double)(int64_t)*nodata) {
    return WRONG(error, "nodata", "a whole number within the range of the dtype");
  }
  return TWZ_OK;
}

static twz_status take_transform(const json_value *root, twz_info *info, twz_error *error) {
  static const double UNIT[6] = {1, 0, 0, 0, 1, 0};
  memcpy(info->transform, UNIT, sizeof UNIT);
  const json_value *v = json_member(root, "transform");
  info->has_transform = v != NULL;
  if (!v) return TWZ_OK;
  int n = 0;
  if (v->kind != JSON_ARRAY) return WRONG(error, "transform", "six numbers");
  for (const json_value *m = v->first; m; m = m->next, n++) {
    if (n >= 6 || !is_number(m)) return WRONG(error, "transform", "six numbers");
    info->transform[n] = json_number(m);
  }
  return n == 6 ? TWZ_OK : WRONG(error, "transform", "six numbers");
}

static twz_status take_all(twz_file *f, double *nodata, twz_error *error) {
  const json_value *root = f->json.root;
  twz_info *info = &f->info;
  TRY(take_string(root, "crs", &info->crs, error));
  TRY(take_string(root, "units", &info->units, error));
  TRY(take_string(root, "description", &info->description, error));
  TRY(take_string(root, "color_interpretation", &info->color_interpretation, error));
  TRY(take_string(root, "software", &info->software, error));
  info->scale = 1;
  TRY(take_number(root, "scale", &info->scale, &info->has_scale, error));
  if (info->scale == 0) return WRONG(error, "scale", "different from 0");
  TRY(take_number(root, "offset", &info->offset, &info->has_offset, error));
  TRY(take_transform(root, info, error));
  static const char *const MASKS[] = {"none", "nodata", "nan", "mask"}, *const AREAS[] = {"Area", "Point"};
  int mask;
  TRY(take_word(root, "mask_kind", MASKS, 4, 0, &mask, error));
  info->mask_kind = (twz_mask_kind)mask;
  TRY(take_word(root, "area_or_point", AREAS, 2, -1, &info->is_point, error));
  info->bound_side = side_of(root);
  for (int band = 0; band < 2; band++) TRY(take_tags(f, band, error));
  const json_value *moved = json_member(root, "moved");
  double n_moved = moved && moved->kind == JSON_NUMBER ? json_number(moved) : -1;
  if (moved && !(n_moved >= 0 && n_moved <= 2147483648.0 && n_moved == (double)(int64_t)n_moved)) {
    return WRONG(error, "moved", "a whole number of quanta from 0 to 2^31");
  }
  return take_nodata(root, f->header.dtype, nodata, &info->has_nodata, error);
}

static void fill_info(twz_file *f) {
  static const char *const METHODS[] = {"store", "cdf97", "predictive", "cdf53", "rapid"};
  static const char *const MESHES[] = {"none",           "halves",         "zerotree-plain", "rqt",
                                       "zerotree-layer", "zerotree-coded", "rqt-coefficient"};
  static const char *const DTYPES[] = {"", "uint8", "", "uint16", "int16", "", "int32", "float32", "float64"};
  const header *h = &f->header;
  twz_info *info = &f->info;
  info->n_rows = h->n_rows;
  info->n_cols = h->n_cols;
  info->n_levels = f->grid.k_max + 1;
  info->block_size = 1u << h->block_log2;
  info->dtype = (twz_dtype)h->dtype;
  info->dtype_bytes = dtype_size(h->dtype);
  info->dtype_name = DTYPES[h->dtype];
  info->method = (twz_method)h->method;
  info->method_name = METHODS[h->method];
  info->mesh_name = MESHES[h->mesh];
  info->features = h->features;
  info->max_error = h->max_error * abs_double(info->scale);
  info->effective_bound = h->effective_bound * abs_double(info->scale);
  info->has_valid = h->z_min <= h->z_max;
  if (info->has_valid) {
    info->raw_min = raw_of_quantum(&f->heights, h->z_min);
    info->raw_max = raw_of_quantum(&f->heights, h->z_max);
  }
  info->raw_rho = h->rho;
  info->quantum = (double)h->quantum_num / (double)h->quantum_den;
  info->step = (uint32_t)h->step;
  info->file_size = h->file_size;
  info->nodata = info->has_nodata ? f->heights.nodata : 0;
}

twz_status read_metadata(twz_file *f, const uint8_t *section, twz_error *error) {
  const header *h = &f->header;
  REQUIRE(crc_matches(&f->crc, section, h->metadata_length, h->metadata_crc), error,
          "the checksum of the metadata is wrong");
  /* A deflated byte stands for at most 1032. */
  size_t n = 0, most = min_size(MOST_METADATA, (size_t)h->metadata_length * 1032);
  uint8_t *text = twz_allocate(&f->allocator, most);
  if (!text) return twz_no_memory(error, most);
  twz_status status = inflate_raw(section, h->metadata_length, (const uint8_t *)twz_dictionary, twz_dictionary_size,
                                  text, most, &n, "the metadata", error);
  if (status == TWZ_OK) {
    f->metadata = twz_allocate(&f->allocator, n + 1);
    if (f->metadata) {
      memcpy(f->metadata, text, n);
      f->metadata[n] = 0;
    } else {
      status = twz_no_memory(error, n + 1);
    }
  }
  twz_release(&f->allocator, text);
  TRY(status);
  f->json.allocator = &f->allocator;
  TRY(json_parse(&f->json, f->metadata, n, error));
  double nodata = 0;
  TRY(take_all(f, &nodata, error));
  f->info.metadata = f->metadata;
  f->info.metadata_length = n;
  heights_init(&f->heights, f->kernels, h, f->info.has_nodata, nodata);
  fill_info(f);
  return TWZ_OK;
}

int twz_file_tag(const twz_file *file, int band, size_t i, const char **key, const char **value) {
  band = band != 0;
  if (!file->is_open || i >= file->n_tags[band]) return 0;
  *key = file->tags[band][i]->key;
  *value = file->tags[band][i]->string;
  return 1;
}
