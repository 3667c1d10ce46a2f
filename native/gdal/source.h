/* A .twz file that datasets of GDAL share, and what reads it. SPDX-License-Identifier: MIT */
#ifndef TWZ_GDAL_SOURCE_H
#define TWZ_GDAL_SOURCE_H

#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "cpl_vsi.h"
#include "terrainwave.h"

namespace twz {

/* One file, decoded for all datasets that have it open: they share what is known of it and its decoded units.
 * Thread-safe. Each dataset reads by a handle of its own, so that none waits for another's. */
class SharedFile {
 public:
  /* The file of that name, shared if one is open. Empty after an error, which CPLError has told. */
  static std::shared_ptr<SharedFile> Open(const std::string &name, VSILFILE *handle);
  ~SharedFile();
  SharedFile(const SharedFile &) = delete;
  SharedFile &operator=(const SharedFile &) = delete;

  const twz_info &Info() const { return *info_; }
  twz_file *Get() const { return file_; }
  const std::string &Name() const { return name_; }
  bool IsRemote() const { return is_remote_; } /* requests are costly */
  const std::vector<uint8_t> &Head() const { return head_; } /* how the file begins */
  /* A text that another file does not have: of its size, its header, its metadata and the first page of its index. */
  std::string Fingerprint() const;

  /* Tell an error of the library in one line. */
  static void Report(const std::string &name, const twz_error &error);

 private:
  SharedFile(const std::string &name, VSILFILE *handle);
  bool Load(vsi_l_offset size);

  std::string name_;
  bool is_remote_;
  std::vector<uint8_t> head_;
  VSILFILE *handle_; /* of the dataset that opens the file; not used afterwards */
  std::mutex mutex_;
  twz_file *file_ = nullptr;
  const twz_info *info_ = nullptr;
};

/* Fetch what a window needs: in few requests if they are costly. */
bool LoadWindow(const SharedFile &file, VSILFILE *handle, twz_window *window, twz_error *error);

/* The largest error that blocks of a level state, in raw units; negative where it takes too many requests to know. */
double StatedError(const SharedFile &file, VSILFILE *handle, int level);

/* The root that the file's digests state; empty where it has none. */
std::string StatedRoot(const SharedFile &file, VSILFILE *handle);

/* Threads that the open option, else GDAL_NUM_THREADS, asks for. */
int ThreadsOf(const char *option);
/* Decode by so many threads, which all datasets share. */
twz_status DecodeWindow(twz_window *window, int n_threads, void *heights, ptrdiff_t heights_stride, twz_error *error);
/* End the threads; when the driver goes. */
void EndThreads();

}  // namespace twz
#endif
