// SPDX-License-Identifier: Apache-2.0
// Helpers of the kernel in photometric_cuda.cu: sizes, ownership, the vertical and horizontal windows.
#pragma once
#include "loss/photometric.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kOut = 64;                      // pixels in a row of a block
constexpr int kMid = kOut + 2 * kSsimRadius;  // windows in a row that contain some of these pixels
constexpr int kIn = kMid + 2 * kSsimRadius;   // pixels in a row that these windows contain
constexpr int kRows = 4;                      // rows per round
constexpr int kMidGroups = (kMid + 3) / 4;    // horizontal items of a row and channel: four windows each
constexpr int kOutGroups = kOut / 4;
constexpr int kInPitch = 88;  // pitch of shared rows: the last item reads 16 values from pixel 72 on
constexpr int kMidPitch = 76;
constexpr int kOutPitch = 68;
constexpr int kPending = kSsimTaps - 1;
static_assert(3 * kIn <= kThreads && kRows * 3 * kMidGroups <= kThreads && kOut % 4 == 0);

// The division of the rows with owned pixels into strips: first those of the first view, then those of the
// next, and so on.
struct Launch {
  int first_view, last_view;
  int begin_row, end_row;  // the first owned row of first_view; one past the last owned row of last_view
  int rows_per_strip, first_strips, view_strips;  // first_strips: of first_view; view_strips: of a whole view
  int strips;                                     // of all views
};

// Strip number `index` of a view: its rows [begin, end).
struct Strip {
  int view, index, begin, end;
};

__device__ inline Strip strip_of(const Launch& launch, int height, int index) {
  Strip strip{launch.first_view, index, launch.begin_row, 0};
  if (index >= launch.first_strips) {
    index -= launch.first_strips;
    strip.view += 1 + index / launch.view_strips;
    strip.index = index % launch.view_strips;
    strip.begin = 0;
  }
  strip.begin += strip.index * launch.rows_per_strip;
  strip.end =
      min(strip.begin + launch.rows_per_strip, strip.view == launch.last_view ? launch.end_row : height);
  return strip;
}

// The number of strips of a view; a view without owned pixels has none.
__device__ inline int strips_of(const Launch& launch, int view) {
  const int place = view - launch.first_view;
  if (place < 0 || view > launch.last_view) return 0;
  const int before = place == 0 ? 0 : launch.first_strips + (place - 1) * launch.view_strips;
  return min(place == 0 ? launch.first_strips : launch.view_strips, launch.strips - before);
}

// The rows of a strip whose pixels are all owned.
__device__ inline Strip whole_rows(const PhotometricArgs<float>& args, const Strip& strip) {
  const int64_t first = int64_t{strip.view} * args.tiles_x * args.tiles_y;
  const int64_t begin = max(args.tile_begin - first, int64_t{0});
  const int64_t end = max(args.tile_end - first, int64_t{0});
  const int64_t top = (begin + args.tiles_x - 1) / args.tiles_x * args.tile_size;
  const int64_t bottom = end / args.tiles_x * args.tile_size;
  return {strip.view, strip.index, int(min(max(top, int64_t{strip.begin}), int64_t{strip.end})),
          int(min(bottom, int64_t{strip.end}))};
}

__device__ inline bool owns_pixel(const PhotometricArgs<float>& args, int view, int row, int column) {
  const OwnedColumns owned = owned_columns(args, view, row);
  return column >= owned.begin && column < owned.end;
}

// Targets keep the type in which they were loaded until they are used, because a conversion right after the
// load would wait for the load.
template <bool kBytes> using Target = std::conditional_t<kBytes, uint8_t, float>;

template <bool kBytes>
__device__ __forceinline__ const Target<kBytes>* targets_of(const PhotometricArgs<float>& args) {
  if constexpr (kBytes) {
    return args.targets_u8;
  } else {
    return args.targets;
  }
}

// The value of a target in [0, 1]. __fmul_rn rounds it: if the compiler contracted the product into a
// following subtraction, the difference of equal pixels would not be zero.
__device__ __forceinline__ float target_value(uint8_t target) {
  // This converts the integer to a float through its bits, because conversion instructions are slow.
  const float value = __uint_as_float(0x4b000000u | target) - 8388608.0f;
  return __fmul_rn(value, 1.0f / 255.0f);
}
__device__ __forceinline__ float target_value(float target) { return target; }

// Adds one input to the incomplete windows of a column and returns the window that it completes.
__device__ __forceinline__ float advance(const float (&window)[kSsimTaps], float (&pending)[kPending],
                                         float value) {
  const float complete = fmaf(window[kSsimTaps - 1], value, pending[0]);
#pragma unroll
  for (int k = 0; k + 1 < kPending; ++k) pending[k] = fmaf(window[kPending - 1 - k], value, pending[k + 1]);
  pending[kPending - 1] = window[0] * value;
  return complete;
}

// Computes four neighbouring horizontal windows of a row in shared memory; `row` points to the first pixel of
// the first window.
__device__ __forceinline__ void convolve4(const float (&window)[kSsimTaps], const float* row,
                                          float (&out)[4]) {
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const float4 pack = *reinterpret_cast<const float4*>(row + 4 * i);
    const float in[4] = {pack.x, pack.y, pack.z, pack.w};
#pragma unroll
    for (int e = 0; e < 4; ++e) {
#pragma unroll
      for (int j = 0; j < 4; ++j) {
        const int k = 4 * i + e - j;
        if (k == 0) out[j] = window[0] * in[e];
        if (k > 0 && k < kSsimTaps) out[j] = fmaf(window[k], in[e], out[j]);
      }
    }
  }
}

// An item of a horizontal step, which one thread computes: four pixels of a row and channel, from `pixel` on.
struct Item {
  int row, channel, pixel;
};
template <int kGroups> __device__ __forceinline__ Item item_of(int thread) {
  const int row = thread / (3 * kGroups), rest = thread - row * 3 * kGroups;
  return {row, rest / kGroups, 4 * (rest % kGroups)};
}

}  // namespace
}  // namespace blitzgs::cuda
