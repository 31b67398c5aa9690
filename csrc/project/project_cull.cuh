// SPDX-License-Identifier: Apache-2.0
// The quick test: which views may see a candidate, in float, from its mean and its largest scale alone.
#pragma once
#include "project/project_device.cuh"

namespace blitzgs::cuda {

__device__ inline std::int64_t candidate_id(const Inputs& in, std::int64_t candidate) {
  return in.active_ids ? in.active_ids[candidate] : candidate;
}

// What the quick test needs of a camera: bounds in float, rounded up.
struct Frustum {
  Vec3<float> row_x, row_y, row_z, translation;
  float fx, fy, cx, cy;
  float largest, offset;   // of the rotation's entries and of the translation's: bounds the rounding of p
  float reach_x, reach_y;  // |d pixel / d world| * z cannot exceed this
};

__device__ inline float norm1(const Vec3<float>& v) { return fabsf(v.x) + fabsf(v.y) + fabsf(v.z); }
__device__ inline float top(const Vec3<float>& v) { return fmaxf(fabsf(v.x), fmaxf(fabsf(v.y), fabsf(v.z))); }

__device__ inline Frustum make_frustum(const Camera<float>& c) {
  Frustum f{c.row_x, c.row_y, c.row_z, c.translation, c.fx, c.fy, c.cx, c.cy, 0.f, 0.f, 0.f, 0.f};
  f.largest = fmaxf(top(c.row_x), fmaxf(top(c.row_y), top(c.row_z)));
  f.offset = top(c.translation);
  const float along = sqrtf(dot(c.row_z, c.row_z));
  const float u = fmaxf(fabsf(c.slope_min_x), fabsf(c.slope_max_x));
  const float v = fmaxf(fabsf(c.slope_min_y), fabsf(c.slope_max_y));
  f.reach_x = 1.01f * fabsf(c.fx) * (sqrtf(dot(c.row_x, c.row_x)) + u * along);
  f.reach_y = 1.01f * fabsf(c.fy) * (sqrtf(dot(c.row_y, c.row_y)) + v * along);
  return f;
}

// A bound on the rounding of any coordinate of p = W mean + t in float.
__device__ inline float rounding(const Frustum& f, const Vec3<float>& mean) {
  return 1e-6f * (f.largest * norm1(mean) + f.offset);
}

__device__ inline bool may_be_in_depth(const Frustum& f, const Vec3<float>& mean,
                                       const ProjectOptions<float>& o) {
  const float z = dot(f.row_z, mean) + f.translation.z, error = rounding(f, mean);
  return z + error > o.near_plane && z - error <= o.far_plane;
}

// Is the splat's box, no larger than `spread` standard deviations of its largest axis, within [0, size)? All
// times z.
__device__ inline bool may_overlap(float focal, float centre, float x, float z, float error, float reach,
                                   float spread, float sigmas, float root_eps, float size) {
  const float position = focal * x + centre * z;
  const float slack = error * (fabsf(focal) + fabsf(centre) + size) +
                      1e-5f * (fabsf(focal * x) + (fabsf(centre) + size) * fabsf(z));
  const float half = reach * spread + 1.01f * sigmas * root_eps * (z + error) + slack;
  return position + half > 0.f && position - half < size * z;
}

// False only when project_row would be false: no division, no quaternion, floats alone.
__device__ inline bool may_be_seen(const Frustum& f, const Vec3<float>& mean, float largest_scale,
                                   float sigmas, const ProjectOptions<float>& o) {
  if (!may_be_in_depth(f, mean, o)) return false;
  const float z = dot(f.row_z, mean) + f.translation.z, error = rounding(f, mean);
  const float x = dot(f.row_x, mean) + f.translation.x, y = dot(f.row_y, mean) + f.translation.y;
  const float spread = sigmas * largest_scale, root_eps = sqrtf(o.eps2d);
  return may_overlap(f.fx, f.cx, x, z, error, f.reach_x, spread, sigmas, root_eps,
                     static_cast<float>(o.width)) &&
         may_overlap(f.fy, f.cy, y, z, error, f.reach_y, spread, sigmas, root_eps,
                     static_cast<float>(o.height));
}

// How many standard deviations any splat of this candidate can reach; raw opacities never exceed 1.
__device__ inline float most_sigmas(const Inputs& in, std::int64_t id) {
  return in.options.raw ? 3.331f : 1.0001f * reach(in.opacities[id]);
}

__device__ inline float largest_scale(const Inputs& in, std::int64_t id) {
  const float* s = in.scales + 3 * id;
  const float widest = fmaxf(s[0], fmaxf(s[1], s[2]));
  return in.options.raw ? 1.0001f * expf(widest) : widest;
}

}  // namespace blitzgs::cuda
