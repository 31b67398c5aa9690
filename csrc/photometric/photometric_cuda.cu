// SPDX-License-Identifier: Apache-2.0
// Two kernels a view. Both stream a strip of rows downwards: a thread holds one column and keeps the partial
// sums of the 10 windows that are open there in registers (the shift to the next row is free: it is the
// destination of the multiply-add), so an input is read once. Every four finished rows go through shared
// memory, where a thread convolves four neighbouring pixels horizontally from four 16-byte loads a quantity.
//   windows_kernel   images -> SSIM of each pixel, its sums, its three derivatives (planar maps)
//   gradient_kernel  maps -> v_renders
// A pixel's arithmetic does not depend on how the image is cut into strips.
#include <algorithm>
#include <climits>

#include "common/cuda_check.h"
#include "photometric/photometric.h"
#include "photometric/photometric_device.cuh"

namespace blitzgs::cuda {

namespace {

template <bool kBytes, bool kGradient, bool kSums>
__global__ void __launch_bounds__(kThreads, 2)
    windows_kernel(const PhotometricArgs<float> args, const Launch launch) {
  __shared__ alignas(16) float shared[2][4][kRows][3][kPitch];
  const int view = launch.view, begin = blockIdx.y * launch.rows_per_strip;
  const int end = min(args.height, begin + launch.rows_per_strip);
  const int first_pixel = blockIdx.x * kOut;
  const OwnedRows rows = owned_rows(args, view);
  const int reach = kGradient ? kSsimRadius : 0;
  const bool needed = rows.begin < rows.end && begin < rows.end + reach && end > rows.begin - reach;
  float l1_sum = 0, ssim_sum = 0;

  if (needed) {
    const bool whole = owns_whole_view(args, view);
    const std::int64_t image = std::int64_t{view} * args.height * args.width;
    const float weight = kGradient ? args.ssim_weights[view] : 0.0f;
    // The column of this thread, channels interleaved.
    const int channel = threadIdx.x % 3, local = threadIdx.x / 3, pixel = first_pixel - kSsimRadius + local;
    const bool has_column = threadIdx.x < 3 * kIn && pixel >= 0 && pixel < args.width;
    const bool in_core = has_column && local >= kSsimRadius && local < kSsimRadius + kOut;
    const Item item = item_of(threadIdx.x);
    float pending[4][kPending] = {};
    float x[kRows];
    Target<kBytes> y[kRows];
    const int stride = 3 * args.width;
    const std::int64_t top_of_column = 3 * (image + pixel) + channel;
    const auto load = [&](int row) {
      const std::int64_t at = top_of_column + std::int64_t{row} * stride;
#pragma unroll
      for (int i = 0; i < kRows; ++i) {
        const bool inside = has_column && static_cast<unsigned>(row + i) < static_cast<unsigned>(args.height);
        x[i] = inside ? args.renders[at + i * stride] : 0.0f;
        y[i] = inside ? targets_of<kBytes>(args)[at + i * stride] : Target<kBytes>(0);
      }
    };
    const int first_row = begin - kSsimRadius - 2;
    const int rounds = kLeadRounds + (end - begin + kRows - 1) / kRows;
    load(first_row);
    for (int round = 0; round < rounds; ++round) {
      float (&buffer)[4][kRows][3][kPitch] = shared[round % 2];
#pragma unroll
      for (int i = 0; i < kRows; ++i) {
        const float target = target_value(y[i]), difference = x[i] - target;
        const float values[4] = {x[i], difference, fmaf(x[i], x[i], target * target),
                                 difference * difference};
#pragma unroll
        for (int q = 0; q < 4; ++q) {
          const float complete = advance(args.window, pending[q], values[q]);
          if (round >= kLeadRounds && threadIdx.x < 3 * kIn) buffer[q][i][channel][local] = complete;
        }
        if constexpr (kSums) {
          const int row = first_row + round * kRows + i;
          if (in_core && row >= begin && row < end && owns_pixel(args, whole, view, row, pixel) &&
              (!args.masks || args.masks[image + std::int64_t{row} * args.width + pixel])) {
            l1_sum += fabsf(difference);
          }
        }
      }
      if (round + 1 < rounds) load(first_row + (round + 1) * kRows);
      if (round < kLeadRounds) continue;
      __syncthreads();
      const int row = begin + (round - kLeadRounds) * kRows + item.row, column = first_pixel + item.pixel;
      if (threadIdx.x < kItems && row < end && column < args.width) {
        float windows[4][4];
#pragma unroll
        for (int q = 0; q < 4; ++q)
          convolve4(args.window, &buffer[q][item.row][item.channel][item.pixel], windows[q]);
        float by_mean[4], by_p[4], by_q[4];
#pragma unroll
        for (int j = 0; j < 4; ++j) {
          const SsimTerms<float> terms =
              ssim_terms(windows[0][j], windows[1][j], windows[2][j], windows[3][j]);
          const bool exists = column + j < args.width;
          const bool counts =
              exists && (!args.masks || args.masks[image + std::int64_t{row} * args.width + column + j]);
          if (kSums && counts && owns_pixel(args, whole, view, row, column + j)) ssim_sum += terms.value;
          const float factor = counts ? weight : 0.0f;
          by_mean[j] = factor * terms.by_mean, by_p[j] = factor * terms.by_p, by_q[j] = factor * terms.by_q;
        }
        if constexpr (kGradient) {
          const std::int64_t at =
              (std::int64_t{item.channel} * args.height + row) * launch.map_pitch + column;
          float* map = launch.maps + at;
          *reinterpret_cast<float4*>(map) = make_float4(by_mean[0], by_mean[1], by_mean[2], by_mean[3]);
          map += launch.map_size;
          *reinterpret_cast<float4*>(map) = make_float4(by_p[0], by_p[1], by_p[2], by_p[3]);
          map += launch.map_size;
          *reinterpret_cast<float4*>(map) = make_float4(by_q[0], by_q[1], by_q[2], by_q[3]);
        }
      }
    }
  }
  if constexpr (kSums) {
    const double l1 = block_sum(l1_sum), ssim = block_sum(ssim_sum);
    if (threadIdx.x == 0) {
      double* out = launch.partials + 2 * (std::int64_t{blockIdx.y} * gridDim.x + blockIdx.x);
      out[0] = l1, out[1] = ssim;
    }
  }
}

template <bool kBytes>
__global__ void __launch_bounds__(kThreads, 3)
    gradient_kernel(const PhotometricArgs<float> args, const Launch launch) {
  __shared__ alignas(16) float columns[3][kRows][3][kPitch];
  __shared__ alignas(16) float results[3][kRows][3][kOutPitch];
  const int view = launch.view, begin = blockIdx.y * launch.rows_per_strip;
  const int end = min(args.height, begin + launch.rows_per_strip);
  const int first_pixel = blockIdx.x * kOut;
  const int width = min(kOut, args.width - first_pixel);
  const std::int64_t image = std::int64_t{view} * args.height * args.width;
  const OwnedRows rows = owned_rows(args, view);
  if (rows.begin >= rows.end || begin >= rows.end || end <= rows.begin) {
    for (int row = begin; row < end; ++row) {
      float* out = args.v_renders + 3 * (image + std::int64_t{row} * args.width + first_pixel);
      for (int i = threadIdx.x; i < 3 * width; i += kThreads) out[i] = 0.0f;
    }
    return;
  }
  const bool whole = owns_whole_view(args, view);
  const float weight = args.l1_weights[view];
  // Maps hold the rows within a window of an owned pixel.
  const int low = max(0, rows.begin - kSsimRadius), high = min(args.height, rows.end + kSsimRadius);
  const int channel = threadIdx.x / kIn, local = threadIdx.x % kIn, pixel = first_pixel - kSsimRadius + local;
  const bool has_column = channel < 3 && pixel >= 0 && pixel < args.width;
  const Item item = item_of(threadIdx.x);
  float pending[3][kPending] = {};
  float values[3][kRows];
  const auto load = [&](int row) {
#pragma unroll
    for (int i = 0; i < kRows; ++i, ++row) {
      const bool inside = has_column && row >= low && row < high;
      const float* map = launch.maps + (std::int64_t{channel} * args.height + row) * launch.map_pitch + pixel;
#pragma unroll
      for (int q = 0; q < 3; ++q) values[q][i] = inside ? map[q * launch.map_size] : 0.0f;
    }
  };
  // The output column of this thread, channels interleaved.
  const int out_channel = threadIdx.x % 3, out_local = threadIdx.x / 3;
  const bool writes = static_cast<int>(threadIdx.x) < 3 * width;
  const std::int64_t out_column = image + first_pixel + out_local;
  const int first_row = begin - kSsimRadius - 2;
  const int rounds = kLeadRounds + (end - begin + kRows - 1) / kRows;
  load(first_row);
  for (int round = 0; round < rounds; ++round) {
    const int top = begin + (round - kLeadRounds) * kRows;
#pragma unroll
    for (int i = 0; i < kRows; ++i) {
#pragma unroll
      for (int q = 0; q < 3; ++q) {
        const float complete = advance(args.window, pending[q], values[q][i]);
        if (round >= kLeadRounds && channel < 3) columns[q][i][channel][local] = complete;
      }
    }
    if (round + 1 < rounds) load(first_row + (round + 1) * kRows);
    if (round < kLeadRounds) continue;
    float x[kRows];
    Target<kBytes> y[kRows];
#pragma unroll
    for (int i = 0; i < kRows; ++i) {
      const bool used = writes && top + i < end;
      const std::int64_t at = 3 * (out_column + std::int64_t{top + i} * args.width) + out_channel;
      x[i] = used ? args.renders[at] : 0.0f;
      y[i] = used ? targets_of<kBytes>(args)[at] : Target<kBytes>(0);
    }
    __syncthreads();
    if (threadIdx.x < kItems) {
#pragma unroll
      for (int q = 0; q < 3; ++q) {
        float out[4];
        convolve4(args.window, &columns[q][item.row][item.channel][item.pixel], out);
        *reinterpret_cast<float4*>(&results[q][item.row][item.channel][item.pixel]) =
            make_float4(out[0], out[1], out[2], out[3]);
      }
    }
    __syncthreads();
#pragma unroll
    for (int i = 0; i < kRows; ++i) {
      const int row = top + i;
      if (!writes || row >= end) continue;
      const std::int64_t at = out_column + std::int64_t{row} * args.width;
      const bool counts = !args.masks || args.masks[at];
      const float difference = x[i] - target_value(y[i]);
      const float sign = difference > 0 ? 1.0f : (difference < 0 ? -1.0f : 0.0f);
      const float* result = &results[0][i][out_channel][out_local];
      constexpr int kMap = kRows * 3 * kOutPitch;
      const float value = (counts ? weight * sign : 0.0f) + result[0] +
                          2.0f * fmaf(x[i], result[kMap], difference * result[2 * kMap]);
      args.v_renders[3 * at + out_channel] =
          owns_pixel(args, whole, view, row, first_pixel + out_local) ? value : 0.0f;
    }
  }
}

// One block per view adds its partial sums in order.
__global__ void finish_sums(const double* partials, int blocks, float* l1_sums, float* ssim_sums) {
  const double* mine = partials + 2 * std::int64_t{blockIdx.x} * blocks;
  double l1 = 0, ssim = 0;
  for (int i = threadIdx.x; i < blocks; i += kThreads) l1 += mine[2 * i], ssim += mine[2 * i + 1];
  l1 = block_sum(l1), ssim = block_sum(ssim);
  if (threadIdx.x == 0)
    l1_sums[blockIdx.x] = static_cast<float>(l1), ssim_sums[blockIdx.x] = static_cast<float>(ssim);
}

// Rows per strip: whole waves of blocks, with few rows read twice.
int rows_per_strip(int height, int strips_x, int slots) {
  std::int64_t best_cost = LLONG_MAX;
  int best = height;
  for (int strips = 1; strips <= (height + 15) / 16; ++strips) {
    const int rows = ((height + strips - 1) / strips + kRows - 1) / kRows * kRows;
    const std::int64_t blocks = std::int64_t{strips_x} * ((height + rows - 1) / rows);
    const std::int64_t cost = (blocks + slots - 1) / slots * (rows + kLead);
    if (cost < best_cost) best_cost = cost, best = rows;
  }
  return best;
}

int multiprocessors() {
  int device = 0, count = 0;
  check(cudaGetDevice(&device), "photometric");
  check(cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device), "photometric");
  return count;
}

template <bool kBytes>
void launch_windows(dim3 grid, const PhotometricArgs<float>& args, const Launch& launch,
                    cudaStream_t stream) {
  if (args.v_renders && args.l1_sums) {
    windows_kernel<kBytes, true, true><<<grid, kThreads, 0, stream>>>(args, launch);
  } else if (args.v_renders) {
    windows_kernel<kBytes, true, false><<<grid, kThreads, 0, stream>>>(args, launch);
  } else {
    windows_kernel<kBytes, false, true><<<grid, kThreads, 0, stream>>>(args, launch);
  }
}

}  // namespace

