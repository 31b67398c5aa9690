// SPDX-License-Identifier: Apache-2.0
#include "project/color_rows.h"

namespace blitzgs::cpu {

void number_rows(const NumberedRows& numbered, const ProjectCapacity& capacity, CudaStream) {
  for (std::int64_t u = 0; u < capacity.sizes.visible; ++u) {
    number_row(numbered, static_cast<std::int32_t>(u));
  }
}

}  // namespace blitzgs::cpu
