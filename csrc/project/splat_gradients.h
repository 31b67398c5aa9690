// SPDX-License-Identifier: Apache-2.0
// Where the projection's backward pass finds the gradients of the splats. Each source has the same three
// members, for splat r: geometry(r), color(r), and whether there are colours at all.
#pragma once
#include <variant>

#include "common/splat_gradient.h"
#include "project/project_splat.h"
#include "scatter/scatter.h"

namespace blitzgs {

// In columns: [P, 2], [P, 3], [P], [P], [P, 3]; depths and colors may be null (zero).
template <class T>
struct SplatGradientColumns {
  const T *means2d, *conics, *depths, *opacities, *colors;

  BLITZGS_HD bool colored() const { return colors != nullptr; }
  BLITZGS_HD GeometryGradient<T> geometry(std::int64_t r) const {
    return {{means2d[2 * r], means2d[2 * r + 1]},
            {conics[3 * r], conics[3 * r + 1], conics[3 * r + 2]},
            depths ? depths[r] : T(0),
            opacities[r]};
  }
  BLITZGS_HD Vec3<T> color(std::int64_t r) const { return load3(colors + 3 * r); }
};

// In the table that the rasteriser's backward pass adds them up in.
struct PackedSplatGradients {
  const SplatGradient* splats;

  BLITZGS_HD bool colored() const { return true; }
  BLITZGS_HD GeometryGradient<float> geometry(std::int64_t r) const {
    const SplatGradient& v = splats[r];
    return {{v.mean2d[0], v.mean2d[1]}, {v.conic[0], v.conic[1], v.conic[2]}, 0.f, v.opacity};
  }
  // By member, so that the compiler knows the alignment.
  BLITZGS_HD Vec3<float> color(std::int64_t r) const {
    const SplatGradient& v = splats[r];
    return {v.color[0], v.color[1], v.color[2]};
  }
};

// In such tables of all ranks that composited the splats (CUDA), added up in the order of ranks. The memory
// is shared: `tables` are mapped here, each from this rank's first splat on.
struct RankSplatGradients {
  const SplatPlace* places;
  int n_ranks;
  const SplatGradient* tables[kMaxPeers];
  std::int32_t sizes[kMaxPeers];  // this rank's splats in each
  float* means2d;                 // null, or [P, 2]: where the projection's backward pass leaves these sums
  bool absolute;                  // those of mean2d_abs instead

  BLITZGS_HD bool colored() const { return true; }
  BLITZGS_HD GeometryGradient<float> geometry(std::int64_t r) const {
    const SplatGradient splat = sum(r);
    return PackedSplatGradients{&splat}.geometry(0);
  }
  BLITZGS_HD Vec3<float> color(std::int64_t r) const {
    const SplatGradient splat = sum(r);
    return PackedSplatGradients{&splat}.color(0);
  }
  BLITZGS_HD SplatGradient sum(std::int64_t r) const {
    SplatGradient sum{};
    for (int m = 0; m < n_ranks; ++m) {
      const SplatGradient* splat = at(m, r);
      if (!splat) continue;
      const SplatGradient v = *splat;
      sum.add(v);
    }
    return sum;
  }
  // The splat at rank m; null: that composited none of it.
  BLITZGS_HD const SplatGradient* at(int m, std::uint64_t r) const {
    const SplatPlace place = places[r / kPlaceSplats * n_ranks + m];
    const auto in_run = static_cast<std::uint32_t>(r % kPlaceSplats);
    const std::int64_t splat = place.of(in_run);
    return place.has(in_run) && splat < sizes[m] ? tables[m] + splat : nullptr;
  }
};

// One that a kernel on CUDA reads; the CPU reads columns.
using SplatGradientSource =
    std::variant<SplatGradientColumns<float>, PackedSplatGradients, RankSplatGradients>;

}  // namespace blitzgs
