/* twz: look into .twz files, and decode them to raw numbers. SPDX-License-Identifier: MIT */
#define _FILE_OFFSET_BITS 64
#if !defined(_WIN32)
#define _POSIX_C_SOURCE 200809L /* fseeko */
#endif
#include <errno.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "terrainwave.h"

#if defined(_WIN32)
#include <fcntl.h>
#include <io.h>
#define seek _fseeki64
#define tell _ftelli64
#else
#define seek fseeko
#define tell ftello
#endif

static const char USAGE[] =
    "usage: twz COMMAND FILE [OPTIONS]\n"
    "\n"
    "  twz info FILE      what a file says of itself\n"
    "      --json         the same as one line of JSON\n"
    "  twz dump FILE      heights of a level to stdout, row by row, as the numbers of the file's dtype\n"
    "                     in the byte order of this machine; void samples hold nodata, else NaN, else 0\n"
    "      --level N      0 is the coarsest, -1 (which is meant otherwise) the full grid\n"
    "      --window R,C,ROWS,COLS   of the level: from row R and column C on, cut to the level with a note\n"
    "      --mask         instead of heights one byte for each sample: 1 valid, 0 void\n"
    "      --own          one byte for each sample: 1 if the original has one at this very place\n"
    "      --blocks       four int64 for each block of the level, in Morton order, in quanta: lowest and\n"
    "                     highest height, error of the block, error of its mesh\n"
    "  twz check FILE     read all bytes, decode all heights and compare those that blocks share; silent if the\n"
    "                     file is sound. Of meshes only the checksums are compared, as a note then says\n"
    "  twz root FILE      decode all heights and print their root: 64 digits that stand for them and for where\n"
    "                     they lie (FORMAT 4.9), to be compared with a published one\n"
    "\n"
    "  --threads N        decode on N threads; 0: as many as there are processors; 1 otherwise\n"
    "  --kernels NAME     auto, baseline, avx2 or avx512: which instructions to use; the heights are the same\n"
    "  twz --version, twz --help\n"
    "\n"
    "Exit status: 0 good; 1 the file is bad, or cannot be read or written; 2 wrong usage.\n";

typedef struct options {
  const char *command, *path;
  int level, is_json, has_window;
  enum { HEIGHTS, MASK, OWN, BLOCKS } what;
  twz_box window;
  size_t n_threads;
  twz_kernels kernels;
} options;

/* ---- Arguments ---- */

static int misused(const char *what, const char *argument) {
  fprintf(stderr, "twz: %s: %s\nRun: twz --help\n", what, argument);
  return 2;
}

static int read_number(const char *text, long long low, long long high, long long *number) {
  char *end;
  errno = 0;
  *number = strtoll(text, &end, 10);
  return *text && !*end && !errno && *number >= low && *number <= high;
}

static int read_window(const char *text, twz_box *box) {
  char copy[80];
  uint32_t *fields[4] = {&box->row, &box->col, &box->n_rows, &box->n_cols};
  if (strlen(text) >= sizeof copy) return 0;
  memcpy(copy, text, strlen(text) + 1);
  char *at = copy;
  for (int i = 0; i < 4; i++) {
    char *comma = strchr(at, ',');
    long long number;
    if ((comma != NULL) != (i < 3)) return 0;
    if (comma) *comma = 0;
    if (!read_number(at, 0, UINT32_MAX, &number)) return 0;
    *fields[i] = (uint32_t)number;
    if (comma) at = comma + 1;
  }
  return 1;
}

static int read_kernels(const char *name, twz_kernels *kernels) {
  static const char *const NAMES[] = {"auto", "baseline", "avx2", "avx512"};
  for (int i = 0; i < 4; i++) {
    if (strcmp(name, NAMES[i]) != 0) continue;
    *kernels = (twz_kernels)i;
    return 1;
  }
  return 0;
}

