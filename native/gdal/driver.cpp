/* GDAL driver TWZ: reads .twz, as gdal_TWZ.so or another ending. SPDX-License-Identifier: MIT */
#include <algorithm>
#include <cmath>
#include <cstring>
#include <iterator>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "area.h"
#include "cpl_conv.h"
#include "cpl_json.h"
#include "cpl_minixml.h"
#include "cpl_string.h"
#include "gdal_pam.h"
#include "gdal_priv.h"
#include "ogr_spatialref.h"

static_assert(GDAL_VERSION_NUM >= 3060000, "the TWZ driver needs GDAL 3.6 or newer");

namespace twz {
namespace {

constexpr char MAGIC[] = "\x89TWZ\r\n\x1a\n";
constexpr size_t MAGIC_BYTES = 8;
constexpr char PREFIX[] = "TWZ:";
constexpr char DOMAIN[] = "TERRAINWAVE";
constexpr char HOW_TO_WRITE[] =
    "the TWZ driver only reads; to make a .twz file: terrainwave compress dem.tif dem.twz --max-error 0.5";
/* Of the band, in DOMAIN: it goes into the .aux.xml and marks of which file statistics there are. */
constexpr char FINGERPRINT[] = "FINGERPRINT";
constexpr uint32_t HAS_REMAINDERS = 2; /* feature bit 1 */
/* Samples a side that overviews stop at, as Terrain.geotiff has it. */
constexpr uint32_t SMALLEST_OVERVIEW = 512;
/* Blocks are as large as units of decoding, within these. Of 128 to 2048 samples a side, 512 took least, units being
 * 512: windows of 256 x 256 of a file just opened 3.7 ms, by 1024 5.8; 300 x 300 at any place 1.6 ms, by 128 2.3. */
constexpr uint32_t LEAST_BLOCK = 256, MOST_BLOCK = 1024;
/* Requests of so many samples go past GDAL's cache of blocks: straight into the caller's array. */
constexpr int64_t DIRECT_SAMPLES = 1 << 18;
/* Samples of a level that are decoded at once: as many as processors' caches hold, for each thread. Of remote files
 * more, which takes fewer rounds of requests. */
constexpr int64_t SAMPLES_AT_ONCE = 1 << 21, MOST_SAMPLES = 1 << 24;
/* Requests that shrink more than this are for an overview, if there is one. */
constexpr double LEAST_SHRINKING = 1.6;

GDALDataType TypeOf(twz_dtype dtype) {
  switch (dtype) {
    case TWZ_UINT8: return GDT_Byte;
    case TWZ_UINT16: return GDT_UInt16;
    case TWZ_INT16: return GDT_Int16;
    case TWZ_INT32: return GDT_Int32;
    case TWZ_FLOAT32: return GDT_Float32;
    case TWZ_FLOAT64: return GDT_Float64;
  }
  return GDT_Unknown;
}

/* The shortest text that reads back as the number. */
std::string TextOf(double number) {
  char text[40];
  for (int digits = 15; digits <= 17; digits++) {
    CPLsnprintf(text, sizeof text, "%.*g", digits, number);
    if (CPLAtof(text) == number) break;
  }
  return text;
}

/* A text of a file without what terminals take for commands. */
std::string Printable(const char *text, size_t most) {
  std::string printable(text, strnlen(text, most));
  for (char &letter : printable) {
    if (static_cast<unsigned char>(letter) < ' ' || letter == 127) letter = '?';
  }
  return printable;
}

/* Run what may throw; GDAL is called from C. */
template <class Function>
CPLErr Guarded(Function function) {
  try {
    return function() ? CE_None : CE_Failure;
  } catch (const std::bad_alloc &) {
    CPLError(CE_Failure, CPLE_OutOfMemory, "TWZ: out of memory");
  } catch (const std::exception &error) {
    CPLError(CE_Failure, CPLE_AppDefined, "TWZ: %s", error.what());
  }
  return CE_Failure;
}

/* What a call of RasterIO asks for. */
struct Request {
  int x, y, n_cols, n_rows;
  void *data;
  int buffer_cols, buffer_rows;
  GDALDataType type;
  GSpacing pixel_space, line_space;
  GDALRasterIOExtraArg *extra;
};

class Dataset;

/* What bands of heights and of validity share. */
template <class Base>
class ReadingBand : public Base {
 public:
  ReadingBand(Dataset *dataset, GDALDataType type);
  CPLErr IReadBlock(int col, int row, void *data) override;
  CPLErr IRasterIO(GDALRWFlag, int, int, int, int, void *, int, int, GDALDataType, GSpacing, GSpacing,
                   GDALRasterIOExtraArg *) override;

 protected:
  Dataset &Of() const { return *static_cast<Dataset *>(this->poDS); }
};

/* Validity of samples, 255 or 0. */
class MaskBand final : public ReadingBand<GDALRasterBand> {
 public:
  explicit MaskBand(Dataset *dataset) : ReadingBand(dataset, GDT_Byte) {}
  int GetOverviewCount() override;
  GDALRasterBand *GetOverview(int i) override;
  bool IsMaskBand() const override { return true; }
};

class Band final : public ReadingBand<GDALPamRasterBand> {
 public:
  explicit Band(Dataset *dataset);
  int GetOverviewCount() override;
  GDALRasterBand *GetOverview(int i) override;
  GDALRasterBand *GetMaskBand() override;
  int GetMaskFlags() override;
  double GetNoDataValue(int *is_there) override;
  double GetMinimum(int *is_known) override { return Extreme(true, is_known); }
  double GetMaximum(int *is_known) override { return Extreme(false, is_known); }
  double GetScale(int *is_there) override;
  double GetOffset(int *is_there) override;
  const char *GetUnitType() override;
  GDALColorInterp GetColorInterpretation() override;
  CPLErr ComputeStatistics(int is_rough, double *least, double *greatest, double *mean, double *deviation,
                           GDALProgressFunc progress, void *data) override;
  CPLErr GetHistogram(double least, double greatest, int n, GUIntBig *counts, int with_others, int is_rough,
                      GDALProgressFunc progress, void *data) override;
  /* Drop statistics and histograms that an .aux.xml brought. */
  void ForgetStatistics();

