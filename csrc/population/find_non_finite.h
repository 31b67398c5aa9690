// SPDX-License-Identifier: Apache-2.0
// Looks for values that are not finite in some columns, and for zeros in others, in one pass without memory
// of their size: `bad` becomes 1 if there is one, and else keeps its value.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

constexpr int kMaxCheckedColumns = 16;

// values [length] of n columns. zero_is_bad: look for zeros instead.
template <class T>
struct CheckedColumns {
  struct Column {
    const T* values;
    std::int64_t length;
    bool zero_is_bad;
  };
  Column columns[kMaxCheckedColumns];
  int n;
  std::int32_t* bad;
};

template <class T>
BLITZGS_HD bool is_bad(T value, bool zero_is_bad) {
  // A number that is not finite, times zero, is NaN.
  return zero_is_bad ? value == T(0) : !(value * T(0) == T(0));
}

namespace BLITZGS_BACKEND {
void clear_flag(std::int32_t* bad, CudaStream);
template <class T>
void check_columns(const CheckedColumns<T>&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
