// SPDX-License-Identifier: Apache-2.0
// Counter-based random numbers: a draw depends on its key alone, so it is the same on every rank and device.
// SplitMix64 (Steele, Lea, Flood 2014) over a tuple of keys.
#pragma once
#include <cmath>

#include "common/kernel.h"

namespace blitzgs {

BLITZGS_HD uint64_t mix64(uint64_t value) {
  value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9u;
  value = (value ^ (value >> 27)) * 0x94D049BB133111EBu;
  return value ^ (value >> 31);
}

// Adds one more key to the hash of the keys before it; the hash of no keys is 0.
BLITZGS_HD uint64_t hash_key(uint64_t hash, int64_t key) {
  return mix64((hash + 0x9E3779B97F4A7C15u) ^ uint64_t(key));
}

// Uniform in (0, 1), from 53 bits of a hash.
BLITZGS_HD double uniform_of(uint64_t hash) { return (double(hash >> 11) + 0.5) * 0x1p-53; }

// Standard normal (Box-Muller), from two hashes that are derived from `hash`.
BLITZGS_HD double normal_of(uint64_t hash) {
  const double first = uniform_of(hash_key(hash, 0)), second = uniform_of(hash_key(hash, 1));
  return std::sqrt(-2.0 * std::log(first)) * std::cos(2.0 * 3.14159265358979323846 * second);
}

}  // namespace blitzgs
