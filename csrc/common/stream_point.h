// SPDX-License-Identifier: Apache-2.0
// CUDA only: a point in a stream that another stream waits for while work is queued behind it.
#pragma once
#include "common/stream.h"

struct CUevent_st;  // cudaEvent_t is a pointer to this

namespace blitzgs::cuda {

class StreamPoint {
 public:
  // Behind what is queued now.
  explicit StreamPoint(CudaStream);
  ~StreamPoint();
  StreamPoint(const StreamPoint&) = delete;
  StreamPoint& operator=(const StreamPoint&) = delete;

  // What is queued in another stream from now on waits for it.
  void hold(CudaStream other) const;

 private:
  CUevent_st* event_ = nullptr;
};

}  // namespace blitzgs::cuda
