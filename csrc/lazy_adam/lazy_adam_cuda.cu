// SPDX-License-Identifier: Apache-2.0
#include <type_traits>

#include "common/cuda_check.h"
#include "lazy_adam/lazy_adam.h"

namespace blitzgs::cuda {

namespace {

constexpr int kRows = 64;  // rows per block
constexpr int kThreads = 256;

template <int Width>
struct alignas(4 * Width) Pack {
  float x[Width];
};

// One block's rows of one column. Items are packs of Width floats; all items of a thread are independent, and
// the loads of kUnroll of them are in flight at once: a row without debt costs its bytes alone.
template <int Column, int Width, int kUnroll, bool Gradient>
__device__ __forceinline__ void update_column(const AdamArgs<float>& args, const AdamStep<float>& step,
                                              const AdamDebt<float>* debts, const std::int32_t* rows,
                                              std::int64_t first, int count) {
  using P = Pack<Width>;
  const AdamColumn<float>& column = args.columns[Column];
  const int packs = static_cast<int>(column.width) / Width;
  const int items = count * packs;
  for (int base = threadIdx.x; base < items; base += kThreads * kUnroll) {
    P p[kUnroll], m[kUnroll], v[kUnroll], g[kUnroll];
#pragma unroll
    for (int u = 0; u < kUnroll; ++u) {
      const int item = base + u * kThreads;
      if (item >= items) break;
      const int local = item / packs, pack = item - local * packs;
      const std::int64_t at = rows[local] * column.width + pack * Width;
      p[u] = *reinterpret_cast<const P*>(column.param + at);
      m[u] = *reinterpret_cast<const P*>(column.exp_avg + at);
      v[u] = *reinterpret_cast<const P*>(column.exp_avg_sq + at);
      if (Gradient)
        g[u] = *reinterpret_cast<const P*>(column.grad + (first + local) * column.width + pack * Width);
    }
#pragma unroll
    for (int u = 0; u < kUnroll; ++u) {
      const int item = base + u * kThreads;
      if (item >= items) break;
      const int local = item / packs, pack = item - local * packs;
      const AdamDebt<float>& debt = debts[local];
      if (debt.from < debt.to) {
#pragma unroll
        for (int j = 0; j < Width; ++j) {
          adam_catch_up(args, debt, adam_group(Column, pack * Width + j), p[u].x[j], m[u].x[j], v[u].x[j]);
        }
      }
      if (Gradient) {
#pragma unroll
        for (int j = 0; j < Width; ++j) {
          const int group = adam_group(Column, pack * Width + j);
          adam_update(step, group, g[u].x[j], p[u].x[j], m[u].x[j], v[u].x[j]);
        }
      }
      const std::int64_t at = rows[local] * column.width + pack * Width;
      *reinterpret_cast<P*>(column.param + at) = p[u];
      *reinterpret_cast<P*>(column.exp_avg + at) = m[u];
      *reinterpret_cast<P*>(column.exp_avg_sq + at) = v[u];
    }
  }
}

// A block owns kRows rows of the list in all five columns, so last_step is read and written by it alone.
template <int ShWidth, bool Gradient>
__global__ void __launch_bounds__(kThreads) lazy_adam_kernel(const AdamArgs<float> args) {
  __shared__ AdamDebt<float> debts[kRows];
  __shared__ std::int32_t rows[kRows];
  __shared__ AdamStep<float> step;
  __shared__ int owing;
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kRows;
  const int count = static_cast<int>(args.n - first < kRows ? args.n - first : kRows);
  const std::int32_t target = Gradient ? args.step - 1 : args.step;
  if (threadIdx.x == 0) owing = 0;
  __syncthreads();
  if (threadIdx.x < count) {
    const std::int64_t i = first + threadIdx.x;
    const std::int32_t row = args.ids ? args.ids[i] : static_cast<std::int32_t>(i);
    const std::int32_t from = args.sparse ? target : args.last_step[row];
    rows[threadIdx.x] = row;
    debts[threadIdx.x] = adam_debt(args, from, target);
    if (from < target) owing = 1;
    if (Gradient || from < target) args.last_step[row] = args.step;
  }
  if (threadIdx.x == kThreads - 1) step = adam_step_scalars(args);
  __syncthreads();
  if (!Gradient && !owing) return;
  update_column<4, ShWidth, 3, Gradient>(args, step, debts, rows, first, count);
  update_column<0, 1, 1, Gradient>(args, step, debts, rows, first, count);
  update_column<2, 1, 1, Gradient>(args, step, debts, rows, first, count);
  update_column<1, 4, 1, Gradient>(args, step, debts, rows, first, count);
  update_column<3, 1, 1, Gradient>(args, step, debts, rows, first, count);
}

}  // namespace

template <class T>
void lazy_adam(const AdamArgs<T>& args, Workspace&, CudaStream stream) {
  static_assert(std::is_same_v<T, float>);
  if (args.n == 0) return;
  const bool with_gradient = args.columns[0].grad != nullptr;
  const bool wide = args.columns[4].width % 4 == 0;
  const unsigned blocks = blocks_for(args.n, kRows);
  auto kernel = with_gradient ? (wide ? lazy_adam_kernel<4, true> : lazy_adam_kernel<1, true>)
                              : (wide ? lazy_adam_kernel<4, false> : lazy_adam_kernel<1, false>);
  kernel<<<blocks, kThreads, 0, stream>>>(args);
  check_launch("lazy_adam");
}

template void lazy_adam<float>(const AdamArgs<float>&, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
