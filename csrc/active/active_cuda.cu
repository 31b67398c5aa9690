// SPDX-License-Identifier: Apache-2.0
#include "active/pool.h"
#include "active/view_gate.h"
#include "common/cuda.cuh"
#include "exchange/transport.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / 32;
// A lane moves kWords words of 16 bytes at a time, so that enough of them are in flight; a unit is what a
// warp moves at a time. The grid is small because the kernel is bound by the bus, and the kernels of a
// training step run at the same time.
constexpr int kWords = 4, kUnit = 32 * kWords, kBlocks = 96;

// seen [n] (pool.h), one thread per block of the table.
__global__ void __launch_bounds__(kThreads) see_blocks(const SeenBlocks args) {
  __shared__ Frustum planes[kMaxViews];
  if (threadIdx.x < args.views) planes[threadIdx.x] = frustum_of(args, threadIdx.x);
  __syncthreads();
  const int64_t block = blockIdx.x * int64_t{kThreads} + threadIdx.x;
  if (block < args.n) args.seen[block] = views_that_see(args, planes, block);
}

// A warp moves up to kUnit words, of which `count` exist: from the slot to the leaving block, and from the
// coming block to the slot. leaving, coming: null if there is none.
__device__ __forceinline__ void move(uint4* slot, uint4* leaving, const uint4* coming, int lane, int count) {
  uint4 old[kWords], fresh[kWords];
#pragma unroll
  for (int k = 0; k < kWords; ++k) {
    const int at = lane + 32 * k;
    if (at >= count) break;
    if (coming) fresh[k] = coming[at];
    if (leaving) old[k] = slot[at];
  }
#pragma unroll
  for (int k = 0; k < kWords; ++k) {
    const int at = lane + 32 * k;
    if (at >= count) break;
    if (leaving) leaving[at] = old[k];
    if (coming) slot[at] = fresh[k];
  }
}

// Moves the blocks of `swap` (pool.h). The units of all columns of all moves are numbered; a warp moves
// one unit at a time, in a loop. units: the number of units in a move.
__global__ void __launch_bounds__(kThreads) move_blocks(const SwapBlocks swap, int units) {
  const int lane = threadIdx.x % 32;
  const int64_t warps = int64_t{gridDim.x} * kWarps;
  for (int64_t i = blockIdx.x * int64_t{kWarps} + threadIdx.x / 32; i < swap.n * units; i += warps) {
    const int64_t move_index = i / units;
    int unit = int(i - move_index * units), c = 0;
    int words = int(swap.columns[0].bytes / sizeof(uint4));
    while (unit * kUnit >= words) {
      unit -= (words + kUnit - 1) / kUnit;
      words = int(swap.columns[++c].bytes / sizeof(uint4));
    }
    const SwapColumn& column = swap.columns[c];
    const int32_t leaving = swap.leaving[move_index], coming = swap.coming[move_index];
    const int64_t first = int64_t{unit} * kUnit;
    const auto at = [&](std::byte* base, int64_t block) {
      return reinterpret_cast<uint4*>(base) + block * words + first;
    };
    move(at(column.pool, swap.slots[move_index]),
         leaving >= 0 && column.is_written ? at(column.table, leaving) : nullptr,
         coming >= 0 ? at(column.table, coming) : nullptr, lane, words - int(first));
  }
}

// Converts a mask by rows to sectors or back (view_gate.h). A CUDA block handles a block of 256 rows; each of
// its warps handles 32 of these rows, which are one word of each sector.
template <bool kToSectors>
__global__ void __launch_bounds__(kBlockRows) transpose_kernel(const CullMask mask) {
  const int group = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int64_t block = blockIdx.x, row = block * kBlockRows + threadIdx.x;
  const bool present = row < mask.n;
  for (int64_t word = 0; word < mask.words; ++word) {
    int32_t& row_word = mask.rows[(present ? row : 0) * mask.words + word];
    int32_t& sector_word = mask.sectors[sector_at(block, 32 * mask.words, 32 * word + lane) + group];
    if (kToSectors) {
      sector_word = int32_t(transpose_bits(present ? uint32_t(row_word) : 0u, lane));
    } else {
      const uint32_t own = transpose_bits(uint32_t(sector_word), lane);
      if (present) row_word = int32_t(own);
    }
  }
}

template <bool kToSectors> void transpose(const CullMask& mask, CudaStream stream) {
  if (mask.n == 0 || mask.words == 0) return;
  transpose_kernel<kToSectors><<<unsigned(blocks_of(mask.n)), kBlockRows, 0, stream>>>(mask);
  check_launch("cull mask");
}

constexpr int kResident = 6;  // CUDA blocks that fit a multiprocessor of every supported GPU

// Applies the gate (view_gate.h) to the list, one thread per entry in a grid-stride loop.
__global__ void __launch_bounds__(kThreads, kResident) gate_views_kernel(const ViewGateArgs args) {
  __shared__ GateTable table;
  wait_for_earlier_kernels();
  const int64_t count = args.count ? *args.count : args.capacity;
  const int64_t first = blockIdx.x * int64_t{kThreads};
  if (first >= count) return;
  fill_gate_table(args.rules, args.viewmats, threadIdx.x, table);
  __syncthreads();
  for (int64_t i = first + threadIdx.x; i < count; i += int64_t{kThreads} * gridDim.x) {
    gate_entry(args, table, i);
  }
}

}  // namespace

void seen_blocks(const SeenBlocks& args, CudaStream stream) {
  if (args.n == 0) return;
  see_blocks<<<blocks_for(args.n, kThreads), kThreads, 0, stream>>>(args);
  check_launch("seen_blocks");
}

void swap_blocks(const SwapBlocks& given, CudaStream stream) {
  if (given.n == 0 || given.n_columns == 0) return;
  SwapBlocks swap = given;
  int64_t units = 0;
  for (int c = 0; c < swap.n_columns; ++c) {
    SwapColumn& column = swap.columns[c];
    column.table = reinterpret_cast<std::byte*>(device_address(reinterpret_cast<int64_t*>(column.table)));
    const auto places =
        reinterpret_cast<std::uintptr_t>(column.pool) | reinterpret_cast<std::uintptr_t>(column.table);
    if (places % sizeof(uint4) != 0) {
      throw std::runtime_error(
          "blitzgs: columns that blocks move between must begin at multiples of 16 bytes");
    }
    const int64_t words = column.bytes / int64_t(sizeof(uint4));
    units += (words + kUnit - 1) / kUnit;
  }
  const int64_t wanted = (swap.n * units + kWarps - 1) / kWarps;
  move_blocks<<<unsigned(std::min<int64_t>(wanted, kBlocks)), kThreads, 0, stream>>>(swap, int(units));
  check_launch("swap_blocks");
}

void sectors_of_rows(const CullMask& mask, CudaStream stream) { transpose<true>(mask, stream); }
void rows_of_sectors(const CullMask& mask, CudaStream stream) { transpose<false>(mask, stream); }

void gate_views(const ViewGateArgs& args, CudaStream stream) {
  if (args.capacity == 0) return;
  // The grid is limited because the list's capacity is the whole table and its valid entries are few.
  launch_early("gate_views", gate_views_kernel,
               {resident_blocks(args.capacity, kThreads, kResident), kThreads, stream}, args);
}

}  // namespace blitzgs::cuda
