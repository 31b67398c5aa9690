// SPDX-License-Identifier: Apache-2.0
#include "rasterize/tile_kernels.h"

namespace blitzgs::cpu {

TileKernels<float> avx2_tile_kernels(int n_channels, bool absgrad) {
  return select_kernels<Avx2Lanes>(n_channels, absgrad);
}

}  // namespace blitzgs::cpu
