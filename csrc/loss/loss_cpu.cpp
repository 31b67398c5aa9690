// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "loss/photometric.h"
#include "loss/photometric_strip.h"

namespace blitzgs::cpu {

// common/kernels_avx2.cpp
void photometric_strips_avx2(const PhotometricArgs<float>& args, const int64_t* strips, int64_t begin,
                             int64_t end, double* sums);

namespace {

template <class T>
void run_strips(const PhotometricArgs<T>& args, const int64_t* strips, int64_t begin, int64_t end,
                double* sums) {
  if constexpr (std::is_same_v<T, float>) {
    if (use_avx2()) return photometric_strips_avx2(args, strips, begin, end, sums);
  }
  run_photometric_strips(args, strips, begin, end, sums);
}

}  // namespace

template <class T> int64_t photometric_parts(const PhotometricArgs<T>& args) {
  return (args.height + kStripRows - 1) / kStripRows;
}

template <class T> void photometric(const PhotometricArgs<T>& args, Workspace& workspace, CudaStream) {
  const int64_t per_view = photometric_parts(args);
  const int64_t total = args.views * per_view;
  const int64_t view_tiles = int64_t{args.tiles_x} * args.tiles_y;
  int64_t* strips = workspace.allocate<int64_t>(total);
  double* sums = args.parts ? args.parts : workspace.allocate<double>(2 * total);
  std::fill_n(sums, 2 * total, 0.0);
  int64_t count = 0;
  for (int64_t strip = 0; strip < total; ++strip) {
    const int64_t first = strip / per_view * view_tiles;
    const int begin = int(strip % per_view) * kStripRows;
    const int end = std::min(args.height, begin + kStripRows);
    const bool owned = first + begin / args.tile_size * int64_t{args.tiles_x} < args.tile_end &&
                       first + ((end - 1) / args.tile_size + 1) * int64_t{args.tiles_x} > args.tile_begin;
    if (owned) {
      strips[count++] = strip;
    } else if (args.v_renders && args.clear_rest) {
      const int64_t row = 3 * int64_t{args.width};
      T* rows = args.v_renders + (strip / per_view * args.height + begin) * row;
      std::fill_n(rows, (end - begin) * row, T(0));
    }
  }
  parallel_for(0, count, 1, [&](int64_t begin, int64_t end) { run_strips(args, strips, begin, end, sums); });
  if (!args.means.visible) return;
  for (int64_t view = 0; view < args.views; ++view) write_mean_terms(args.means, args.views, view);
}

BLITZGS_FOR_BOTH_DTYPES(photometric_parts);
BLITZGS_FOR_BOTH_DTYPES(photometric);

template <class T> void report(const Report<T>& report, CudaStream) {
  for (int64_t view = 0; view < report.views; ++view) {
    const double* parts = report.parts + 2 * view * report.n_parts;
    double l1 = 0, ssim = 0;
    for (int64_t i = 0; i < report.n_parts; ++i) l1 += parts[2 * i], ssim += parts[2 * i + 1];
    for (int m = 0; m < report.n_targets; ++m) {
      report.targets[m].l1[view] = T(l1);
      report.targets[m].ssim[view] = T(ssim);
    }
  }
  for (int m = 0; m < report.n_targets; ++m) {
    for (int64_t tile = report.tile_begin; tile < report.tile_end; ++tile) {
      report.targets[m].tiles[tile] = T(report.tile_work[tile]);
    }
  }
}

BLITZGS_FOR_BOTH_DTYPES(report);

template <class T> void loss_of_sums(const LossOfSums<T>& args, CudaStream) {
  double l1 = 0, ssim = 0;
  for (int64_t i = 0; i < args.n; ++i) l1 += args.parts[2 * i], ssim += args.parts[2 * i + 1];
  *args.loss = T(args.offset + args.l1_weight * l1 + args.ssim_weight * ssim);
}

BLITZGS_FOR_BOTH_DTYPES(loss_of_sums);

}  // namespace blitzgs::cpu
