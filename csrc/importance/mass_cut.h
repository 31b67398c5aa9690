// SPDX-License-Identifier: Apache-2.0
// The mass cut: for each segment, the smallest set of items by descending weight (ties by ascending id) whose
// weights sum to at least a share of the segment's total. One search serves all segments, without sorting or
// waiting on the host. The importance pass cuts the weights of a view at 99 % (BlitzGS, section 3.2).
//
//   weights [P] int64 in [0, 2^62), segments [P] int32, owners [P] int32 and ids [N] int64: item i has the id
//   ids[owners[i]], unique within its segment  ->  chosen [P]
//
// The search finds the threshold of each segment, the smallest weight in the set, digit by digit as in a
// radix select. The first digit of a number is like that of a float: its exponent and the four bits after the
// leading one. Each later digit is the next kDigitBits bits. A round finds one digit in two steps:
//
//   scan:    sums the weights of the items whose earlier digits equal those of the threshold, by their next
//            digit;
//   descent: finds the digit, from the largest one down, at which the sums reach the missing weight.
//
// Sums are integers; between scan and descent they may be added up over ranks. If more items than needed
// weigh as much as the threshold, kRounds more rounds find the largest id in the set, by the same search for
// 2^63 - 1 - id in which each item counts one. Few items agree with the threshold in the first digit: the
// second scan lists them, and later scans read the list. The result is exact, whatever the order of additions
// or the division among ranks. The cost is O(P).
#pragma once
#include <limits>

#include "common/kernel.h"

