// SPDX-License-Identifier: Apache-2.0
// Relocation (3DGS-MCMC, Kheradmand et al. 2024): draws the Gaussians that are copied, and shares what N
// equal Gaussians at one place have, so that they look like one before (eq. 9).
#pragma once
#include "math/gaussian.h"
#include "population/columns.h"

namespace blitzgs {

// Opacities as weights of a draw: integers in units of 2^-31, so that sums do not depend on the order. Rows
// with a cause of death have the weight 0.
struct DrawWeights {
  const float* opacities;  // [n], logits
  const uint8_t* causes;   // [n]
  int64_t n;
  int64_t* weights;

  BLITZGS_HD void operator()(int64_t i) const {
    const auto opacity = float(sigmoid(double(opacities[i])));
    weights[i] = causes[i] ? 0 : int64_t(opacity * 2147483648.0);
  }
};

// Residual resampling (Liu and Chen 1998): of `draws` draws in proportion to weights that add up to `total`,
// the whole numbers that each row gets for certain, and keys (columns.h) that draw the rest without
// replacement in proportion to what is left.
struct ResidualDraws {
  const int64_t* weights;  // [n], 0 to 2^31
  const int64_t* ids;      // [n]
  int64_t n, draws, total, seed, event;
  int64_t* whole;
  float* keys;

  BLITZGS_HD void operator()(int64_t i) const {
    const int64_t share = weights[i] * draws;
    whole[i] = share / total;
    keys[i] = sampling_key(float(share - whole[i] * total), ids[i], seed, event);
  }
};

// The integral along a line through the centre of what N Gaussians of opacity o composite, over that of one
// of opacity 1:
//
//   sum_{i=1}^{N} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o^(k+1) / sqrt(k + 1)
//
// The sum over i of C(i-1, k) is C(N, k+1), which leaves one sum. It alternates, and its terms exceed it by
// up to 10^5, so it is one of doubles.
BLITZGS_HD double overlap_of(double opacity, int64_t copies) {
  double term = -1, total = 0;
  for (int64_t k = 1; k <= copies; ++k) {
    term *= double(copies - (k - 1)) / double(k) * -opacity;
    total += term / std::sqrt(double(k));
  }
  return total;
}

struct Overlap {
  const double* opacities;  // [n]
  const int64_t* copies;    // [n]
  int64_t n;
  double* overlaps;

  BLITZGS_HD void operator()(int64_t i) const { overlaps[i] = overlap_of(opacities[i], copies[i]); }
};

// Lets rows of a table stand for N copies each: opacities and scales are shared (the logits and logarithms of
// o' = 1 - (1 - o)^(1/N) and s' = s o / overlap(o', N)), and Adam's moments are scaled as the gradients are.
//
// Each of N Gaussians in one place has 1/N of the gradient of the Gaussian before. That of the logit changes
// by the factor o' / o, since (1 - o')^N = 1 - o. Second moments change by the squares.
struct ShareRows {
  float* opacities;        // [N], logits
  float* scales;           // [N, 3], logarithms
  float* opacity_avgs;     // [N], first moments of the logits
  float* opacity_avg_sqs;  // [N], second moments
  const int64_t* rows;     // [n], each once
  const int64_t* copies;   // [n], the row itself included
  int64_t n;
  float least;  // sharing does not reduce a logit below this

  BLITZGS_HD void operator()(int64_t i) const {
    const int64_t row = rows[i];
    const double logit = opacities[row], count = double(copies[i]);
    const double log_complement = std::log1p(std::exp(-std::fabs(logit)));
    // -log(1 - o) = softplus(logit), and log(o) = -softplus(-logit).
    const double depth = (log_complement + larger(logit, 0.0)) / count;
    const double log_opacity = -(log_complement + larger(-logit, 0.0));
    const double factor = log_opacity - std::log(overlap_of(-std::expm1(-depth), copies[i]));
    const float shared = larger(float(std::log(std::expm1(depth))), least);
    opacities[row] = shared;
    for (int axis = 0; axis < 3; ++axis) {
      float& scale = scales[3 * row + axis];
      scale = float(scale + factor);
    }
    const double dimmed = sigmoid(double(shared)) / sigmoid(logit);
    opacity_avgs[row] *= float(dimmed);
    opacity_avg_sqs[row] *= float(dimmed * dimmed);
  }
};

// Scales the moments of all parameters but the opacity by 1/N and 1/N^2. On CUDA, neighbouring threads scale
// neighbouring values of a row.
struct ShareMoments {
  static constexpr int kColumns = 4;  // of first moments, and of second ones
  struct Moments {
    float* values;  // [N, width]
    int width;
  };
  Moments avgs[kColumns], avg_sqs[kColumns];
  const int64_t* rows;    // [n / lanes]
  const int64_t* copies;  // [n / lanes]
  int lanes;              // threads of a row
  int64_t n;

  BLITZGS_HD void operator()(int64_t item) const {
    const int64_t row = rows[item / lanes];
    const double share = 1 / double(copies[item / lanes]);
    for (int c = 0; c < kColumns; ++c) {
      scale(avgs[c], row, item % lanes, float(share));
      scale(avg_sqs[c], row, item % lanes, float(share * share));
    }
  }

  BLITZGS_HD void scale(const Moments& moments, int64_t row, int64_t lane, float factor) const {
    float* const values = moments.values + row * moments.width;
    for (auto k = int(lane); k < moments.width; k += lanes) values[k] *= factor;
  }
};

}  // namespace blitzgs
