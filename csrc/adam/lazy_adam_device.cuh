// SPDX-License-Identifier: Apache-2.0
// The Adam step of a few elements of a row, for step_kernel (lazy_adam_cuda.cu) and for the projection's
// backward pass that takes the step (project_step_cuda.cu).
#pragma once
#include "adam/lazy_adam.h"
#include "common/cuda.cuh"

namespace blitzgs::cuda {

// The factors beta1^k and beta2^k by which the moments decay over k steps.
struct Decay {
  float first, second;
};

__device__ inline Decay make_decay(const AdamArgs<float>& args, int32_t steps) {
  const double* row = args.table_row(steps);
  return {float(row[kBeta1Power]), float(row[kBeta2Power])};
}

// Width floats that one instruction loads or stores.
template <int Width> struct alignas(4 * Width) Pack {
  float x[Width];
};

// The learning-rate group of an element of a pack. In a pack that spans two groups, only the last element is
// in the second one.
template <int Column, int Width> __device__ constexpr int pack_group(int pack, int element) {
  return adam_group(Column, pack * Width + (element < Width - 1 ? 0 : element));
}

// The Adam step of Width elements of a row of a column. load() and finish() are separate, so that a thread
// can have the loads of several packs in flight.
template <int Column, int Width> class StepPack {
 public:
  using P = Pack<Width>;

  __device__ __forceinline__ void load(const AdamColumn<float>& column, int64_t row, int pack) {
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
  int64_t at_;
  int pack_;
};

// The first two kernels of catching up, for lazy_adam_cuda.cu: prepare computes the rules by which rows catch
// up, and list_pending_rows lists the rows with pending steps.

inline constexpr int kPrepareLanes = 8, kPrepareThreads = 64, kListThreads = 256;
static_assert(kPrepareLanes > kAdamGroups);

// The rules and decays by which rows catch up. All rows of a launch catch up to the same step, so the rules
// depend on the row's last_step alone and are computed once for each such step. If final rules are tabulated,
// only those of the last explicit_steps steps are computed.
struct Prepared {
  PendingSteps<float>* pending;  // [target - first], for parameters at the steps first, first + 1, ...
  Decay* decays;                 // [n_decays], the decay of the moments over i steps
  bool* any_pending;             // whether any row has pending steps
  const PendingSteps<float>* final_rules;  // for parameters at the steps before `first`
  int32_t first, n_decays;

  __device__ const PendingSteps<float>& of(int32_t from) const {
    return from < first ? final_rules[from] : pending[from - first];
  }
};

// Computes prepared.pending and prepared.decays. kPrepareLanes lanes per step, one for each learning-rate
// group, because the kernel's time is that of a chain of divisions.
static __global__ void __launch_bounds__(kPrepareThreads)
    prepare(const __grid_constant__ AdamArgs<float> args, const Prepared prepared) {
  wait_for_earlier_kernels();
  const auto thread = int32_t(blockIdx.x * kPrepareThreads + threadIdx.x);
  const int32_t i = thread / kPrepareLanes, t = prepared.first + i, target = args.target();
  const int group = thread % kPrepareLanes;
  if (thread == 0) *prepared.any_pending = false;
  if (i < prepared.n_decays && group == kPrepareLanes - 1) prepared.decays[i] = make_decay(args, i);
  double error = 0;
  if (t < target && group < kAdamGroups)
    prepared.pending[i].rules[group] = adam_rule(args, t, target, group, error);
#pragma unroll
  for (int step = 1; step < kPrepareLanes; step *= 2) {
    error = fmax(error, __shfl_xor_sync(kFullWarp, error, step));
  }
  if (t >= target || group != 0) return;
  PendingSteps<float>& steps = prepared.pending[i];
  steps.from = t;
  steps.to = target;
  steps.explicit_up_to = adam_explicit_up_to(args, t, target, error);
}

struct alignas(16) PendingRow {
  int32_t id;    // -1: the row has no pending steps, or has taken them already
  int32_t from;  // the step of its parameters
  Decay here;    // the decay of its moments up to that step
};

// One column of a row catches up if the rules are not exact enough for all its elements. All lanes of the
// warp call this, each for some elements of the row.
template <int Column>
__device__ void catch_up_elements(const AdamArgs<float>& args, const PendingSteps<float>& steps,
                                  const Decay& here, int64_t row) {
  const AdamColumn<float>& column = args.columns[Column];
  for (int j = threadIdx.x % 32; j < column.width; j += 32) {
    const int64_t at = row * column.width + j;
    column.param[at] -= adam_drift(args, steps, adam_group(Column, j), column.exp_avg[at] * here.first,
                                   column.exp_avg_sq[at] * here.second);
  }
}

// The number of valid rows in the list. A count above n says that the caller had too little room for the list
// and will repeat its work; the n rows that are there are valid.
__device__ inline int64_t listed(const AdamArgs<float>& args) {
  return args.count && *args.count < args.n ? *args.count : args.n;
}

// Writes the pending rows [n], one thread per listed row, and sets last_step to the target, as if the rows
// had caught up. Rows for which the rules are not exact enough, which occur only early in a schedule, catch
// up here, each by a whole warp.
static __global__ void __launch_bounds__(kListThreads)
    list_pending_rows(const __grid_constant__ AdamArgs<float> args, const Prepared prepared,
                      PendingRow* pending_rows) {
  wait_for_earlier_kernels();
  const int64_t n = listed(args);
  for (int64_t first = blockIdx.x * int64_t{kListThreads}; first < n;
       first += gridDim.x * int64_t{kListThreads}) {
    const int64_t i = first + threadIdx.x;
    PendingRow mine{-1, 0, {}};
    bool explicitly = false;
    if (i < n) {
      const int32_t row = int32_t(args.row(i));
      const int32_t from = args.last_step[row], stand = args.moment_step[row];
      if (adam_moves(args, from, stand)) {
        mine = {row, from, prepared.decays[from - stand]};
        explicitly = prepared.of(from).explicit_up_to >= 0;
      }
      if (from < args.step) args.last_step[row] = args.step;
    }
    for (unsigned left = __ballot_sync(kFullWarp, explicitly); left; left &= left - 1) {
      const int lane = __ffs(left) - 1;
      const int64_t row = __shfl_sync(kFullWarp, mine.id, lane);
      const PendingSteps<float>& steps = prepared.of(__shfl_sync(kFullWarp, mine.from, lane));
      const Decay here{__shfl_sync(kFullWarp, mine.here.first, lane),
                       __shfl_sync(kFullWarp, mine.here.second, lane)};
      catch_up_elements<0>(args, steps, here, row);
      catch_up_elements<1>(args, steps, here, row);
      catch_up_elements<2>(args, steps, here, row);
      catch_up_elements<3>(args, steps, here, row);
      catch_up_elements<4>(args, steps, here, row);
    }
    if (explicitly) mine.id = -1;
    if (i < n) pending_rows[i] = mine;
    if (__any_sync(kFullWarp, mine.id >= 0) && threadIdx.x % 32 == 0) *prepared.any_pending = true;
  }
}

}  // namespace blitzgs::cuda
