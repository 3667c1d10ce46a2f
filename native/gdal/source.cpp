/* Files that datasets share, fetching through VSI, threads. SPDX-License-Identifier: MIT */
#include "source.h"

#include <algorithm>
#include <cinttypes>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <map>
#include <tuple>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif
#ifndef _WIN32
#include <sys/stat.h>
#endif

#include "cpl_conv.h"
#include "cpl_error.h"
#include "cpl_multiproc.h"
#include "cpl_string.h"

namespace twz {
namespace {

/* Decoded units of all open files; a file opened beside k others gets a share of 1/(k + 1). 64 MiB hold a row of 32
 * units of int16 and those above it; more made whole reads no faster. GDAL caches blocks besides. */
constexpr uint64_t CACHE_BYTES = uint64_t{64} << 20;
constexpr uint64_t LEAST_CACHE_BYTES = uint64_t{8} << 20;
/* Of a remote file ranges with gaps between them are one request, the shortest gaps first, as in Python
 * (container/sources/ranges.py): while gaps are no more than a quarter of what is wanted, or 64 KiB, and while requests
 * are more than is aimed at, no more than one and a half times what is wanted, or 512 KiB. */
constexpr uint64_t FREE_GAPS = 64 << 10;
constexpr uint64_t FREE_GAPS_OF_MANY = 512 << 10;
constexpr uint64_t MOST_GAP = 1 << 20;
constexpr size_t AIMED_REQUESTS = 3;
constexpr size_t MOST_RANGES = 512;
constexpr size_t HEAD_BYTES = 16 << 10; /* as GDAL reads of remote files at a time */
/* Blocks whose errors are looked up when a level is opened: some hundred pages of the index. */
constexpr uint64_t MOST_BLOCKS = 1 << 16;
constexpr uint32_t BLOCKS_AT_ONCE = 16;

struct Piece {
  uint64_t offset;
  std::vector<uint8_t> bytes;
  uint64_t End() const { return offset + bytes.size(); }
};

/* Whether requests are costly: of the innermost of names like /vsizip//vsicurl/... */
bool IsRemote(const std::string &name) {
  const size_t at = name.rfind("/vsi");
  return at != std::string::npos && !VSIIsLocal(name.c_str() + at);
}

/* Read pieces whose sizes are set; a single one by way of GDAL's own cache of remote files. */
bool Fetch(VSILFILE *handle, std::vector<Piece> &pieces) {
  if (pieces.size() == 1) {
    Piece &one = pieces[0];
    return VSIFSeekL(handle, one.offset, SEEK_SET) == 0 &&
           VSIFReadL(one.bytes.data(), 1, one.bytes.size(), handle) == one.bytes.size();
  }
  std::vector<void *> buffers;
  std::vector<vsi_l_offset> offsets;
  std::vector<size_t> sizes;
  for (Piece &piece : pieces) {
    buffers.push_back(piece.bytes.data());
    offsets.push_back(piece.offset);
    sizes.push_back(piece.bytes.size());
  }
  return VSIFReadMultiRangeL(static_cast<int>(pieces.size()), buffers.data(), offsets.data(), sizes.data(), handle) ==
         0;
}

/* twz_fetch, for what is needed to open a file. */
int FetchAll(void *source, size_t n, const twz_range *ranges, void *const *buffers) {
  VSILFILE *handle = static_cast<VSILFILE *>(source);
  for (size_t i = 0; i < n; i++) {
    const size_t length = static_cast<size_t>(ranges[i].length);
    if (VSIFSeekL(handle, ranges[i].offset, SEEK_SET) != 0 || VSIFReadL(buffers[i], 1, length, handle) != length)
      return 1;
  }
  return 0;
}

/* ---- Memory ---- */

/* Large pieces that were released and will soon be asked for again: units and what they are decoded in. To get fresh
 * pages from the system costs a sixth of the time of decoding. */
class Recycler {
 public:
  void *Allocate(size_t n) {
    if (n > SIZE_MAX / 2) return nullptr;
    const size_t size = SizeFor(n);
    if (size >= LEAST) {
      std::lock_guard<std::mutex> lock(mutex_);
      auto found = kept_.find(size);
      if (found != kept_.end() && !found->second.empty()) {
        Head *head = found->second.back();
        found->second.pop_back();
        n_kept_ -= size;
        return head + 1;
      }
    }
    Head *head = static_cast<Head *>(Fresh(sizeof(Head) + size));
    if (!head) return nullptr;
    head->size = size;
    return head + 1;
  }

