// SPDX-License-Identifier: Apache-2.0
// The smallest set of items, by descending weight (ties by ascending id), that holds a share of the weight of
// its segment: one search for all segments, without sorting and without the host.
//
//   weights [P] int64 in [0, 2^62), segments [P] int32, owners [P] int32 and ids [N] int64: item i has the id
//   ids[owners[i]], unique within its segment  ->  chosen [P]
//
// A segment's threshold is found digit by digit, as in a radix select. The first digit of a number is that of
// a float: its exponent and four bits behind the leading one. Each later digit has kDigitBits of the bits
// that are left. In a round
//
//   the scan adds up, by this digit, the weights of the items whose digits so far are those of the threshold;
//   the descent finds, from the largest digit down, where the missing weight is reached: the next digit.
//
// Sums are integers; between scan and descent they may be added up over ranks. Where more items weigh as much
// as the threshold than are missing, kRounds more rounds find the largest id that is in, by the same search
// for 2^63 - 1 - id, each item counting one. Items behind the first two digits are few: the second scan lists
// them, and later ones read the list.
//
// All of it is exact: no order of additions, division among ranks or repetition changes a bit. O(P).
#pragma once
#include <cstdint>
#include <limits>

#include "common/kernel.h"

namespace blitzgs {

inline constexpr int kDigitBits = 12;
inline constexpr int kDigits = 1 << kDigitBits;
inline constexpr int kFirstMantissaBits = 4;
inline constexpr int kFirstDigits = 1 << 10;  // 1 + 63 exponents x 16
// A first digit leaves at most 58 bits.
inline constexpr int kRounds = 1 + (58 + kDigitBits - 1) / kDigitBits;
// Steps of the whole search: scan and descent of the rounds for weights, those for ids, and the choice.
inline constexpr int kTiesStep = 2 * kRounds, kChoiceStep = 4 * kRounds, kSteps = kChoiceStep + 1;

// Where the search of a segment stands: the threshold's bits from `shift` on are `head`, and `missing` is to
// come from the items that have these bits, which together hold `held`. Done when shift is 0.
struct MassSearch {
  std::int64_t head, shift, missing, held;
};
inline constexpr std::int64_t kNobody = std::numeric_limits<std::int64_t>::max();  // a head above all weights

struct SegmentSearch {
  MassSearch weight, id;
};

struct MassCutArgs {
  const std::int64_t* weights;
  const std::int32_t* segments;
  const std::int32_t* owners;
  const std::int64_t* ids;
  std::int64_t n_items, n_segments;
  std::int64_t numerator, denominator;  // of the share
  SegmentSearch* searches;              // [S]
  std::int64_t* sums;                   // [S, kDigits], zero between a descent and the next scan
  std::int32_t* listed;                 // [1 + P]: how many items are listed, and these
  bool* chosen;                         // [P], written by the last step
};

BLITZGS_HD int bits_of(std::int64_t number) {
#if defined(__CUDA_ARCH__)
  return 64 - __clzll(number);
#else
  return number == 0 ? 0 : 64 - __builtin_clzll(static_cast<unsigned long long>(number));
#endif
}

// The first digit of a number in [0, 2^63): 0 for 0, and growing with it.
BLITZGS_HD int first_digit(std::int64_t number) {
  if (number == 0) return 0;
  const int exponent = bits_of(number) - 1, behind = exponent - kFirstMantissaBits;
  const std::int64_t head = behind >= 0 ? number >> behind : number << -behind;
  return 1 + (exponent << kFirstMantissaBits) + static_cast<int>(head & ((1 << kFirstMantissaBits) - 1));
}

BLITZGS_HD int later_digit_bits(std::int64_t shift) {
  return shift < kDigitBits ? static_cast<int>(shift) : kDigitBits;
}

// Takes the digit that a descent found; `above` is the sum of the larger ones, `held` that of this one.
BLITZGS_HD void take_digit(MassSearch& search, bool first, int digit, std::int64_t above, std::int64_t held) {
  if (first) {
    const int exponent = (digit - 1) >> kFirstMantissaBits, behind = exponent - kFirstMantissaBits;
    const std::int64_t head = ((digit - 1) & ((1 << kFirstMantissaBits) - 1)) | 1 << kFirstMantissaBits;
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

// ceil(share x total), without the product, which might overflow.
BLITZGS_HD std::int64_t share_of(std::int64_t total, std::int64_t numerator, std::int64_t denominator) {
  const std::int64_t rest = denominator - numerator;
  return total - total / denominator * rest - total % denominator * rest / denominator;
}

// Begins the search for ids when that for the weight has ended: it has something to find only where some of
// the items that weigh as much as the threshold are left out.
BLITZGS_HD MassSearch search_of_ids(const MassSearch& weight) {
  if (weight.head == kNobody) return {0, 0, 0, 0};
  const std::int64_t wanted = (weight.missing + weight.head - 1) / weight.head;
  return {0, 0, weight.held / weight.head > wanted ? wanted : 0, 0};
}

BLITZGS_HD std::int64_t id_key(std::int64_t id) { return std::numeric_limits<std::int64_t>::max() - id; }

BLITZGS_HD std::int64_t id_key_of(const MassCutArgs& args, std::int64_t item) {
  return id_key(args.ids[args.owners[item]]);
}

// What a scan of a round adds, and where; nothing for items that are not under the digits so far.
struct ScanTerm {
  bool adds;
  int digit;
  std::int64_t amount;
};

BLITZGS_HD ScanTerm digit_under(const MassSearch& search, std::int64_t number, bool first,
                                std::int64_t amount) {
  if (first) return {true, first_digit(number), amount};
  if (search.shift == 0 || number >> search.shift != search.head) return {false, 0, 0};
  const int bits = later_digit_bits(search.shift);
  const std::int64_t digit = number >> (search.shift - bits) & ((std::int64_t{1} << bits) - 1);
  return {true, static_cast<int>(digit), amount};
}

BLITZGS_HD ScanTerm scan_term(const MassCutArgs& args, int round, std::int64_t item) {
  const SegmentSearch& search = args.searches[args.segments[item]];
  const std::int64_t weight = args.weights[item];
  if (round < kRounds) return digit_under(search.weight, weight, round == 0, weight);
  if (search.id.missing == 0 || weight != search.weight.head) return {false, 0, 0};
  return digit_under(search.id, id_key_of(args, item), round == kRounds, 1);
}

BLITZGS_HD bool is_listed(const MassCutArgs& args, std::int64_t item) {
  const MassSearch& search = args.searches[args.segments[item]].weight;
  return args.weights[item] >> search.shift == search.head;
}

BLITZGS_HD bool is_chosen(const MassCutArgs& args, std::int64_t item) {
  const SegmentSearch& search = args.searches[args.segments[item]];
  const std::int64_t weight = args.weights[item];
  if (weight != search.weight.head) return weight > search.weight.head;
  return search.id.missing == 0 || id_key_of(args, item) >= search.id.head;
}

// Whether a descent has a digit to find.
BLITZGS_HD bool descends(const MassSearch& search, bool first) {
  return first ? search.missing > 0 : search.shift > 0;
}

namespace cpu {
// Takes the steps first_step to last_step - 1.
void mass_cut(const MassCutArgs& args, int first_step, int last_step, CudaStream);
}  // namespace cpu
namespace cuda {
void mass_cut(const MassCutArgs& args, int first_step, int last_step, CudaStream);
}

}  // namespace blitzgs
