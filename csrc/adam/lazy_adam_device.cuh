// SPDX-License-Identifier: Apache-2.0
// The Adam step of a few elements of a row, for step_kernel (lazy_adam_cuda.cu) and for the projection's
// backward pass that takes the step (project_step_cuda.cu).
#pragma once
#include <cstdint>

#include "adam/lazy_adam.h"

namespace blitzgs::cuda {

// The factors beta1^k and beta2^k by which the moments decay over k steps.
struct Decay {
  float first, second;
};

__device__ inline Decay make_decay(const AdamArgs<float>& args, std::int32_t steps) {
  const double* row = args.table_row(steps);
  return {static_cast<float>(row[kBeta1Power]), static_cast<float>(row[kBeta2Power])};
}

// Width floats that one instruction loads or stores.
template <int Width>
struct alignas(4 * Width) Pack {
  float x[Width];
};

// The learning-rate group of an element of a pack. In a pack that spans two groups, only the last element is
// in the second one.
template <int Column, int Width>
__device__ constexpr int pack_group(int pack, int element) {
  return adam_group(Column, pack * Width + (element < Width - 1 ? 0 : element));
}

// The Adam step of Width elements of a row of a column. load() and finish() are separate, so that a thread
// can have the loads of several packs in flight.
template <int Column, int Width>
class StepPack {
 public:
  using P = Pack<Width>;

  __device__ __forceinline__ void load(const AdamColumn<float>& column, std::int64_t row, int pack) {
    pack_ = pack;
    at_ = row * column.width + pack * Width;
    p_ = *reinterpret_cast<const P*>(column.param + at_);
    m_ = *reinterpret_cast<const P*>(column.exp_avg + at_);
    v_ = *reinterpret_cast<const P*>(column.exp_avg_sq + at_);
  }
  __device__ __forceinline__ void finish(const AdamColumn<float>& column, const AdamStep<float>& step,
                                         const Decay& decay, const P& g) {
#pragma unroll
    for (int j = 0; j < Width; ++j) {
      m_.x[j] *= decay.first;
      v_.x[j] *= decay.second;
      adam_update(step, pack_group<Column, Width>(pack_, j), g.x[j], p_.x[j], m_.x[j], v_.x[j]);
    }
    *reinterpret_cast<P*>(column.param + at_) = p_;
    *reinterpret_cast<P*>(column.exp_avg + at_) = m_;
    *reinterpret_cast<P*>(column.exp_avg_sq + at_) = v_;
  }

 private:
  P p_, m_, v_;
  std::int64_t at_;
  int pack_;
};

}  // namespace blitzgs::cuda