  void Release(void *memory) {
    if (!memory) return;
    Head *head = static_cast<Head *>(memory) - 1;
    if (head->size >= LEAST) {
      std::lock_guard<std::mutex> lock(mutex_);
      if (n_kept_ + head->size <= MOST_KEPT) {
        kept_[head->size].push_back(head);
        n_kept_ += head->size;
        return;
      }
    }
    free(head);
  }

 private:
  struct alignas(std::max_align_t) Head {
    size_t size;
  };
  static constexpr size_t LEAST = 32 << 10, MOST_KEPT = 32 << 20;

  /* Much memory lies in large pages, where the system has them; what is left at the end stays of small ones. */
  static void *Fresh(size_t n) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    const size_t page = size_t{1} << 21;
    if (n >= page && n < SIZE_MAX - page) {
      void *memory = aligned_alloc(page, (n + page - 1) / page * page);
      if (memory) madvise(memory, n / page * page, MADV_HUGEPAGE);
      return memory;
    }
#endif
    return malloc(n);
  }

  /* Sizes in steps of an eighth: pieces of nearly the same size stand for each other. */
  static size_t SizeFor(size_t n) {
    size_t step = 16;
    while (step * 16 < n) step *= 2;
    return (n + step - 1) / step * step;
  }

  std::mutex mutex_;
  std::map<size_t, std::vector<Head *>> kept_;
  size_t n_kept_ = 0;
};

/* Never destroyed: files may be closed while the process ends. */
Recycler &Memory() {
  static Recycler *memory = new Recycler();
  return *memory;
}

/* ---- Files that are open ---- */

/* Two files that have all of this in common are the same, unchanged. */
struct Key {
  std::string name, head, version;
  vsi_l_offset size;
  bool operator<(const Key &o) const {
    return std::tie(name, size, version, head) < std::tie(o.name, o.size, o.version, o.head);
  }
};

struct Registry {
  std::mutex mutex;
  std::map<Key, std::weak_ptr<SharedFile>> files;
  uint64_t n_unknown = 0; /* files opened without a known version */
};

Registry &Files() {
  static Registry registry;
  return registry;
}

#ifdef __APPLE__
#define TWZ_TIME(status, kind) (status).st_##kind##timespec
#else
#define TWZ_TIME(status, kind) (status).st_##kind##tim
#endif

/*
 * Return a text that changes whenever the bytes of an open file do; empty if there is none. A local file has its inode
 * and times: no program can set the time of the inode's last change. For a remote file GDAL itself relies on the
 * server's date. Files in memory and in archives have no more than whole seconds, which is too coarse.
 */
std::string VersionOf(const std::string &name, VSILFILE *handle) {
#ifndef _WIN32
  struct stat status;
  void *native = VSIFGetNativeFileDescriptorL(handle);
  if (native && fstat(static_cast<int>(reinterpret_cast<intptr_t>(native)), &status) == 0) {
    const auto modified = TWZ_TIME(status, m), changed = TWZ_TIME(status, c);
    return CPLSPrintf("%" PRIu64 " %" PRIu64 " %" PRId64 ".%09ld %" PRId64 ".%09ld",
                      static_cast<uint64_t>(status.st_dev), static_cast<uint64_t>(status.st_ino),
                      static_cast<int64_t>(modified.tv_sec), static_cast<long>(modified.tv_nsec),
                      static_cast<int64_t>(changed.tv_sec), static_cast<long>(changed.tv_nsec));
  }
#endif
  VSIStatBufL stated;
  if (!IsRemote(name) || VSIStatExL(name.c_str(), &stated, VSI_STAT_EXISTS_FLAG | VSI_STAT_SIZE_FLAG) != 0 ||
      stated.st_mtime == 0)
    return "";
  return CPLSPrintf("%" PRId64, static_cast<int64_t>(stated.st_mtime));
}

size_t ForgetClosed(Registry &registry) {
  for (auto at = registry.files.begin(); at != registry.files.end();) {
    at = at->second.expired() ? registry.files.erase(at) : std::next(at);
  }
  return registry.files.size();
}

/* ---- Threads: one pool for all; who finds it busy decodes alone ---- */

struct Pool {
  std::mutex mutex;
  twz_pool *pool = nullptr;
  int n_threads = 0;
  GIntBig process = 0;
};

Pool &Threads() {
  static Pool pool;
  return pool;
}

/* The workers of the pool, which the caller has locked; NULL if there are none. */
const twz_workers *WorkersOf(Pool &pool, int n_threads) {
  const GIntBig process = CPLGetCurrentProcessID();
  if (pool.process != process) pool.pool = nullptr; /* after a fork its threads are not there */
  pool.process = process;
  if (pool.pool && pool.n_threads != n_threads) {
    twz_pool_free(pool.pool);
    pool.pool = nullptr;
  }
  if (!pool.pool && twz_pool_new(static_cast<size_t>(n_threads), &pool.pool, nullptr) != TWZ_OK) return nullptr;
  pool.n_threads = n_threads;
  return twz_pool_workers(pool.pool);
}

}  // namespace

