// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "active/cull_mask.h"
#include "active/view_gate.h"
#include "common/parallel.h"

namespace blitzgs::cpu {

namespace {

// Transposes 32 x 32 bits: bit j of word i becomes bit i of word j. It swaps the off-diagonal quarters of
// squares of 32, 16, 8, 4 and 2 bits.
void transpose_bits(std::uint32_t* words) {
  std::uint32_t low = 0x0000ffffu;  // the columns of each square's left half
  for (int half = 16; half > 0; half /= 2, low ^= low << half) {
    for (int i = 0; i < 32; ++i) {
      if (i & half) continue;
      const std::uint32_t swapped = (words[i] >> half ^ words[i + half]) & low;
      words[i] ^= swapped << half;
      words[i + half] ^= swapped;
    }
  }
}

// Calls f(words, count, rows, sector) for each square of 32 rows and 32 columns. words: 32 words of scratch,
// zero. count: the number of existing rows. rows: the word of the first row. sector: the word of the first
// column.
template <class F>
void for_each_square(const CullMask& mask, const F& f) {
  parallel_for(0, blocks_of(mask.n) * kSectorWords, 64, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t group = begin; group < end; ++group) {
      const auto count = static_cast<int>(std::clamp<std::int64_t>(mask.n - 32 * group, 0, 32));
      for (std::int64_t word = 0; word < mask.words; ++word) {
        std::uint32_t words[32] = {};
        std::int32_t* sector =
            mask.sectors + group % kSectorWords + sector_at(group / kSectorWords, 32 * mask.words, 32 * word);
        f(words, count, mask.rows + 32 * group * mask.words + word, sector);
      }
    }
  });
}

}  // namespace

void sectors_of_rows(const CullMask& mask, CudaStream) {
  for_each_square(mask, [&](std::uint32_t* words, int count, const std::int32_t* rows, std::int32_t* sector) {
    for (int i = 0; i < count; ++i) words[i] = static_cast<std::uint32_t>(rows[i * mask.words]);
    transpose_bits(words);
    for (int i = 0; i < 32; ++i) sector[i * kSectorWords] = static_cast<std::int32_t>(words[i]);
  });
}

void rows_of_sectors(const CullMask& mask, CudaStream) {
  for_each_square(mask, [&](std::uint32_t* words, int count, std::int32_t* rows, const std::int32_t* sector) {
    for (int i = 0; i < 32; ++i) words[i] = static_cast<std::uint32_t>(sector[i * kSectorWords]);
    transpose_bits(words);
    for (int i = 0; i < count; ++i) rows[i * mask.words] = static_cast<std::int32_t>(words[i]);
  });
}

void gate_views(const ViewGateArgs& args, Workspace&, CudaStream) {
  GateTable table = args.rules.table;
  for (int view = 0; view < args.rules.n_views; ++view)
    camera_centre(args.viewmats + 16 * view, table.centres[view]);
  parallel_for(0, args.capacity, 4096, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) gate_entry(args, table, i);
  });
}

}  // namespace blitzgs::cpu
