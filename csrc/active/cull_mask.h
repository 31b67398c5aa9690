// SPDX-License-Identifier: Apache-2.0
// The cull mask has a bit for each row of a table and each column (a training view), in two layouts:
//
//   by row:    int32 [N, words]. Bit v % 32 of word v / 32 is that of column v. In this layout a row of the
//              mask moves together with the row of the table.
//   by sector: int32 [ceil(N / 256), 32 words, 8]. The bits of the 256 rows of a block for one column are the
//              32 bytes of a sector; bit r % 32 of word r / 32 is that of the block's row r. A kernel that
//              needs one column reads one sector per block instead of one word per row, and the sector alone
//              says whether any or all rows of the block have the bit.
//
// The bits of missing rows of the last block are zero. Both conversions transpose 32 x 32 bits at a time;
// they are exact and inverse to each other. The cost is O(N words).
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

constexpr int kBlockRows = 256;                // rows of a block of the table
constexpr int kSectorWords = kBlockRows / 32;  // words of a sector

BLITZGS_HD std::int64_t blocks_of(std::int64_t rows) { return (rows + kBlockRows - 1) / kBlockRows; }

// The position of the sector of a block and a column, in a mask of n_columns columns.
BLITZGS_HD std::int64_t sector_at(std::int64_t block, std::int64_t n_columns, std::int64_t column) {
  return (block * n_columns + column) * kSectorWords;
}

BLITZGS_HD bool sector_bit(const std::int32_t* sectors, std::int64_t n_columns, std::int64_t column,
                           std::int64_t row) {
  const int local = static_cast<int>(row % kBlockRows);
  const std::int32_t word = sectors[sector_at(row / kBlockRows, n_columns, column) + local / 32];
  return (static_cast<std::uint32_t>(word) >> local % 32 & 1u) != 0;
}

// Whether any, and whether all, of the first `count` rows of a sector have the bit.
struct SectorBits {
  bool any, all;
};

BLITZGS_HD SectorBits sector_bits(const std::int32_t* sector, int count) {
  SectorBits bits{false, true};
  for (int word = 0; word < kSectorWords; ++word) {
    const int live = count - 32 * word;
    const std::uint32_t rows = live >= 32 ? ~0u : live > 0 ? (1u << live) - 1u : 0u;
    const std::uint32_t set = static_cast<std::uint32_t>(sector[word]) & rows;
    bits.any |= set != 0;
    bits.all &= set == rows;
  }
  return bits;
}

// The two layouts of a mask of n rows and 32 * words columns.
struct CullMask {
  std::int32_t *rows, *sectors;
  std::int64_t n, words;
};

namespace BLITZGS_BACKEND {
void sectors_of_rows(const CullMask&, CudaStream);
void rows_of_sectors(const CullMask&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