void SharedFile::Report(const std::string &name, const twz_error &error) {
  const bool is_of_a_build = std::strstr(error.text, "made by a development build") != nullptr;
  if (error.status == TWZ_UNSUPPORTED && !is_of_a_build) {
    CPLError(CE_Failure, CPLE_NotSupported, "%s: %s; install a terrainwave driver for GDAL newer than %d.%d.%d",
             name.c_str(), error.text, TWZ_VERSION_MAJOR, TWZ_VERSION_MINOR, TWZ_VERSION_PATCH);
    return;
  }
  const CPLErrorNum number = error.status == TWZ_FETCH_FAILED ? CPLE_FileIO
                             : error.status == TWZ_NO_MEMORY  ? CPLE_OutOfMemory
                                                              : CPLE_AppDefined;
  CPLError(CE_Failure, number, "%s: %s", name.c_str(), error.text);
}

SharedFile::SharedFile(const std::string &name, VSILFILE *handle)
    : name_(name), is_remote_(twz::IsRemote(name)), handle_(handle) {}

std::shared_ptr<SharedFile> SharedFile::Open(const std::string &name, VSILFILE *handle) {
  Key key{name, std::string(HEAD_BYTES, '\0'), VersionOf(name, handle), 0};
  key.head.resize(VSIFSeekL(handle, 0, SEEK_SET) == 0 ? VSIFReadL(&key.head[0], 1, HEAD_BYTES, handle) : 0);
  if (VSIFSeekL(handle, 0, SEEK_END) == 0) key.size = VSIFTellL(handle);
  Registry &registry = Files();
  {
    std::lock_guard<std::mutex> lock(registry.mutex);
    if (key.version.empty()) key.version = CPLSPrintf("unknown %" PRIu64, ++registry.n_unknown);
    auto found = registry.files.find(key);
    if (found != registry.files.end()) {
      if (auto open = found->second.lock()) return open;
    }
  }
  std::shared_ptr<SharedFile> file(new SharedFile(name, handle));
  file->head_.assign(key.head.begin(), key.head.end());
  if (!file->Load(key.size)) return nullptr;
  std::lock_guard<std::mutex> lock(registry.mutex);
  std::weak_ptr<SharedFile> &known = registry.files[key];
  if (auto open = known.lock()) return open; /* another thread was faster */
  known = file;
  return file;
}

bool SharedFile::Load(vsi_l_offset size) {
  size_t n_open;
  {
    std::lock_guard<std::mutex> lock(Files().mutex);
    n_open = ForgetClosed(Files());
  }
  twz_options options = TWZ_OPTIONS;
  options.locks.context = &mutex_;
  options.locks.lock = [](void *mutex) { static_cast<std::mutex *>(mutex)->lock(); };
  options.locks.unlock = [](void *mutex) { static_cast<std::mutex *>(mutex)->unlock(); };
  options.allocator.allocate = [](void *, size_t n) -> void * {
    try {
      return Memory().Allocate(n);
    } catch (const std::exception &) {
      return nullptr;
    }
  };
  options.allocator.release = [](void *, void *memory) { Memory().Release(memory); };
  options.cache_bytes = std::max(CACHE_BYTES / (n_open + 1), LEAST_CACHE_BYTES);
  twz_error error;
  if (twz_file_new(&options, size, &file_, &error) != TWZ_OK ||
      twz_file_load(file_, FetchAll, handle_, &error) != TWZ_OK) {
    Report(name_, error);
    return false;
  }
  info_ = twz_file_info(file_);
  return true;
}

SharedFile::~SharedFile() { twz_file_free(file_); }