/* Returns 0, or the exit status. */
static int read_arguments(int n, char **arguments, options *o) {
  memset(o, 0, sizeof *o);
  o->level = -1;
  o->n_threads = 1;
  for (int i = 1; i < n; i++) {
    const char *name = arguments[i], *value = i + 1 < n ? arguments[i + 1] : NULL;
    long long number;
    if (strcmp(name, "--json") == 0) {
      o->is_json = 1;
    } else if (strcmp(name, "--mask") == 0) {
      o->what = MASK;
    } else if (strcmp(name, "--own") == 0) {
      o->what = OWN;
    } else if (strcmp(name, "--blocks") == 0) {
      o->what = BLOCKS;
    } else if (strncmp(name, "--", 2) == 0) {
      if (!value) return misused("unknown option, or one without its value", name);
      i++;
      if (strcmp(name, "--level") == 0) {
        if (!read_number(value, -99, 99, &number)) return misused("a level is a whole number, found", value);
        o->level = (int)number;
      } else if (strcmp(name, "--window") == 0) {
        if (!read_window(value, &o->window)) return misused("a window is ROW,COLUMN,ROWS,COLUMNS, found", value);
        o->has_window = 1;
      } else if (strcmp(name, "--threads") == 0) {
        if (!read_number(value, 0, 1024, &number)) return misused("threads are 0 to 1024, found", value);
        o->n_threads = (size_t)number;
      } else if (strcmp(name, "--kernels") == 0) {
        if (!read_kernels(value, &o->kernels)) return misused("kernels are auto, baseline, avx2 or avx512, found", value);
      } else {
        return misused("unknown option", name);
      }
    } else if (!o->command) {
      o->command = name;
    } else if (!o->path) {
      o->path = name;
    } else {
      return misused("more than one file", name);
    }
  }
  return o->command && o->path ? 0 : misused("a command and a file are needed", o->command ? o->command : "none given");
}

/* ---- Reading ---- */

static int fetch(void *source, size_t n, const twz_range *ranges, void *const *buffers) {
  FILE *file = source;
  for (size_t i = 0; i < n; i++) {
    if (seek(file, (long long)ranges[i].offset, SEEK_SET) != 0) return 1;
    if (fread(buffers[i], 1, (size_t)ranges[i].length, file) != ranges[i].length) return 1;
  }
  return 0;
}

typedef struct session {
  const options *options;
  FILE *source;
  twz_file *file;
  twz_pool *pool;
  twz_error error;
} session;

static int failed(const session *s) {
  static const char *const NAMES[] = {"good", "corrupt", "unsupported", "too large", "no memory",
                                      "bad argument", "not ready", "not readable"};
  fprintf(stderr, "twz: %s: %s: %s\n", s->options->path, NAMES[s->error.status], s->error.text);
  return s->error.status == TWZ_BAD_ARGUMENT ? 2 : 1;
}

static int broken(const session *s, const char *what) {
  fprintf(stderr, "twz: %s: %s%s%s\n", s->options->path, what, errno ? ": " : "", errno ? strerror(errno) : "");
  return 1;
}

static int open_session(session *s) {
  const options *o = s->options;
  errno = 0;
  s->source = fopen(o->path, "rb");
  if (!s->source || seek(s->source, 0, SEEK_END) != 0) return broken(s, "cannot be opened");
  long long size = tell(s->source);
  if (size < 0) return broken(s, "has no size");
  twz_options given = TWZ_OPTIONS;
  given.kernels = o->kernels;
  if (o->n_threads != 1 && twz_pool_new(o->n_threads, &s->pool, &s->error) != TWZ_OK) return failed(s);
  if (twz_file_new(&given, (uint64_t)size, &s->file, &s->error) != TWZ_OK) return failed(s);
  if (twz_file_load(s->file, fetch, s->source, &s->error) != TWZ_OK) return failed(s);
  return 0;
}

static void close_session(session *s) {
  twz_file_free(s->file);
  twz_pool_free(s->pool);
  if (s->source) fclose(s->source);
}

