// SPDX-License-Identifier: Apache-2.0
// Rows whose number only the device knows. The host queues an op before it knows how many rows the ops before
// it make. The op gets columns with room for n_rows rows and a pointer to their number in device memory: the
// first *known rows are valid. The memory behind them is undefined and is not read as rows. A number outside
// [0, n_rows] counts as 0: there was too little room, and the caller discards the result.
#pragma once
#include <cstdint>

#include "common/host_device.h"

namespace blitzgs {

// known: null if all n_rows rows are valid. Kernels read it after wait_for_earlier_kernels().
BLITZGS_HD std::int64_t rows_there(std::int64_t n_rows, const std::int64_t* known) {
  if (!known) return n_rows;
  const std::int64_t there = *known;
  return 0 <= there && there <= n_rows ? there : 0;
}

template <class Input>
BLITZGS_HD std::int64_t rows_there(const Input& in) {
  return rows_there(in.n_rows, in.known_rows);
}

}  // namespace blitzgs
