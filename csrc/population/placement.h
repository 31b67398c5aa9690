// SPDX-License-Identifier: Apache-2.0
// Which new Gaussians take the rows of those that leave a table (blitzgs/table/placement.py): rows that leave
// are opening brackets in the order of their blocks, and new Gaussians closing ones, behind those of the same
// block; a bracket and the one that closes it get the same row.
#pragma once
#include "active/view_gate.h"

namespace blitzgs {

// The first of n ascending numbers, divided by `unit`, that is not below (or, if `above`, is above) a value.
BLITZGS_HD int64_t bound_of(const int64_t* numbers, int64_t n, int64_t unit, int64_t value, bool above) {
  int64_t begin = 0;
  while (n > 0) {
    const int64_t half = n / 2, found = numbers[begin + half] / unit;
    if (found < value || (above && found == value)) {
      begin += half + 1;
      n -= half + 1;
    } else {
      n = half;
    }
  }
  return begin;
}

// Keys of all brackets by which they are sorted: depth, then place. Brackets of one depth open and close in
// turn, so in this order pairs are neighbours.
struct BracketKeys {
  const int64_t* gone;          // [leaving], ascending rows
  const int64_t* blocks;        // [joining], ascending
  int64_t leaving, joining, n;  // n: both
  int64_t* keys;                // [n]; depth * (n + 1) + place

  BLITZGS_HD void operator()(int64_t i) const {
    const bool opens = i < leaving;
    const int64_t number = opens ? i : i - leaving;
    // Brackets before this one, of the other kind.
    const int64_t before = opens ? bound_of(blocks, joining, 1, gone[i] / kBlockRows, false)
                                 : bound_of(gone, leaving, kBlockRows, blocks[number], true);
    const int64_t depth = opens ? number + 1 - before : before - number;
    keys[i] = depth * (n + 1) + number + before;
  }
};

// Gives the rows of closed brackets to the new Gaussians.
struct MatchBrackets {
  const int64_t* keys;      // [n] of BracketKeys, sorted
  const int64_t* order;     // [n], the brackets in this order
  const int64_t* gone;      // [leaving]
  const int64_t* by_block;  // [joining], the new Gaussians in the order of their blocks
  int64_t leaving, n;       // n: brackets but the last
  int64_t unit;             // of depths in keys
  int64_t* rows;            // [joining], of those that close a bracket
  bool* is_left;            // [leaving], becomes false where a bracket is closed

  BLITZGS_HD void operator()(int64_t i) const {
    const int64_t first = order[i], second = order[i + 1];
    if (first >= leaving || second < leaving) return;
    // Places are from 0 to unit - 1, so two neighbours of one depth differ by less.
    const int64_t depth = floor_quotient(keys[i], unit);
    if (keys[i + 1] >= (depth + 1) * unit) return;
    rows[by_block[second - leaving]] = gone[first];
    is_left[first] = false;
  }

  static BLITZGS_HD int64_t floor_quotient(int64_t a, int64_t b) { return a / b - (a % b < 0); }
};

}  // namespace blitzgs