 private:
  double Extreme(bool is_least, int *is_known);
  const twz_info &Info() const;
};

using MetadataList = decltype(std::declval<GDALPamDataset &>().GetMetadata("")); /* char **, once const */

class Dataset final : public GDALPamDataset {
 public:
  static int Identify(GDALOpenInfo *info);
  static GDALDataset *Open(GDALOpenInfo *info);
  ~Dataset() override;

#if GDAL_VERSION_NUM >= 3120000
  CPLErr GetGeoTransform(GDALGeoTransform &transform) const override {
    if (!has_transform_) return GDALPamDataset::GetGeoTransform(transform);
    transform = GDALGeoTransform(transform_);
    return CE_None;
  }
#else
  CPLErr GetGeoTransform(double *transform) override {
    if (!has_transform_) return GDALPamDataset::GetGeoTransform(transform);
    std::copy(transform_, transform_ + 6, transform);
    return CE_None;
  }
#endif
  /* With the root of the heights, which costs a request: only where this domain is asked for. */
  MetadataList GetMetadata(const char *domain = "") override {
    if (domain && EQUAL(domain, DOMAIN)) AddRoot();
    return GDALPamDataset::GetMetadata(domain);
  }
  const char *GetMetadataItem(const char *name, const char *domain = "") override {
    if (domain && EQUAL(domain, DOMAIN)) AddRoot();
    return GDALPamDataset::GetMetadataItem(name, domain);
  }
  const OGRSpatialReference *GetSpatialRef() const override {
    return crs_.IsEmpty() ? GDALPamDataset::GetSpatialRef() : &crs_;
  }

  const twz_info &Info() const { return file_->Info(); }
  bool IsOverview() const { return grid_.stride != 0; }
  bool IsFinest() const { return !IsOverview() && grid_.level == Info().n_levels - 1; }
  bool HasMask() const { return mask_ != nullptr; }
  MaskBand *Mask() const { return mask_.get(); }
  const std::string &UnitOfCrs() const { return unit_of_crs_; }
  int CountOverviews() const { return static_cast<int>(overviews_.size()); }
  Dataset *Overview(int i) const {
    return i >= 0 && i < CountOverviews() ? overviews_[static_cast<size_t>(i)].get() : nullptr;
  }
  int BlockSize() const;

  CPLErr IBuildOverviews(const char *, int, const int *, int, const int *, GDALProgressFunc, void *,
                         CSLConstList) override {
    is_explained_ = true;
    CPLError(CE_Failure, CPLE_NotSupported, "%s: a .twz file brings its own overviews; %s", file_->Name().c_str(),
             HOW_TO_WRITE);
    return CE_Failure;
  }

  CPLErr ReadBlock(GDALRasterBand &band, int col, int row, void *data);
  /* Answer a request where that is faster than block by block; else see that its blocks are in GDAL's cache. */
  CPLErr Read(GDALRasterBand &band, const Request &request, bool *is_done);

  /* What is read of a roughly measured raster is no reason for an .aux.xml. */
  template <class Function>
  CPLErr WithoutSaving(bool is_rough, Function function) {
    const int before = nPamFlags & GPF_DIRTY;
    const CPLErr result = function();
    if (is_rough && !before) nPamFlags &= ~GPF_DIRTY;
    return result;
  }

 private:
  Dataset(std::shared_ptr<SharedFile> file, VSILFILE *handle, const Grid &grid, int n_threads);
  void Describe();
  void AddRoot();
  void DescribePlace();
  double Bound() const;
  void LoadSidecar(char **siblings);
  void DescribeCrs();
  bool ReadDirectly(GDALRasterBand &band, const Request &request);
  bool FillBlocks(GDALRasterBand &band, const Request &request);
  template <class Function>
  bool ForEachPart(const Request &request, Function function) const;
  bool Copy(Area &area, const twz_box &part, bool is_mask, void *data, ptrdiff_t stride) const;

