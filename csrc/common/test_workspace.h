// SPDX-License-Identifier: Apache-2.0
// Scratch memory for the tests that run without torch.
#pragma once
#include <cstddef>
#include <memory>
#include <vector>

#include "common/kernel.h"

namespace blitzgs {

class TestWorkspace final : public Workspace {
 public:
  void* allocate_bytes(std::size_t bytes) override {
    // Allocations have exactly the requested length, so that AddressSanitizer notices the first byte beyond.
    held_.push_back(std::make_unique<std::byte[]>(bytes));
    return held_.back().get();
  }
  // Returns the last allocation; null before the first.
  void* last() const { return held_.empty() ? nullptr : held_.back().get(); }

 private:
  std::vector<std::unique_ptr<std::byte[]>> held_;
};

}  // namespace blitzgs
