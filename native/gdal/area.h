/* Heights of a part of what a dataset shows: a level's samples, or averages. SPDX-License-Identifier: MIT */
#ifndef TWZ_GDAL_AREA_H
#define TWZ_GDAL_AREA_H

#include <cstddef>
#include <memory>
#include <vector>

#include "source.h"

namespace twz {

/* What a dataset shows: the samples of a level, or, where stride is not 0, averages of them. */
struct Grid {
  int level;       /* from 0, the coarsest, on */
  uint32_t stride; /* pixels of the full grid from one sample of the level to the next */
  uint32_t n_rows, n_cols;
};

/*
 * A part of a grid, decoded when it is made. Ask IsGood first: what went wrong has been told. Given `heights`, of the
 * finest level, these are filled at once, and there is nothing to copy.
 */
class Area {
 public:
  Area(const SharedFile &file, VSILFILE *handle, const Grid &grid, const twz_box &box, int n_threads,
       void *heights = nullptr, ptrdiff_t heights_stride = 0);

  bool IsGood() const { return is_good_; }

  /*
   * Copy heights, or validity (1 or 0), or both, of a part; rows are `stride` bytes apart. Samples of coarse levels
   * that fill a void of the full grid are void where the file tells them, as Terrain.read has it.
   */
  bool Copy(const twz_box &part, void *heights, ptrdiff_t heights_stride, uint8_t *valid, ptrdiff_t valid_stride);

 private:
  struct Free {
    void operator()(twz_window *window) const { twz_window_free(window); }
  };
  bool Decode(VSILFILE *handle, int n_threads, void *heights, ptrdiff_t heights_stride);
  bool CopySamples(const twz_box &part, void *heights, ptrdiff_t heights_stride, uint8_t *valid,
                   ptrdiff_t valid_stride);
  bool Fail(const twz_error &error) const;

  const SharedFile &file_;
  const Grid grid_;
  twz_box source_; /* of the level */
  std::unique_ptr<twz_window, Free> window_;
  std::vector<uint8_t> own_;                /* where the file tells fills */
  std::vector<uint8_t> samples_, is_valid_; /* what averages are made of */
  bool is_good_ = false;
};

/* What void samples of a file hold: its nodata value, else NaN, else 0. */
double VoidOf(const twz_info &info);

}  // namespace twz
#endif
