// SPDX-License-Identifier: Apache-2.0
// Compiled without FMA contraction (cmake/cuda.cmake), so that tiles are counted as they are listed.
#include "project/unscented.h"

#include "common/rows.h"

namespace blitzgs::cuda {

template void for_each_row(const UnscentedVisible<float>&, CudaStream);
template void for_each_row(const UnscentedSplats<float>&, CudaStream);
template void for_each_row(const UnscentedGradients<float>&, CudaStream);

}  // namespace blitzgs::cuda
