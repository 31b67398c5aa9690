// SPDX-License-Identifier: Apache-2.0
// EWA projection (Zwicker et al. 2001; Kerbl et al. 2023, Eq. 5) of one Gaussian into one pinhole camera
// (docs/image.md, section 2), and its derivative. viewmat = [W | t], Sigma = A A^T (gaussian.h):
//   p = W mean + t,   mean2d = (fx p.x / p.z + cx, fy p.y / p.z + cy),   depth = p.z
//   J = d mean2d / dp at the clamped slopes p.x / p.z and p.y / p.z
//   Sigma' = J W Sigma W^T J^T + eps I,   eps = eps2d,   conic (a, b, c) = Sigma'^-1
//   compensation = sqrt(det(Sigma' - eps I) / det Sigma')   (the 2D filter of Mip-Splatting, Yu et al. 2024)
// The covariance is kept as its 2x3 factor M = J W A with rows m0 and m1, so Sigma' = M M^T + eps I. The
// determinant |m0 x m1|^2 + eps tr(M M^T) + eps^2 is then a sum of non-negative terms, while the usual
// ac - b^2 cancels for elongated splats.
#pragma once
#include "math/gaussian.h"

namespace blitzgs {

// A pinhole camera: the rows of the world-to-camera rotation, the camera centre, and the slopes x/z and y/z
// at which the Jacobian is clamped.
template <class T> struct Camera {
  Vec3<T> row_x, row_y, row_z, translation, centre;
  T fx, fy, cx, cy;
  T slope_min_x, slope_max_x, slope_min_y, slope_max_y;
};

// viewmat [4, 4] and K [3, 3] row-major. The slopes leave 0.15 of the image size beyond each border, which is
// 1.3 tan(fov / 2) for a centred principal point. The centre assumes a rotation: c = -W^T t. A camera with a
// skew, or another last row of K than 0, 0, 1, has no place in the projection: beyond rounding, it sees
// nothing, as one that is not finite.
template <class T> BLITZGS_HD Camera<T> make_camera(const T* viewmat, const T* K, int width, int height) {
  Camera<T> camera;
  camera.row_x = load3(viewmat);
  camera.row_y = load3(viewmat + 4);
  camera.row_z = load3(viewmat + 8);
  camera.translation = {viewmat[3], viewmat[7], viewmat[11]};
  const Vec3<T>& t = camera.translation;
  camera.centre = T(-1) * (t.x * camera.row_x + t.y * camera.row_y + t.z * camera.row_z);
  const T rounding = T(1e-6), most = rounding * std::fabs(K[0]);
  const bool is_pinhole = std::fabs(K[1]) <= most && std::fabs(K[3]) <= most && std::fabs(K[6]) <= rounding &&
                          std::fabs(K[7]) <= rounding && std::fabs(K[8] - T(1)) <= rounding;
  camera.fx = is_pinhole ? K[0] : std::numeric_limits<T>::quiet_NaN();
  camera.fy = K[4];
  camera.cx = K[2];
  camera.cy = K[5];
  const T margin_x = T(0.15) * T(width), margin_y = T(0.15) * T(height);
  camera.slope_min_x = (-camera.cx - margin_x) / camera.fx;
  camera.slope_max_x = (T(width) - camera.cx + margin_x) / camera.fx;
  camera.slope_min_y = (-camera.cy - margin_y) / camera.fy;
  camera.slope_max_y = (T(height) - camera.cy + margin_y) / camera.fy;
  return camera;
}

// The projection of a mean. It is computed in double, because in float the rounding of the rotation alone
// would move a splat by hundreds of ulps of its pixel position.
struct ProjectedMean {
  double slope_x, slope_y, z, inverse_z;  // x/z, y/z, camera-space depth
};

template <class T> BLITZGS_HD double row_times_point(const Vec3<T>& row, const Vec3<T>& point, T offset) {
  return mul_add(double(row.z), double(point.z),
                 mul_add(double(row.y), double(point.y), double(row.x) * double(point.x))) +
         double(offset);
}

template <class T> BLITZGS_HD ProjectedMean project_mean(const Camera<T>& camera, const Vec3<T>& mean) {
  const double x = row_times_point(camera.row_x, mean, camera.translation.x);
  const double y = row_times_point(camera.row_y, mean, camera.translation.y);
  const double z = row_times_point(camera.row_z, mean, camera.translation.z);
  const double inverse_z = 1.0 / z;
  return {x * inverse_z, y * inverse_z, z, inverse_z};
}

template <class T>
BLITZGS_HD void pixel_position(const Camera<T>& camera, const ProjectedMean& p, T* mean2d) {
  mean2d[0] = T(mul_add(double(camera.fx), p.slope_x, double(camera.cx)));
  mean2d[1] = T(mul_add(double(camera.fy), p.slope_y, double(camera.cy)));
}

// Rows of J W: the derivative of the pixel position by the world-space position, at the clamped slopes.
template <class T> struct PixelGradients {
  Vec3<T> gx, gy;
  T u, v, inverse_z;
  bool u_free, v_free;  // not clamped
};

template <class T>
BLITZGS_HD PixelGradients<T> pixel_gradients(const Camera<T>& camera, const ProjectedMean& p) {
  const T u = T(p.slope_x), v = T(p.slope_y);
  PixelGradients<T> g;
  g.u = smaller(larger(u, camera.slope_min_x), camera.slope_max_x);
  g.v = smaller(larger(v, camera.slope_min_y), camera.slope_max_y);
  g.u_free = g.u == u;
  g.v_free = g.v == v;
  g.inverse_z = T(p.inverse_z);
  g.gx = (camera.fx * g.inverse_z) * (camera.row_x - g.u * camera.row_z);
  g.gy = (camera.fy * g.inverse_z) * (camera.row_y - g.v * camera.row_z);
  return g;
}

// The footprint of a Gaussian in the image: the rows of M, and of the blurred covariance Sigma' the diagonal,
// the inverse (conic a, b, c) and the determinant.
template <class T> struct Footprint {
  Vec3<T> m0, m1;
  T cov_xx, cov_yy;
  T conic[3];
  Vec3<T> normal;   // m0 x m1, divided by `magnitude`
  T normal_length;  // |normal|
  T root_det;       // sqrt(det Sigma'), divided by `magnitude`
  T magnitude;      // larger of cov_xx, cov_yy
  T blur;           // eps2d, divided by `magnitude`
};

// Computes the footprint. Quantities are divided by the larger diagonal entry before they are multiplied, so
// that scales from 1e-8 to 1e4 pixels stay in the range of float.
template <class T>
BLITZGS_HD Footprint<T> make_footprint(const PixelGradients<T>& g, const Columns3<T>& axes, T eps2d) {
  Footprint<T> s;
  s.m0 = {dot(g.gx, axes.x), dot(g.gx, axes.y), dot(g.gx, axes.z)};
  s.m1 = {dot(g.gy, axes.x), dot(g.gy, axes.y), dot(g.gy, axes.z)};
  const T xx = dot(s.m0, s.m0), xy = dot(s.m0, s.m1), yy = dot(s.m1, s.m1);
  s.cov_xx = xx + eps2d;
  s.cov_yy = yy + eps2d;
  s.magnitude = larger(s.cov_xx, s.cov_yy);
  const T inverse = T(1) / s.magnitude;
  const T shrink = std::sqrt(inverse), eps = s.blur = eps2d * inverse;
  s.normal = cross(shrink * s.m0, shrink * s.m1);
  const T unblurred = dot(s.normal, s.normal);
  const T det = unblurred + eps * ((xx + yy) * inverse + eps);
  s.normal_length = std::sqrt(unblurred);
  s.root_det = std::sqrt(det);
  const T factor = inverse / det;
  s.conic[0] = factor * (s.cov_yy * inverse);
  s.conic[1] = -factor * (xy * inverse);
  s.conic[2] = factor * (s.cov_xx * inverse);
  return s;
}

// Writes the conic (a, b, c) to conic [3]. The length of a splat depends on ac - b^2, which rounding to float
// changes by up to ac / (ac - b^2) roundings: 1e-3 for a splat a hundred times longer than wide. The function
// therefore tries floats next to a, scales b with a (the axis has the direction (-b, a)), and keeps the pair
// for which some float c gives the best determinant.
template <class T> BLITZGS_HD void store_conic(const Footprint<T>& s, T* conic) {
  for (int i = 0; i < 3; ++i) conic[i] = s.conic[i];
  if constexpr (sizeof(T) == sizeof(float)) {
    constexpr T kLong = 64;  // ac / (ac - b^2)
    constexpr double kGood = 4e-6;
    constexpr int kTries = 64;
    if (!(smaller(s.cov_xx, s.cov_yy) > kLong * s.root_det * s.root_det * s.magnitude)) return;
    const double root = double(s.root_det) * double(s.magnitude), det = 1.0 / (root * root);
    double best = std::fabs(double(conic[0]) * double(conic[2]) - double(conic[1]) * double(conic[1]) - det);
    for (int i = 1; i <= kTries && best > kGood * det; ++i) {
      const double nudge = 1.0 + (i % 2 ? i : -i) * 6e-8;
      const T a = T(double(s.conic[0]) * nudge), b = T(double(s.conic[1]) * nudge);
      const double bb = double(b) * double(b);
      const T c = T((det + bb) / double(a));
      const double error = std::fabs(double(a) * double(c) - bb - det);
      if (error >= best) continue;
      best = error;
      conic[0] = a;
      conic[1] = b;
      conic[2] = c;
    }
  }
}

// In antialiased mode, the factor by which the blur lowers the peak of a splat.
template <class T> BLITZGS_HD T compensation(const Footprint<T>& s) { return s.normal_length / s.root_det; }

// Gradients of the rows of M from those of the conic (b counted once) and of the compensation. With Q the
// conic matrix, d(Sigma'^-1) = -Q dSigma' Q, so the conic's part is v_M = -2 Q V Q M. As a matrix product,
// Q M would lose all digits for a splat that is a thousand times longer than wide. The form
// (m1 x n + eps m0, n x m0 + eps m1) / det with n = m0 x m1 loses none.
template <class T>
BLITZGS_HD void footprint_vjp(const Footprint<T>& s, const T* v_conic, T v_compensation, Vec3<T>* v_m0,
                              Vec3<T>* v_m1) {
  const T a = s.conic[0], b = s.conic[1], c = s.conic[2];
  const T p = v_conic[0], q = T(0.5) * v_conic[1], r = v_conic[2];
  const T shrink = T(1) / (s.root_det * s.root_det * s.magnitude);
  const Vec3<T> qm0 = shrink * (cross(s.m1, s.normal) + s.blur * s.m0);
  const Vec3<T> qm1 = shrink * (cross(s.normal, s.m0) + s.blur * s.m1);
  *v_m0 = T(-2) * ((a * p + b * q) * qm0 + (a * q + b * r) * qm1);
  *v_m1 = T(-2) * ((b * p + c * q) * qm0 + (b * q + c * r) * qm1);
  if (v_compensation == T(0) || !(s.normal_length > T(0))) return;
  // The derivatives of log |n| and of log det Sigma' cancel but for a share eps / Sigma' of them. The form
  // eps / det ((tr(M M^T) + eps) m1 x n / |n|^2 - m0), times the compensation, has only that share. The
  // derivative does not exist for a splat that is seen exactly edge-on; zero is used there.
  const T scale = v_compensation * s.blur * shrink / s.root_det;
  const T trace = (s.cov_xx + s.cov_yy) / s.magnitude - s.blur;
  const Vec3<T> along = (trace / s.normal_length) * s.normal;
  *v_m0 = *v_m0 + scale * (cross(s.m1, along) - s.normal_length * s.m0);
  *v_m1 = *v_m1 + scale * (cross(along, s.m0) - s.normal_length * s.m1);
}

// From the gradients of the rows of M: sets those of J W (v_gx, v_gy) and adds those of the axes to v_axes.
template <class T>
BLITZGS_HD void factor_vjp(const PixelGradients<T>& g, const Columns3<T>& axes, const Vec3<T>& v_m0,
                           const Vec3<T>& v_m1, Vec3<T>* v_gx, Vec3<T>* v_gy, Columns3<T>* v_axes) {
  v_axes->x = v_axes->x + v_m0.x * g.gx + v_m1.x * g.gy;
  v_axes->y = v_axes->y + v_m0.y * g.gx + v_m1.y * g.gy;
  v_axes->z = v_axes->z + v_m0.z * g.gx + v_m1.z * g.gy;
  *v_gx = v_m0.x * axes.x + v_m0.y * axes.y + v_m0.z * axes.z;
  *v_gy = v_m1.x * axes.x + v_m1.y * axes.y + v_m1.z * axes.z;
}

// Gradients with respect to a camera's pose, summed over Gaussians.
template <class T> struct PoseGradient {
  Vec3<T> row_x, row_y, row_z, translation;
};

// Returns the gradient of the camera-space mean from those of J W, of the pixel position and of the depth.
// J W also depends on the rows of the rotation; their gradients are added to pose (null: not wanted).
template <class T>
BLITZGS_HD Vec3<T> pixel_gradients_vjp(const Camera<T>& camera, const ProjectedMean& p,
                                       const PixelGradients<T>& g, const Vec3<T>& v_gx, const Vec3<T>& v_gy,
                                       const T* v_mean2d, T v_depth, PoseGradient<T>* pose) {
  const T fx = camera.fx * g.inverse_z, fy = camera.fy * g.inverse_z;
  const T slope_x = T(p.slope_x), slope_y = T(p.slope_y);
  Vec3<T> v{fx * v_mean2d[0], fy * v_mean2d[1], v_depth};
  v.z -= fx * slope_x * v_mean2d[0] + fy * slope_y * v_mean2d[1];
  v.z -= g.inverse_z * (dot(v_gx, g.gx) + dot(v_gy, g.gy));
  const T v_u = g.u_free ? -fx * dot(camera.row_z, v_gx) * g.inverse_z : T(0);
  const T v_v = g.v_free ? -fy * dot(camera.row_z, v_gy) * g.inverse_z : T(0);
  v.x += v_u;
  v.y += v_v;
  v.z -= v_u * slope_x + v_v * slope_y;
  if (pose) {
    pose->row_x = pose->row_x + fx * v_gx;
    pose->row_y = pose->row_y + fy * v_gy;
    pose->row_z = pose->row_z - fx * g.u * v_gx - fy * g.v * v_gy;
  }
  return v;
}

// p = W mean + t: adds W^T v_p to v_mean, and the derivative by the pose to pose (null: not wanted).
template <class T>
BLITZGS_HD void camera_point_vjp(const Camera<T>& camera, const Vec3<T>& mean, const Vec3<T>& v_p,
                                 Vec3<T>* v_mean, PoseGradient<T>* pose) {
  *v_mean = *v_mean + v_p.x * camera.row_x + v_p.y * camera.row_y + v_p.z * camera.row_z;
  if (pose) {
    pose->row_x = pose->row_x + v_p.x * mean;
    pose->row_y = pose->row_y + v_p.y * mean;
    pose->row_z = pose->row_z + v_p.z * mean;
    pose->translation = pose->translation + v_p;
  }
}

// c = -W^T t: adds the pose's gradient from the gradient v_c of the camera centre.
template <class T>
BLITZGS_HD void camera_centre_vjp(const Camera<T>& camera, const Vec3<T>& v_c, PoseGradient<T>* pose) {
  const Vec3<T>& t = camera.translation;
  pose->row_x = pose->row_x - t.x * v_c;
  pose->row_y = pose->row_y - t.y * v_c;
  pose->row_z = pose->row_z - t.z * v_c;
  pose->translation =
      pose->translation - Vec3<T>{dot(camera.row_x, v_c), dot(camera.row_y, v_c), dot(camera.row_z, v_c)};
}

}  // namespace blitzgs
