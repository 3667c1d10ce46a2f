/*
 * terrainwave.h: read .twz, a compressed format for rasters of heights. SPDX-License-Identifier: MIT
 *
 * The library does no input or output of its own. It says which bytes of a file it needs, the caller
 * fetches them from wherever they are and feeds them, and the library decodes:
 *
 *     twz_file *file;
 *     twz_file_new(NULL, size_of_the_file, &file, &error);
 *     twz_file_load(file, fetch, source, &error);             header, metadata, index
 *     twz_window *window;
 *     twz_window_new(file, -1, NULL, &window, &error);        the whole of the finest level
 *     twz_window_load(window, fetch, source, &error);         what the window needs
 *     twz_window_decode(window, NULL, &error);
 *     twz_window_read(window, heights, 0, valid, 0, &error);  copy it out
 *     twz_window_free(window);
 *     twz_file_free(file);
 *
 * twz_file_load and twz_window_load are loops of need, fetch and feed; a caller that cannot wait (a
 * page, an event loop) writes the loop itself. A file that lies in memory, read or mapped, needs none
 * of them: twz_file_borrow. Heights at points: twz_points_new.
 *
 * Errors. Functions that can fail return a twz_status. If `error` is not NULL it gets the status and
 * one line of English that names what was found, and is meant for people. After an error of a window
 * the file and other windows can still be used; after an error of twz_file_* free the file.
 * Whatever bytes a file has, no function reads or writes outside its memory, and time and memory
 * are bounded by the size of the window that was asked for.
 *
 * Ownership. Who calls ..._new calls ..._free. Windows are freed before their file. Strings and
 * structures that getters return belong to the file, live as long as it does, and never change.
 *
 * Threads. There is no global state: different files are independent. A file and its windows are
 * used by one thread at a time, unless twz_options.locks is given; then several threads may use a
 * file at once, each with windows of its own. twz_window_decode can use threads of the caller's
 * (twz_workers); twz_pool has some for callers that have none.
 *
 * Long calls. Each can say how far it is, and be ended: by twz_workers.report where it decodes or checks,
 * by the caller's fetch where it loads.
 *
 * Binary interface. A program that was built with release 1.x runs with the library of each later
 * release 1.y, without being built again; the SONAME has the first number. For this, structures
 *   begin with their size, and may grow:  twz_options, twz_workers, twz_points_request
 *   have fields `reserved` for more:      twz_error, twz_allocator, twz_locks, twz_range, twz_level, twz_block
 *   belong to the library, and may grow:  twz_info
 *   never change:                         twz_box
 * Begin the first with their macros (`twz_workers workers = TWZ_WORKERS;`), which set the size and the
 * defaults. The library sets `reserved` of its results to 0; set those of others to 0. Numbers of
 * enumerations keep their meaning, and others may come: expect some that are not listed here.
 *
 * Words. Level 0 is the coarsest, n_levels - 1 the full grid; negative numbers count from the finest,
 * which is -1. Rows and columns are those of a level. A raw height is what the source stored;
 * the physical height is raw * scale + offset.
 */
#ifndef TERRAINWAVE_H
#define TERRAINWAVE_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(_WIN32) && defined(TWZ_SHARED)
#ifdef TWZ_BUILDING
#define TWZ_API __declspec(dllexport)
#else
#define TWZ_API __declspec(dllimport)
#endif
#elif defined(__GNUC__)
#define TWZ_API __attribute__((visibility("default")))
#else
#define TWZ_API
#endif

/* Between releases the next one's, with .dev0 behind the numbers. */
#define TWZ_VERSION "1.0.0.dev0"
#define TWZ_VERSION_MAJOR 1
#define TWZ_VERSION_MINOR 0
#define TWZ_VERSION_PATCH 0

/* The version of the library that runs, as 10000 major + 100 minor + patch. */
TWZ_API int twz_version(void);

/* ---- Status -------------------------------------------------------------------------------- */

