// SPDX-License-Identifier: Apache-2.0
// Pieces of the CUDA kernels in photometric_cuda.cu: sizes, ownership, the two passes of a window.
#pragma once
#include <type_traits>

#include "photometric/photometric.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kOut = 72;                     // pixels of a block's row
constexpr int kIn = kOut + 2 * kSsimRadius;  // with the windows' margin
constexpr int kRows = 4;                     // rows per round
constexpr int kGroups = kOut / 4;            // horizontal items of a row and channel
constexpr int kItems = kRows * 3 * kGroups;  // horizontal items of a round
constexpr int kPitch = 84;                   // shared row: the last item reads 16 values from pixel 68
constexpr int kOutPitch = 76;
constexpr int kLead = 2 * kSsimRadius + 2;  // rows read before the first output, a multiple of kRows
constexpr int kLeadRounds = kLead / kRows;
constexpr int kPending = kSsimTaps - 1;
static_assert(3 * kIn <= kThreads && kItems <= kThreads && kOut % 4 == 0 && kLead % kRows == 0);

struct Launch {
  int view, rows_per_strip;
  std::int64_t map_pitch, map_size;  // floats per map row; floats per map (three channels of a view)
  float* maps;                       // [3 maps][3 channels][height][map_pitch]
  double* partials;                  // [blocks, 2] of this view
};

struct OwnedRows {
  int begin, end;
};

// Rows of the view that hold an owned pixel.
__device__ OwnedRows owned_rows(const PhotometricArgs<float>& args, std::int64_t view) {
  const std::int64_t tiles = std::int64_t{args.tiles_x} * args.tiles_y;
  const std::int64_t begin = max(args.tile_begin - view * tiles, std::int64_t{0});
  const std::int64_t end = min(args.tile_end - view * tiles, tiles);
  if (begin >= end) return {0, 0};
  const std::int64_t last = (end + args.tiles_x - 1) / args.tiles_x * args.tile_size;
  return {static_cast<int>(begin / args.tiles_x * args.tile_size),
          static_cast<int>(min(last, static_cast<std::int64_t>(args.height)))};
}

__device__ bool owns_whole_view(const PhotometricArgs<float>& args, std::int64_t view) {
  const std::int64_t tiles = std::int64_t{args.tiles_x} * args.tiles_y;
  return args.tile_begin <= view * tiles && args.tile_end >= (view + 1) * tiles;
}

__device__ bool owns_pixel(const PhotometricArgs<float>& args, bool whole, int view, int row, int column) {
  if (whole) return true;
  const OwnedColumns owned = owned_columns(args, view, row);
  return column >= owned.begin && column < owned.end;
}

// Targets stay as they were loaded until they are used: a conversion next to its load would wait for it.
template <bool kBytes>
using Target = std::conditional_t<kBytes, std::uint8_t, float>;

template <bool kBytes>
__device__ __forceinline__ const Target<kBytes>* targets_of(const PhotometricArgs<float>& args) {
  if constexpr (kBytes) {
    return args.targets_u8;
  } else {
    return args.targets;
  }
}

// Rounded before it is subtracted: contracted into the difference, equal pixels would not cancel.
__device__ __forceinline__ float target_value(std::uint8_t target) {
  return __fmul_rn(static_cast<float>(target), 1.0f / 255.0f);
}
__device__ __forceinline__ float target_value(float target) { return target; }

// Adds one input to the open windows of a column; returns the window that it completes.
__device__ __forceinline__ float advance(const float (&window)[kSsimTaps], float (&pending)[kPending],
                                         float value) {
  const float complete = fmaf(window[kSsimTaps - 1], value, pending[0]);
#pragma unroll
  for (int k = 0; k + 1 < kPending; ++k) pending[k] = fmaf(window[kPending - 1 - k], value, pending[k + 1]);
  pending[kPending - 1] = window[0] * value;
  return complete;
}

// Four neighbouring horizontal windows from a shared row; `row` points at the first pixel of the first.
__device__ __forceinline__ void convolve4(const float (&window)[kSsimTaps], const float* row,
                                          float (&out)[4]) {
  float in[16];
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const float4 pack = *reinterpret_cast<const float4*>(row + 4 * i);
    in[4 * i] = pack.x, in[4 * i + 1] = pack.y, in[4 * i + 2] = pack.z, in[4 * i + 3] = pack.w;
  }
#pragma unroll
  for (int j = 0; j < 4; ++j) {
    out[j] = window[0] * in[j];
#pragma unroll
    for (int k = 1; k < kSsimTaps; ++k) out[j] = fmaf(window[k], in[j + k], out[j]);
  }
}

// Sum over the block, on thread 0.
__device__ double block_sum(double value) {
  __shared__ double warps[kThreads / 32];
  for (int offset = 16; offset > 0; offset /= 2) value += __shfl_down_sync(~0u, value, offset);
  __syncthreads();
  if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = value;
  __syncthreads();
  double total = 0;
  if (threadIdx.x == 0) {
    for (const double part : warps) total += part;
  }
  return total;
}

// Where a horizontal item of a round lies.
struct Item {
  int row, channel, pixel;
};
__device__ __forceinline__ Item item_of(int thread) {
  const int row = thread / (3 * kGroups), rest = thread - row * 3 * kGroups;
  return {row, rest / kGroups, 4 * (rest % kGroups)};
}

}  // namespace
}  // namespace blitzgs::cuda
