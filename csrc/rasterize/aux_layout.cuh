// SPDX-License-Identifier: Apache-2.0
// Where things lie in what forward leaves for backward: the order of the tiles, PackedRow [capacity], and for
// up to four channels float4 [capacity] colors. Backward may have fewer rows than forward had room for, and
// may differentiate fewer tiles than were composited: the size of the memory tells both. It is the number of
// composited tiles modulo one more than the images have, and behind the order lie as many rows as fit.
#pragma once
#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

class AuxLayout {
 public:
  // Of memory for the rows and tiles of a forward pass.
  static std::int64_t bytes(const TileGrid& grid, std::int64_t n_rows, int n_channels) {
    const std::int64_t composited = grid.tile_end - grid.tile_begin, modulus = grid.count() + 1;
    const std::int64_t least = TileOrder::bytes(grid, composited) + n_rows * row_bytes(n_channels);
    return least + (composited - least % modulus + modulus) % modulus;
  }

  // Of memory of any size.
  AuxLayout(const TileGrid& grid, int n_channels, std::int64_t bytes)
      : composited_(bytes % (grid.count() + 1)),
        rows_begin_(TileOrder::bytes(grid, composited_)),
        capacity_(bytes < rows_begin_ ? -1 : (bytes - rows_begin_) / row_bytes(n_channels)) {}

  // Whether forward can have left it for these rows and tiles, or more of them.
  bool holds(const TileGrid& grid, std::int64_t n_rows) const {
    return composited_ >= grid.tile_end - grid.tile_begin && capacity_ >= n_rows;
  }

  // For the tiles of this grid.
  TileOrder order(const TileGrid& grid, void* aux) const { return {grid, composited_, aux}; }
  PackedRow* rows(void* aux) const {
    return reinterpret_cast<PackedRow*>(static_cast<std::byte*>(aux) + rows_begin_);
  }
  float4* colors(void* aux, int n_channels) const {
    return n_channels <= 4 ? reinterpret_cast<float4*>(rows(aux) + capacity_) : nullptr;
  }

 private:
  static std::int64_t row_bytes(int n_channels) {
    return sizeof(PackedRow) + (n_channels <= 4 ? sizeof(float4) : 0);
  }

  std::int64_t composited_, rows_begin_, capacity_;
};

}  // namespace blitzgs::cuda
