/*
 * Any bytes as the payload of a unit of a sound file: an error or heights, the same from all kernels.
 * libFuzzer's target. TWZ_FUZZ_FILES names the sound files, one a line; the first two bytes of an input say
 * which unit of theirs its payload is of. TWZ_FUZZ_SEEDS: a folder to write their own payloads to, as seeds.
 */
#include <stdio.h>
#include <stdlib.h>

#include "internal.h"
#include "kernels.h"

enum { MOST_UNITS = 4096 };

typedef struct target {
  twz_file *file;
  unit *unit, *above;
} target;

static twz_file *files[256];
static size_t n_files;
static target targets[MOST_UNITS];
static size_t n_targets;

static int fetch(void *source, size_t n, const twz_range *ranges, void *const *buffers) {
  for (size_t i = 0; i < n; i++) {
    if (fseek(source, (long)ranges[i].offset, SEEK_SET) != 0) return 1;
    if (fread(buffers[i], 1, (size_t)ranges[i].length, source) != ranges[i].length) return 1;
  }
  return 0;
}

static void write_seed(const char *folder, size_t number, FILE *source, const section_place *where) {
  char path[512];
  uint8_t *bytes = malloc(where->length);
  snprintf(path, sizeof path, "%s/unit-%zu", folder, number);
  FILE *seed = fopen(path, "wb");
  if (!seed || !bytes || fseek(source, (long)where->offset, SEEK_SET) != 0) exit(1);
  if (fread(bytes, 1, where->length, source) != where->length) exit(1);
  fputc((int)(number & 255), seed);
  fputc((int)(number >> 8), seed);
  fwrite(bytes, 1, where->length, seed);
  fclose(seed);
  free(bytes);
}

/* All units of a file; they stay in its cache. */
static void add_file(const char *path, const char *seeds) {
  FILE *source = fopen(path, "rb");
  twz_file *file;
  if (!source || fseek(source, 0, SEEK_END) != 0) exit(1);
  if (twz_file_new(NULL, (uint64_t)ftell(source), &file, NULL) != TWZ_OK || twz_file_load(file, fetch, source, NULL) != TWZ_OK) exit(1);
  if (n_files == 256) exit(1);
  files[n_files++] = file;
  for (int level = 0; level < file->info.n_levels; level++) {
    twz_window *window;
    if (twz_window_new(file, level, NULL, &window, NULL) != TWZ_OK || twz_window_load(window, fetch, source, NULL) != TWZ_OK ||
        twz_window_decode(window, NULL, NULL) != TWZ_OK) {
      exit(1);
    }
    twz_window_free(window);
  }
  for (size_t i = 0; i < file->segments.n_slots; i++) {
    for (entry *e = file->segments.slots[i]; e; e = e->next) {
      const segment *s = (const segment *)e;
      for (int k = 0; k < s->n_keys && n_targets < MOST_UNITS; k++) {
        unit *u = (unit *)table_find(&file->units, s->keys[k]);
        if (!u || s->payloads[k].length == 0) continue;
        target *t = &targets[n_targets];
        t->file = file;
        t->unit = u;
        t->above = s->keys[k].level < 0 ? NULL : (unit *)table_find(&file->units, parent_unit(&file->grid, s->keys[k]));
        if (seeds) write_seed(seeds, n_targets, source, &s->payloads[k]);
        n_targets++;
      }
    }
  }
  fclose(source);
}

int LLVMFuzzerInitialize(int *n, char ***arguments);
int LLVMFuzzerInitialize(int *n, char ***arguments) {
  (void)n;
  (void)arguments;
  const char *list = getenv("TWZ_FUZZ_FILES");
  char path[512];
  FILE *paths = list ? fopen(list, "r") : NULL;
  if (!paths) {
    fprintf(stderr, "TWZ_FUZZ_FILES names a text of paths, one a line\n");
    exit(1);
  }
  while (fgets(path, sizeof path, paths)) {
    path[strcspn(path, "\n")] = 0;
    add_file(path, getenv("TWZ_FUZZ_SEEDS"));
  }
  fclose(paths);
  return 0;
}

/* What follows from a status and the heights of a part. */
typedef struct found {
  twz_status status;
  uint64_t hash;
} found;

static found mix(const unit *u, twz_status status, const part *wanted) {
  found f = {status, 1469598103934665603u + (uint64_t)status};
  for (int i = 0; status == TWZ_OK && i < u->n_layers && !u->is_void; i++) {
    const layer *l = &u->layers[i];
    const part p = wanted ? *wanted : (part){0, 0, l->rows.n, l->cols.n};
    for (int32_t row = p.row; row < p.end_row; row++) {
      for (int32_t col = p.col; col < p.end_col; col++) {
        f.hash = (f.hash ^ (uint32_t)height_at(l, (size_t)row * (size_t)l->cols.n + (size_t)col)) * 1099511628211u;
      }
    }
  }
  return f;
}

/* Decode a payload, all or a part of it; mix a part's heights. Returns 0 where this processor has no such kernels. */
static int decode(const target *t, const uint8_t *payload, size_t n, twz_kernels kind, int is_part, const part *wanted, found *result) {
  static scratch work;
  twz_allocator plain = {0};
  twz_file *f = t->file;
  const row_kernels *kernels = find_kernels(kind);
  if (!kernels) return 0;
  f->kernels = kernels;
  work.allocator = &f->allocator;
  order o = {twz_allocate_zeros(&plain, sizeof(unit)), t->above, payload, n, NULL, 0};
  if (!o.unit) abort();
  o.unit->entry.at = t->unit->entry.at;
  if (is_part) o.unit->layers[0].ready = *wanted;
  twz_error error;
  twz_status status = decode_unit(f, &o, &work, &error);
  *result = mix(o.unit, status, wanted);
  unit_free(f, o.unit);
  return 1;
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n) {
  if (n < 3) return 0;
  const target *t = &targets[(bytes[0] + 256u * bytes[1]) % n_targets];
  uint8_t *payload = malloc(n - 2 + PAYLOAD_SLACK);
  if (!payload) abort();
  memcpy(payload, bytes + 2, n - 2);
  memset(payload + n - 2, 0, PAYLOAD_SLACK);
  const twz_file *f = t->file;
  found whole, some, other;
  decode(t, payload, n - 2, TWZ_KERNELS_BASELINE, 0, NULL, &whole);
  if (f->header.method == TWZ_RAPID) {
    twz_kernels kind = n & 1 ? TWZ_KERNELS_AVX2 : TWZ_KERNELS_AVX512;
    if (decode(t, payload, n - 2, kind, 0, NULL, &other) && other.hash != whole.hash) abort();
    /* A part of a unit is sound where it is as a whole, and the same; see worth_decoding of window.c. */
    if (f->heights.first > f->heights.last && t->unit->entry.at.level >= 0 && whole.status == TWZ_OK) {
      int32_t n_rows = t->unit->layers[0].rows.n, n_cols = t->unit->layers[0].cols.n;
      part wanted = {(int32_t)(n / 2 % (size_t)n_rows), (int32_t)(n / 3 % (size_t)n_cols), 0, 0};
      wanted.end_row = wanted.row + 1 + (int32_t)(n / 5 % (size_t)(n_rows - wanted.row));
      wanted.end_col = wanted.col + 1 + (int32_t)(n / 7 % (size_t)(n_cols - wanted.col));
      decode(t, payload, n - 2, TWZ_KERNELS_BASELINE, 0, &wanted, &some);
      if (decode(t, payload, n - 2, kind, 1, &wanted, &other) && other.hash != some.hash) abort();
    }
  }
  free(payload);
  return 0;
}
