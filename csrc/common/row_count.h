// SPDX-License-Identifier: Apache-2.0
// Rows whose number only the device knows. An op that the host queues before it knows how many rows were made
// gets columns with room for n_rows and, where the ops before it have left it, the number of rows that are
// there: the first *known ones. What lies behind them is undefined memory and is not read as a row. A number
// that is not in [0, n_rows] counts as 0: there was too little room, and the caller throws the result away.
#pragma once
#include <cstdint>

#include "common/host_device.h"

namespace blitzgs {

// known: null where all n_rows are there. On the device it is read behind wait_for_earlier_kernels().
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