  std::shared_ptr<SharedFile> file_;
  VSILFILE *handle_; /* of the dataset that was opened; its overviews use it, too */
  bool owns_handle_ = false;
  bool has_root_ = false; /* it was asked for */
  bool is_explained_ = true; /* false: the program tried to open the file for update, and has not read since */
  const Grid grid_;
  const int n_threads_;
  bool has_transform_ = false;
  double transform_[6] = {0, 1, 0, 0, 0, 1}; /* in GDAL's order */
  OGRSpatialReference crs_;
  std::string unit_of_crs_;
  std::unique_ptr<MaskBand> mask_;
  std::vector<std::unique_ptr<Dataset>> overviews_; /* the largest first */
};

/* ---- Reading ---- */

Dataset::Dataset(std::shared_ptr<SharedFile> file, VSILFILE *handle, const Grid &grid, int n_threads)
    : file_(std::move(file)), handle_(handle), grid_(grid), n_threads_(n_threads) {
  nRasterXSize = static_cast<int>(grid.n_cols);
  nRasterYSize = static_cast<int>(grid.n_rows);
  eAccess = GA_ReadOnly;
  nPamFlags |= GPF_NOSAVE; /* of overviews and levels there is nothing to keep */
  const twz_info &info = Info();
  const bool is_float = info.dtype == TWZ_FLOAT32 || info.dtype == TWZ_FLOAT64;
  const bool has_value = info.has_nodata || (is_float && info.mask_kind == TWZ_MASK_NAN);
  if (info.mask_kind == TWZ_MASK_MASK || (info.mask_kind != TWZ_MASK_NONE && !has_value))
    mask_.reset(new MaskBand(this));
  SetBand(1, new Band(this));
}

Dataset::~Dataset() {
  if (!is_explained_) CPLError(CE_Warning, CPLE_NotSupported, "%s: %s", file_->Name().c_str(), HOW_TO_WRITE);
  static_cast<void>(FlushCache(true));
  overviews_.clear();
  mask_.reset();
  if (owns_handle_) VSIFCloseL(handle_);
}

int Dataset::BlockSize() const {
  return static_cast<int>(std::max(LEAST_BLOCK, std::min(MOST_BLOCK, 2 * Info().block_size)));
}

bool Dataset::Copy(Area &area, const twz_box &part, bool is_mask, void *data, ptrdiff_t stride) const {
  if (!is_mask) return area.Copy(part, data, stride, nullptr, 0);
  uint8_t *valid = static_cast<uint8_t *>(data);
  if (!area.Copy(part, nullptr, 0, valid, stride)) return false;
  for (uint32_t row = 0; row < part.n_rows; row++, valid += stride) {
    for (uint32_t col = 0; col < part.n_cols; col++) valid[col] = static_cast<uint8_t>(valid[col] ? 255 : 0);
  }
  return true;
}

/* The samples of blocks, those past the raster's edge left out. */
twz_box BoxOf(const GDALRasterBand &band, const Grid &grid, int col, int row, int n_cols, int n_rows) {
  int block_cols, block_rows;
  const_cast<GDALRasterBand &>(band).GetBlockSize(&block_cols, &block_rows);
  const uint32_t first_row = static_cast<uint32_t>(row) * static_cast<uint32_t>(block_rows);
  const uint32_t first_col = static_cast<uint32_t>(col) * static_cast<uint32_t>(block_cols);
  const uint64_t wanted_rows = static_cast<uint64_t>(n_rows) * static_cast<uint64_t>(block_rows);
  const uint64_t wanted_cols = static_cast<uint64_t>(n_cols) * static_cast<uint64_t>(block_cols);
  return {first_row, first_col, static_cast<uint32_t>(std::min<uint64_t>(wanted_rows, grid.n_rows - first_row)),
          static_cast<uint32_t>(std::min<uint64_t>(wanted_cols, grid.n_cols - first_col))};
}

ptrdiff_t LineOfBlock(GDALRasterBand &band) {
  int n_cols, n_rows;
  band.GetBlockSize(&n_cols, &n_rows);
  return static_cast<ptrdiff_t>(n_cols) * GDALGetDataTypeSizeBytes(band.GetRasterDataType());
}

CPLErr Dataset::ReadBlock(GDALRasterBand &band, int col, int row, void *data) {
  is_explained_ = true;
  return Guarded([&] {
    const twz_box box = BoxOf(band, grid_, col, row, 1, 1);
    Area area(*file_, handle_, grid_, box, n_threads_);
    return area.IsGood() && Copy(area, box, band.IsMaskBand(), data, LineOfBlock(band));
  });
}

/* Call with parts of a request that begin and end where blocks do, until it returns false. */
template <class Function>
bool Dataset::ForEachPart(const Request &request, Function function) const {
  const int64_t block = BlockSize();
  const int64_t at_once = file_->IsRemote() ? MOST_SAMPLES : std::min(SAMPLES_AT_ONCE * n_threads_, MOST_SAMPLES);
  const int64_t most = at_once / (grid_.stride ? 4 : 1);
  const int64_t cols_at_once = std::max(most / block / block, int64_t{1}) * block;
  const int64_t end_x = static_cast<int64_t>(request.x) + request.n_cols,
                end_y = static_cast<int64_t>(request.y) + request.n_rows;
  for (int64_t x = request.x; x < end_x;) {
    const int64_t next_x = std::min((x / block * block) + cols_at_once, end_x);
    const int64_t rows_at_once = std::max(most / (next_x - x) / block, int64_t{1}) * block;
    for (int64_t y = request.y; y < end_y;) {
      const int64_t next_y = std::min((y / block * block) + rows_at_once, end_y);
      const twz_box part = {static_cast<uint32_t>(y), static_cast<uint32_t>(x), static_cast<uint32_t>(next_y - y),
                            static_cast<uint32_t>(next_x - x)};
      if (!function(part)) return false;
      y = next_y;
    }
    x = next_x;
  }
  return true;
}

bool Dataset::ReadDirectly(GDALRasterBand &band, const Request &request) {
  const GDALDataType own_type = band.GetRasterDataType();
  const ptrdiff_t size = GDALGetDataTypeSizeBytes(own_type);
  const bool is_plain = request.type == own_type && request.pixel_space == size;
  std::vector<uint8_t> lines;
  const double n_all = static_cast<double>(request.n_cols) * request.n_rows;
  double n_done = 0;
  return ForEachPart(request, [&](const twz_box &part) {
    char *to = static_cast<char *>(request.data) +
               (part.row - static_cast<uint32_t>(request.y)) * request.line_space +
               (part.col - static_cast<uint32_t>(request.x)) * request.pixel_space;
    /* Of large parts nothing is kept: their units are decoded where the samples are wanted. */
    const bool is_large = static_cast<int64_t>(part.n_rows) * part.n_cols >= 4 * int64_t{BlockSize()} * BlockSize();
    const bool is_into = is_plain && is_large && !band.IsMaskBand() && !grid_.stride && grid_.level == Info().n_levels - 1;
    Area area(*file_, handle_, grid_, part, n_threads_, is_into ? to : nullptr, static_cast<ptrdiff_t>(request.line_space));
    if (!area.IsGood()) return false;
    if (is_plain) {
      if (!is_into && !Copy(area, part, band.IsMaskBand(), to, static_cast<ptrdiff_t>(request.line_space))) return false;
    } else {
      lines.resize(static_cast<size_t>(size) * part.n_cols);
      for (uint32_t row = 0; row < part.n_rows; row++, to += request.line_space) {
        const twz_box line = {part.row + row, part.col, 1, part.n_cols};
        if (!Copy(area, line, band.IsMaskBand(), lines.data(), static_cast<ptrdiff_t>(lines.size()))) return false;
        GDALCopyWords64(lines.data(), own_type, static_cast<int>(size), to, request.type,
                        static_cast<int>(request.pixel_space), part.n_cols);
      }
    }
    n_done += static_cast<double>(part.n_rows) * part.n_cols;
    const GDALRasterIOExtraArg *extra = request.extra;
    if (extra && extra->pfnProgress && !extra->pfnProgress(n_done / n_all, "", extra->pProgressData)) {
      CPLError(CE_Failure, CPLE_UserInterrupt, "User terminated");
      return false;
    }
    return true;
  });
}

/* Put the blocks of a request into GDAL's cache; those that are missing are fetched and decoded together. */
bool Dataset::FillBlocks(GDALRasterBand &band, const Request &request) {
  return ForEachPart(request, [&](const twz_box &part) {
    int block_cols, block_rows;
    band.GetBlockSize(&block_cols, &block_rows);
    const uint32_t side_x = static_cast<uint32_t>(block_cols), side_y = static_cast<uint32_t>(block_rows);
    const int left = static_cast<int>(part.col / side_x),
              right = static_cast<int>((part.col + part.n_cols - 1) / side_x);
    const int top = static_cast<int>(part.row / side_y),
              bottom = static_cast<int>((part.row + part.n_rows - 1) / side_y);
    std::vector<std::pair<int, int>> missing;
    int first_x = right, last_x = left, first_y = bottom, last_y = top;
    for (int row = top; row <= bottom; row++) {
      for (int col = left; col <= right; col++) {
        if (GDALRasterBlock *block = band.TryGetLockedBlockRef(col, row)) {
          block->DropLock();
          continue;
        }
        missing.emplace_back(col, row);
        first_x = std::min(first_x, col);
        last_x = std::max(last_x, col);
        first_y = std::min(first_y, row);
        last_y = row;
      }
    }
    if (missing.empty()) return true;
    Area area(*file_, handle_, grid_,
              BoxOf(band, grid_, first_x, first_y, last_x - first_x + 1, last_y - first_y + 1), n_threads_);
    if (!area.IsGood()) return false;
    for (const auto &at : missing) {
      GDALRasterBlock *block = band.GetLockedBlockRef(at.first, at.second, TRUE);
      if (!block) return false;
      const bool is_good = Copy(area, BoxOf(band, grid_, at.first, at.second, 1, 1), band.IsMaskBand(),
                                block->GetDataRef(), LineOfBlock(band));
      block->DropLock();
      if (!is_good) return false;
    }
    return true;
  });
}

CPLErr Dataset::Read(GDALRasterBand &band, const Request &request, bool *is_done) {
  is_explained_ = true;
  const int64_t n = static_cast<int64_t>(request.n_cols) * request.n_rows;
  const bool is_whole = request.n_cols == request.buffer_cols && request.n_rows == request.buffer_rows;
  *is_done = is_whole && n >= DIRECT_SAMPLES;
  if (*is_done) return Guarded([&] { return ReadDirectly(band, request); });
  const bool shrinks = request.n_cols > LEAST_SHRINKING * request.buffer_cols ||
                       request.n_rows > LEAST_SHRINKING * request.buffer_rows;
  const int64_t room = GDALGetCacheMax64() / 4 / GDALGetDataTypeSizeBytes(band.GetRasterDataType());
  if ((shrinks && band.GetOverviewCount() > 0) || n > std::min(room, MOST_SAMPLES)) return CE_None;
  return Guarded([&] { return FillBlocks(band, request); });
}

/* ---- Bands ---- */

template <class Base>
ReadingBand<Base>::ReadingBand(Dataset *dataset, GDALDataType type) {
  this->poDS = dataset;
  this->nRasterXSize = dataset->GetRasterXSize();
  this->nRasterYSize = dataset->GetRasterYSize();
  this->eDataType = type;
  this->nBlockXSize = std::min(dataset->BlockSize(), this->nRasterXSize);
  this->nBlockYSize = std::min(dataset->BlockSize(), this->nRasterYSize);
}

template <class Base>
CPLErr ReadingBand<Base>::IReadBlock(int col, int row, void *data) {
  return Of().ReadBlock(*this, col, row, data);
}

template <class Base>
CPLErr ReadingBand<Base>::IRasterIO(GDALRWFlag flag, int x, int y, int n_cols, int n_rows, void *data, int buffer_cols,
                                    int buffer_rows, GDALDataType type, GSpacing pixel_space, GSpacing line_space,
                                    GDALRasterIOExtraArg *extra) {
  bool is_done = false;
  const Request request = {x,           y,    n_cols,      n_rows,     data, buffer_cols,
                           buffer_rows, type, pixel_space, line_space, extra};
  const CPLErr result = flag == GF_Read ? Of().Read(*this, request, &is_done) : CE_None;
  if (is_done || result != CE_None) return result;
  return Base::IRasterIO(flag, x, y, n_cols, n_rows, data, buffer_cols, buffer_rows, type, pixel_space, line_space,
                         extra);
}

int MaskBand::GetOverviewCount() { return Of().CountOverviews(); }

GDALRasterBand *MaskBand::GetOverview(int i) {
  Dataset *overview = Of().Overview(i);
  return overview ? overview->Mask() : nullptr;
}

Band::Band(Dataset *dataset) : ReadingBand(dataset, TypeOf(dataset->Info().dtype)) { nBand = 1; }

const twz_info &Band::Info() const { return Of().Info(); }

int Band::GetOverviewCount() {
  const int n = Of().CountOverviews();
  return n > 0 ? n : GDALPamRasterBand::GetOverviewCount();
}

GDALRasterBand *Band::GetOverview(int i) {
  if (Of().CountOverviews() == 0) return GDALPamRasterBand::GetOverview(i);
  Dataset *overview = Of().Overview(i);
  return overview ? overview->GetRasterBand(1) : nullptr;
}

GDALRasterBand *Band::GetMaskBand() { return Of().HasMask() ? Of().Mask() : GDALPamRasterBand::GetMaskBand(); }
int Band::GetMaskFlags() { return Of().HasMask() ? GMF_PER_DATASET : GDALPamRasterBand::GetMaskFlags(); }

double Band::GetNoDataValue(int *is_there) {
  const twz_info &info = Info();
  const bool is_nan = info.mask_kind == TWZ_MASK_NAN && (eDataType == GDT_Float32 || eDataType == GDT_Float64);
  if (!info.has_nodata && !is_nan) return GDALPamRasterBand::GetNoDataValue(is_there);
  if (is_there) *is_there = TRUE;
  return VoidOf(info);
}

/* Extremes of the original, of which the decoded ones are no further than the bound. */
double Band::Extreme(bool is_least, int *is_known) {
  const twz_info &info = Info();
  if (!info.has_valid || !Of().IsFinest())
    return is_least ? GDALPamRasterBand::GetMinimum(is_known) : GDALPamRasterBand::GetMaximum(is_known);
  if (is_known) *is_known = TRUE;
  return is_least ? info.raw_min : info.raw_max;
}

double Band::GetScale(int *is_there) {
  if (!Info().has_scale && !Info().has_offset) return GDALPamRasterBand::GetScale(is_there);
  if (is_there) *is_there = TRUE;
  return Info().scale;
}

double Band::GetOffset(int *is_there) {
  if (!Info().has_scale && !Info().has_offset) return GDALPamRasterBand::GetOffset(is_there);
  if (is_there) *is_there = TRUE;
  return Info().offset;
}

const char *Band::GetUnitType() {
  if (Info().units) return Info().units;
  const char *kept = GDALPamRasterBand::GetUnitType();
  return kept && *kept ? kept : Of().UnitOfCrs().c_str();
}

GDALColorInterp Band::GetColorInterpretation() {
  const char *name = Info().color_interpretation;
  if (!name) return GCI_GrayIndex;
  const GDALColorInterp found = GDALGetColorInterpretationByName(name);
  return found == GCI_PaletteIndex || found == GCI_AlphaBand || found == GCI_Undefined ? GCI_GrayIndex : found;
}

CPLErr Band::ComputeStatistics(int is_rough, double *least, double *greatest, double *mean, double *deviation,
                               GDALProgressFunc progress, void *data) {
  return Of().WithoutSaving(is_rough != 0, [&] {
    return GDALPamRasterBand::ComputeStatistics(is_rough, least, greatest, mean, deviation, progress, data);
  });
}

CPLErr Band::GetHistogram(double least, double greatest, int n, GUIntBig *counts, int with_others, int is_rough,
                          GDALProgressFunc progress, void *data) {
  return Of().WithoutSaving(is_rough != 0, [&] {
    return GDALPamRasterBand::GetHistogram(least, greatest, n, counts, with_others, is_rough, progress, data);
  });
}

void Band::ForgetStatistics() {
  const CPLStringList known(CSLDuplicate(GDALMajorObject::GetMetadata()));
  for (int i = 0; i < known.size(); i++) {
    const std::string key = known[i], name = key.substr(0, key.find('='));
    if (STARTS_WITH_CI(name.c_str(), "STATISTICS_")) GDALMajorObject::SetMetadataItem(name.c_str(), nullptr);
  }
  if (!psPam || !psPam->psSavedHistograms) return;
  CPLDestroyXMLNode(psPam->psSavedHistograms);
  psPam->psSavedHistograms = nullptr;
}

/* ---- What a file says of itself ---- */

void Dataset::DescribeCrs() {
  const char *text = Info().crs;
  if (!text) return;
  OGRErr result;
  {
    CPLErrorStateBackuper backuper;
    CPLErrorHandlerPusher quiet(CPLQuietErrorHandler);
    result = crs_.SetFromUserInput(text, OGRSpatialReference::SET_FROM_USER_INPUT_LIMITATIONS_get());
  }
  if (result != OGRERR_NONE) {
    crs_.Clear();
    CPLError(CE_Warning, CPLE_AppDefined,
             "%s: PROJ does not know the coordinate reference system \"%s\": the raster has none",
             file_->Name().c_str(), Printable(text, 60).c_str());
    return;
  }
  crs_.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  const char *unit = nullptr;
  if (crs_.IsVertical()) crs_.GetTargetLinearUnits("VERT_CS", &unit);
  if (unit) unit_of_crs_ = unit;
}

void Dataset::DescribePlace() {
  const twz_info &info = Info();
  has_transform_ = info.has_transform != 0 || info.crs != nullptr;
  twz_level level;
  if (twz_file_level(file_->Get(), IsOverview() ? info.n_levels - 1 : grid_.level, &level, nullptr) == TWZ_OK) {
    /* Pixels of overviews cover the raster, as GDAL has it for the overviews of any raster. */
    const double across = IsOverview() ? static_cast<double>(info.n_cols) / grid_.n_cols : 1;
    const double down = IsOverview() ? static_cast<double>(info.n_rows) / grid_.n_rows : 1;
    const double *t = level.transform;
    const double ordered[6] = {t[2], t[0] * across, t[1] * down, t[5], t[3] * across, t[4] * down};
    std::copy(ordered, ordered + 6, transform_);
  }
  /* A coarse level has one even where the raster has none: rows and columns of the full grid. */
  if (!IsOverview() && !IsFinest()) has_transform_ = true;
  DescribeCrs();
}

/* The bound of the samples that the dataset shows, in physical units; negative: none is known. */
double Dataset::Bound() const {
  const twz_info &info = Info();
  if (IsOverview()) return -1;
  /* Levels of these methods have samples of the full grid; those of others are filtered. */
  const bool is_nested = info.method == TWZ_STORE || info.method == TWZ_PREDICTIVE || info.method == TWZ_RAPID;
  if (IsFinest()) return info.effective_bound;
  /* Remainders make the full grid exact; coarser levels have none. */
  if (is_nested) return info.features & HAS_REMAINDERS ? info.raw_rho * std::fabs(info.scale) : info.effective_bound;
  const double raw = StatedError(*file_, handle_, grid_.level);
  if (raw < 0) return raw;
  const bool is_float = info.dtype == TWZ_FLOAT32 || info.dtype == TWZ_FLOAT64;
  const bool is_rounded = !is_float && info.quantum != std::floor(info.quantum);
  return (raw + (is_rounded ? 0.5 : 0)) * std::fabs(info.scale);
}

/* Names of metadata are the same in capitals and small letters. */
struct IsLess {
  bool operator()(const std::string &a, const std::string &b) const { return STRCASECMP(a.c_str(), b.c_str()) < 0; }
};

void Dataset::Describe() {
  const twz_info &info = Info();
  GDALRasterBand *band = GetRasterBand(1);
  for (int of_band = 0; of_band < 2; of_band++) {
    GDALMajorObject *object = of_band ? static_cast<GDALMajorObject *>(band) : this;
    std::map<std::string, std::string, IsLess> tags; /* to set one by one looks through all that are there, for each */
    for (CSLConstList known = object->GDALMajorObject::GetMetadata(); known && *known; known++) {
      char *name = nullptr;
      const char *kept = CPLParseNameValue(*known, &name);
      if (name && kept) tags[name] = kept;
      CPLFree(name);
    }
    const char *key, *value;
    for (size_t i = 0; twz_file_tag(file_->Get(), of_band, i, &key, &value); i++) {
      if (!*key || strchr(key, '=') || STARTS_WITH_CI(key, "STATISTICS_")) continue;
      tags.erase(key);
      tags.emplace(key, value);
    }
    CPLStringList items;
    for (const auto &tag : tags) items.AddNameValue(tag.first.c_str(), tag.second.c_str());
    object->GDALMajorObject::SetMetadata(items.List());
  }
  /* As the CF conventions say it; a tag of the same name tells what the source said. */
  CPLJSONDocument metadata;
  std::string kind;
  std::string proof;
  if (metadata.LoadMemory(reinterpret_cast<const GByte *>(info.metadata), static_cast<int>(info.metadata_length))) {
    kind = metadata.GetRoot().GetString("heights_are");
    proof = metadata.GetRoot().GetString("proof");
  }
  if (kind != "depth" && kind != "height" && kind != "radius") kind.clear();
  if (kind == "depth" || kind == "height")
    band->GDALMajorObject::SetMetadataItem("positive", kind == "depth" ? "down" : "up");
  if (info.is_point >= 0)
    GDALMajorObject::SetMetadataItem(GDALMD_AREA_OR_POINT, info.is_point ? GDALMD_AOP_POINT : GDALMD_AOP_AREA);
  if (info.description) band->GDALMajorObject::SetDescription(info.description);
  CPLStringList own;
  own.SetNameValue("METHOD", info.method_name);
  own.SetNameValue("LEVELS", std::to_string(info.n_levels).c_str());
  own.SetNameValue("BLOCK_SIZE", std::to_string(info.block_size).c_str());
  own.SetNameValue("MESH", info.mesh_name);
  if (!kind.empty()) own.SetNameValue("HEIGHTS_ARE", kind.c_str());
  if (info.bound_side && IsFinest()) own.SetNameValue("BOUND", info.bound_side > 0 ? "above" : "below");
  if (proof == "none") own.SetNameValue("PROOF", "none");
  if (info.software) own.SetNameValue("SOFTWARE", info.software);
  if (!IsOverview()) own.SetNameValue("LEVEL", std::to_string(grid_.level - info.n_levels).c_str());
  if (IsOverview() || !overviews_.empty()) own.SetNameValue("OVERVIEWS", "averages of samples, without a bound");
  if (IsFinest()) own.SetNameValue("MAX_ERROR_ASKED", TextOf(info.max_error).c_str());
  /* No COMPRESSION in IMAGE_STRUCTURE: rasterio 1.3 accepts only the names that GeoTIFF has. METHOD names ours. */
  const double bound = Bound();
  if (bound >= 0) {
    own.SetNameValue("MAX_ERROR", TextOf(bound).c_str());
    GDALMajorObject::SetMetadataItem("COMPRESSION_REVERSIBILITY", bound > 0 ? "LOSSY" : "LOSSLESS", "IMAGE_STRUCTURE");
  }
  GDALMajorObject::SetMetadata(own.List(), DOMAIN);
  char *json[] = {const_cast<char *>(info.metadata), nullptr};
  GDALMajorObject::SetMetadata(json, "json:TERRAINWAVE");
}

void Dataset::AddRoot() {
  if (has_root_ || !IsFinest()) return;
  has_root_ = true;
  const std::string root = StatedRoot(*file_, handle_);
  if (!root.empty()) GDALMajorObject::SetMetadataItem("ROOT", root.c_str(), DOMAIN);
}

/*
 * Load the .aux.xml. Without the fingerprint of this very file its statistics are another raster's: they are dropped,
 * and what the file itself says stands against copies of what that raster said.
 */
void Dataset::LoadSidecar(char **siblings) {
  static_cast<void>(TryLoadXML(siblings));
  Band *band = static_cast<Band *>(GetRasterBand(1));
  const std::string own = file_->Fingerprint();
  const char *found = band->GDALMajorObject::GetMetadataItem(FINGERPRINT, DOMAIN);
  if (!found || own != found) {
    band->ForgetStatistics();
    Describe();
  }
  band->GDALMajorObject::SetMetadataItem(FINGERPRINT, own.c_str(), DOMAIN);
}

/* The overviews of a raster, the largest first. */
std::vector<Grid> OverviewsOf(const twz_info &info, Grid grid) {
  std::vector<Grid> found;
  for (uint32_t shift = 1;
       std::max(grid.n_rows, grid.n_cols) > SMALLEST_OVERVIEW && static_cast<int>(shift) <= info.n_levels; shift++) {
    grid.level = info.n_levels - static_cast<int>(shift);
    grid.stride = uint32_t{1} << (shift - 1);
    grid.n_rows = (grid.n_rows + 1) / 2;
    grid.n_cols = (grid.n_cols + 1) / 2;
    found.push_back(grid);
  }
  return found;
}

/* ---- Opening ---- */

/* What a name asks for: FILE, or TWZ:FILE, or TWZ:FILE:LEVEL, or TWZ:"FILE":LEVEL. */
struct Name {
  std::string file, level;
};

/*
 * The prefix in a name, or null. GDAL before 3.8 puts the folder of a VRT before a relative name in it:
 * FOLDER/TWZ:FILE:LEVEL stands for TWZ:FOLDER/FILE:LEVEL.
 */
const char *PrefixIn(const char *text) {
  if (STARTS_WITH_CI(text, PREFIX)) return text;
  const char *found = strstr(text, (std::string("/") + PREFIX).c_str());
  return found ? found + 1 : nullptr;
}

/* True if a name has the prefix, and is not that of a file. */
bool IsNamed(const GDALOpenInfo &info) {
  return STARTS_WITH_CI(info.pszFilename, PREFIX) || (!info.fpL && PrefixIn(info.pszFilename));
}

Name Parse(const char *text) {
  const char *prefix = PrefixIn(text);
  if (!prefix) return {text, ""};
  Name name = {prefix + strlen(PREFIX), ""};
  const size_t colon = name.file.rfind(':');
  if (colon != std::string::npos && colon + 1 < name.file.size()) {
    const std::string last = name.file.substr(colon + 1);
    if (last.find_first_not_of("0123456789", last[0] == '-' ? 1 : 0) == std::string::npos && last != "-") {
      name.level = last;
      name.file.resize(colon);
    }
  }
  if (name.file.size() > 1 && name.file.front() == '"' && name.file.back() == '"')
    name.file = name.file.substr(1, name.file.size() - 2);
  if (prefix != text) name.file = CPLProjectRelativeFilename(std::string(text, prefix).c_str(), name.file.c_str());
  return name;
}

#if GDAL_VERSION_NUM >= 3080000
/* Tells GDAL which part of TWZ:FILE:LEVEL is a path: VRT files then keep it relative to themselves. */
struct SubdatasetInfo final : GDALSubdatasetInfo {
  explicit SubdatasetInfo(const char *text) : GDALSubdatasetInfo(text) {}

