// SPDX-License-Identifier: Apache-2.0
// Density control: statistics of the gradients, the features of candidates, and the trees that score them.
#pragma once
#include "math/gaussian.h"
#include "math/tiles.h"

// The statistics of density control (Kerbl et al. 2023, section 5), summed over the views of one step.
//
// For every visible Gaussian g and each of its splats r (g in one view):
//   grad_sum[g]   += phi[g] * weight * |(v_means2d[r].x * width / 2, v_means2d[r].y * height / 2)|
//   grad_count[g] += 1
//   max_radii[g]   = max(max_radii[g], ceil(3 sqrt(largest eigenvalue of the 2D covariance))), in pixels
// With the mean m and the product d of the eigenvalues, the largest is m + sqrt(max(0.1, m^2 - d)), as in the
// original renderer.
//
// v_means2d [P, 2] is the gradient by the pixel position; the values of consecutive splats are v_stride
// numbers apart. weight is the factor from the gradient of the batch's loss to the gradient of one view's
// loss (B for a mean over B views). phi [N] or null (1); conics [P, 3] inverse covariance (a, b, c);
// visible_ids int32 [U], splat_offsets int32 [U + 1]. The statistics are updated in place. One thread sums
// over the splats of a Gaussian in order, so the result is deterministic. The cost is O(P).
namespace blitzgs {

// The radius of a splat in pixels, three standard deviations of its longer axis; 0 for a conic whose diagonal
// is not positive. In double, because the determinant of a thin splat's conic is a small difference. If that
// is less than the rounding of the conic's own numbers, the rounding takes its place: the splat is then at
// least so long, and not mistaken for a small one.
template <class T> BLITZGS_HD T three_sigma_radius(const T* conic) {
  constexpr double kRounding = std::numeric_limits<T>::epsilon();
  const double a = double(conic[0]), c = double(conic[2]);
  if (!(a > 0 && c > 0)) return 0;
  const double found = conic_determinant(conic), least = kRounding * a * c;
  const double determinant = found > least ? found : least;
  const double half_trace = 0.5 * (a + c) / determinant;
  const double gap = half_trace * half_trace - 1 / determinant;
  return T(std::ceil(3 * std::sqrt(half_trace + std::sqrt(gap > 0.1 ? gap : 0.1))));
}

template <class T> struct DensityStats {
  T* grad_sum;          // [N]
  int32_t* grad_count;  // [N]
  T* max_radii;         // [N]
  const int32_t *visible_ids, *splat_offsets;
  const T* v_means2d;
  int64_t v_stride;
  const T *conics, *phi;
  int64_t n;
  T half_width, half_height, weight;

  BLITZGS_HD void operator()(int64_t u) const {
    const int32_t id = visible_ids[u];
    const int32_t begin = splat_offsets[u], end = splat_offsets[u + 1];
    T sum = 0, radius = max_radii[id];
    for (int32_t r = begin; r < end; ++r) {
      const T* v = v_means2d + r * v_stride;
      const T x = v[0] * half_width, y = v[1] * half_height;
      sum += std::sqrt(x * x + y * y);
      const T reach = three_sigma_radius(conics + 3 * int64_t{r});
      radius = reach > radius ? reach : radius;
    }
    grad_sum[id] += (phi ? phi[id] : T(1)) * weight * sum;
    grad_count[id] += end - begin;
    max_radii[id] = radius;
  }
};

// The features of candidates of densification, from which the spawn gate predicts whether their children
// survive (BlitzGS, section 3.2). The features are those of blitzgs.spawn.candidates.FEATURES. Each is
// computed in float64 and rounded once, so that CPU and CUDA rarely differ, in the last bit. O(M).

constexpr int kSpawnFeatures = 10;

struct SpawnFeatures {
  const float* grad_sum;       // [N], sum of gradient norms since the last density event
  const int32_t* grad_count;   // [N], number of these gradients
  const float* opacities;      // [N], logits
  const float* scales;         // [N, 3], logarithms
  const int32_t* birth;        // [N], in images
  const uint8_t* level;        // [N], octree level
  const float* color_moments;  // [N, K, 3], Adam's mean squared gradients of the SH coefficients
  int64_t color_stride;        // 3 K
  const int64_t* rows;         // [M], in [0, N)
  const bool* is_split;        // [M]
  int64_t n, time;             // time: of the event, in images
  double extent;               // of the scene
  int level_count;
  float* features;  // [M, kSpawnFeatures]

  BLITZGS_HD void operator()(int64_t candidate) const {
    const int64_t row = rows[candidate];
    const int views = grad_count[row], own_level = level[row];
    const float* const log_scale = scales + 3 * row;
    const double x = log_scale[0], y = log_scale[1], z = log_scale[2];
    const float* const moments = color_moments + color_stride * row;
    const double color = (double{moments[0]} + moments[1] + moments[2]) / 3;
    const bool splits = is_split[candidate];
    float* const out = features + kSpawnFeatures * candidate;
    out[0] = grad_sum[row] / float(views > 1 ? views : 1);
    out[1] = float(sigmoid(double(opacities[row])));
    out[2] = float((std::exp(x) + std::exp(y) + std::exp(z)) / 3 / extent);
    out[3] = float(time - birth[row]);
    out[4] = float(views);
    out[5] = float(splits ? smaller(own_level + 1, level_count - 1) : own_level);
    out[6] = float(time);
    out[7] = splits;
    out[8] = float(std::sqrt(color));
    out[9] = float(std::exp(smaller(x, smaller(y, z)) - larger(x, larger(y, z))));
  }
};

// The prediction of a gradient-boosted model (the spawn gate): for each row of features, the sum over all
// trees of the leaf that the row reaches.
//
//   features float32 [M, F], roots int32 [T], nodes [n], leaves int64 [n]  ->  sums int64 [M]
//
// At a node, a row goes left if its feature is below the threshold, or if it is NaN and the node sends NaN
// left. A node without children is a leaf. Leaves are integers, so the order of the trees does not matter and
// both backends give the same bits. The caller must check that children and features are in range and that no
// path is longer than `depth`. The cost is O(M T depth).

struct alignas(16) TreeNode {
  float threshold;
  int32_t feature;      // twice the index of the feature, plus 1 if NaN goes left
  int32_t left, right;  // -1 for a leaf
};

struct TreeSumsArgs {
  const float* features;
  const int32_t* roots;
  const TreeNode* nodes;
  const int64_t* leaves;
  int64_t n_rows, n_features;
  int n_trees, depth;
  int64_t* sums;
};

// The sum for one row; row[i] is its feature i.
template <class Row> BLITZGS_HD int64_t tree_sum_of(const TreeSumsArgs& args, const Row& row) {
  int64_t sum = 0;
  for (int tree = 0; tree < args.n_trees; ++tree) {
    int32_t at = args.roots[tree];
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