/* A decoded window, or NULL. */
static twz_window *decoded(session *s, int level, const twz_box *box, int is_read) {
  twz_window *w;
  if (twz_window_new(s->file, level, box, &w, &s->error) != TWZ_OK) return NULL;
  twz_status status = twz_window_load(w, fetch, s->source, &s->error);
  const twz_workers *workers = s->pool ? twz_pool_workers(s->pool) : NULL;
  if (status == TWZ_OK && is_read) status = twz_window_decode(w, workers, &s->error);
  if (status == TWZ_OK) return w;
  twz_window_free(w);
  return NULL;
}

/* ---- info ---- */

/* Do terminals obey a character: control characters, also those of 8 bits, and what turns or hides text? */
static int is_control(uint32_t code) {
  return code < 0x20 || (code >= 0x7F && code < 0xA0) || code == 0x61C || (code >= 0x200B && code <= 0x200F) ||
         (code >= 0x2028 && code <= 0x202E) || (code >= 0x2060 && code <= 0x206F) || code == 0xFEFF;
}

/* The bytes of a character of text, which is UTF-8, and its number. */
static int next_character(const char *text, uint32_t *code) {
  unsigned char first = (unsigned char)*text;
  int n = first < 0x80 ? 1 : first < 0xE0 ? 2 : first < 0xF0 ? 3 : 4;
  *code = n == 1 ? first : first & (0x7Fu >> n);
  for (int i = 1; i < n; i++) *code = *code << 6 | ((unsigned char)text[i] & 63);
  return n;
}

/* Text by anyone, filled up to `width` characters. */
static void print_plain(const char *text, int width) {
  for (uint32_t code; *text; width--) {
    int n = next_character(text, &code);
    printf("%.*s", is_control(code) ? 1 : n, is_control(code) ? " " : text);
    text += n;
  }
  if (width > 0) printf("%*s", width, "");
}

static void print_text(const char *name, const char *text) {
  if (!text) return;
  print_plain(name, 16);
  print_plain(text, 0);
  putchar('\n');
}

static int print_json(const twz_info *i) {
  printf("{\"rows\": %" PRIu32 ", \"cols\": %" PRIu32 ", \"levels\": %d, \"dtype\": \"%s\", \"method\": \"%s\", ", i->n_rows,
         i->n_cols, i->n_levels, i->dtype_name, i->method_name);
  printf("\"max_error\": %.17g, \"effective_bound\": %.17g, \"features\": %" PRIu32 ", \"metadata\": ", i->max_error,
         i->effective_bound, i->features);
  /* White space lies between tokens, other control characters in strings. */
  uint32_t code;
  for (const char *c = i->metadata; *c; c += next_character(c, &code)) {
    int n = next_character(c, &code);
    if (!is_control(code)) {
      printf("%.*s", n, c);
    } else if (code < 0x20) {
      putchar(' ');
    } else {
      printf("\\u%04" PRIx32, code);
    }
  }
  printf("}\n");
  return 0;
}

