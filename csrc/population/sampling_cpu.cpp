// SPDX-License-Identifier: Apache-2.0
#include "population/sampling.h"

#include <algorithm>

#include "common/parallel.h"

namespace blitzgs::cpu {

void sampling_keys(const SamplingKeys& args, CudaStream) {
  parallel_for(0, args.n, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) args.keys[i] = sampling_key(args, i);
  });
}

void key_histogram(const KeyHistogram& args, CudaStream) {
  std::fill_n(args.counts, std::int64_t{1} << args.width, 0);
  for (std::int64_t i = 0; i < args.n; ++i) {
    const int digit = digit_of(args, *args.prefix, args.keys[i]);
    if (digit >= 0) ++args.counts[digit];
  }
}

}  // namespace blitzgs::cpu
