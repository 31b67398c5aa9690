// SPDX-License-Identifier: Apache-2.0
// A bit for each row of a table and each column, in two layouts:
//   by row     int32 [N, words]: bit v % 32 of word v / 32 is that of column v. Rows move as those of any
//   column. by sector  int32 [ceil(N / 256), 32 words, 8]: the bits of the 256 rows of a block, for one
//   column, are the
//              32 bytes of a sector; bit r % 32 of word r / 32 is that of the block's row r. A kernel that
//              asks for one column reads a sector for each block, not one for each row, and finds from the
//              sector alone whether the block has to be looked at.
// Bits of rows that the last block does not have are zero. Both directions transpose 32 x 32 bits at a time;
// they are exact and inverse to each other. O(N words).
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

constexpr int kSectorRows = 256, kSectorWords = kSectorRows / 32;

BLITZGS_HD std::int64_t sector_blocks(std::int64_t rows) { return (rows + kSectorRows - 1) / kSectorRows; }

// Where the sector of a block and a column begins, of n_columns.
BLITZGS_HD std::int64_t sector_at(std::int64_t block, std::int64_t n_columns, std::int64_t column) {
  return (block * n_columns + column) * kSectorWords;
}

BLITZGS_HD bool sector_bit(const std::int32_t* sectors, std::int64_t n_columns, std::int64_t column,
                           std::int64_t row) {
  const int local = static_cast<int>(row % kSectorRows);
  const std::int32_t word = sectors[sector_at(row / kSectorRows, n_columns, column) + local / 32];
  return (static_cast<std::uint32_t>(word) >> local % 32 & 1u) != 0;
}

// Of the first `count` rows of a sector: whether any has its bit set, and whether all have.
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

namespace cpu {
void sectors_of_rows(const CullMask&, CudaStream);
void rows_of_sectors(const CullMask&, CudaStream);
}  // namespace cpu
namespace cuda {
void sectors_of_rows(const CullMask&, CudaStream);
void rows_of_sectors(const CullMask&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
