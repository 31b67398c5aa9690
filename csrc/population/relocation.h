// SPDX-License-Identifier: Apache-2.0
// Relocation (3DGS-MCMC, Kheradmand et al. 2024, eq. 9): N equal Gaussians at one place look like one before.
#pragma once
#include <cmath>
#include <cstdint>

#include "common/kernel.h"
#include "math/gaussian.h"

namespace blitzgs {

// The integral along a line through the centre of what N Gaussians of opacity o composite, over that of one
// of opacity 1:
//
//   sum_{i=1}^{N} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o^(k+1) / sqrt(k + 1)
//
// The sum over i of C(i-1, k) is C(N, k+1), which leaves one sum. It alternates, and its terms exceed it by
// up to 10^5, so it is one of doubles.
BLITZGS_HD double overlap_of(double opacity, std::int64_t copies) {
  double term = -1, total = 0;
  for (std::int64_t k = 1; k <= copies; ++k) {
    term *= static_cast<double>(copies - (k - 1)) / static_cast<double>(k) * -opacity;
    total += term / std::sqrt(static_cast<double>(k));
  }
  return total;
}

struct Overlap {
  const double* opacities;     // [n]
  const std::int64_t* copies;  // [n]
  std::int64_t n;
  double* overlaps;

  BLITZGS_HD void operator()(std::int64_t i) const { overlaps[i] = overlap_of(opacities[i], copies[i]); }
};

// Lets rows of a table stand for N copies each: opacities and scales are shared (the logits and logarithms of
// o' = 1 - (1 - o)^(1/N) and s' = s o / overlap(o', N)), and Adam's moments are scaled as the gradients are.
//
// Each of N Gaussians in one place has 1/N of the gradient of the Gaussian before. That of the logit changes
// by the factor o' / o, since (1 - o')^N = 1 - o. Second moments change by the squares. One thread per row.
struct ShareRows {
  static constexpr int kColumns = 10;  // first moments of all parameters, then second moments
  struct Moments {
    float* values;  // [N, width]
    int width;
  };
  float* opacities;            // [N], logits
  float* scales;               // [N, 3], logarithms
  Moments moments[kColumns];   // the fourth parameter is the opacity
  const std::int64_t* rows;    // [n], each once
  const std::int64_t* copies;  // [n], the row itself included
  std::int64_t n;
  float least;  // sharing does not reduce a logit below this

  BLITZGS_HD void operator()(std::int64_t i) const {
    const std::int64_t row = rows[i];
    const double logit = opacities[row], count = static_cast<double>(copies[i]);
    const double log_complement = std::log1p(std::exp(-std::fabs(logit)));
    // -log(1 - o) = softplus(logit), and log(o) = -softplus(-logit).
    const double depth = (log_complement + larger(logit, 0.0)) / count;
    const double log_opacity = -(log_complement + larger(-logit, 0.0));
    const double factor = log_opacity - std::log(overlap_of(-std::expm1(-depth), copies[i]));
    const float shared = larger(static_cast<float>(std::log(std::expm1(depth))), least);
    opacities[row] = shared;
    for (int axis = 0; axis < 3; ++axis) {
      float& scale = scales[3 * row + axis];
      scale = static_cast<float>(scale + factor);
    }
    const double share = 1 / count, dimmed = sigmoid(static_cast<double>(shared)) / sigmoid(logit);
    for (int c = 0; c < kColumns; ++c) {
      const double by = c % 5 == 3 ? dimmed : share;
      const float factor_of_column = static_cast<float>(c < 5 ? by : by * by);
      float* const values = moments[c].values + row * moments[c].width;
      for (int k = 0; k < moments[c].width; ++k) values[k] *= factor_of_column;
    }
  }
};

}  // namespace blitzgs