typedef enum twz_status {
  TWZ_OK = 0,
  TWZ_CORRUPT,      /* the bytes contradict the format: fetch or make the file anew */
  TWZ_UNSUPPORTED,  /* the file uses what this release does not know: get a newer one */
  TWZ_LIMIT,        /* legal, but more than the caller allowed (twz_options.max_bytes) */
  TWZ_NO_MEMORY,    /* the allocator returned NULL */
  TWZ_BAD_ARGUMENT, /* the call is wrong: an empty window, a level that does not exist */
  TWZ_NOT_READY,    /* bytes are missing: need, fetch and feed first */
  TWZ_FETCH_FAILED, /* the caller's fetch returned nonzero */
  TWZ_CANCELLED     /* the caller's report returned nonzero */
} twz_status;

typedef struct twz_error {
  twz_status status;
  char text[240]; /* UTF-8, one line, ends with a NUL */
  uint64_t reserved[2];
} twz_error;

/* ---- Options ------------------------------------------------------------------------------- */

/* All memory comes from here; NULL functions stand for malloc and free. `allocate` returns memory
 * aligned as malloc's, or NULL. Several threads may call both at once if workers decode. */
typedef struct twz_allocator {
  void *context;
  void *(*allocate)(void *context, size_t n_bytes);
  void (*release)(void *context, void *memory);
  void *reserved[2];
} twz_allocator;

/* A lock that the caller made, held for short times (no decoding, no fetching inside). */
typedef struct twz_locks {
  void *context;
  void (*lock)(void *context);
  void (*unlock)(void *context);
  void *reserved[2];
} twz_locks;

/* Instructions that kernels may use. Each decodes to the same heights. */
typedef enum twz_kernels {
  TWZ_KERNELS_AUTO = 0, /* the best that this processor has */
  TWZ_KERNELS_BASELINE, /* what every processor of the target has */
  TWZ_KERNELS_AVX2,
  TWZ_KERNELS_AVX512
} twz_kernels;

typedef struct twz_options {
  size_t size;             /* sizeof(twz_options) */
  twz_allocator allocator;
  twz_locks locks;
  uint64_t cache_bytes;    /* most memory of decoded units that are kept for later windows; 0: none. Units that
                              windows use are kept besides, until these are freed */
  uint64_t max_bytes;      /* most memory of one window, decoded units and payloads; 0: no limit */
  twz_kernels kernels;     /* TWZ_BAD_ARGUMENT if this processor or this build has them not */
} twz_options;

#define TWZ_OPTIONS \
  { sizeof(twz_options), {0, 0, 0, {0, 0}}, {0, 0, 0, {0, 0}}, (uint64_t)256 << 20, (uint64_t)4 << 30, TWZ_KERNELS_AUTO }

/* ---- Fetching ------------------------------------------------------------------------------ */

/* Bytes offset ... offset + length - 1 of the file. */
typedef struct twz_range {
  uint64_t offset;
  uint64_t length;
  uint64_t is_page; /* 1: a page of the index, which tells more of what is needed; else 0 */
  uint64_t reserved;
} twz_range;

/*
 * Read n ranges into buffers[i], which hold ranges[i].length bytes each. They are in order of
 * offset and do not overlap: a source with costly requests may join those that lie close together.
 * Return 0, or anything else if any range could not be read as a whole.
 */
typedef int (*twz_fetch)(void *source, size_t n, const twz_range *ranges, void *const *buffers);

/* ---- Files --------------------------------------------------------------------------------- */

typedef struct twz_file twz_file;

/* Begin a file of file_size bytes. options may be NULL. Nothing is read yet. */
TWZ_API twz_status twz_file_new(const twz_options *options, uint64_t file_size, twz_file **file,
                                twz_error *error);
TWZ_API void twz_file_free(twz_file *file); /* NULL is allowed */

