// SPDX-License-Identifier: Apache-2.0
// Noise on the means of almost transparent Gaussians (stochastic gradient Langevin dynamics; Kheradmand et
// al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", eq. 8).
//
// For every listed row i, with opacity o = sigmoid(opacities[i]) and covariance Sigma = A A^T, A = R(q)
// diag(exp(s)):
//   gate = sigmoid(100 (threshold - o))
//   means[i] += strength * gate * Sigma n,   n = three standard normal numbers of (ids[i], seed, step)
//
// A Gaussian therefore moves along its own axes, and a Gaussian with an opacity well above the threshold does
// not move: a gate below 2^-24 changes no mean, so the other columns of such rows are not read. The draws are
// float64 and depend on the persistent id, the seed and the step alone, so the noise is the same for any
// order of the rows and any number of ranks. The means are updated in place, one thread per row:
// deterministic. The cost is O(U).
//
// means [N, 3], quats [N, 4], scales [N, 3] (log), opacities [N] (logit), ids int64 [N], visible_ids int32
// [U] (each row once). strength has the unit of an inverse length.
#pragma once
#include "math/counter_random.h"
#include "math/gaussian.h"

namespace blitzgs {

constexpr double kGateSlope = 100;
constexpr double kLeastGate = 0x1p-24;
// The key that makes these draws differ from other draws of the same id and seed.
constexpr int64_t kPositionNoise = 1;

template <class T> struct PositionNoise {
  T* means;            // [N, 3]
  const T* quats;      // [N, 4]
  const T* scales;     // [N, 3]
  const T* opacities;  // [N]
  const int64_t* ids;
  const int32_t* visible_ids;
  int64_t n;
  int64_t seed, step;
  double threshold, strength;

  BLITZGS_HD void operator()(int64_t u) const {
    const int64_t row = visible_ids[u];
    const double opacity = sigmoid(double(opacities[row]));
    const double gate = sigmoid(kGateSlope * (threshold - opacity));
    if (!(gate >= kLeastGate)) return;
    const Columns3<T> rotation = rotation_columns(normalize_quaternion(quats + 4 * row));
    const Vec3<T> log_scale = load3(scales + 3 * row);
    const Columns3<T> axes =
        scaled_axes(rotation, Vec3<T>{std::exp(log_scale.x), std::exp(log_scale.y), std::exp(log_scale.z)});
    uint64_t hash = 0;
    for (const int64_t key : {ids[row], seed, kPositionNoise, step}) hash = hash_key(hash, key);
    const Vec3<T> draw = {T(normal_of(hash_key(hash, 0))), T(normal_of(hash_key(hash, 1))),
                          T(normal_of(hash_key(hash, 2)))};
    const T factor = T(strength * gate);
    const Vec3<T> moved =
        load3(means + 3 * row) +
        factor * (dot(axes.x, draw) * axes.x + dot(axes.y, draw) * axes.y + dot(axes.z, draw) * axes.z);
    store3(moved, means + 3 * row);
  }
};

}  // namespace blitzgs
