// SPDX-License-Identifier: Apache-2.0
// Work on rows that do not know each other: a struct with the number n of rows, whose operator() does the
// work of row i. rows_cpu.cpp and rows_cuda.cu name all such structs.
#pragma once
#include "common/kernel.h"

namespace blitzgs::BLITZGS_BACKEND {

// Does the work of rows 0 to n - 1, on CUDA with a thread for each.
template <class Rows>
void for_each_row(const Rows& work, CudaStream);

}  // namespace blitzgs::BLITZGS_BACKEND
