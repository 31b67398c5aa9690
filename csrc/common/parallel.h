// SPDX-License-Identifier: Apache-2.0
// Threads of the CPU kernels, which do not include torch, and their vector instructions. The library links
// torch's thread pool (parallel_torch.cpp), so torch.set_num_threads applies; the Catch2 tests link plain
// threads (parallel_std.cpp).
#pragma once
#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstdlib>

namespace blitzgs {

using RangeFunction = void (*)(int64_t begin, int64_t end, void* context);

void parallel_for_impl(int64_t begin, int64_t end, int64_t grain, RangeFunction function, void* context);
int num_threads();

// Calls f(chunk_begin, chunk_end) over disjoint chunks that cover [begin, end). The results must not depend
// on how the range is cut. f must not throw.
template <class F> void parallel_for(int64_t begin, int64_t end, int64_t grain, const F& f) {
  if (begin >= end) return;
  parallel_for_impl(
      begin, end, grain, [](int64_t b, int64_t e, void* context) { (*static_cast<const F*>(context))(b, e); },
      const_cast<void*>(static_cast<const void*>(&f)));
}

// Calls f(i) for each i in [0, n), on threads that each take at least `grain` consecutive ones.
template <class F> void parallel_rows(int64_t n, int64_t grain, const F& f) {
  parallel_for(0, n, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i);
  });
}

template <class T> void parallel_zero(T* values, int64_t n) {
  parallel_for(0, n, 1 << 16,
               [&](int64_t begin, int64_t end) { std::fill(values + begin, values + end, T(0)); });
}

// Calls f(task, worker) once for each task in [0, n). Each worker takes one task at a time, which suits tasks
// of uneven cost. worker < num_threads() is the index of the thread's scratch memory. f must not throw.
template <class F> void parallel_tasks(int64_t n, const F& f) {
  std::atomic<int64_t> next{0};
  parallel_for(0, num_threads(), 1, [&](int64_t begin, int64_t) {
    for (int64_t task = next++; task < n; task = next++) f(task, int(begin));
  });
}

// Instantiates a function template of a CPU kernel for both dtypes.
#define BLITZGS_FOR_BOTH_DTYPES(f)      \
  template decltype(f<float>) f<float>; \
  template decltype(f<double>) f<double>

// Whether to use AVX2 and FMA: true where the processor has them, unless BLITZGS_NO_AVX2 is set in the
// environment (read once). The plain code gives the same bits, and a test compares both.
inline bool use_avx2() {
  static const bool use = std::getenv("BLITZGS_NO_AVX2") == nullptr && __builtin_cpu_supports("avx2") &&
                          __builtin_cpu_supports("fma");
  return use;
}

}  // namespace blitzgs
