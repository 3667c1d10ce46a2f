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

static uint64_t decode(const target *t, const uint8_t *payload, size_t n, twz_kernels kind) {
  static scratch work[2];
  twz_allocator plain = {0, 0, 0};
  twz_file *f = t->file;
  const row_kernels *kernels = find_kernels(kind);
  if (!kernels) return 0;
  f->kernels = kernels;
  work[0].allocator = work[1].allocator = &f->allocator;
  unit *u = twz_allocate_zeros(&plain, sizeof *u);
  if (!u) abort();
  u->entry.at = t->unit->entry.at;
  twz_error error;
  order o = {u, t->above, payload, n};
  twz_status status = decode_units(f, &o, 1, work, &error);
  uint64_t found = 1469598103934665603u + (uint64_t)status;
  for (int i = 0; status == TWZ_OK && i < u->n_layers && !u->is_void; i++) {
    const layer *l = &u->layers[i];
    size_t n_samples = (size_t)l->rows.n * (size_t)l->cols.n;
    for (size_t k = 0; k < n_samples; k++) found = (found ^ (uint32_t)l->heights[k]) * 1099511628211u;
  }
  unit_free(f, u);
  return found;
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n) {
  if (n < 3) return 0;
  const target *t = &targets[(bytes[0] + 256u * bytes[1]) % n_targets];
  uint8_t *payload = malloc(n - 2 + PAYLOAD_SLACK);
  if (!payload) abort();
  memcpy(payload, bytes + 2, n - 2);
  memset(payload + n - 2, 0, PAYLOAD_SLACK);
  uint64_t baseline = decode(t, payload, n - 2, TWZ_KERNELS_BASELINE);
  if (t->file->header.method == TWZ_RAPID) {
    uint64_t found = decode(t, payload, n - 2, baseline & 1 ? TWZ_KERNELS_AVX2 : TWZ_KERNELS_AVX512);
    if (found && found != baseline) abort();
  }
  free(payload);
  return 0;
}