std::string SharedFile::Fingerprint() const {
  uint64_t hash = 14695981039346656037u; /* FNV-1a */
  for (const uint8_t byte : head_) hash = (hash ^ byte) * 1099511628211u;
  char text[40];
  CPLsnprintf(text, sizeof text, "%016" PRIx64 "-%" PRIu64, hash, info_->file_size);
  return text;
}

namespace {

/* What a window has taken so far. */
struct Spent {
  size_t n_requests = 0;
  uint64_t n_wanted = 0, n_gaps = 0; /* bytes */
};

/* Join pieces with the shortest gaps between them. */
std::vector<Piece> Joined(std::vector<Piece> pieces, Spent &spent) {
  std::vector<std::pair<uint64_t, size_t>> gaps;
  for (size_t i = 0; i < pieces.size(); i++) {
    spent.n_wanted += pieces[i].bytes.size();
    if (i > 0) gaps.emplace_back(pieces[i].offset - pieces[i - 1].End(), i);
  }
  const uint64_t free = std::max(spent.n_wanted / 4, FREE_GAPS);
  const uint64_t most = std::max(spent.n_wanted / 2 * 3, FREE_GAPS_OF_MANY);
  std::sort(gaps.begin(), gaps.end());
  std::vector<bool> is_joined(pieces.size(), false);
  size_t n_requests = spent.n_requests + pieces.size();
  for (const auto &gap : gaps) {
    if (gap.first > MOST_GAP || spent.n_gaps + gap.first > (n_requests > AIMED_REQUESTS ? most : free)) break;
    spent.n_gaps += gap.first;
    n_requests--;
    is_joined[gap.second] = true;
  }
  spent.n_requests = n_requests;
  std::vector<Piece> joined;
  for (size_t i = 0; i < pieces.size(); i++) {
    if (!is_joined[i]) {
      joined.push_back(std::move(pieces[i]));
      continue;
    }
    Piece &last = joined.back();
    last.bytes.resize(static_cast<size_t>(pieces[i].End() - last.offset));
  }
  return joined;
}

}  // namespace

/* A round is one call of VSI. What has come of a remote file is not fetched again. */
bool LoadWindow(const SharedFile &file, VSILFILE *handle, twz_window *window, twz_error *error) {
  const bool is_remote = file.IsRemote();
  std::vector<Piece> ahead;
  Spent spent;
  if (is_remote) ahead.push_back({0, file.Head()});
  std::vector<twz_range> ranges(MOST_RANGES);
  for (;;) {
    size_t n = 0;
    if (twz_window_need(window, ranges.data(), ranges.size(), &n, error) != TWZ_OK) return false;
    if (n == 0) return true;
    std::vector<Piece> pieces;
    bool is_told = false;
    for (size_t i = 0; i < n; i++) {
      const twz_range &range = ranges[i];
      const uint64_t end = range.offset + range.length;
      const auto known = std::find_if(ahead.begin(), ahead.end(), [&](const Piece &piece) {
        return piece.offset <= range.offset && end <= piece.End();
      });
      if (known != ahead.end()) {
        const uint8_t *bytes = known->bytes.data() + (range.offset - known->offset);
        if (twz_window_feed(window, range.offset, bytes, static_cast<size_t>(range.length), error) != TWZ_OK)
          return false;
        is_told = is_told || range.is_page;
        continue;
      }
      pieces.push_back({range.offset, std::vector<uint8_t>(static_cast<size_t>(range.length))});
    }
    if (pieces.empty() || is_told) continue; /* pages that were here may tell more of what to fetch */
    if (is_remote) pieces = Joined(std::move(pieces), spent);
    if (!Fetch(handle, pieces)) {
      error->status = TWZ_FETCH_FAILED;
      CPLsnprintf(error->text, sizeof error->text, "bytes " CPL_FRMT_GUIB " to " CPL_FRMT_GUIB " could not be read",
                  static_cast<GUIntBig>(pieces.front().offset), static_cast<GUIntBig>(pieces.back().End() - 1));
      return false;
    }
    for (Piece &piece : pieces) {
      if (twz_window_feed(window, piece.offset, piece.bytes.data(), piece.bytes.size(), error) != TWZ_OK)
        return false;
      if (is_remote) ahead.push_back(std::move(piece));
    }
  }
}

