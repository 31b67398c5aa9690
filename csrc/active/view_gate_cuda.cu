// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "active/view_gate.h"
#include "common/cuda.cuh"

namespace blitzgs::cuda {

namespace {

// Transposes the 32 x 32 bits of a warp: bit i of the result of lane l is bit l of the argument of lane i.
__device__ std::uint32_t transpose_bits(std::uint32_t word, int lane) {
  std::uint32_t own = 0;
#pragma unroll
  for (int bit = 0; bit < 32; ++bit) {
    const std::uint32_t lanes_with_bit = __ballot_sync(kFullWarp, word >> bit & 1u);
    if (lane == bit) own = lanes_with_bit;
  }
  return own;
}

// Converts a mask by rows to sectors or back (view_gate.h). A CUDA block handles a block of 256 rows; each of
// its warps handles 32 of these rows, which are one word of each sector.
template <bool kToSectors>
__global__ void __launch_bounds__(kBlockRows) transpose_kernel(const CullMask mask) {
  const int group = threadIdx.x / 32, lane = threadIdx.x % 32;
  const std::int64_t block = blockIdx.x, row = block * kBlockRows + threadIdx.x;
  const bool present = row < mask.n;
  for (std::int64_t word = 0; word < mask.words; ++word) {
    std::int32_t& row_word = mask.rows[(present ? row : 0) * mask.words + word];
    std::int32_t& sector_word = mask.sectors[sector_at(block, 32 * mask.words, 32 * word + lane) + group];
    if (kToSectors) {
      sector_word = static_cast<std::int32_t>(
          transpose_bits(present ? static_cast<std::uint32_t>(row_word) : 0u, lane));
    } else {
      const std::uint32_t own = transpose_bits(static_cast<std::uint32_t>(sector_word), lane);
      if (present) row_word = static_cast<std::int32_t>(own);
    }
  }
}

template <bool kToSectors>
void transpose(const CullMask& mask, CudaStream stream) {
  if (mask.n == 0 || mask.words == 0) return;
  transpose_kernel<kToSectors><<<static_cast<unsigned>(blocks_of(mask.n)), kBlockRows, 0, stream>>>(mask);
  check_launch("cull mask");
}

}  // namespace

void sectors_of_rows(const CullMask& mask, CudaStream stream) { transpose<true>(mask, stream); }
void rows_of_sectors(const CullMask& mask, CudaStream stream) { transpose<false>(mask, stream); }

namespace {

constexpr int kThreads = 256;
constexpr int kResident = 6;  // CUDA blocks that fit a multiprocessor of every supported GPU

// Applies the gate (view_gate.h) to the list, one thread per entry in a grid-stride loop.
__global__ void __launch_bounds__(kThreads, kResident) gate_views_kernel(const ViewGateArgs args) {
  __shared__ GateTable table;
  wait_for_earlier_kernels();
  const std::int64_t count = args.count ? *args.count : args.capacity;
  const std::int64_t first = blockIdx.x * std::int64_t{kThreads};
  if (first >= count) return;
  fill_gate_table(args.rules, args.viewmats, threadIdx.x, table);
  __syncthreads();
  for (std::int64_t i = first + threadIdx.x; i < count; i += std::int64_t{kThreads} * gridDim.x) {
    gate_entry(args, table, i);
  }
}

}  // namespace

void gate_views(const ViewGateArgs& args, Workspace&, CudaStream stream) {
  if (args.capacity == 0) return;
  // The grid is limited because the list's capacity is the whole table and its valid entries are few.
  const std::int64_t most = kResident * multiprocessors();
  const auto blocks =
      static_cast<unsigned>(std::min<std::int64_t>(blocks_for(args.capacity, kThreads), most));
  launch_early("gate_views", gate_views_kernel, {blocks, kThreads, stream}, args);
}

}  // namespace blitzgs::cuda