 private:
  void parseFileName() override {
    const Name name = Parse(m_fileName.c_str());
    const std::string quoted = '"' + name.file + '"';
    m_driverPrefixComponent = "TWZ";
    m_pathComponent = m_fileName.find(quoted) == std::string::npos ? name.file : quoted;
    m_subdatasetComponent = name.level;
  }
};

GDALSubdatasetInfo *GetSubdatasetInfo(const char *text) {
  return STARTS_WITH_CI(text, PREFIX) ? new (std::nothrow) SubdatasetInfo(text) : nullptr;
}
#endif

int Dataset::Identify(GDALOpenInfo *info) {
  if (IsNamed(*info)) return TRUE;
  return info->fpL && info->nHeaderBytes >= static_cast<int>(MAGIC_BYTES) &&
         memcmp(info->pabyHeader, MAGIC, MAGIC_BYTES) == 0;
}

/* Number a level from 0 on; -1 where there is no such level. */
int LevelOf(const std::string &text, int n_levels) {
  char *end = nullptr;
  const long level = strtol(text.c_str(), &end, 10);
  if (text.empty() || *end || level < -n_levels || level >= n_levels) return -1;
  return static_cast<int>(level < 0 ? level + n_levels : level);
}

/*
 * Take the overview that GDAL's open option OVERVIEW_LEVEL names, "1" or "1only", with the coarser ones below it. GDAL
 * itself would show it with the metadata of the full grid, whose bound does not hold for averages.
 */
bool TakeOverview(const char *wanted, Grid *grid, std::vector<Grid> *overviews) {
  if (!wanted || EQUAL(wanted, "NONE")) return true;
  char *end = nullptr;
  const long number = strtol(wanted, &end, 10);
  if (end == wanted || (*end && !EQUAL(end, "only")) || number < 0 || number >= static_cast<long>(overviews->size()))
    return false;
  *grid = (*overviews)[static_cast<size_t>(number)];
  overviews->erase(overviews->begin(), *end ? overviews->end() : overviews->begin() + number + 1);
  return true;
}

GDALDataset *Dataset::Open(GDALOpenInfo *info) {
  if (!Identify(info)) return nullptr;
  const bool is_named = IsNamed(*info);
  const Name name = is_named ? Parse(info->pszFilename) : Name{info->pszFilename, ""};
  /* The file that this thread was last refused for update. gdalwarp hides that error, opens the file again to see if
   * it is there, and says only that it cannot be updated. */
  static thread_local std::string refused;
  if (info->eAccess == GA_Update) {
    CPLError(CE_Failure, CPLE_NotSupported, "%s: opened for update, but %s", name.file.c_str(), HOW_TO_WRITE);
    refused = name.file;
    return nullptr;
  }
  const bool was_refused = refused == name.file;
  refused.clear();
  std::unique_ptr<Dataset> dataset;
  const CPLErr result = Guarded([&] {
    std::unique_ptr<VSILFILE, int (*)(VSILFILE *)> handle(is_named ? VSIFOpenL(name.file.c_str(), "rb") : info->fpL,
                                                          VSIFCloseL);
    if (!is_named) info->fpL = nullptr;
    char magic[MAGIC_BYTES];
    if (!handle || VSIFReadL(magic, 1, is_named ? MAGIC_BYTES : 0, handle.get()) != (is_named ? MAGIC_BYTES : 0) ||
        (is_named && memcmp(magic, MAGIC, MAGIC_BYTES) != 0)) {
      const bool may_be_of_vrt = is_named && !name.level.empty() && CPLIsFilenameRelative(name.file.c_str());
      CPLError(CE_Failure, CPLE_OpenFailed, "%s: %s%s", name.file.c_str(),
               handle ? "not a .twz file" : "there is no such file, or it cannot be read",
               handle || !may_be_of_vrt ? "" : "; in a VRT, name the file and give the level by the open option LEVEL");
      return false;
    }
    std::shared_ptr<SharedFile> file = SharedFile::Open(name.file, handle.get());
    if (!file) return false;
    const twz_info &told = file->Info();
    const char *option = CSLFetchNameValue(info->papszOpenOptions, "LEVEL");
    const std::string wanted = option ? option : name.level.empty() ? "-1" : name.level;
    const int level = LevelOf(wanted, told.n_levels);
    twz_level size;
    if (level < 0 || twz_file_level(file->Get(), level, &size, nullptr) != TWZ_OK) {
      CPLError(CE_Failure, CPLE_IllegalArg,
               "%s: found level %s, expected 0 (the coarsest) to %d, or -1 (the full grid) to -%d", name.file.c_str(),
               wanted.c_str(), told.n_levels - 1, told.n_levels);
      return false;
    }
    if (!GDALCheckDatasetDimensions(static_cast<int>(std::min<uint32_t>(size.n_cols, INT_MAX)),
                                    static_cast<int>(std::min<uint32_t>(size.n_rows, INT_MAX))) ||
        size.n_cols > INT_MAX || size.n_rows > INT_MAX) {
      CPLError(CE_Failure, CPLE_NotSupported, "%s: %u x %u samples are more than GDAL can address", name.file.c_str(),
               size.n_rows, size.n_cols);
      return false;
    }
    const bool is_full = level == told.n_levels - 1;
    Grid grid = {level, 0, size.n_rows, size.n_cols};
    std::vector<Grid> overviews;
    if (is_full) overviews = OverviewsOf(told, grid);
    const char *overview = CSLFetchNameValue(info->papszOpenOptions, "OVERVIEW_LEVEL");
    const size_t n_overviews = overviews.size();
    if (!TakeOverview(overview, &grid, &overviews)) {
      CPLError(CE_Failure, CPLE_OpenFailed, "%s: found OVERVIEW_LEVEL %s, expected one of the raster's %d overviews, from 0 on",
               name.file.c_str(), overview, static_cast<int>(n_overviews));
      return false;
    }
    const int n_threads = ThreadsOf(CSLFetchNameValue(info->papszOpenOptions, "NUM_THREADS"));
    dataset.reset(new Dataset(file, handle.get(), grid, n_threads));
    handle.release();
    dataset->owns_handle_ = true;
    dataset->is_explained_ = !was_refused;
    for (const Grid &coarser : overviews)
      dataset->overviews_.emplace_back(new Dataset(file, dataset->handle_, coarser, n_threads));
    dataset->DescribePlace();
    dataset->Describe();
    dataset->GDALMajorObject::SetDescription(info->pszFilename);
    if (dataset->IsFinest() && !is_named) {
      dataset->nPamFlags &= ~GPF_NOSAVE;
      dataset->LoadSidecar(info->GetSiblingFiles());
    }
    return true;
  });
  return result == CE_None ? dataset.release() : nullptr;
}

GDALDataset *CannotWrite() {
  CPLError(CE_Failure, CPLE_NotSupported, "%s", HOW_TO_WRITE);
  return nullptr;
}

/* GDAL deletes what is there under the name of a raster that is made: a file that could not be made again. */
CPLErr Delete(const char *name) {
  CPLError(CE_Warning, CPLE_NotSupported, "%s is left as it is: the TWZ driver deletes no files", name);
  return CE_Failure;
}

void Unload(GDALDriver *) { EndThreads(); }

}  // namespace
}  // namespace twz