static int info(session *s) {
  const twz_info *i = twz_file_info(s->file);
  if (s->options->is_json) return print_json(i);
  printf("%-16s%" PRIu32 " rows x %" PRIu32 " columns of %s\n", "heights", i->n_rows, i->n_cols, i->dtype_name);
  printf("%-16s%d, the coarsest with ", "levels", i->n_levels);
  twz_level level;
  if (twz_file_level(s->file, 0, &level, &s->error) != TWZ_OK) return failed(s);
  printf("%" PRIu32 " x %" PRIu32 "\n", level.n_rows, level.n_cols);
  printf("%-16s%s, blocks of %" PRIu32 " cells, meshes: %s\n", "method", i->method_name, i->block_size, i->mesh_name);
  printf("%-16s%.17g asked for, %.17g holds\n", "error", i->max_error, i->effective_bound);
  if (i->has_valid) printf("%-16s%.17g to %.17g raw\n", "range", i->raw_min, i->raw_max);
  if (i->has_scale || i->has_offset) printf("%-16s%.17g, %.17g\n", "scale, offset", i->scale, i->offset);
  print_text("units", i->units);
  static const char *const VOIDS[] = {"none", "a number", "NaN", "a mask of its own"};
  printf("%-16stold by %s\n", "voids", VOIDS[i->mask_kind]);
  if (i->has_nodata) printf("%-16s%.17g\n", "nodata", i->nodata);
  if (i->has_transform) {
    const double *t = i->transform;
    printf("%-16s%.17g %.17g %.17g %.17g %.17g %.17g\n", "transform", t[0], t[1], t[2], t[3], t[4], t[5]);
  }
  print_text("crs", i->crs);
  if (i->bound_side) print_text("bound", i->bound_side > 0 ? "above" : "below");
  if (i->is_point >= 0) print_text("area or point", i->is_point ? "Point" : "Area");
  print_text("description", i->description);
  for (int band = 0; band < 2; band++) {
    const char *key, *value;
    for (size_t k = 0; twz_file_tag(s->file, band, k, &key, &value); k++) {
      printf("%-16s", band ? "band tag" : "tag");
      print_text(key, value);
    }
  }
  print_text("software", i->software);
  printf("%-16s%" PRIu64 " bytes\n", "size", i->file_size);
  return 0;
}

/* ---- dump, check ---- */

/* Morton order: the bits of row and column, the row's above the column's. */
static void from_morton(uint64_t number, uint32_t *row, uint32_t *col) {
  *row = *col = 0;
  for (int i = 0; i < 32; i++) {
    *col |= (uint32_t)(number >> (2 * i) & 1) << i;
    *row |= (uint32_t)(number >> (2 * i + 1) & 1) << i;
  }
}

static int dump_blocks(session *s) {
  twz_window *w = decoded(s, s->options->level, NULL, 0);
  if (!w) return failed(s);
  twz_level level;
  twz_file_level(s->file, s->options->level, &level, &s->error);
  uint32_t size = twz_file_info(s->file)->block_size, side = 1;
  while ((uint64_t)side * size < (level.n_rows > level.n_cols ? level.n_rows : level.n_cols)) side *= 2;
  int status = 0;
  for (uint64_t i = 0; status == 0 && i < (uint64_t)side * side; i++) {
    uint32_t row, col;
    from_morton(i, &row, &col);
    twz_block block;
    twz_status found = twz_window_block(w, row, col, &block, &s->error);
    if (found == TWZ_BAD_ARGUMENT) continue; /* past the edge */
    if (found != TWZ_OK) status = failed(s);
    int64_t numbers[4] = {block.z_min, block.z_max, (int64_t)block.error, (int64_t)block.mesh_error};
    if (status == 0 && fwrite(numbers, 8, 4, stdout) != 4) status = broken(s, "stdout cannot be written");
  }
  twz_window_free(w);
  return status;
}

/* Cut a window to its level, with a note; one that lies outside of it is left for the library to refuse. */
static void cut(twz_box *box, const twz_level *level) {
  if (box->row >= level->n_rows || box->col >= level->n_cols) return;
  uint32_t n_rows = level->n_rows - box->row, n_cols = level->n_cols - box->col;
  if (box->n_rows <= n_rows && box->n_cols <= n_cols) return;
  if (box->n_rows > n_rows) box->n_rows = n_rows;
  if (box->n_cols > n_cols) box->n_cols = n_cols;
  fprintf(stderr,
          "twz: note: the window reaches beyond the level's %u x %u samples: what lies inside it is taken,"
          " %u x %u samples from row %u, column %u on\n",
          level->n_rows, level->n_cols, box->n_rows, box->n_cols, box->row, box->col);
}