/*
 * Ask which bytes are needed to go on: writes at most `capacity` ranges and sets *n. *n = 0: the file
 * is open, and all functions below may be used. Most files take one range of 16 KiB.
 */
TWZ_API twz_status twz_file_need(twz_file *file, twz_range *ranges, size_t capacity, size_t *n,
                                 twz_error *error);
/* Give bytes offset ... offset + n - 1, any that are at hand; what is needed is copied. */
TWZ_API twz_status twz_file_feed(twz_file *file, uint64_t offset, const void *bytes, size_t n,
                                 twz_error *error);
/* Need, fetch and feed until the file is open. */
TWZ_API twz_status twz_file_load(twz_file *file, twz_fetch fetch, void *source, twz_error *error);
/*
 * Instead of these: open a file all of whose bytes lie in memory, read or mapped, and stay there unchanged until
 * twz_file_free. Its windows and points need no bytes: ..._need never asks for any, ..._load and twz_file_check do not
 * call fetch, which may be NULL. Payloads are decoded where they lie; only what a decoder may read past the end of
 * the file is copied.
 */
TWZ_API twz_status twz_file_borrow(twz_file *file, const void *bytes, twz_error *error);

/* Keep at most n_bytes of decoded units from now on, instead of twz_options.cache_bytes; what is more goes at once. */
TWZ_API void twz_file_limit_cache(twz_file *file, uint64_t n_bytes);

/* ---- What a file says of itself ------------------------------------------------------------ */

typedef enum twz_dtype { /* of raw heights, in the byte order of this machine */
  TWZ_UINT8 = 1,
  TWZ_UINT16 = 3,
  TWZ_INT16 = 4,
  TWZ_INT32 = 6,
  TWZ_FLOAT32 = 7,
  TWZ_FLOAT64 = 8
} twz_dtype;

typedef enum twz_method {
  TWZ_STORE = 0,
  TWZ_CDF97 = 1,
  TWZ_PREDICTIVE = 2,
  TWZ_CDF53 = 3,
  TWZ_RAPID = 4
} twz_method;

typedef enum twz_mask_kind { /* how the source told voids */
  TWZ_MASK_NONE = 0,         /* not at all: every sample is valid */
  TWZ_MASK_NODATA,           /* by a number */
  TWZ_MASK_NAN,              /* by NaN */
  TWZ_MASK_MASK              /* by a mask of its own: give it to readers of the raster, too */
} twz_mask_kind;

typedef struct twz_info {
  uint32_t n_rows, n_cols;  /* of the full grid, at most 2^31 each */
  int n_levels;             /* 1 ... 27 */
  uint32_t block_size;      /* cells on a side of a block; a unit of decoding has twice as many */
  twz_dtype dtype;
  size_t dtype_bytes;
  twz_method method;
  const char *dtype_name;   /* "int16" */
  const char *method_name;  /* "rapid" */
  const char *mesh_name;    /* "none", "halves", ... : this library reads no meshes */
  uint32_t features;        /* feature bits of the header */
  double max_error;         /* the bound asked for, in physical units (times |scale|) */
  double effective_bound;   /* the bound that holds for every valid sample of the full grid, in physical
                               units: |decoded - original| is not more. 0: lossless */
  int has_valid;            /* 0: every sample is void, and the next two are 0 */
  double raw_min, raw_max;  /* least and greatest valid raw height of the original, within rounding to
                               quanta (raw_rho) and the bound */
  double raw_rho;           /* header field rho, raw units */
  double quantum;           /* distance of two raw heights that can be told apart */
  uint32_t step;            /* quantizer width in quanta */
  double scale, offset;     /* physical = raw * scale + offset; 1 and 0 where the file has none */
  int has_scale, has_offset;
  double transform[6];      /* a, b, c, d, e, f of the full grid: x = a col + b row + c, y = d col + e row + f
                               of the upper left corner of the pixel whose centre is sample (row, col) */
  int has_transform;        /* 0: transform is 1, 0, 0, 0, 1, 0 */
  int has_nodata;
  double nodata;            /* what void samples hold in twz_window_read, in the dtype */
  twz_mask_kind mask_kind;
  int is_point;             /* area_or_point: 1 "Point", 0 "Area", -1 not said */
  const char *crs;          /* "AUTH:CODE" or WKT 2; NULL: not known. Strings are UTF-8 and by
                               anyone: escape them where they are shown. They end at the first NUL */
  const char *units;        /* of physical heights; NULL: not known */
  const char *description;
  const char *color_interpretation; /* GDAL's name where it is not gray */
  const char *software;
  const char *metadata;     /* all metadata, one JSON object (RFC 8259) as it stands in the file */
  size_t metadata_length;   /* bytes, without the NUL behind it */
  uint64_t file_size;
  int bound_side;           /* on which side of originals the heights of the full grid lie: 1 above (none is below its
                               original), -1 below, 0 both. Up is up for physical heights; depths go down */
} twz_info;

