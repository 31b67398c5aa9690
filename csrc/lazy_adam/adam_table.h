// SPDX-License-Identifier: Apache-2.0
// Columns of the table of a learning-rate schedule, double [S + 1, 30], made once in Python
// (blitzgs/ops/lazy_adam.py). S is the last step; row t holds, with
//   a_t = 1 / sqrt(1 - beta2^t),  b_t = 1 / (1 - beta1^t)  (row 0: 0)  and  q_k = beta1 beta2^((k - 1) / 2),
// for the groups g = means, quats, scales, opacities, SH DC, SH rest and the orders k = 0 .. 3
//   tail_k[t] = sum over u = t + 1 .. S of lr_u b_u a_u^(k - 1) q_k^(u - t).
#pragma once

namespace blitzgs {

constexpr int kAdamGroups = 6;  // learning rates: the SH column has two
constexpr int kAdamOrders = 4;

constexpr int kTails = 0;         // + 6 k + g
constexpr int kBeta1Power = 24;   // beta1^t
constexpr int kBeta2Power = 25;   // beta2^t
constexpr int kRatioPower = 26;   // q_0^t
constexpr int kRootPower = 27;    // beta2^(t/2)
constexpr int kCorrection1 = 28;  // b_t
constexpr int kCorrection2 = 29;  // a_t
constexpr int kAdamTable = 30;

}  // namespace blitzgs
