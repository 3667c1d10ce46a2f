/* Lines that units share: which they are (P.3 of format-predictive.md, FORMAT §7.3). */
#ifndef TWZ_BORDER_H
#define TWZ_BORDER_H

#include "internal.h"

/* The region's lines near each shared side of an axis, of one side or two. */
typedef struct shared_lines {
  int n_sides;
  int32_t first[2], last[2];
} shared_lines;

static inline void find_shared_lines(shared_lines *l, const axis *a, int32_t rings) {
  l->n_sides = 0;
  for (int i = 0; i < 2; i++) {
    if (!a->shared[i]) continue;
    int32_t side = i ? a->core + a->n_core - 1 : a->core;
    l->first[l->n_sides] = max_i32(side - rings, 0);
    l->last[l->n_sides++] = min_i32(side + rings, a->n - 1);
  }
}

/* The parent's line at or before (after) a line of the level, counted from the first parent height. */
static inline int32_t line_above(uint32_t line, int is_after, uint32_t first, int32_t n) {
  uint32_t at = (uint32_t)(((uint64_t)line + (is_after ? 1u : 0u)) >> 1);
  return min_i32((int32_t)(at - first), n - 1);
}

/* What the four parent heights around a sample of the level predict. */
static inline int64_t corner_above(const parent *p, uint32_t row, uint32_t col) {
  int32_t top = line_above(row, 0, p->first_row, p->n_rows), bottom = line_above(row, 1, p->first_row, p->n_rows);
  int32_t left = line_above(col, 0, p->first_col, p->n_cols), right = line_above(col, 1, p->first_col, p->n_cols);
  int64_t sum = (int64_t)parent_height(p, top, left) + parent_height(p, top, right) + parent_height(p, bottom, left) +
                parent_height(p, bottom, right);
  return shift_right(sum + 2, 2);
}

/* A row (column) of the core near a side that is shared. */
typedef struct border_line {
  const axis *along;
  uint32_t number;    /* of the line on its level */
  size_t start, step; /* its first sample in the region, and how far the next one is */
  int32_t n_sums;     /* of the parent's lines before and after it, sample by sample */
} border_line;

typedef void (*corner_decoder)(void *decoding, int32_t row, int32_t col);
typedef void (*line_decoder)(void *decoding, const border_line *line);

static inline void walk_lines(const layer *out, const parent *p, const shared_lines *lines, int are_rows, int64_t *sums,
                              line_decoder decode_line, void *decoding) {
  const axis *across = are_rows ? &out->rows : &out->cols, *along = are_rows ? &out->cols : &out->rows;
  uint32_t first_across = are_rows ? p->first_row : p->first_col, first_along = are_rows ? p->first_col : p->first_row;
  int32_t n_across = are_rows ? p->n_rows : p->n_cols, n_along = are_rows ? p->n_cols : p->n_rows, done = -1;
  int32_t from = line_above(along->core_first, 0, first_along, n_along);
  size_t pitch = (size_t)out->cols.n;
  border_line l = {along, 0, 0, are_rows ? 1 : pitch, (along->n_core + 1) >> 1};
  for (int side = 0; side < lines->n_sides; side++) {
    for (int32_t line = max_i32(lines->first[side], done + 1); line <= lines->last[side]; line++) {
      l.number = across->first + (uint32_t)line;
      l.start = are_rows ? (size_t)line * pitch + (size_t)along->core : (size_t)along->core * pitch + (size_t)line;
      int32_t before = line_above(l.number, 0, first_across, n_across), after = line_above(l.number, 1, first_across, n_across);
      for (int32_t k = 0; k < l.n_sums; k++) {
        sums[k] = are_rows ? (int64_t)parent_height(p, before, from + k) + parent_height(p, after, from + k)
                           : (int64_t)parent_height(p, from + k, before) + parent_height(p, from + k, after);
      }
      decode_line(decoding, &l);
      done = line;
    }
  }
}

/* Decode the samples that units share: corners, rows, columns. `sums` are made before each line. */
static inline void walk_shared(const layer *out, const parent *p, int32_t rings, int64_t *sums, corner_decoder decode_corner,
                               line_decoder decode_line, void *decoding) {
  shared_lines rows, cols;
  find_shared_lines(&rows, &out->rows, rings);
  find_shared_lines(&cols, &out->cols, rings);
  for (int side = 0; side < rows.n_sides; side++) {
    for (int other = 0; other < cols.n_sides; other++) {
      for (int32_t r = rows.first[side]; r <= rows.last[side]; r++) {
        for (int32_t c = cols.first[other]; c <= cols.last[other]; c++) decode_corner(decoding, r, c);
      }
    }
  }
  walk_lines(out, p, &rows, 1, sums, decode_line, decoding);
  walk_lines(out, p, &cols, 0, sums, decode_line, decoding);
}

#endif
