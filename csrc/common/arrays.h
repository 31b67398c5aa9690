// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <cstddef>
#include <cstdint>
#include <tuple>

#include "common/stream.h"

namespace blitzgs {

// Uninitialised arrays of one length in one piece of scratch memory, each aligned for any type. They share a
// piece because the host spends microseconds on allocating each, while the device waits for the launch behind
// it.
template <class... T>
std::tuple<T*...> allocate_arrays(std::int64_t length, Workspace& workspace) {
  constexpr std::size_t kAlignment = 256;
  const auto bytes = [&](std::size_t size) {
    return (static_cast<std::size_t>(length) * size + kAlignment - 1) / kAlignment * kAlignment;
  };
  auto* next = static_cast<std::byte*>(workspace.allocate_bytes((bytes(sizeof(T)) + ...)));
  const auto take = [&](std::size_t size) {
    void* const array = next;
    next += bytes(size);
    return array;
  };
  return {static_cast<T*>(take(sizeof(T)))...};  // braces: from left to right
}

}  // namespace blitzgs
