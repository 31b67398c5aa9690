// SPDX-License-Identifier: Apache-2.0
#include <type_traits>

#include "common/cuda_check.h"
#include "lazy_adam/lazy_adam.h"

namespace blitzgs::cuda {

namespace {

constexpr int kRows = 32;  // rows per block
constexpr int kThreads = 128;

// What rows that stand at any step before the target owe: every row of a launch goes to the same step, so
// the double arithmetic is done once a step, not once a row.
__global__ void list_debts(const AdamArgs<float> args, AdamDebt<float>* debts) {
  const std::int32_t from = blockIdx.x * blockDim.x + threadIdx.x;
  if (from < args.target()) debts[from] = adam_debt(args, from, args.target());
}

template <int Width>
struct alignas(4 * Width) Pack {
  float x[Width];
};

// A row as the threads of its block see it.
struct BlockRow {
  std::int32_t row, list_row;
  AdamRow<float> state;
};

// One pack of Width elements of one row: loads first, so that many packs are in flight, then the arithmetic.
template <int Column, int Width, bool Gradient>
class Item {
 public:
  __device__ __forceinline__ void load(const AdamArgs<float>& args, const BlockRow* rows, int local,
                                       int pack) {
    const AdamColumn<float>& column = args.columns[Column];
    local_ = local;
    pack_ = pack;
    at_ = rows[local].row * column.width + pack * Width;
    p_ = *reinterpret_cast<const P*>(column.param + at_);
    m_ = *reinterpret_cast<const P*>(column.exp_avg + at_);
    v_ = *reinterpret_cast<const P*>(column.exp_avg_sq + at_);
    if (Gradient) {
      g_ = *reinterpret_cast<const P*>(column.grad + rows[local].list_row * column.width + pack * Width);
    }
  }

  __device__ __forceinline__ void finish(const AdamArgs<float>& args, const AdamStep<float>& step,
                                         const AdamDebt<float>* debts, const BlockRow* rows) {
    const AdamColumn<float>& column = args.columns[Column];
    const AdamRow<float>& state = rows[local_].state;
    const int first = adam_group(Column, pack_ * Width), last = adam_group(Column, pack_ * Width + Width - 1);
    if (state.moves) {
      const AdamDebt<float>& debt = debts[state.from];
      const AdamRule<float> rules[2] = {debt.rules[first], debt.rules[last]};
#pragma unroll
      for (int j = 0; j < Width; ++j) {
        const bool low = j < Width - 1;  // of a pack over two groups, the last element alone has the second
        p_.x[j] -= adam_drift(args, debt, rules[low ? 0 : 1], low ? first : last, m_.x[j] * state.here1,
                              v_.x[j] * state.here2);
      }
    }
    if (Gradient) {
#pragma unroll
      for (int j = 0; j < Width; ++j) {
        m_.x[j] *= state.then1;
        v_.x[j] *= state.then2;
        adam_update(step, j < Width - 1 ? first : last, g_.x[j], p_.x[j], m_.x[j], v_.x[j]);
      }
      *reinterpret_cast<P*>(column.exp_avg + at_) = m_;
      *reinterpret_cast<P*>(column.exp_avg_sq + at_) = v_;
    }
    *reinterpret_cast<P*>(column.param + at_) = p_;
  }

 private:
  using P = Pack<Width>;
  P p_, m_, v_, g_;
  std::int64_t at_;
  int local_, pack_;
};

// The rows of the block that there is something to do for, in `rows`; returns how many.
template <bool Gradient>
__device__ __forceinline__ int collect_rows(const AdamArgs<float>& args, BlockRow* rows) {
  static_assert(kRows == 32, "the first warp has a row a lane");
  bool work = false;
  if (threadIdx.x < kRows) {
    BlockRow mine;
    const std::int64_t i = blockIdx.x * std::int64_t{kRows} + threadIdx.x;
    if (i < args.n) {
      mine.list_row = static_cast<std::int32_t>(i);
      mine.row = args.ids ? args.ids[i] : mine.list_row;
      mine.state = adam_row(args, mine.row);
      work = Gradient || mine.state.moves;
      if (Gradient || mine.state.from < args.step) args.last_step[mine.row] = args.step;
      if (Gradient) args.moment_step[mine.row] = args.step;
    }
    const unsigned ballot = __ballot_sync(~0u, work);
    if (work) rows[__popc(ballot & ((1u << threadIdx.x) - 1))] = mine;
  }
  return __syncthreads_count(work);
}

// A block owns kRows rows of the list in all five columns, so their steps are read and written by it alone.
// The short columns' loads are in flight while the SH column is worked on.
template <int ShWidth, bool Gradient>
__global__ void __launch_bounds__(kThreads)
    lazy_adam_kernel(const AdamArgs<float> args, const AdamDebt<float>* debts) {
  __shared__ BlockRow rows[kRows];
  __shared__ AdamStep<float> step;
  if (Gradient && threadIdx.x == kThreads - 1) step = adam_step_scalars(args);
  const int count = collect_rows<Gradient>(args, rows);
  const int thread = threadIdx.x;
  Item<0, 1, Gradient> mean;
  Item<1, 4, Gradient> quat;
  Item<2, 1, Gradient> scale;
  Item<3, 1, Gradient> opacity;
  if (thread < 3 * count) {
    mean.load(args, rows, thread / 3, thread % 3);
    scale.load(args, rows, thread / 3, thread % 3);
  }
  if (thread < count) {
    quat.load(args, rows, thread, 0);
    opacity.load(args, rows, thread, 0);
  }
  constexpr int kUnroll = 3;
  const int packs = static_cast<int>(args.columns[4].width) / ShWidth, items = count * packs;
  for (int base = thread; base < items; base += kThreads * kUnroll) {
    Item<4, ShWidth, Gradient> sh[kUnroll];
#pragma unroll
    for (int u = 0; u < kUnroll; ++u) {
      const int item = base + u * kThreads;
      if (item < items) sh[u].load(args, rows, item / packs, item % packs);
    }
#pragma unroll
    for (int u = 0; u < kUnroll; ++u) {
      if (base + u * kThreads < items) sh[u].finish(args, step, debts, rows);
    }
  }
  if (thread < 3 * count) {
    mean.finish(args, step, debts, rows);
    scale.finish(args, step, debts, rows);
  }
  if (thread < count) {
    quat.finish(args, step, debts, rows);
    opacity.finish(args, step, debts, rows);
  }
}

}  // namespace

template <class T>
void lazy_adam(const AdamArgs<T>& args, Workspace& workspace, CudaStream stream) {
  static_assert(std::is_same_v<T, float>);
  if (args.n == 0) return;
  AdamDebt<float>* debts = nullptr;
  if (args.target() > 0 && !args.sparse) {
    debts = workspace.allocate<AdamDebt<float>>(args.target());
    list_debts<<<blocks_for(args.target(), 64), 64, 0, stream>>>(args, debts);
    check_launch("list_debts");
  }
  const bool wide = args.columns[4].width % 4 == 0;
  auto kernel = args.with_gradient() ? (wide ? lazy_adam_kernel<4, true> : lazy_adam_kernel<1, true>)
                                     : (wide ? lazy_adam_kernel<4, false> : lazy_adam_kernel<1, false>);
  kernel<<<blocks_for(args.n, kRows), kThreads, 0, stream>>>(args, debts);
  check_launch("lazy_adam");
}

template void lazy_adam<float>(const AdamArgs<float>&, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