/* What header and metadata say; NULL while the file is not open. */
TWZ_API const twz_info *twz_file_info(const twz_file *file);

/* Tag number i, of the file (band 0) or of its band (band 1), in the file's order: 1, or 0 past the last. */
TWZ_API int twz_file_tag(const twz_file *file, int band, size_t i, const char **key,
                         const char **value);

typedef struct twz_level {
  uint32_t n_rows, n_cols; /* samples */
  double transform[6];     /* as in twz_info, of this level's samples. Sample (r, c) lies on sample
                              (r 2^j, c 2^j) of the full grid: half a pixel off GDAL's overviews */
  uint64_t reserved[2];
} twz_level;

TWZ_API twz_status twz_file_level(const twz_file *file, int level, twz_level *found, twz_error *error);

/* ---- Windows ------------------------------------------------------------------------------- */

/* Rows row ... row + n_rows - 1 and columns of a level; it lies inside the level. */
typedef struct twz_box {
  uint32_t row, col, n_rows, n_cols;
} twz_box;

typedef struct twz_window twz_window;

/* Begin a window of a level. box NULL: all of it. */
TWZ_API twz_status twz_window_new(twz_file *file, int level, const twz_box *box, twz_window **window,
                                  twz_error *error);
TWZ_API void twz_window_free(twz_window *window); /* NULL is allowed */

/* As twz_file_need, ..._feed and ..._load. Pages of the index come with the payloads whose places are known; each
 * round can ask for what the one before has told. *n = 0: the window can be decoded. */
TWZ_API twz_status twz_window_need(twz_window *window, twz_range *ranges, size_t capacity, size_t *n,
                                   twz_error *error);
TWZ_API twz_status twz_window_feed(twz_window *window, uint64_t offset, const void *bytes, size_t n,
                                   twz_error *error);
TWZ_API twz_status twz_window_load(twz_window *window, twz_fetch fetch, void *source, twz_error *error);

/*
 * The caller's threads, and whom to tell how far a long call is.
 *
 * `run` calls task(argument, index, worker) once for each index 0 ... n - 1, on whatever threads, and returns when
 * all calls have returned; `worker` tells calls apart that run at the same time: 0 ... n_workers - 1.
 *
 * `report` is called between pieces of work, on the thread that made the call: n_done of n_all are done, of units
 * that no other call decoded before, of points, or of bytes that are checked. It returns 0 to go on; anything else ends
 * the call with TWZ_CANCELLED. Then the same call goes on where it ended, if it is made again; but twz_window_decode_into
 * and twz_file_check begin anew.
 *
 *     twz_workers workers = TWZ_WORKERS;                       this thread works
 *     workers = *twz_pool_workers(pool);                       or those of a pool
 *     workers.report = report;
 */
