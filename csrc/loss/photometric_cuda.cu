// SPDX-License-Identifier: Apache-2.0
// The photometric loss on CUDA: one kernel for all owned pixels of all views. Intermediate values stay in
// registers and shared memory. A block goes down a strip of rows, four rows in each round, in five steps:
//   1 Vertical windows of the images. A thread has one column and keeps the partial sums of the 10 incomplete
//     windows of this column in registers, so each input is read once. (The shift of the sums to the next row
//     costs nothing, because the multiply-add writes to the shifted register.)
//   2 Horizontal windows. A thread computes four neighbouring pixels from four 16-byte shared loads per
//     quantity, then the SSIM of each pixel, its sums and its three derivatives.
//   3 Vertical windows of the derivatives, as in step 1.
//   4 Horizontal windows of these, as in step 2.
//   5 The gradient; a thread has one column again.
// All five steps run in every round, each on the rows that the step before it handled one round earlier, with
// one barrier per round. The arithmetic of a pixel does not depend on how the image is divided into strips.
#include <climits>

#include "common/cuda.cuh"
#include "loss/photometric.h"
#include "loss/photometric_device.cuh"

namespace blitzgs::cuda {
namespace {

// Shared memory of one round; two rounds alternate.
struct Shared {
  float inputs[4][kRows][3][kInPitch];    // 1 -> 2
  float maps[3][kRows][3][kMidPitch];     // 2 -> 3
  float columns[3][kRows][3][kMidPitch];  // 3 -> 4
  float results[3][kRows][3][kOutPitch];  // 4 -> 5
};

// kLead: how many rows above its first row a strip starts to read. kWindowRound: the round of its first
// windows. They are chosen such that sums are added in the same order with and without a gradient.
template <bool kGradient> constexpr int kLead = kGradient ? 2 * kSsimRadius : kSsimRadius + 1;
constexpr int kWindowRound = 2;
constexpr int kOutRound = 5;
static_assert(kRows * kOutRound == 4 * kSsimRadius);

// One block's work on its strip. Steps 2 and 5 have two forms. The plain form is for rounds whose rows are
// all inside the image and owned as a whole, without a mask; nearly all rounds are of this kind.
template <bool kBytes, bool kGradient, bool kSums> class StripWalk {
 public:
  __device__ __forceinline__ StripWalk(const PhotometricArgs<float>& args, const Launch& launch,
                                       Shared* shared)
      : args_(args),
        shared_(shared),
        strip_(strip_of(launch, args.height, blockIdx.y)),
        whole_(whole_rows(args, strip_)),
        first_pixel_(blockIdx.x * kOut),
        width_(min(kOut, args.width - first_pixel_)),
        first_row_(strip_.begin - kLead<kGradient>),
        stride_(3 * args.width),
        image_(int64_t{strip_.view} * args.height * args.width),
        channel_(threadIdx.x % 3),
        local_(threadIdx.x / 3) {
    const int pixel = first_pixel_ - 2 * kSsimRadius + local_;
    has_column_ = threadIdx.x < 3 * kIn && pixel >= 0 && pixel < args.width;
    in_core_ = has_column_ && local_ >= 2 * kSsimRadius && local_ < 2 * kSsimRadius + kOut;
    next_ = 3 * (image_ + int64_t{first_row_} * args.width + pixel) + channel_;
    out_ = 3 * (image_ + int64_t{strip_.begin} * args.width + first_pixel_ + local_) + channel_;
    if constexpr (kGradient) {
      ssim_weight_ = weight_of(args, args.ssim_weights, strip_.view);
      l1_weight_ = weight_of(args, args.l1_weights, strip_.view);
      // Windows centred outside the image have no derivative.
      for (int i = threadIdx.x; i < 3 * kRows * 3 * kMidPitch; i += kThreads) {
        (&shared[0].columns[0][0][0][0])[i] = (&shared[1].columns[0][0][0][0])[i] = 0;
      }
      const int map_pixel = first_pixel_ - kSsimRadius + int(threadIdx.x) % kMid;
      has_map_column_ = threadIdx.x < 3 * kMid && map_pixel >= 0 && map_pixel < args.width;
      __syncthreads();
    }
  }

  __device__ __forceinline__ void run() {
    const int rows = strip_.end - strip_.begin;
    const int lead = kGradient ? 4 * kSsimRadius : 2 * kSsimRadius + 1;
    const int rounds = (rows + lead + kRows - 1) / kRows;
    load(first_row_);
    for (int round = 0; round < rounds + (kGradient ? 4 : 1); ++round) {
      const int row = first_row_ + round * kRows;
      Shared &even = shared_[round % 2], &odd = shared_[1 - round % 2];
      if (round < rounds) {
        image_columns(even, row, round >= kWindowRound);
        if (round + 1 < rounds) load(row + kRows);
      }
      if (round >= kWindowRound + 1 && round < rounds + 1) {
        const int top = row - kRows - kSsimRadius;
        // Ownership matters only for sums, and only for rows of the strip.
        const bool simple = !args_.masks && (kSums && top + kRows > strip_.begin && top < strip_.end
                                                 ? plain(top)
                                                 : top >= 0 && top + kRows <= args_.height);
        simple ? windows<true>(odd, top) : windows<false>(odd, top);
      }
      if constexpr (kGradient) {
        if (round >= kWindowRound + 2 && round < rounds + 2) map_columns(even);
        if (round >= kOutRound + 3 && round < rounds + 3) map_rows(odd);
        if (round >= kOutRound + 4) {
          const int top = strip_.begin + (round - 4 - kOutRound) * kRows;
          plain(top) ? write_gradient<true>(even, top) : write_gradient<false>(even, top);
        }
      }
      __syncthreads();
    }
  }

  // The index of this block's part of the sums: part blockIdx.x of its strip.
  __device__ __forceinline__ int64_t part(const Launch& launch) const {
    return (int64_t{strip_.view} * launch.view_strips + strip_.index) * gridDim.x + blockIdx.x;
  }

  float l1_sum = 0, ssim_sum = 0;

 private:
  // Whether all rows of the round from `top` on are in the strip and owned as a whole, without a mask.
  __device__ __forceinline__ bool plain(int top) const {
    return !args_.masks && top >= whole_.begin && top + kRows <= whole_.end;
  }

  __device__ __forceinline__ bool counted(int row, int pixel) const {
    return !args_.masks || args_.masks[image_ + int64_t{row} * args_.width + pixel];
  }

  // Loads this thread's column of the images for the rows of the next round.
  __device__ __forceinline__ void load(int row) {
    const bool all = row >= 0 && row + kRows <= args_.height;
#pragma unroll
    for (int i = 0; i < kRows; ++i, next_ += stride_) {
      const bool inside = has_column_ && (all || unsigned(row + i) < unsigned(args_.height));
      x_[i] = inside ? args_.renders[next_] : 0.0f;
      y_[i] = inside ? targets_of<kBytes>(args_)[next_] : Target<kBytes>(0);
    }
  }

  // Step 1, and the sum of |x - y|. keep: windows are complete from this round on.
  __device__ __forceinline__ void image_columns(Shared& shared, int top, bool keep) {
    float differences[kRows];
#pragma unroll
    for (int i = 0; i < kRows; ++i) {
      const float target = target_value(y_[i]), difference = x_[i] - target;
      differences[i] = difference;
      const float values[4] = {x_[i], difference, fmaf(x_[i], x_[i], target * target),
                               difference * difference};
#pragma unroll
      for (int q = 0; q < 4; ++q) {
        const float complete = advance(args_.window, image_pending_[q], values[q]);
        if (keep && threadIdx.x < 3 * kIn) shared.inputs[q][i][channel_][local_] = complete;
      }
    }
    if constexpr (kSums) {
      if (!in_core_) return;
      const bool all = plain(top);
#pragma unroll
      for (int i = 0; i < kRows; ++i) {
        const int row = top + i, pixel = first_pixel_ - 2 * kSsimRadius + local_;
        if (all || (row >= strip_.begin && row < strip_.end && owns_pixel(args_, strip_.view, row, pixel) &&
                    counted(row, pixel))) {
          l1_sum += fabsf(differences[i]);
        }
      }
    }
  }

  // Step 2: the windows that are centred on the rows of the round from `top` on.
  template <bool kPlain> __device__ __forceinline__ void windows(Shared& shared, int top) {
    if (threadIdx.x >= kRows * 3 * kMidGroups) return;
    const Item item = item_of<kMidGroups>(threadIdx.x);
    float sums[4][4];
#pragma unroll
    for (int q = 0; q < 4; ++q)
      convolve4(args_.window, &shared.inputs[q][item.row][item.channel][item.pixel], sums[q]);
    const int row = top + item.row, column = item.pixel - kSsimRadius;  // column: in the block
    const bool in_rows = kPlain || (row >= 0 && row < args_.height);
    const bool in_strip = kSums && row >= strip_.begin && row < strip_.end;
    float by_mean[4], by_p[4], by_q[4];
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const SsimTerms<float> terms = ssim_terms(sums[0][j], sums[1][j], sums[2][j], sums[3][j]);
      const int pixel = first_pixel_ + column + j;
      const bool counts =
          kPlain || (in_rows && unsigned(pixel) < unsigned(args_.width) && counted(row, pixel));
      if (in_strip && unsigned(column + j) < unsigned(width_) &&
          (kPlain || (counts && owns_pixel(args_, strip_.view, row, pixel)))) {
        ssim_sum += terms.value;
      }
      const float factor = counts ? ssim_weight_ : 0.0f;
      by_mean[j] = factor * terms.by_mean, by_p[j] = factor * terms.by_p, by_q[j] = factor * terms.by_q;
    }
    if constexpr (kGradient) {
      const auto store = [&](int map, const float (&values)[4]) {
        *reinterpret_cast<float4*>(&shared.maps[map][item.row][item.channel][item.pixel]) =
            make_float4(values[0], values[1], values[2], values[3]);
      };
      store(0, by_mean), store(1, by_p), store(2, by_q);
    }
  }

