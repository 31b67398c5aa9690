// SPDX-License-Identifier: Apache-2.0
#include "render/render.h"

#include "common/parallel.h"

namespace blitzgs::cpu {

template <class T>
void alphas_of(const T* transmittances, std::int64_t n, T* alphas, CudaStream) {
  parallel_for(0, n, 1 << 16, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) alphas[i] = T(1) - transmittances[i];
  });
}

template void alphas_of<float>(const float*, std::int64_t, float*, CudaStream);
template void alphas_of<double>(const double*, std::int64_t, double*, CudaStream);

}  // namespace blitzgs::cpu