typedef void (*twz_task)(void *argument, size_t index, size_t worker);
typedef struct twz_workers {
  size_t size;      /* sizeof(twz_workers) */
  void *context;    /* of run */
  size_t n_workers; /* at least 1; without run 1 */
  void (*run)(void *context, size_t n, twz_task task, void *argument); /* NULL: this thread works */
  void *report_context;
  int (*report)(void *report_context, uint64_t n_done, uint64_t n_all); /* NULL: nobody is told */
} twz_workers;

#define TWZ_WORKERS \
  { sizeof(twz_workers), 0, 1, 0, 0, 0 }

/* Decode all units of the window; workers NULL: on this thread. */
TWZ_API twz_status twz_window_decode(twz_window *window, const twz_workers *workers, twz_error *error);
/*
 * The same and twz_window_read in one, for a window that is read once: units that lie in it are decoded into the
 * caller's memory, and not kept. Afterwards the window can only be freed.
 */
TWZ_API twz_status twz_window_decode_into(twz_window *window, const twz_workers *workers, void *heights, ptrdiff_t heights_stride,
                                          uint8_t *valid, ptrdiff_t valid_stride, twz_error *error);

/*
 * Check all of an open file, as a verifier does (docs/FORMAT.md, 13.1): each byte belongs to one section and has the
 * right checksum, every unit decodes, units agree on the samples that they share, and heights have the digests that the
 * file states. Of meshes only the checksums are compared. The file has no windows meanwhile. workers NULL: on this thread.
 */
TWZ_API twz_status twz_file_check(twz_file *file, twz_fetch fetch, void *source, const twz_workers *workers,
                                  twz_error *error);

/*
 * The root of an open file (docs/FORMAT.md, 4.9): 64 hexadecimal digits that stand for all heights of the full grid,
 * and for where they lie. Heights have the same root however they are coded. `root` has TWZ_ROOT_SIZE bytes.
 */
#define TWZ_ROOT_SIZE 65
/* Of the heights as they decode: decodes all of them. workers NULL: on this thread. */
TWZ_API twz_status twz_file_root(twz_file *file, twz_fetch fetch, void *source, const twz_workers *workers, char *root,
                                 twz_error *error);
/* As the file's own digests say, which nothing is compared with: reads 72 bytes at most. Empty without digests. */
TWZ_API twz_status twz_file_stated_root(twz_file *file, twz_fetch fetch, void *source, char *root, twz_error *error);

/*
 * Copy raw heights, in the file's dtype and this machine's byte order, row by row; void samples hold
 * nodata, else NaN, else 0. The distance of two rows in bytes is heights_stride, 0: rows follow
 * each other. Any address and any distance will do; multiples of the dtype's size are faster. `valid` gets one byte
 * a sample, 1 valid, 0 void, rows valid_stride bytes apart. Either array may be NULL. The caller owns both. Several
 * threads may read one decoded window at once.
 */
TWZ_API twz_status twz_window_read(const twz_window *window, void *heights, ptrdiff_t heights_stride,
                                   uint8_t *valid, ptrdiff_t valid_stride, twz_error *error);
/* The same of a part of the window; rows and columns of `part` are those of the level. */
TWZ_API twz_status twz_window_read_part(const twz_window *window, const twz_box *part, void *heights,
                                        ptrdiff_t heights_stride, uint8_t *valid,
                                        ptrdiff_t valid_stride, twz_error *error);
/*
 * One byte a sample: 1 if the original has a valid sample at this very place, 0 if it is void or a
 * fill (a valid sample of a coarse level whose place is void in the full grid).
 */
TWZ_API twz_status twz_window_read_own(const twz_window *window, uint8_t *own, ptrdiff_t own_stride,
                                       twz_error *error);
/* The same of a part of the window. */
TWZ_API twz_status twz_window_read_own_part(const twz_window *window, const twz_box *part, uint8_t *own,
                                            ptrdiff_t own_stride, twz_error *error);

