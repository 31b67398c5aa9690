// SPDX-License-Identifier: Apache-2.0
// The test of which tiles a splat touches (docs/image.md, section 3): the projection counts tiles by it and
// the intersection lists them, on every backend.
//
// A splat is composited where opacity * exp(-q/2) >= 1/255 with q = a dx^2 + 2 b dx dy + c dy^2, that is
// inside the ellipse q <= 2 ln(255 opacity). Its part in the band of pixel centres of one row of tiles spans
// an interval of x, whose ends have a closed form: the turning point of the ellipse, clamped to the band. The
// splat touches the tiles of the row with a pixel column in this interval. The cost is O(tile rows).
//
// The test is conservative: the ellipse is enlarged by a relative and absolute 2e-5 in q, and the interval by
// some float roundings. This covers the rounding of the test and of the rasterisers, which evaluate q as
// factor_conic() writes it. A splat that is not finite, not convex (a <= 0 or c <= 0) or too faint
// (opacity < 1/255) touches no tile.
//
// The count of one kernel is the buffer size of another, so the expressions here use mul() and mul_add(),
// which no compiler contracts differently.
#pragma once
#include "math/vec.h"

namespace blitzgs {

constexpr double kAlphaCut = 1.0 / 255.0;   // a splat touches a pixel iff alpha >= this
constexpr double kAlphaMax = 0.99;          // alpha is clipped here
constexpr double kMinTransmittance = 1e-4;  // a pixel ends before its transmittance would fall below this

// Tiles of B images of one size, flattened as (camera * tiles_y + ty) * tiles_x + tx. Only tiles in
// [tile_begin, tile_end) are owned: the others are not listed, and their pixels are zero.
struct TileGrid {
  int n_cameras, width, height, tile_size, tiles_x, tiles_y;
  int64_t tile_begin, tile_end;

  BLITZGS_HD int64_t per_image() const { return int64_t(tiles_x) * tiles_y; }
  BLITZGS_HD int64_t count() const { return n_cameras * per_image(); }
};

// tile_end < 0 means all tiles.
BLITZGS_HD TileGrid make_tile_grid(int n_cameras, int width, int height, int tile_size, int64_t tile_begin,
                                   int64_t tile_end) {
  const int tiles_x = (width + tile_size - 1) / tile_size;
  const int tiles_y = (height + tile_size - 1) / tile_size;
  TileGrid grid{n_cameras, width, height, tile_size, tiles_x, tiles_y, tile_begin, tile_end};
  if (tile_end < 0) grid.tile_end = grid.count();
  return grid;
}

// Clamp a value; NaN becomes the lower bound in the first and the upper bound in the second.
template <class T> BLITZGS_HD T clamp_nan_low(T value, T low, T high) {
  return value > low ? (value < high ? value : high) : low;
}
template <class T> BLITZGS_HD T clamp_nan_high(T value, T low, T high) {
  return value < high ? (value > low ? value : low) : high;
}

// x / size for x >= 0. If the size is a power of two, as tile sizes usually are, the division is a shift.
struct TileDivider {
  int size, shift;