/* Write a level, or a window of it, in strips of whole units. */
static int dump_samples(session *s) {
  const options *o = s->options;
  const twz_info *i = twz_file_info(s->file);
  twz_level level;
  if (twz_file_level(s->file, o->level, &level, &s->error) != TWZ_OK) return failed(s);
  twz_box box = {0, 0, level.n_rows, level.n_cols};
  if (o->has_window) {
    box = o->window;
    cut(&box, &level);
  }
  size_t width = o->what == HEIGHTS ? i->dtype_bytes : 1;
  uint32_t strip = 2 * i->block_size, row = box.row, stop = box.row + box.n_rows;
  if (box.n_rows == 0 || stop < row) stop = row + 1, box.n_rows = 0; /* let the library say so */
  uint8_t *buffer = NULL;
  size_t n_buffer = 0;
  int status = 0;
  while (row < stop && status == 0) {
    uint32_t next = (row / strip + 1) * strip;
    if (next > stop || next < row) next = stop;
    twz_box part = {row, box.col, box.n_rows ? next - row : 0, box.n_cols};
    twz_window *w = decoded(s, o->level, &part, 1);
    size_t n = (size_t)part.n_rows * part.n_cols * width;
    if (w && n > n_buffer) {
      free(buffer);
      buffer = malloc(n);
      n_buffer = buffer ? n : 0;
    }
    if (!w) {
      status = failed(s);
    } else if (!buffer) {
      status = broken(s, "no memory for a strip of the raster");
    } else {
      twz_status read = o->what == OWN ? twz_window_read_own(w, buffer, 0, &s->error)
                                       : twz_window_read(w, o->what == HEIGHTS ? buffer : NULL, 0,
                                                         o->what == MASK ? buffer : NULL, 0, &s->error);
      if (read != TWZ_OK) {
        status = failed(s);
      } else if (fwrite(buffer, 1, n, stdout) != n) {
        status = broken(s, "stdout cannot be written");
      }
    }
    twz_window_free(w);
    row = next;
  }
  free(buffer);
  return status;
}

static int dump(session *s) {
#if defined(_WIN32)
  _setmode(_fileno(stdout), _O_BINARY);
#endif
  int status = s->options->what == BLOCKS ? dump_blocks(s) : dump_samples(s);
  errno = 0;
  if (status == 0 && fflush(stdout) != 0) status = broken(s, "stdout cannot be written");
  return status;
}

static int check(session *s) {
  const char *mesh = twz_file_info(s->file)->mesh_name;
  const twz_workers *workers = s->pool ? twz_pool_workers(s->pool) : NULL;
  if (twz_file_check(s->file, fetch, s->source, workers, &s->error) != TWZ_OK) return failed(s);
  if (strcmp(mesh, "none") != 0) {
    fprintf(stderr, "twz: note: %s: meshes (%s) were not checked, only their checksums; terrainwave verify --mesh does that\n",
            s->options->path, mesh);
  }
  return 0;
}

static int root(session *s) {
  char digits[TWZ_ROOT_SIZE];
  const twz_workers *workers = s->pool ? twz_pool_workers(s->pool) : NULL;
  if (twz_file_root(s->file, fetch, s->source, workers, digits, &s->error) != TWZ_OK) return failed(s);
  puts(digits);
  errno = 0;
  return fflush(stdout) == 0 ? 0 : broken(s, "stdout cannot be written");
}

int main(int n, char **arguments) {
  if (n == 2 && strcmp(arguments[1], "--help") == 0) {
    fputs(USAGE, stdout);
    return 0;
  }
  if (n == 2 && strcmp(arguments[1], "--version") == 0) {
    puts("twz " TWZ_VERSION);
    return 0;
  }
  options o;
  int status = read_arguments(n, arguments, &o);
  if (status) return status;
  static const struct { const char *name; int (*run)(session *); } COMMANDS[] = {
      {"info", info}, {"dump", dump}, {"check", check}, {"root", root}};
  session s;
  memset(&s, 0, sizeof s);
  s.options = &o;
  for (int i = 0; i < 4; i++) {
    if (strcmp(o.command, COMMANDS[i].name) != 0) continue;
    status = open_session(&s);
    if (status == 0) status = COMMANDS[i].run(&s);
    close_session(&s);
    return status;
  }
  return misused("unknown command", o.command);
}
