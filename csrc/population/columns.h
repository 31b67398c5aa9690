// SPDX-License-Identifier: Apache-2.0
// Work on columns of a table: copies of rows, checks, and sampling without replacement.
#pragma once
#include "math/counter_random.h"
#include "math/vec.h"

// Copies rows between columns of a table: row to[i] of `out` becomes row from[i] of `column`.
//
// Rows are `row_bytes` bytes each. from, to int64 [n]; null: i. column null: the rows become zeros. No row of
// `out` may be written twice, or be read. Each row is read and written once.
namespace blitzgs {

struct CopyRows {
  const std::byte* column;
  const int64_t* from;
  std::byte* out;
  const int64_t* to;
  int64_t n, row_bytes;
};

// Looks for values that are not finite in some columns, and for zeros in others, in one pass without memory
// of their size: `bad` becomes 1 if there is one, and else keeps its value.

constexpr int kMaxCheckedColumns = 16;

// values [length] of n columns. zero_is_bad: look for zeros instead.
template <class T> struct CheckedColumns {
  struct Column {
    const T* values;
    int64_t length;
    bool zero_is_bad;
  };
  Column columns[kMaxCheckedColumns];
  int n;
  int32_t* bad;
};

template <class T> BLITZGS_HD bool is_bad(T value, bool zero_is_bad) {
  // A number that is not finite, times zero, is NaN.
  return zero_is_bad ? value == T(0) : !(value * T(0) == T(0));
}

// Sampling without replacement in proportion to weights, by exponential races (Efraimidis and Spirakis 2006):
// each item has the key -log(u) / weight, u uniform in (0, 1), and those with the smallest keys are chosen.
//
//   sampling_keys: weights float [n], ids int64 [n], seed, event -> keys float [n]
//
// u depends on (seed, event, id) alone (math/counter_random.h). The key of weight 0 is infinite.
//
//   key_histogram: keys float [n], prefix int64 [1], shift, width -> counts int64 [2^width]
//
// counts the keys with ordered bits b, b >> (shift + width) = prefix, by the digit (b >> shift) mod 2^width.
// blitzgs/distributed/selection.py finds the k-th smallest key over all ranks by such counts: find_digit_
// takes the next digit, and keys_up_to marks the keys up to the one found.

BLITZGS_HD float sampling_key(float weight, int64_t id, int64_t seed, int64_t event) {
  const uint64_t hash = hash_key(hash_key(hash_key(0, seed), event), id);
  return float(-std::log(uniform_of(hash)) / double(weight));
}

struct SamplingKeys {
  const float* weights;
  const int64_t* ids;
  int64_t n, seed, event;
  float* keys;

  BLITZGS_HD void operator()(int64_t i) const { keys[i] = sampling_key(weights[i], ids[i], seed, event); }
};

// Adds one more key to hashes: a tensor [n], or the same number for all.
struct HashKey {
  const int64_t* hashes;
  const int64_t* keys;  // null: number
  int64_t number, n;
  int64_t* out;

  BLITZGS_HD void operator()(int64_t i) const {
    const auto hash = uint64_t(hashes[i]);
    out[i] = int64_t(hash_key(hash, keys ? keys[i] : number));
  }
};

constexpr int kMaxDigitBits = 11;

struct KeyHistogram {
  const float* keys;
  const int64_t* prefix;
  int64_t n;
  int shift, width;  // width at most kMaxDigitBits
  int64_t* counts;   // set to zero first
};

// The digit of a key; -1 if its bits before it are not the prefix. -0 equals 0.
BLITZGS_HD int digit_of(const KeyHistogram& args, int64_t prefix, float key) {
  const uint64_t head = uint64_t{ordered_bits(key + 0.0f)} >> args.shift;
  if (int64_t(head >> args.width) != prefix) return -1;
  return int(head & ((uint64_t{1} << args.width) - 1));
}

// Takes the digit at which counts reach the number of keys that are still to be found.
//
// search int64 [3]: the digits so far, the number of keys still to be found under them (from 1 on), and the
// number of keys that have them, which is written only.
struct FindDigit {
  const int64_t* counts;  // [2^width]
  int width;
  int64_t* search;
};

// Ends a search at `digit`, before which there are `before` keys.
BLITZGS_HD void take_digit(const FindDigit& args, int64_t digit, int64_t before) {
  args.search[0] = args.search[0] << args.width | digit;
  args.search[1] -= before;
  args.search[2] = args.counts[digit];
}

// Marks the keys whose ordered bits are at most `limit`.
struct KeysUpTo {
  const float* keys;
  const int64_t* limit;  // [1]
  int64_t n;
  bool* marks;

  BLITZGS_HD void operator()(int64_t i) const { marks[i] = int64_t{ordered_bits(keys[i] + 0.0f)} <= *limit; }
};

namespace BLITZGS_BACKEND {
void copy_rows(const CopyRows&, CudaStream);
void clear_flag(int32_t* bad, CudaStream);
template <class T> void check_columns(const CheckedColumns<T>&, CudaStream);
void key_histogram(const KeyHistogram&, CudaStream);
void find_digit(const FindDigit&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
