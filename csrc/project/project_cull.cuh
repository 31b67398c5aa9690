// SPDX-License-Identifier: Apache-2.0
// The quick test: which views may see a candidate, in float, from its mean and its largest scale alone.
#pragma once
#include "project/project_device.cuh"

namespace blitzgs::cuda {

// n . p + d + k s + e |p|_1 >= 0 for whatever a view may see, p a mean and s its largest standard deviation.
struct Plane {
  float4 normal;  // n, d
  float k, e;

  __device__ float value(const Vec3<float>& p, float norm1) const {
    return fmaf(e, norm1, fmaf(normal.z, p.z, fmaf(normal.y, p.y, fmaf(normal.x, p.x, normal.w))));
  }
};

constexpr int kSides = 4;

// The region that a view may see, in float, rounded up: depths first, which need no scale, then the borders
// of the image, all times z. Within kMostSigmas of its mean a splat of opacity <= 1 has alpha >= 1/255.
struct Frustum {
  Plane near, far, sides[kSides];
};

constexpr float kMostSigmas = 3.331f;

__device__ inline float norm1(const Vec3<float>& v) { return fabsf(v.x) + fabsf(v.y) + fabsf(v.z); }
__device__ inline float top(const Vec3<float>& v) { return fmaxf(fabsf(v.x), fmaxf(fabsf(v.y), fabsf(v.z))); }

// size: an upper bound of |n| in units of the rows of the rotation, whose entries and those of the
// translation do not exceed `largest` and `offset`. 2e-6 of every term is more than rounding takes.
__device__ inline Plane make_plane(const Vec3<float>& n, float d, float k, float size, float largest,
                                   float offset) {
  return {{n.x, n.y, n.z, d + 2e-6f * (size * offset + fabsf(d))}, k, 2e-6f * size * largest};
}

__device__ inline Frustum make_frustum(const Camera<float>& c, const ProjectOptions<float>& o) {
  const Vec3<float>& t = c.translation;
  const float largest = fmaxf(top(c.row_x), fmaxf(top(c.row_y), top(c.row_z))), offset = top(t);
  Frustum f;
  f.near = make_plane(c.row_z, t.z - o.near_plane, 0.f, 1.f, largest, offset);
  f.far = make_plane(-1.f * c.row_z, o.far_plane - t.z, 0.f, 1.f, largest, offset);
  const float along = sqrtf(dot(c.row_z, c.row_z)), blur = 1.01f * kMostSigmas * sqrtf(o.eps2d);
  const auto add_sides = [&](Plane* sides, const Vec3<float>& row, float shift, float focal, float centre,
                             float slope_min, float slope_max, float length) {
    // |d pixel / d world| z cannot exceed this.
    const float reach =
        fabsf(focal) * (sqrtf(dot(row, row)) + fmaxf(fabsf(slope_min), fabsf(slope_max)) * along);
    const float k = 1.01f * kMostSigmas * reach, size = fabsf(focal) + fabsf(centre) + length + blur;
    const float low = centre + blur, high = length - centre + blur;
    sides[0] = make_plane(focal * row + low * c.row_z, focal * shift + low * t.z, k, size, largest, offset);
    sides[1] = make_plane(high * c.row_z - focal * row, high * t.z - focal * shift, k, size, largest, offset);
  };
  add_sides(f.sides, c.row_x, t.x, c.fx, c.cx, c.slope_min_x, c.slope_max_x, static_cast<float>(o.width));
  add_sides(f.sides + 2, c.row_y, t.y, c.fy, c.cy, c.slope_min_y, c.slope_max_y,
            static_cast<float>(o.height));
  return f;
}

__device__ inline bool may_be_in_depth(const Frustum& f, const Vec3<float>& mean, float norm) {
  return f.near.value(mean, norm) >= 0.f && f.far.value(mean, norm) >= 0.f;
}

// False only when project_row would be false: no division, no quaternion, floats alone. Of what is in depth.
__device__ inline bool may_overlap(const Frustum& f, const Vec3<float>& mean, float norm, float sigma) {
  bool overlaps = true;
#pragma unroll
  for (const Plane& side : f.sides) overlaps &= fmaf(side.k, sigma, side.value(mean, norm)) >= 0.f;
  return overlaps;
}

// An upper bound. Stored opacities may exceed 1, and such a splat kMostSigmas; logits cannot.
__device__ inline float largest_scale(const Inputs& in, std::int64_t id) {
  const float* s = in.scales + 3 * id;
  const float widest = fmaxf(s[0], fmaxf(s[1], s[2]));
  if (in.options.raw) return 1.001f * __expf(widest);
  return in.opacities[id] <= 1.f ? widest : 1e30f;
}

}  // namespace blitzgs::cuda