  BLITZGS_HD explicit TileDivider(int tile_size) : size(tile_size), shift(-1) {
    if ((tile_size & (tile_size - 1)) == 0) {
      for (shift = 0; (1 << shift) < tile_size;) ++shift;
    }
  }
  BLITZGS_HD int operator()(int x) const { return shift >= 0 ? x >> shift : x / size; }
};

// The factor L of conic = L^T L, so q = (l11 dx + l21 dy)^2 + (l22 dy)^2, which is never negative and does
// not cancel for thin splats. A conic that rounding made indefinite gets l22 = 0: a splat that is so long is
// constant along its axis. The products of floats are exact in double.
template <class T> struct ConicFactor {
  T l11, l21, l22;
};

template <class T> BLITZGS_HD double conic_determinant(const T* conic) {
  const double b = double(conic[1]);
  const double bb = b * b;
#ifdef __CUDA_ARCH__
  const double det = fma(double(conic[0]), double(conic[2]), -bb);
#else
  const double det = double(conic[0]) * double(conic[2]) - bb;
#endif
  return det > 0.0 ? det : 0.0;
}

template <class T> BLITZGS_HD ConicFactor<T> factor_conic(const T* conic) {
  ConicFactor<T> factor;
  factor.l11 = std::sqrt(conic[0]);
  factor.l21 = conic[1] / factor.l11;
  factor.l22 = std::sqrt(T(conic_determinant(conic) / double(conic[0])));
  return factor;
}

// The enlarged ellipse of a splat relative to its mean.
template <class T> struct SplatEllipse {
  T cut;      // q <= cut
  T shear;    // the row at height dy meets the ellipse in a chord that is centred on dx = -shear * dy
  T inv_l11;  // half the length of this chord is sqrt(cut - (l22 dy)^2) * inv_l11
  T l22;
  T half_width, half_height;  // of the bounding box, infinite for a stripe
  T turn;                     // dy of the rightmost point; the leftmost has -turn
};

// Returns false if the splat touches no pixel.
template <class T> BLITZGS_HD bool make_ellipse(const T* conic, T opacity, SplatEllipse<T>* ellipse) {
  const T a = conic[0], b = conic[1], c = conic[2];
  if (!(opacity >= T(kAlphaCut)) || !is_finite(opacity)) return false;
  if (!(a > T(0)) || !(c > T(0)) || !is_finite(a) || !is_finite(b) || !is_finite(c)) return false;
  const T exact = T(2) * std::log(T(255) * opacity);
  ellipse->cut = mul_add(exact > T(0) ? exact : T(0), T(1.00002), T(2e-5));
  const ConicFactor<T> factor = factor_conic(conic);
  if (!(factor.l11 > T(0))) return false;
  // One division serves both, because one in double costs as much as the rest of this function.
  const double det = conic_determinant(conic);
  const double inverse = 1.0 / det;
  ellipse->inv_l11 = T(1) / factor.l11;
  ellipse->shear = b / a;
  ellipse->l22 = factor.l22;
  ellipse->half_height = std::sqrt(mul(ellipse->cut, T(double(a) * inverse)));
  ellipse->half_width = std::sqrt(mul(ellipse->cut, T(double(c) * inverse)));
  ellipse->turn = b == T(0) ? T(0) : -(b / c) * ellipse->half_width;
  return is_finite(ellipse->shear) && is_finite(ellipse->inv_l11);
}

// Sets the first and last index of the pixel centres i + 0.5 in [low, high], within [0, size); first > last
// if there is none. A bound that is NaN is ignored.
template <class T> BLITZGS_HD void pixels_between(T low, T high, int size, int* first, int* last) {
  *first = int(std::ceil(clamp_nan_low(low - T(0.5), T(0), T(size))));
  *last = int(std::floor(clamp_nan_high(high - T(0.5), T(-1), T(size - 1))));
}

// Returns x at one end of the ellipse's interval over a band of rows. side is -1 for the left end and 1 for
// the right one; dy is the height within the band at which that end lies furthest out.
template <class T> BLITZGS_HD T chord_end(const SplatEllipse<T>& e, T x, T y, T dy, T side) {
  constexpr T kRounding = sizeof(T) == 4 ? T(1e-6) : T(1e-14);
  const T w = e.l22 * dy;
  const T rest = mul_add(-w, w, e.cut);
  const T root = std::sqrt(rest > T(0) ? rest : T(0));
  const T middle = mul(-e.shear, dy);
  // Bounds the rounding of the terms that are added up, and of dy, which the shear multiplies.
  const T tilt = mul_add(std::fabs(e.shear), std::fabs(y), std::fabs(x));
  const T terms = mul_add(root, e.inv_l11, tilt + std::fabs(middle));
  const T end = x + mul_add(side * root, e.inv_l11, middle);
  return mul_add(side * kRounding, terms, end);
}

// The tile rows that a splat's ellipse may reach, and the interval of tiles in each of them.
template <class T> struct TileRows {
  SplatEllipse<T> ellipse;
  T x, y;                   // the splat's mean
  int row_first, row_last;  // pixel rows
  int first, last;          // tile rows; first > last if there is none

  // Sets the tiles [*begin, *end) that the splat touches in tile row ty, from first to last; false: none.
  BLITZGS_HD bool interval(int ty, int width, const TileDivider& tile_of, int* begin, int* end) const {
    const int top = ty * tile_of.size, bottom = top + tile_of.size - 1;
    const int band_first = row_first > top ? row_first : top,
              band_last = row_last < bottom ? row_last : bottom;
    const T low = T(band_first) + T(0.5) - y, high = T(band_last) + T(0.5) - y;
    const T left = chord_end(ellipse, x, y, clamp_nan_low(-ellipse.turn, low, high), T(-1));
    const T right = chord_end(ellipse, x, y, clamp_nan_low(ellipse.turn, low, high), T(1));
    int column_first, column_last;
    pixels_between(left, right, width, &column_first, &column_last);
    *begin = tile_of(column_first);
    *end = tile_of(column_last) + 1;
    return column_first <= column_last;
  }
};

template <class T>
BLITZGS_HD TileRows<T> find_tile_rows(const T* mean2d, const T* conic, T opacity, int height,
                                      const TileDivider& tile_of) {
  constexpr T kRounding = sizeof(T) == 4 ? T(1e-6) : T(1e-14);
  TileRows<T> rows{};
  rows.last = -1;
  rows.x = mean2d[0];
  rows.y = mean2d[1];
  if (!is_finite(rows.x) || !is_finite(rows.y)) return rows;
  if (!make_ellipse(conic, opacity, &rows.ellipse)) return rows;
  const T half = mul_add(kRounding, std::fabs(rows.y), rows.ellipse.half_height);
  pixels_between(rows.y - half, rows.y + half, height, &rows.row_first, &rows.row_last);
  if (rows.row_first > rows.row_last) return rows;
  rows.first = tile_of(rows.row_first);
  rows.last = tile_of(rows.row_last);
  return rows;
}

// Calls f(ty, tx_begin, tx_end) for each tile row with a touched tile, top to bottom.
template <class T, class F>
BLITZGS_HD void for_each_tile_row(const T* mean2d, const T* conic, T opacity, int width, int height,
                                  int tile_size, const F& f) {
  const TileDivider tile_of(tile_size);
  const TileRows<T> rows = find_tile_rows(mean2d, conic, opacity, height, tile_of);
  for (int ty = rows.first; ty <= rows.last; ++ty) {
    int begin, end;
    if (rows.interval(ty, width, tile_of, &begin, &end)) f(ty, begin, end);
  }
}

// The tiles of each rank: rank m composites the flattened tiles [begin[m], end[m]) of all cameras. Ranges may
// be empty and may overlap; their begins ascend.
struct RankTiles {
  int64_t begin[kMaxRanks], end[kMaxRanks];
  int n_ranks;
};

// Calls f(rank, tiles) for each rank that composites some of the tiles [begin, end).
template <class F>
BLITZGS_HD void for_each_rank(const RankTiles& ranks, int64_t begin, int64_t end, const F& f) {
  for (int m = 0; m < ranks.n_ranks && ranks.begin[m] < end; ++m) {
    const int64_t low = ranks.begin[m] > begin ? ranks.begin[m] : begin;
    const int64_t high = ranks.end[m] < end ? ranks.end[m] : end;
    if (low < high) f(m, high - low);
  }
}

}  // namespace blitzgs