#ifdef _WIN32
#define TWZ_EXPORT __declspec(dllexport)
#else
#define TWZ_EXPORT __attribute__((visibility("default")))
#endif

/* GDAL calls it when it loads the plugin. */
extern "C" TWZ_EXPORT void GDALRegister_TWZ(void);

void GDALRegister_TWZ(void) {
  if (!GDAL_CHECK_VERSION("TWZ driver") || GDALGetDriverByName("TWZ")) return;
  std::unique_ptr<GDALDriver> driver(new GDALDriver());
  driver->SetDescription("TWZ");
  driver->SetMetadataItem(GDAL_DCAP_RASTER, "YES");
  driver->SetMetadataItem(GDAL_DCAP_VIRTUALIO, "YES");
  driver->SetMetadataItem(GDAL_DMD_LONGNAME, "terrainwave (.twz)");
  driver->SetMetadataItem(GDAL_DMD_EXTENSION, "twz");
  driver->SetMetadataItem(GDAL_DMD_EXTENSIONS, "twz");
  driver->SetMetadataItem(GDAL_DMD_MIMETYPE, "application/vnd.terrainwave");
  driver->SetMetadataItem(GDAL_DMD_CONNECTION_PREFIX, twz::PREFIX);
  driver->SetMetadataItem(
      GDAL_DMD_OPENOPTIONLIST,
      "<OpenOptionList>"
      "<Option name='LEVEL' type='int' default='-1' description='Level to read, with its own transform: -1 the full "
      "grid, -2 half of it, 0 the coarsest'/>"
      "<Option name='OVERVIEW_LEVEL' type='string' description='Overview to show, 0 the largest: averages, without a "
      "bound'/>"
      "<Option name='NUM_THREADS' type='string' description='Threads that decode, or ALL_CPUS; GDAL_NUM_THREADS if "
      "it is not given'/>"
      "</OpenOptionList>");
#if GDAL_VERSION_NUM >= 3080000
  driver->SetMetadataItem(GDAL_DMD_SUBDATASETS, "YES");
  driver->pfnGetSubdatasetInfoFunc = twz::GetSubdatasetInfo;
#endif
  driver->pfnIdentify = twz::Dataset::Identify;
  driver->pfnOpen = twz::Dataset::Open;
  driver->pfnDelete = twz::Delete;
  driver->pfnUnloadDriver = twz::Unload;
  /* Options are of one type before GDAL 3.13, and of another from then on. */
  driver->pfnCreate = [](const char *, int, int, int, GDALDataType, auto) { return twz::CannotWrite(); };
  driver->pfnCreateCopy = [](const char *, GDALDataset *, int, auto, GDALProgressFunc, void *) {
    return twz::CannotWrite();
  };
  GDALDriver *registered = driver.release();
  GetGDALDriverManager()->RegisterDriver(registered);
  /* Left standing, DCAP_CREATECOPY lets gdal_translate come as far as our line, which says what makes such files.
   * Without DCAP_CREATE, programs do not offer the format for new rasters. */
  registered->SetMetadataItem(GDAL_DCAP_CREATE, nullptr);
}