namespace blitzgs {

inline constexpr int kDigitBits = 12;
inline constexpr int kDigits = 1 << kDigitBits;
inline constexpr int kFirstMantissaBits = 4;
inline constexpr int kFirstDigits = 1 << 10;  // 1 + 63 exponents x 16
// A first digit leaves at most 58 bits.
inline constexpr int kRounds = 1 + (58 + kDigitBits - 1) / kDigitBits;
// The steps of the whole search: scan and descent of each round for weights, then of each round for ids, then
// the choice.
inline constexpr int kChoiceStep = 4 * kRounds, kSteps = kChoiceStep + 1;

// The state of the search in a segment. It is done when shift is 0.
struct MassSearch {
  int64_t head, shift;  // the bits of the threshold from bit `shift` on
  int64_t missing;      // the weight that items with these bits have to contribute to the set
  int64_t held;         // the weight of all items with these bits
};
// The initial head: no item weighs as much, so an empty search chooses no item.
inline constexpr int64_t kAboveAllWeights = std::numeric_limits<int64_t>::max();

struct SegmentSearch {
  MassSearch weight, id;
};

struct MassCutArgs {
  const int64_t* weights;
  const int32_t *segments, *owners;
  const int64_t* ids;
  int64_t n_items, n_segments;
  int64_t numerator, denominator;  // the share
  SegmentSearch* searches;         // [S]
  int64_t* sums;                   // [S, kDigits], zero between a descent and the next scan
  int32_t* listed;                 // [1 + P]: the number of listed items, then these items
  bool* chosen;                    // [P], written by the last step
};

BLITZGS_HD int bits_of(int64_t number) {
#if defined(__CUDA_ARCH__)
  return 64 - __clzll(number);
#else
  return number == 0 ? 0 : 64 - __builtin_clzll(static_cast<unsigned long long>(number));
#endif
}

// The first digit of a number in [0, 2^63). It is 0 for 0 and never decreases with the number.
BLITZGS_HD int first_digit(int64_t number) {
  if (number == 0) return 0;
  const int exponent = bits_of(number) - 1, behind = exponent - kFirstMantissaBits;
  const int64_t head = behind >= 0 ? number >> behind : number << -behind;
  return 1 + (exponent << kFirstMantissaBits) + int(head & ((1 << kFirstMantissaBits) - 1));
}

BLITZGS_HD int later_digit_bits(int64_t shift) { return shift < kDigitBits ? int(shift) : kDigitBits; }

// Appends the digit that a descent found. above: the sum of the larger digits; held: the sum of this digit.
BLITZGS_HD void take_digit(MassSearch& search, bool first, int digit, int64_t above, int64_t held) {
  if (first) {
    const int exponent = (digit - 1) >> kFirstMantissaBits, behind = exponent - kFirstMantissaBits;
    const int64_t head = ((digit - 1) & ((1 << kFirstMantissaBits) - 1)) | 1 << kFirstMantissaBits;
    search.head = digit == 0 ? 0 : behind >= 0 ? head : head >> -behind;
    search.shift = digit > 0 && behind > 0 ? behind : 0;
  } else {
    const int bits = later_digit_bits(search.shift);
    search.head = search.head << bits | digit;
    search.shift -= bits;
  }
  search.missing -= above;
  search.held = held;
}

// ceil(share * total), without computing the product, which might overflow.
BLITZGS_HD int64_t share_of(int64_t total, int64_t numerator, int64_t denominator) {
  const int64_t rest = denominator - numerator;
  return total - total / denominator * rest - total % denominator * rest / denominator;
}

// The initial state of the search for ids, after the search for the weight. It finds an id only if some of
// the items that weigh as much as the threshold are not in the set; otherwise `missing` is 0.
BLITZGS_HD MassSearch search_of_ids(const MassSearch& weight) {
  if (weight.head == kAboveAllWeights) return {0, 0, 0, 0};
  const int64_t wanted = (weight.missing + weight.head - 1) / weight.head;
  return {0, 0, weight.held / weight.head > wanted ? wanted : 0, 0};
}

BLITZGS_HD int64_t id_key_of(const MassCutArgs& args, int64_t item) {
  return std::numeric_limits<int64_t>::max() - args.ids[args.owners[item]];
}

// The summand of an item in a scan: `amount`, to the sum of `digit`. adds: whether the item's earlier digits
// equal those of the threshold.
struct ScanTerm {
  bool adds;
  int digit;
  int64_t amount;
};

BLITZGS_HD ScanTerm digit_under(const MassSearch& search, int64_t number, bool first, int64_t amount) {
  if (first) return {true, first_digit(number), amount};
  if (search.shift == 0 || number >> search.shift != search.head) return {false, 0, 0};
  const int bits = later_digit_bits(search.shift);
  const int64_t digit = number >> (search.shift - bits) & ((int64_t{1} << bits) - 1);
  return {true, int(digit), amount};
}

BLITZGS_HD ScanTerm scan_term(const MassCutArgs& args, int round, int64_t item) {
  const SegmentSearch& search = args.searches[args.segments[item]];
  const int64_t weight = args.weights[item];
  if (round < kRounds) return digit_under(search.weight, weight, round == 0, weight);
  if (search.id.missing == 0 || weight != search.weight.head) return {false, 0, 0};
  return digit_under(search.id, id_key_of(args, item), round == kRounds, 1);
}

BLITZGS_HD bool is_listed(const MassCutArgs& args, int64_t item) {
  const MassSearch& search = args.searches[args.segments[item]].weight;
  return args.weights[item] >> search.shift == search.head;
}

BLITZGS_HD bool is_chosen(const MassCutArgs& args, int64_t item) {
  const SegmentSearch& search = args.searches[args.segments[item]];
  const int64_t weight = args.weights[item];
  if (weight != search.weight.head) return weight > search.weight.head;
  return search.id.missing == 0 || id_key_of(args, item) >= search.id.head;
}

BLITZGS_HD bool descends(const MassSearch& search, bool first) {
  return first ? search.missing > 0 : search.shift > 0;
}

BLITZGS_HD bool finds_digit(const SegmentSearch& search, int round) {
  return round < kRounds ? descends(search.weight, false) : descends(search.id, round == kRounds);
}

namespace BLITZGS_BACKEND {
void mass_cut(const MassCutArgs& args, int first_step, int last_step, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
