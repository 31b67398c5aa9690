// SPDX-License-Identifier: Apache-2.0
// A call with SH gathers the rows of the visible Gaussians of a projection (project.h) into a small table,
// row u for the Gaussian visible_ids[u]. This op writes the numbers that lead from rows and splats to each
// other:
//   rows[u] = u;   indices[u] = visible_ids[u];
//   row_of_splat[i] = u for the splats i of this Gaussian, splat_offsets[u] <= i < splat_offsets[u + 1].
// On CUDA nothing is written if there are more splats than the capacity. On the CPU the sizes of the capacity
// are the actual numbers.
#pragma once
#include <cstdint>

#include "common/kernel.h"
#include "project/project.h"

namespace blitzgs {

struct NumberedRows {
  const std::int32_t* visible_ids;    // [U]
  const std::int32_t* splat_offsets;  // [U + 1]
  std::int32_t* rows;                 // [U]
  std::int64_t* indices;              // [U]
  std::int32_t* row_of_splat;         // [P]
};

BLITZGS_HD void number_row(const NumberedRows& numbered, std::int32_t u) {
  numbered.rows[u] = u;
  numbered.indices[u] = numbered.visible_ids[u];
  for (std::int32_t i = numbered.splat_offsets[u]; i < numbered.splat_offsets[u + 1]; ++i) {
    numbered.row_of_splat[i] = u;
  }
}

namespace BLITZGS_BACKEND {
void number_rows(const NumberedRows&, const ProjectCapacity&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