namespace {

/* A part of a level, of whole blocks. */
struct Blocks {
  uint32_t row, col, n_rows, n_cols;
};

/* The largest error that blocks state, in raw units; negative while pages of the index are missing. */
double LargestError(const twz_window *window, const Blocks &part) {
  double largest = 0;
  for (uint32_t row = part.row; row < part.row + part.n_rows; row++) {
    for (uint32_t col = part.col; col < part.col + part.n_cols; col++) {
      twz_block block;
      if (twz_window_block(window, row, col, &block, nullptr) != TWZ_OK) return -1;
      largest = std::max(largest, block.raw_error);
    }
  }
  return largest;
}

/* The same, with the pages that it takes; no payload is read. Negative after an error, too. */
double LoadedError(const SharedFile &file, VSILFILE *handle, int level, const twz_level &size, const Blocks &part) {
  const uint32_t side = file.Info().block_size, row = part.row * side, col = part.col * side;
  const twz_box box = {row, col, std::min(part.n_rows * side, size.n_rows - row),
                       std::min(part.n_cols * side, size.n_cols - col)};
  twz_window *made = nullptr;
  if (twz_window_new(file.Get(), level, &box, &made, nullptr) != TWZ_OK) return -1;
  const std::unique_ptr<twz_window, void (*)(twz_window *)> window(made, twz_window_free);
  std::vector<twz_range> ranges(MOST_RANGES);
  for (;;) {
    const double found = LargestError(made, part);
    size_t n = 0;
    if (found >= 0 || twz_window_need(made, ranges.data(), ranges.size(), &n, nullptr) != TWZ_OK || n == 0) return found;
    for (size_t i = 0; i < n; i++) {
      if (!ranges[i].is_page) continue;
      std::vector<Piece> page(1);
      page[0].offset = ranges[i].offset;
      page[0].bytes.resize(static_cast<size_t>(ranges[i].length));
      if (!Fetch(handle, page) ||
          twz_window_feed(made, page[0].offset, page[0].bytes.data(), page[0].bytes.size(), nullptr) != TWZ_OK)
        return -1;
    }
  }
}

}  // namespace

double StatedError(const SharedFile &file, VSILFILE *handle, int level) {
  twz_level size;
  if (file.IsRemote() || twz_file_level(file.Get(), level, &size, nullptr) != TWZ_OK) return -1;
  const auto count = [&file](uint32_t n) {
    return std::max(n - 1 + file.Info().block_size - 1, file.Info().block_size) / file.Info().block_size;
  };
  const uint32_t n_rows = count(size.n_rows), n_cols = count(size.n_cols);
  if (uint64_t{n_rows} * n_cols > MOST_BLOCKS) return -1;
  double largest = 0;
  for (uint32_t row = 0; row < n_rows; row += BLOCKS_AT_ONCE) {
    for (uint32_t col = 0; col < n_cols; col += BLOCKS_AT_ONCE) {
      const Blocks part = {row, col, std::min(BLOCKS_AT_ONCE, n_rows - row), std::min(BLOCKS_AT_ONCE, n_cols - col)};
      const double error = LoadedError(file, handle, level, size, part);
      if (error < 0) return error;
      largest = std::max(largest, error);
    }
  }
  return largest;
}

std::string StatedRoot(const SharedFile &file, VSILFILE *handle) {
  char root[TWZ_ROOT_SIZE];
  twz_error error;
  if (twz_file_stated_root(file.Get(), FetchAll, handle, root, &error) == TWZ_OK) return root;
  SharedFile::Report(file.Name(), error);
  return std::string();
}

int ThreadsOf(const char *option) {
  const char *text = option ? option : CPLGetConfigOption("GDAL_NUM_THREADS", "1");
  const int n = EQUAL(text, "ALL_CPUS") ? CPLGetNumCPUs() : atoi(text);
  return std::max(1, std::min(n, 128));
}

twz_status DecodeWindow(twz_window *window, int n_threads, void *heights, ptrdiff_t heights_stride, twz_error *error) {
  const auto decode = [&](const twz_workers *workers) {
    if (!heights) return twz_window_decode(window, workers, error);
    return twz_window_decode_into(window, workers, heights, heights_stride, nullptr, 0, error);
  };
  Pool &pool = Threads();
  if (n_threads <= 1 || !pool.mutex.try_lock()) return decode(nullptr);
  std::lock_guard<std::mutex> lock(pool.mutex, std::adopt_lock);
  return decode(WorkersOf(pool, n_threads));
}

void EndThreads() {
  Pool &pool = Threads();
  std::lock_guard<std::mutex> lock(pool.mutex);
  if (pool.pool && pool.process == CPLGetCurrentProcessID()) twz_pool_free(pool.pool);
  pool.pool = nullptr;
}

}  // namespace twz
