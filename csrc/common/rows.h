// SPDX-License-Identifier: Apache-2.0
// Work on rows that do not know each other: a struct with the number n of rows, whose operator() does the
// work of row i. For CUDA, a kernel file of the struct's folder instantiates for_each_row (rows.cuh).
#pragma once
#include "common/kernel.h"
#include "common/parallel.h"

namespace blitzgs::BLITZGS_BACKEND {

// Does the work of rows 0 to n - 1, on CUDA with a thread for each.
template <class Rows>
void for_each_row(const Rows& work, CudaStream)
#ifdef BLITZGS_BACKEND_CUDA
    ;
#else
{
  parallel_rows(work.n, 4096, [&](std::int64_t i) { work(i); });
}
#endif

}  // namespace blitzgs::BLITZGS_BACKEND
