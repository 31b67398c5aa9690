// SPDX-License-Identifier: Apache-2.0
// Where the projection's backward pass finds the gradients of the rows. Each source has the same three
// members, for row r: geometry(r), color(r), and whether there are colours at all.
#pragma once
#include <variant>

#include "project/project_row.h"
#include "scatter/scatter.h"

namespace blitzgs {

// In columns: [P, 2], [P, 3], [P], [P], [P, 3]; depths and colors may be null (zero).
template <class T>
struct ProjectRowGradients {
  const T *means2d, *conics, *depths, *opacities, *colors;

  BLITZGS_HD bool colored() const { return colors != nullptr; }
  BLITZGS_HD RowGradient<T> geometry(std::int64_t r) const {
    return {{means2d[2 * r], means2d[2 * r + 1]},
            {conics[3 * r], conics[3 * r + 1], conics[3 * r + 2]},
            depths ? depths[r] : T(0),
            opacities[r]};
  }
  BLITZGS_HD Vec3<T> color(std::int64_t r) const { return load3(colors + 3 * r); }
};

// A row of a table of gradients: mean2d 2, conic 3, opacity 1, color 3.
inline constexpr int kRowGradient = 9;

// In the table that the rasteriser's backward pass adds them up in.
struct PackedRowGradients {
  struct alignas(16) Row {
    float mean2d[2], conic[3], opacity, color[3], unused[3];
  };
  const Row* rows;

  BLITZGS_HD bool colored() const { return true; }
  BLITZGS_HD RowGradient<float> geometry(std::int64_t r) const {
    const Row& v = rows[r];
    return {{v.mean2d[0], v.mean2d[1]}, {v.conic[0], v.conic[1], v.conic[2]}, 0.f, v.opacity};
  }
  // By member, so that the compiler knows the alignment.
  BLITZGS_HD Vec3<float> color(std::int64_t r) const {
    const Row& v = rows[r];
    return {v.color[0], v.color[1], v.color[2]};
  }
};

// In tables that came back from the ranks that composited the rows, added up in the order of ranks.
struct ReturnedRowGradients {
  RowValues<float> rows;

  BLITZGS_HD bool colored() const { return true; }
  BLITZGS_HD RowGradient<float> geometry(std::int64_t r) const {
    RowGradient<float> sum{};
    rows.for_each(r, [&](const float* v) {
      for (int i = 0; i < 2; ++i) sum.mean2d[i] += v[i];
      for (int i = 0; i < 3; ++i) sum.conic[i] += v[2 + i];
      sum.opacity += v[5];
    });
    return sum;
  }
  BLITZGS_HD Vec3<float> color(std::int64_t r) const {
    Vec3<float> sum{};
    rows.for_each(r, [&](const float* v) {
      sum.x += v[6];
      sum.y += v[7];
      sum.z += v[8];
    });
    return sum;
  }
};

// One that a kernel on CUDA reads; the CPU reads columns.
using RowGradientSource = std::variant<ProjectRowGradients<float>, PackedRowGradients, ReturnedRowGradients>;

}  // namespace blitzgs