template <class T>
void photometric(const PhotometricArgs<T>& args, Workspace& workspace, CudaStream stream) {
  const int strips_x = (args.width + kOut - 1) / kOut, sms = multiprocessors();
  const int window_rows = rows_per_strip(args.height, strips_x, 2 * sms);
  const int gradient_rows = rows_per_strip(args.height, strips_x, 3 * sms);
  const dim3 window_grid(strips_x, (args.height + window_rows - 1) / window_rows);
  const dim3 gradient_grid(strips_x, (args.height + gradient_rows - 1) / gradient_rows);
  const int blocks = static_cast<int>(window_grid.x * window_grid.y);

  Launch launch{};
  launch.map_pitch = (args.width + 3) / 4 * 4;
  launch.map_size = 3 * launch.map_pitch * args.height;
  // One view at a time: the maps are reused and mostly stay in the L2 cache.
  if (args.v_renders) launch.maps = workspace.allocate<float>(3 * launch.map_size);
  double* partials = args.l1_sums ? workspace.allocate<double>(2 * args.views * blocks) : nullptr;
  for (int view = 0; view < args.views; ++view) {
    launch.view = view;
    launch.partials = partials + 2 * std::int64_t{view} * blocks;
    launch.rows_per_strip = window_rows;
    args.targets_u8 ? launch_windows<true>(window_grid, args, launch, stream)
                    : launch_windows<false>(window_grid, args, launch, stream);
    check_launch("photometric windows");
    if (!args.v_renders) continue;
    launch.rows_per_strip = gradient_rows;
    args.targets_u8 ? gradient_kernel<true><<<gradient_grid, kThreads, 0, stream>>>(args, launch)
                    : gradient_kernel<false><<<gradient_grid, kThreads, 0, stream>>>(args, launch);
    check_launch("photometric gradient");
  }
  if (!args.l1_sums) return;
  finish_sums<<<static_cast<unsigned>(args.views), kThreads, 0, stream>>>(partials, blocks, args.l1_sums,
                                                                          args.ssim_sums);
  check_launch("photometric sums");
}

template void photometric<float>(const PhotometricArgs<float>&, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
