// SPDX-License-Identifier: Apache-2.0
#include <thread>
#include <vector>

#include "common/parallel.h"

namespace blitzgs {

int num_threads() { return 2; }

void parallel_for_impl(int64_t begin, int64_t end, int64_t grain, RangeFunction function, void* context) {
  const int64_t count = end - begin;
  const int64_t chunk =
      std::max<int64_t>(std::max<int64_t>(grain, 1), (count + num_threads() - 1) / num_threads());
  std::vector<std::thread> threads;
  for (int64_t b = begin; b < end; b += chunk) {
    threads.emplace_back(function, b, std::min(b + chunk, end), context);
  }
  for (auto& thread : threads) thread.join();
}

}  // namespace blitzgs
