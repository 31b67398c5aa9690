// SPDX-License-Identifier: Apache-2.0
// The prediction of a gradient-boosted model (the spawn gate): for each row of features, the sum over all
// trees of the leaf that the row reaches.
//
//   features float32 [M, F], roots int32 [T], nodes [n], leaves int64 [n]  ->  sums int64 [M]
//
// At a node, a row goes left if its feature is below the threshold, or if it is NaN and the node sends NaN
// left. A node without children is a leaf. Leaves are integers, so the order of the trees does not matter and
// both backends give the same bits. The caller must check that children and features are in range and that no
// path is longer than `depth`. The cost is O(M T depth).
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

struct alignas(16) TreeNode {
  float threshold;
  std::int32_t feature;      // twice the index of the feature, plus 1 if NaN goes left
  std::int32_t left, right;  // -1 for a leaf
};

struct TreeSumsArgs {
  const float* features;
  const std::int32_t* roots;
  const TreeNode* nodes;
  const std::int64_t* leaves;
  std::int64_t n_rows, n_features;
  int n_trees, depth;
  std::int64_t* sums;
};

// The sum for one row; row[i] is its feature i.
template <class Row>
BLITZGS_HD std::int64_t tree_sum_of(const TreeSumsArgs& args, const Row& row) {
  std::int64_t sum = 0;
  for (int tree = 0; tree < args.n_trees; ++tree) {
    std::int32_t at = args.roots[tree];
    for (int step = 0; step < args.depth; ++step) {
      const TreeNode node = args.nodes[at];
      if (node.left < 0) break;
      const float value = row[node.feature >> 1];
      const bool goes_left = value < node.threshold || (value != value && (node.feature & 1));
      at = goes_left ? node.left : node.right;
    }
    sum += args.leaves[at];
  }
  return sum;
}

namespace BLITZGS_BACKEND {
void tree_sums(const TreeSumsArgs& args, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
