/* Copies of windows; overviews as Terrain.geotiff makes them. SPDX-License-Identifier: MIT */
#include "area.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <type_traits>

namespace twz {
namespace {

constexpr uint32_t HAS_VOIDS = 1; /* feature bit 0 */

/* Call something with a value of the type that heights have. */
template <class Function>
void WithType(twz_dtype dtype, Function function) {
  switch (dtype) {
    case TWZ_UINT8: return function(uint8_t{});
    case TWZ_UINT16: return function(uint16_t{});
    case TWZ_INT16: return function(int16_t{});
    case TWZ_INT32: return function(int32_t{});
    case TWZ_FLOAT32: return function(float{});
    case TWZ_FLOAT64: return function(double{});
  }
}

/* ---- Averages ---- */

struct Samples {
  const uint8_t *heights, *valid;
  uint32_t n_rows, n_cols;
  size_t pitch; /* samples from one row to the next */
};

struct Output {
  void *heights;
  ptrdiff_t heights_stride;
  uint8_t *valid;
  ptrdiff_t valid_stride;
};

/* A value next to the void value, towards 0. */
template <class T>
T Beside(T value) {
  if constexpr (std::is_floating_point_v<T>) {
    return std::nextafter(value, static_cast<T>(value != 0 ? 0 : 1));
  } else {
    return static_cast<T>(value > 0 ? value - 1 : value + 1);
  }
}

/*
 * Average samples 2i, 2i + 1, 2i + 2 down columns and then along rows. Samples lie `stride` pixels of the full grid
 * apart, in the middles of pixels: pixel i of the overview has its centre stride - 1/2 pixels behind sample 2i. The
 * order of sums is that of virtual_geotiff.py: the same averages to the last bit.
 */
template <class T>
void Average(const twz_info &info, uint32_t stride, const Samples &finer, uint32_t n_rows, uint32_t n_cols,
             const Output &out) {
  const double last = (0.5 - 0.5 / stride) / 2;
  const double weights[3] = {0.5 - last, 0.5, last};
  const T void_value = static_cast<T>(VoidOf(info));
  std::vector<double> sums(finer.n_cols), counts(finer.n_cols);
  for (uint32_t row = 0; row < n_rows; row++) {
    std::fill(sums.begin(), sums.end(), 0.0);
    std::fill(counts.begin(), counts.end(), 0.0);
    for (uint32_t k = 0; k < 3 && 2 * row + k < finer.n_rows; k++) {
      const size_t at = (2 * row + k) * finer.pitch;
      const T *heights = reinterpret_cast<const T *>(finer.heights) + at;
      const uint8_t *valid = finer.valid + at;
      for (uint32_t col = 0; col < finer.n_cols; col++) {
        sums[col] += weights[k] * (valid[col] ? static_cast<double>(heights[col]) : 0.0);
        counts[col] += weights[k] * valid[col];
      }
    }
    for (uint32_t col = 0; col < n_cols; col++) {
      double sum = 0, count = 0;
      for (uint32_t k = 0; k < 3 && 2 * col + k < finer.n_cols; k++) {
        sum += weights[k] * sums[2 * col + k];
        count += weights[k] * counts[2 * col + k];
      }
      if (out.valid) out.valid[static_cast<ptrdiff_t>(row) * out.valid_stride + col] = count > 0;
      if (!out.heights) continue;
      T height = void_value;
      if (count > 0) {
        const double mean = sum / count;
        height = static_cast<T>(std::is_floating_point_v<T> ? mean : std::nearbyint(mean));
        if (info.has_nodata && height == void_value) height = Beside(void_value);
      }
      char *to = static_cast<char *>(out.heights) + static_cast<ptrdiff_t>(row) * out.heights_stride;
      reinterpret_cast<T *>(to)[col] = height;
    }
  }
}

/* Samples of a level that averages of n pixels from `first` on are made of, along an axis of n_samples. */
uint32_t Finer(uint32_t first, uint32_t n, uint32_t n_samples) {
  return static_cast<uint32_t>(std::min<uint64_t>(uint64_t{2} * n + 1, n_samples - uint64_t{2} * first));
}

}  // namespace

Area::Area(const SharedFile &file, VSILFILE *handle, const Grid &grid, const twz_box &box, int n_threads, void *heights,
           ptrdiff_t heights_stride)
    : file_(file), grid_(grid), source_(box) {
  if (grid.stride) {
    twz_level level;
    twz_error error;
    if (twz_file_level(file.Get(), grid.level, &level, &error) != TWZ_OK) {
      Fail(error);
      return;
    }
    source_ = {2 * box.row, 2 * box.col, Finer(box.row, box.n_rows, level.n_rows),
               Finer(box.col, box.n_cols, level.n_cols)};
  }
  is_good_ = Decode(handle, n_threads, heights, heights_stride);
}

bool Area::Fail(const twz_error &error) const {
  SharedFile::Report(file_.Name(), error);
  return false;
}

bool Area::Decode(VSILFILE *handle, int n_threads, void *heights, ptrdiff_t heights_stride) {
  twz_error error;
  twz_window *window = nullptr;
  const twz_status begun = twz_window_new(file_.Get(), grid_.level, &source_, &window, &error);
  window_.reset(window);
  if (begun != TWZ_OK || !LoadWindow(file_, handle, window, &error) ||
      DecodeWindow(window, n_threads, heights, heights_stride, &error) != TWZ_OK) {
    return Fail(error);
  }
  if (heights) return true;
  const twz_info &info = file_.Info();
  const size_t n = static_cast<size_t>(source_.n_rows) * source_.n_cols;
  if (grid_.level != info.n_levels - 1 && (info.features & HAS_VOIDS)) {
    own_.resize(n);
    if (twz_window_read_own(window, own_.data(), 0, &error) != TWZ_OK) return Fail(error);
  }
  if (!grid_.stride) return true;
  samples_.resize(n * info.dtype_bytes);
  is_valid_.resize(n);
  return CopySamples(source_, samples_.data(), static_cast<ptrdiff_t>(source_.n_cols * info.dtype_bytes),
                     is_valid_.data(), static_cast<ptrdiff_t>(source_.n_cols));
}

bool Area::CopySamples(const twz_box &part, void *heights, ptrdiff_t heights_stride, uint8_t *valid,
                       ptrdiff_t valid_stride) {
  twz_error error;
  if (twz_window_read_part(window_.get(), &part, heights, heights_stride, valid, valid_stride, &error) != TWZ_OK)
    return Fail(error);
  if (own_.empty()) return true;
  const twz_info &info = file_.Info();
  for (uint32_t row = 0; row < part.n_rows; row++) {
    const uint8_t *own =
        own_.data() + static_cast<size_t>(part.row - source_.row + row) * source_.n_cols + (part.col - source_.col);
    if (valid) memcpy(valid + static_cast<ptrdiff_t>(row) * valid_stride, own, part.n_cols);
    if (!heights) continue;
    char *to = static_cast<char *>(heights) + static_cast<ptrdiff_t>(row) * heights_stride;
    WithType(info.dtype, [&](auto type) {
      using T = decltype(type);
      const T value = static_cast<T>(VoidOf(info));
      for (uint32_t col = 0; col < part.n_cols; col++) {
        if (!own[col]) reinterpret_cast<T *>(to)[col] = value;
      }
    });
  }
  return true;
}

bool Area::Copy(const twz_box &part, void *heights, ptrdiff_t heights_stride, uint8_t *valid,
                ptrdiff_t valid_stride) {
  if (!grid_.stride) return CopySamples(part, heights, heights_stride, valid, valid_stride);
  const twz_info &info = file_.Info();
  const uint32_t row = 2 * part.row - source_.row, col = 2 * part.col - source_.col;
  const size_t at = static_cast<size_t>(row) * source_.n_cols + col;
  const Samples finer = {samples_.data() + at * info.dtype_bytes, is_valid_.data() + at, source_.n_rows - row,
                         std::min(source_.n_cols - col, 2 * part.n_cols + 1), source_.n_cols};
  const Output out = {heights, heights_stride, valid, valid_stride};
  WithType(info.dtype,
           [&](auto type) { Average<decltype(type)>(info, grid_.stride, finer, part.n_rows, part.n_cols, out); });
  return true;
}

double VoidOf(const twz_info &info) {
  if (info.has_nodata) return info.nodata;
  const bool is_float = info.dtype == TWZ_FLOAT32 || info.dtype == TWZ_FLOAT64;
  return is_float ? std::numeric_limits<double>::quiet_NaN() : 0;
}

}  // namespace twz
