// SPDX-License-Identifier: Apache-2.0
// Splats whose number only the device knows. The host queues an op before it knows how many splats the ops
// before it make. The op gets columns with room for n_splats splats and a pointer to their number in device
// memory: the first *known splats are valid. The memory behind them is undefined and is not read as splats. A
// number outside [0, n_splats] counts as 0: there was too little room, and the caller discards the result.
#pragma once
#include <cstdint>

#include "common/host_device.h"

namespace blitzgs {

// known: null if all n_splats splats are valid. Kernels read it after wait_for_earlier_kernels().
BLITZGS_HD std::int64_t splats_there(std::int64_t n_splats, const std::int64_t* known) {
  if (!known) return n_splats;
  const std::int64_t there = *known;
  return 0 <= there && there <= n_splats ? there : 0;
}

template <class Input>
BLITZGS_HD std::int64_t splats_there(const Input& in) {
  return splats_there(in.n_splats, in.known_splats);
}

}  // namespace blitzgs