  // Step 3.
  __device__ __forceinline__ void map_columns(Shared& shared) {
    if (!has_map_column_) return;
    const int channel = threadIdx.x / kMid, local = threadIdx.x % kMid;
#pragma unroll
    for (int i = 0; i < kRows; ++i) {
#pragma unroll
      for (int q = 0; q < 3; ++q) {
        shared.columns[q][i][channel][local] =
            advance(args_.window, map_pending_[q], shared.maps[q][i][channel][local]);
      }
    }
  }

  // Step 4.
  __device__ __forceinline__ void map_rows(Shared& shared) {
    if (threadIdx.x >= kRows * 3 * kOutGroups) return;
    const Item item = item_of<kOutGroups>(threadIdx.x);
#pragma unroll
    for (int q = 0; q < 3; ++q) {
      float out[4];
      convolve4(args_.window, &shared.columns[q][item.row][item.channel][item.pixel], out);
      *reinterpret_cast<float4*>(&shared.results[q][item.row][item.channel][item.pixel]) =
          make_float4(out[0], out[1], out[2], out[3]);
    }
  }

  // Step 5: writes the gradient of the rows of the round from `top` on.
  template <bool kPlain> __device__ __forceinline__ void write_gradient(const Shared& shared, int top) {
    if (local_ >= width_) return;
    float x[kRows];
    Target<kBytes> y[kRows];
#pragma unroll
    for (int i = 0; i < kRows; ++i) {
      const bool present = kPlain || top + i < strip_.end;
      x[i] = present ? __ldg(args_.renders + out_ + i * int64_t{stride_}) : 0.0f;
      y[i] = present ? __ldg(targets_of<kBytes>(args_) + out_ + i * int64_t{stride_}) : Target<kBytes>(0);
    }
#pragma unroll
    for (int i = 0; i < kRows; ++i, out_ += stride_) {
      const int row = top + i, pixel = first_pixel_ + local_;
      if (!kPlain && row >= strip_.end) break;
      const float difference = x[i] - target_value(y[i]);
      const float l1 = difference == 0.0f ? 0.0f : copysignf(l1_weight_, difference);
      const float* result = &shared.results[0][i][channel_][local_];
      constexpr int kMap = kRows * 3 * kOutPitch;
      const float value = (kPlain || counted(row, pixel) ? l1 : 0.0f) + result[0] +
                          2.0f * fmaf(x[i], result[kMap], difference * result[2 * kMap]);
      args_.v_renders[out_] = kPlain || owns_pixel(args_, strip_.view, row, pixel) ? value : 0.0f;
    }
  }

