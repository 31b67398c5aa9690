// SPDX-License-Identifier: Apache-2.0
#include "common/stream_point.h"

#include "common/cuda_check.h"

namespace blitzgs::cuda {

StreamPoint::StreamPoint(CudaStream stream) {
  check(cudaEventCreateWithFlags(&event_, cudaEventDisableTiming), "an event");
  check(cudaEventRecord(event_, stream), "an event");
}

StreamPoint::~StreamPoint() { cudaEventDestroy(event_); }

void StreamPoint::hold(CudaStream other) const { check(cudaStreamWaitEvent(other, event_, 0), "an event"); }

}  // namespace blitzgs::cuda
