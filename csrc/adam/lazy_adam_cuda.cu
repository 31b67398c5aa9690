// SPDX-License-Identifier: Apache-2.0
#include "adam/lazy_adam_device.cuh"
#include "adam/position_noise.h"
#include "adam/scale_limit.h"
#include "common/rows.h"

namespace blitzgs::cuda {
namespace {

// The lazy optimiser (lazy_adam.h) on CUDA. Catching up takes three kernels: prepare computes the rules and
// list_pending_rows lists the rows with pending steps (lazy_adam_device.cuh), and catch_up_kernel moves their
// parameters. step_kernel takes the step with gradients. A parameter stepped alone has its own.

// A row with SH degree 3 has 12 packs of four SH coefficients, one quaternion and seven more numbers; each of
// these gets a thread.
constexpr int kRows = 16;  // rows per block
constexpr int kThreads = kRows * (12 + 8);
// With three SH values a row (the first coefficient alone) a block has threads for more rows.
constexpr int kFewPacks = 3, kMoreRows = kThreads / (kFewPacks + 8);
constexpr int kCatchUpBlocks = 4, kListBlocks = 8;  // per multiprocessor
constexpr int kAlone = kAdamColumns - 1;            // the column of a parameter that is stepped alone

// Calls update<Column, Width>(local row, pack) for the packs that this thread handles in every Rows rows.
// ShPacks: the packs in an SH row; 0: sh_packs is their number.
template <int ShWidth, int ShPacks, int Rows, class F>
__device__ __forceinline__ void for_each_pack(int sh_packs, const F& update) {
  const int packs = ShPacks ? ShPacks : sh_packs;
  // If the number of packs is known at compile time, a single round handles all of them.
  constexpr int kRound = ShPacks ? Rows * (ShPacks + 8) : kThreads;
  static_assert(kRound <= kThreads);
  for (int item = threadIdx.x; item < Rows * (packs + 8); item += kRound) {
    const int rest = item - Rows * packs;
    if (rest < 0) {
      update.template operator()<4, ShWidth>(item / packs, item % packs);
    } else if (rest < 3 * Rows) {
      update.template operator()<0, 1>(rest / 3, rest % 3);
    } else if (rest < 6 * Rows) {
      update.template operator()<2, 1>(rest / 3 - Rows, rest % 3);
    } else if (rest < 7 * Rows) {
      update.template operator()<1, 4>(rest - 6 * Rows, 0);
    } else {
      update.template operator()<3, 1>(rest - 7 * Rows, 0);
    }
  }
}

// One pack of a row catches up by the rules.
template <int Column, int Width>
__device__ __forceinline__ void catch_up_pack(const AdamArgs<float>& args, const Prepared& prepared,
                                              const PendingRow& row, int pack) {
  using P = Pack<Width>;
  const AdamColumn<float>& column = args.columns[Column];
  const int64_t at = row.id * column.width + pack * Width;
  P p = *reinterpret_cast<const P*>(column.param + at);
  const P m = *reinterpret_cast<const P*>(column.exp_avg + at);
  const P v = *reinterpret_cast<const P*>(column.exp_avg_sq + at);
  const PendingSteps<float>& steps = prepared.of(row.from);
  const AdamRule<float> first = steps.rules[pack_group<Column, Width>(pack, 0)],
                        last = steps.rules[pack_group<Column, Width>(pack, Width - 1)];
#pragma unroll
  for (int j = 0; j < Width; ++j) {
    p.x[j] -= adam_ruled_drift(j < Width - 1 ? first : last, m.x[j] * row.here.first,
                               adam_root(v.x[j] * row.here.second), float(args.eps));
  }
  *reinterpret_cast<P*>(column.param + at) = p;
}

// The pending rows catch up: reads parameters and moments, writes parameters. A thread handles the same pack
// of every (gridDim.x * Rows)-th listed row, and loads the next list entry while it updates the current row.
template <int ShWidth, int ShPacks, int Rows>
__global__ void __launch_bounds__(kThreads, kCatchUpBlocks)
    catch_up_kernel(const __grid_constant__ AdamArgs<float> args, const Prepared prepared,
                    const PendingRow* pending_rows) {
  wait_for_earlier_kernels();
  if (!*prepared.any_pending) return;
  const int64_t n = listed(args);
  const auto catch_up_one = [&]<int Column, int Width>(int local, int pack) {
    const int64_t stride = gridDim.x * int64_t{Rows};
    int64_t i = blockIdx.x * int64_t{Rows} + local;
    PendingRow next{-1, 0, {}};
    if (i < n) next = pending_rows[i];
    while (i < n) {
      const PendingRow row = next;
      i += stride;
      if (i < n) next = pending_rows[i];
      if (row.id >= 0) catch_up_pack<Column, Width>(args, prepared, row, pack);
    }
  };
  for_each_pack<ShWidth, ShPacks, Rows>(int(args.columns[4].width) / ShWidth, catch_up_one);
}

// One pack of a row takes the Adam step; the row has caught up.
template <int Column, int Width>
__device__ __forceinline__ void step_pack(const AdamArgs<float>& args, const AdamStep<float>& step,
                                          int64_t row, int64_t list_row, int pack) {
  const AdamColumn<float>& column = args.columns[Column];
  StepPack<Column, Width> own;
  own.load(column, row, pack);
  const auto g = *reinterpret_cast<const Pack<Width>*>(column.grad + list_row * column.width + pack * Width);
  own.finish(column, step, make_decay(args, args.target() - args.moment_step[row]), g);
}

// The Adam step with gradients, for rows that have caught up. One thread per pack. A block handles Rows rows
// of the list in all five columns, so no other block reads or writes their last_step and moment_step.
template <int ShWidth, int ShPacks, int Rows>
__global__ void __launch_bounds__(kThreads) step_kernel(const __grid_constant__ AdamArgs<float> args) {
  __shared__ AdamStep<float> step;
  wait_for_earlier_kernels();
  if (threadIdx.x == 0) step = adam_step_scalars(args);
  __syncthreads();
  const int64_t first = blockIdx.x * int64_t{Rows};
  const int count = int(args.n - first < Rows ? args.n - first : Rows);
  const auto take_step = [&]<int Column, int Width>(int local, int pack) {
    if (local >= count) return;
    const int64_t row = args.row(first + local);
    step_pack<Column, Width>(args, step, row, first + local, pack);
  };
  for_each_pack<ShWidth, ShPacks, Rows>(int(args.columns[4].width) / ShWidth, take_step);
  __syncthreads();
  if (threadIdx.x >= count) return;
  const int64_t i = first + threadIdx.x, row = args.row(i);
  args.last_step[row] = args.step;
  args.moment_step[row] = args.step;
}

// catch_up_kernel and step_kernel for a parameter that is stepped alone, which is in the last column and may
// have any width: the rows catch up if rules are prepared, and then take the step if there is a
// gradient, whose learning rates enter the tables. A block handles whole rows, so no other block reads or
// writes their last_step and moment_step; neighbouring lanes access neighbouring addresses.
__global__ void __launch_bounds__(kListThreads)
    alone_kernel(const __grid_constant__ AdamArgs<float> args, const Prepared prepared, int block_rows) {
  __shared__ AdamStep<float> step;
  wait_for_earlier_kernels();
  const AdamColumn<float>& column = args.columns[kAlone];
  const bool takes_step = args.with_gradient();
  if (takes_step && threadIdx.x == 0) step = adam_step_scalars(args);
  __syncthreads();
  const int64_t n = listed(args), stride = gridDim.x * int64_t{block_rows};
  for (int64_t first = blockIdx.x * int64_t{block_rows}; first < n; first += stride) {
    const auto count = unsigned(n - first < block_rows ? n - first : block_rows),
               width = unsigned(column.width);
    for (unsigned e = threadIdx.x; e < count * width; e += kListThreads) {
      const unsigned j = e % width;
      const int64_t row = args.row(first + e / width), at = row * column.width + j;
      const int32_t from = args.last_step[row], stand = args.moment_step[row];
      const bool moves = prepared.decays && adam_moves(args, from, stand);
      if (!moves && !takes_step) continue;
      const int group = adam_group(kAlone, int(j));
      float p = column.param[at], m = column.exp_avg[at], v = column.exp_avg_sq[at];
      if (moves) {
        const Decay here = prepared.decays[from - stand];
        p -= adam_drift(args, prepared.of(from), group, m * here.first, v * here.second);
      }
      if (takes_step) {
        const Decay decay = make_decay(args, args.target() - stand);
        m *= decay.first;
        v *= decay.second;
        adam_update(step, group, column.grad[first * column.width + e], p, m, v);
        column.exp_avg[at] = m;
        column.exp_avg_sq[at] = v;
      }
      column.param[at] = p;
    }
    __syncthreads();
    for (unsigned i = threadIdx.x; i < count; i += kListThreads) {
      const int64_t row = args.row(first + i);
      if (args.last_step[row] < args.step) args.last_step[row] = args.step;
      if (takes_step) args.moment_step[row] = args.step;
    }
  }
  for (int item = int(blockIdx.x * kListThreads + threadIdx.x); item < args.rates.reach() * kAdamOrders;
       item += int(gridDim.x) * kListThreads) {
    const int back = item / kAdamOrders + 1, order = item % kAdamOrders;
    enter_rate(args.rates, back, order, std::pow(args.rates.ratio_of(order), back));
  }
}

bool is_alone(const AdamArgs<float>& args) { return args.columns[0].width == 0; }

// Selects a kernel by the number of SH values in a row: 48 (degree 3), 3 (degree 0) or another.
template <class Kernel>
Kernel* select(const AdamArgs<float>& args, Kernel* degree_3, Kernel* degree_0, Kernel* any) {
  const int64_t width = args.columns[4].width;
  return width == 48 ? degree_3 : width == kFewPacks ? degree_0 : any;
}

int rows_per_block(const AdamArgs<float>& args) {
  return args.columns[4].width == kFewPacks ? kMoreRows : kRows;
}

// Computes the rules by which rows catch up to args.step, which is not 0.
Prepared prepare_rules(const AdamArgs<float>& args, Workspace& workspace, CudaStream stream) {
  // Rows whose moments are explicit_steps or more before last_step do not move (adam_moves), so longer decays
  // are not needed.
  const int32_t first = args.final_rules ? std::max(0, args.step - args.explicit_steps + 1) : 0,
                n_decays = std::min(args.step + 1, args.explicit_steps);
  const Prepared prepared{workspace.allocate<PendingSteps<float>>(args.step - first),
                          workspace.allocate<Decay>(n_decays),
                          workspace.allocate<bool>(1),
                          args.final_rules,
                          first,
                          n_decays};
  launch_early("lazy_adam catch-up", prepare,
               {blocks_for(std::max(args.step - first, n_decays), kPrepareThreads / kPrepareLanes),
                kPrepareThreads, stream},
               args, prepared);
  return prepared;
}

void catch_up(const AdamArgs<float>& args, Workspace& workspace, CudaStream stream) {
  const Prepared prepared = prepare_rules(args, workspace, stream);
  auto* pending_rows = workspace.allocate<PendingRow>(args.n);
  // The grid is limited because n may be far more than the number of valid ids.
  launch_early("lazy_adam catch-up", list_pending_rows,
               {resident_blocks(args.n, kListThreads, kListBlocks), kListThreads, stream}, args, prepared,
               pending_rows);
  const auto kernel = select(args, catch_up_kernel<4, 12, kRows>, catch_up_kernel<1, kFewPacks, kMoreRows>,
                             catch_up_kernel<1, 0, kRows>);
  launch_early("lazy_adam catch-up", kernel,
               {resident_blocks(args.n, rows_per_block(args), kCatchUpBlocks), kThreads, stream}, args,
               prepared, pending_rows);
}

// Quaternions, and SH of degree 3, are moved 16 bytes at a time.
void check_alignment(const AdamArgs<float>& args) {
  for (const int c : {1, 4}) {
    const AdamColumn<float>& column = args.columns[c];
    if (c == 4 && column.width != 48) continue;
    const float* const arrays[] = {column.param, column.exp_avg, column.exp_avg_sq, column.grad};
    for (const float* values : arrays) {
      if (reinterpret_cast<std::uintptr_t>(values) % alignof(Pack<4>) == 0) continue;
      throw std::runtime_error(
          "blitzgs::lazy_adam: quats and sh, their moments and gradients must be 16-byte aligned on CUDA; "
          "clone() a tensor that begins within another");
    }
  }
}

}  // namespace

template <class T> void lazy_adam(const AdamArgs<T>& args, Workspace& workspace, CudaStream stream) {
  static_assert(std::is_same_v<T, float>);
  AdamArgs<float> behind = args;
  behind.step = args.target();
  for (AdamColumn<float>& column : behind.columns) column.grad = nullptr;
  const bool catches_up = !args.current && behind.step > 0 && args.n > 0;
  if (is_alone(args)) {
    const int64_t width = std::clamp<int64_t>(args.columns[kAlone].width, 1, kListThreads);
    const auto block_rows = int(kListThreads / width);
    const Prepared prepared = catches_up ? prepare_rules(behind, workspace, stream) : Prepared{};
    launch_early(
        "lazy_adam of one parameter", alone_kernel,
        {resident_blocks(std::max<int64_t>(args.n, 1), block_rows, kListBlocks), kListThreads, stream}, args,
        prepared, block_rows);
    return;
  }
  if (args.n == 0) return;
  check_alignment(args);
  if (catches_up) catch_up(behind, workspace, stream);
  if (!args.with_gradient()) return;
  const auto kernel =
      select(args, step_kernel<4, 12, kRows>, step_kernel<1, kFewPacks, kMoreRows>, step_kernel<1, 0, kRows>);
  launch_early("lazy_adam step", kernel, {blocks_for(args.n, rows_per_block(args)), kThreads, stream}, args);
}

template void lazy_adam<float>(const AdamArgs<float>&, Workspace&, CudaStream);
template void for_each_row(const FinalRules<float>&, CudaStream);
template void for_each_row(const PositionNoise<float>&, CudaStream);
template void for_each_row(const ScaleLimit<float>&, CudaStream);

}  // namespace blitzgs::cuda