  const PhotometricArgs<float>& args_;
  Shared* shared_;
  const Strip strip_, whole_;
  const int first_pixel_, width_, first_row_, stride_;
  const int64_t image_;
  const int channel_, local_;  // the channel and the pixel of this thread's column, interleaved as in memory
  bool has_column_, in_core_, has_map_column_ = false;
  int64_t next_, out_;  // the elements that this thread reads and writes next
  float ssim_weight_ = 0, l1_weight_ = 0;
  float x_[kRows];
  Target<kBytes> y_[kRows];
  float image_pending_[4][kPending] = {};
  float map_pending_[3][kPending] = {};
};

// Sets the parts of missing strips to zero: a view may have fewer strips than others.
__device__ void clear_parts(const PhotometricArgs<float>& args, const Launch& launch) {
  const int rows = int(args.views) * launch.view_strips;
  for (int i = blockIdx.y; i < rows; i += gridDim.y) {
    if (i % launch.view_strips < strips_of(launch, i / launch.view_strips)) continue;
    double* part = args.parts + 2 * (int64_t{i} * gridDim.x + blockIdx.x);
    part[0] = part[1] = 0;
  }
}

// The loss and its gradient (photometric.h). The grid is (blocks of kOut pixels in a row, strips of all
// views). Reads renders, targets and masks; writes parts [B, K, 2] (kSums), v_renders [B, H, W, 3] and
// the mean terms [B] (kGradient).
template <bool kBytes, bool kGradient, bool kSums>
__global__ void __launch_bounds__(kThreads, 2)
    photometric_kernel(const __grid_constant__ PhotometricArgs<float> args,
                       const __grid_constant__ Launch launch) {
  wait_for_earlier_kernels();
  if (kSums && threadIdx.x == 0) clear_parts(args, launch);
  if (kGradient && args.means.visible && blockIdx.x == 0 && blockIdx.y == 0) {
    for (int view = threadIdx.x; view < args.views; view += kThreads) {
      write_mean_terms(args.means, args.views, view);
    }
  }
  if (launch.strips == 0) return;
  extern __shared__ __align__(16) unsigned char shared[];
  StripWalk<kBytes, kGradient, kSums> walk(args, launch, reinterpret_cast<Shared*>(shared));
  walk.run();
  if constexpr (kSums) {
    const double l1 = block_sum<kThreads>(walk.l1_sum), ssim = block_sum<kThreads>(walk.ssim_sum);
    if (threadIdx.x == 0) {
      double* out = args.parts + 2 * walk.part(launch);
      out[0] = l1, out[1] = ssim;
    }
  }
}

int cut(int rows, int rows_per_strip) { return (rows + rows_per_strip - 1) / rows_per_strip; }

int block_columns(const PhotometricArgs<float>& args) { return (args.width + kOut - 1) / kOut; }

// Divides the owned rows into strips such that the blocks fill whole waves of the device and few rows are
// read twice.
Launch cut_strips(const PhotometricArgs<float>& args) {
  Launch launch{};
  launch.view_strips = 1;
  if (args.tile_begin == args.tile_end) return launch;
  const int columns = block_columns(args), slots = 2 * multiprocessors();
  const int64_t tiles = int64_t{args.tiles_x} * args.tiles_y;
  const int64_t last = args.tile_end - 1;
  launch.first_view = int(args.tile_begin / tiles);
  launch.last_view = int(last / tiles);
  launch.begin_row = int(args.tile_begin % tiles / args.tiles_x * args.tile_size);
  launch.end_row = std::min(args.height, int((last % tiles / args.tiles_x + 1) * args.tile_size));
  const int views = launch.last_view - launch.first_view;
  const int first_rows = (views ? args.height : launch.end_row) - launch.begin_row;
  constexpr int kLeadCost = 24;  // the work of a strip before its first output, in rows
  int64_t best_cost = LLONG_MAX;
  for (int pieces = 1; pieces <= cut(args.height, 16); ++pieces) {
    const int rows = cut(cut(args.height, pieces), kRows) * kRows;
    int strips = cut(first_rows, rows);
    if (views) strips += (views - 1) * cut(args.height, rows) + cut(launch.end_row, rows);
    const int64_t waves = (int64_t{columns} * strips + slots - 1) / slots;
    const int64_t cost = waves * (rows + kLeadCost);
    if (cost >= best_cost) continue;
    best_cost = cost;
    launch.strips = strips;
    launch.rows_per_strip = rows;
    launch.first_strips = cut(first_rows, rows);
    launch.view_strips = cut(args.height, rows);
  }
  return launch;
}

template <bool kBytes>
void launch_strips(dim3 grid, const PhotometricArgs<float>& args, const Launch& launch, CudaStream stream) {
  const auto kernel = !args.v_renders ? photometric_kernel<kBytes, false, true>
                      : args.parts    ? photometric_kernel<kBytes, true, true>
                                      : photometric_kernel<kBytes, true, false>;
  launch_early("photometric", kernel, {grid, kThreads, stream, 2 * sizeof(Shared)}, args, launch);
}

// Sets v_renders to zero before the first row and after the last row with an owned pixel.
void clear_rest(const PhotometricArgs<float>& args, const Launch& launch, cudaStream_t stream) {
  const int64_t row = 3 * int64_t{args.width};
  const int64_t begin = (int64_t{launch.first_view} * args.height + launch.begin_row) * row;
  const int64_t end = (int64_t{launch.last_view} * args.height + launch.end_row) * row;
  const int64_t total = args.views * args.height * row;
  check(cudaMemsetAsync(args.v_renders, 0, begin * sizeof(float), stream), "photometric");
  check(cudaMemsetAsync(args.v_renders + end, 0, (total - end) * sizeof(float), stream), "photometric");
}

}  // namespace

template <class T> int64_t photometric_parts(const PhotometricArgs<T>& args) {
  return int64_t{cut_strips(args).view_strips} * block_columns(args);
}

template <class T> void photometric(const PhotometricArgs<T>& args, Workspace&, CudaStream stream) {
  const Launch launch = cut_strips(args);
  const dim3 grid(block_columns(args), std::max(launch.strips, 1));
  args.targets_u8 ? launch_strips<true>(grid, args, launch, stream)
                  : launch_strips<false>(grid, args, launch, stream);
  if (args.v_renders && args.clear_rest) clear_rest(args, launch, stream);
}

template int64_t photometric_parts<float>(const PhotometricArgs<float>&);
template void photometric<float>(const PhotometricArgs<float>&, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
