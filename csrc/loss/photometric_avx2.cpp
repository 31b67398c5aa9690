// SPDX-License-Identifier: Apache-2.0
#include "loss/photometric_strip.h"

namespace blitzgs::cpu {

void photometric_strips_avx2(const PhotometricArgs<float>& args, const std::int64_t* strips,
                             std::int64_t begin, std::int64_t end, double* sums) {
  run_photometric_strips(args, strips, begin, end, sums);
}

}  // namespace blitzgs::cpu
