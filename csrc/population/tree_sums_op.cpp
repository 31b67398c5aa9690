// SPDX-License-Identifier: Apache-2.0
#include "population/tree_sums.h"

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "tree_sums";
constexpr std::int64_t kMaxFeatures = 32;  // the features of a block's rows are in shared memory

Tensor tree_sums(const Tensor& features_in, const Tensor& roots_in, const Tensor& nodes_in,
                 const Tensor& leaves_in, std::int64_t depth) {
  check_dtype(kOp, "features", features_in, ScalarType::Float);
  check_shape(kOp, "features", features_in, {-1, -1});
  check_dtype(kOp, "roots", roots_in, ScalarType::Int);
  check_shape(kOp, "roots", roots_in, {-1});
  check_dtype(kOp, "nodes", nodes_in, ScalarType::Int);
  check_shape(kOp, "nodes", nodes_in, {-1, 4});
  check_dtype(kOp, "leaves", leaves_in, ScalarType::Long);
  check_shape(kOp, "leaves", leaves_in, {nodes_in.size(0)});
  const std::int64_t rows = features_in.size(0), n_features = features_in.size(1);
  STD_TORCH_CHECK(n_features <= kMaxFeatures, "blitzgs::", kOp, ": at most ", kMaxFeatures, " features, got ",
                  n_features);
  STD_TORCH_CHECK(depth >= 0, "blitzgs::", kOp, ": depth must not be negative, got ", depth);
  const Tensor features = as_contiguous(features_in), roots = as_contiguous(roots_in);
  const Tensor nodes = as_contiguous(nodes_in), leaves = as_contiguous(leaves_in);
  Tensor sums = make_empty(features, {rows}, ScalarType::Long);
  DeviceScope scope(features);
  const TreeSumsArgs args{data<float>(features),
                          data<std::int32_t>(roots),
                          reinterpret_cast<const TreeNode*>(data<std::int32_t>(nodes)),
                          data<std::int64_t>(leaves),
                          rows,
                          n_features,
                          static_cast<int>(roots.numel()),
                          static_cast<int>(depth),
                          mutable_data<std::int64_t>(sums)};
  backend::tree_sums(args, scope.stream);
  return sums;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("tree_sums", TORCH_BOX(&blitzgs::tree_sums)); }
