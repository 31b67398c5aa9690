// SPDX-License-Identifier: Apache-2.0
// All that is compiled with AVX2 and FMA; use_avx2() (parallel.h) tells where it may be called.
#include "adam/lazy_adam_row.h"
#include "loss/photometric_strip.h"
#include "rasterize/tile_kernels.h"

namespace blitzgs::cpu {

AdamRowUpdate<float> avx2_adam_row_update() { return update_row<float>; }

void photometric_strips_avx2(const PhotometricArgs<float>& args, const int64_t* strips, int64_t begin,
                             int64_t end, double* sums) {
  run_photometric_strips(args, strips, begin, end, sums);
}

TileKernels<float> avx2_tile_kernels(int n_channels, bool absgrad) {
  return select_kernels<Avx2Lanes>(n_channels, absgrad);
}

}  // namespace blitzgs::cpu