/* What the index says of a block: samples row * block_size ... (row + 1) * block_size of its level. */
typedef struct twz_block {
  int32_t z_min, z_max;  /* every original under the block lies in this box, in quanta */
  uint64_t error;        /* quanta: no original under the block is further from the bilinear
                            interpolation of the block's samples */
  uint64_t mesh_error;   /* quanta: likewise from the block's mesh; 0 if there is none */
  double raw_min, raw_max, raw_error; /* the same in raw units */
  uint64_t reserved[2];
} twz_block;

/* Block (row, col) of the window's level, which has samples in the window. After twz_window_load. */
TWZ_API twz_status twz_window_block(const twz_window *window, uint32_t row, uint32_t col,
                                    twz_block *block, twz_error *error);

/* ---- Points -------------------------------------------------------------------------------- */

typedef enum twz_interpolation {
  TWZ_BILINEAR = 0, /* of the four samples around a point; void if one of them is that counts */
  TWZ_NEAREST       /* the height of the nearest sample; half way, of the next row or column */
} twz_interpolation;

/* Points of a level, in any order, and where their heights go. The arrays are the caller's, until twz_points_free. */
typedef struct twz_points_request {
  size_t size;               /* sizeof(twz_points_request) */
  int level;
  twz_interpolation interpolation;
  int is_own;                /* 1: fills are void (see twz_window_read_own) */
  size_t n_points;
  const double *rows, *cols; /* fractional: sample (r, c) of the level lies at r, c */
  double *heights;           /* gets raw heights; NaN where there are none: in voids, and outside the level's samples
                                (TWZ_NEAREST: half a sample further out) */
  uint8_t *valid;            /* gets 1 where there is a height, else 0; may be NULL */
} twz_points_request;

#define TWZ_POINTS_REQUEST \
  { sizeof(twz_points_request), -1, TWZ_BILINEAR, 0, 0, 0, 0, 0, 0 }

/*
 * Heights at points. They are sorted by unit, and read some units at a time, each of which is decoded once:
 *
 *     twz_points_new(file, &request, &points, &error);
 *     twz_points_read(points, fetch, source, NULL, &error);
 *     twz_points_free(points);
 *
 * twz_points_read is a loop of need, fetch and feed, then decode, until decode sets *n_left to 0. It is as fast for
 * scattered points as reading the units that they lie in, once.
 */
typedef struct twz_points twz_points;

TWZ_API twz_status twz_points_new(twz_file *file, const twz_points_request *request, twz_points **points,
                                  twz_error *error);
TWZ_API void twz_points_free(twz_points *points); /* NULL is allowed; before twz_file_free */
/* As twz_window_need and ..._feed, of the next units. *n = 0: these can be decoded. */
TWZ_API twz_status twz_points_need(twz_points *points, twz_range *ranges, size_t capacity, size_t *n,
                                   twz_error *error);
TWZ_API twz_status twz_points_feed(twz_points *points, uint64_t offset, const void *bytes, size_t n,
                                   twz_error *error);
/* Fill the heights of the points in the next units. *n_left points are left; 0: all heights are there. */
TWZ_API twz_status twz_points_decode(twz_points *points, const twz_workers *workers, size_t *n_left,
                                     twz_error *error);
/* Fill the heights of all points. */
TWZ_API twz_status twz_points_read(twz_points *points, twz_fetch fetch, void *source, const twz_workers *workers,
                                   twz_error *error);

/* ---- A pool of threads, for callers that have none ------------------------------------------ */

typedef struct twz_pool twz_pool;

/* Start n_threads - 1 threads (the caller's works too); 0: as many as processors. One window is decoded with
 * a pool at a time. TWZ_UNSUPPORTED where the library was built without threads. */
TWZ_API twz_status twz_pool_new(size_t n_threads, twz_pool **pool, twz_error *error);
TWZ_API void twz_pool_free(twz_pool *pool); /* NULL is allowed */
TWZ_API const twz_workers *twz_pool_workers(twz_pool *pool);

#ifdef __cplusplus
}
#endif
#endif
