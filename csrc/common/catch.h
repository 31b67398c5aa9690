// SPDX-License-Identifier: Apache-2.0
// What the tests that run without torch share. Catch2 v2 and v3 define their macros in different headers.
#pragma once
#include <memory>
#include <vector>

#include "common/kernel.h"
#ifdef BLITZGS_CATCH2_V3
#include <catch2/catch_all.hpp>
using Catch::Approx;
#else
#include <catch2/catch.hpp>
#endif

namespace blitzgs {

// Deterministic noise: 16 bits.
inline uint32_t next_random(uint32_t& state) {
  state = state * 1664525u + 1013904223u;
  return state >> 16;
}

class TestWorkspace final : public Workspace {
 public:
  void* allocate_bytes(size_t bytes) override {
    // Allocations have exactly the requested length, so that AddressSanitizer notices the first byte beyond.
    held_.push_back(std::make_unique<std::byte[]>(bytes));
    return held_.back().get();
  }

 private:
  std::vector<std::unique_ptr<std::byte[]>> held_;
};

}  // namespace blitzgs
