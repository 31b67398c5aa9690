// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <random>

#include "common/catch.h"
#include "math/gaussian.h"
#include "math/lanes.h"
#include "math/projection.h"
#include "project/project_splat.h"

using namespace blitzgs;
using Values = std::vector<double>;

namespace {

Values flat(const Columns3<double>& c) {
  return {c.x.x, c.x.y, c.x.z, c.y.x, c.y.y, c.y.z, c.z.x, c.z.y, c.z.z};
}

template <class T> Camera<T> test_camera() {
  // A rotation of 30 degrees about y, then a shift.
  const T c = T(std::sqrt(0.75)), s = T(0.5);
  const T viewmat[16] = {c, 0, s, T(0.2), 0, 1, 0, T(-0.1), -s, 0, c, T(3), 0, 0, 0, 1};
  const T K[9] = {100, 0, 40, 0, 110, 30, 0, 0, 1};
  return make_camera(viewmat, K, 64, 48);
}

}  // namespace

TEST_CASE("the rotation of a quaternion that is zero, very long or very short") {
  const double zero[4] = {};
  double v_zero[4] = {};
  rotation_columns_vjp(normalize_quaternion(zero), {{1, 2, 3}, {4, 5, 6}, {7, 8, 9}}, v_zero);
  REQUIRE(flat(rotation_columns(normalize_quaternion(zero))) == Values{1, 0, 0, 0, 1, 0, 0, 0, 1});
  for (const double v : v_zero) REQUIRE(v == 0.0);
  const float tiny[4] = {1e-40f, 1e-41f, 0.0f, 0.0f};
  REQUIRE(normalize_quaternion(tiny).w == 1.0f);
  REQUIRE(normalize_quaternion(tiny).inverse_norm == 0.0f);
  for (const float size : {1e-38f, 1e-20f, 1e20f, 1e38f}) {
    const float q[4] = {0.5f * size, -0.5f * size, 0.5f * size, 0.5f * size};
    const UnitQuaternion<float> unit = normalize_quaternion(q);
    REQUIRE(unit.w == Approx(0.5f));
    REQUIRE(unit.x == Approx(-0.5f));
    REQUIRE(unit.inverse_norm == Approx(1.0 / size));
  }
}

TEST_CASE("a footprint seen exactly edge-on has finite gradients") {
  const Columns3<double> axes{{1, 0, 0}, {0, 0, 0}, {0, 0, 0}};
  const PixelGradients<double> g{{2, 0, 0}, {1, 0, 0}, 0, 0, 1, true, true};
  const Footprint<double> s = make_footprint(g, axes, 0.3);
  REQUIRE(compensation(s) == 0.0);
  const double v_conic[3] = {1, 2, 3};
  Vec3<double> v0, v1;
  footprint_vjp(s, v_conic, 5.0, &v0, &v1);
  REQUIRE(is_finite(v0.x + v0.y + v0.z + v1.x + v1.y + v1.z));
}

TEST_CASE("needles: the stored conic keeps its determinant, the gradient its digits") {
  const Columns3<float> axes{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  const Columns3<double> wide_axes{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (const float length : {3.0f, 15.0f, 50.0f, 1e5f}) {
    for (int i = 0; i < 60; ++i) {
      const float angle = 0.01f + 0.052f * float(i), x = std::cos(angle), y = std::sin(angle);
      const Vec3<float> gx{length * x, -0.5f * y, 0.03f}, gy{length * y, 0.5f * x, 0.02f};
      const PixelGradients<float> g{gx, gy, 0, 0, 1, true, true};
      const PixelGradients<double> wide{{gx.x, gx.y, gx.z}, {gy.x, gy.y, gy.z}, 0, 0, 1, true, true};
      const Footprint<double> exact = make_footprint(wide, wide_axes, 0.3);
      const Footprint<float> footprint = make_footprint(g, axes, 0.3f);
      INFO("length " << length << ", angle " << angle);
      float conic[3];
      store_conic(footprint, conic);
      for (int k = 0; k < 3; ++k) {
        REQUIRE(conic[k] ==
                Approx(exact.conic[k]).epsilon(1e-5).margin(1e-6 * (exact.conic[0] + exact.conic[2])));
      }
      const double root = exact.root_det * exact.magnitude;
      if (length < 1e4f) REQUIRE(conic_determinant(conic) * root * root == Approx(1.0).epsilon(3e-5));
      const float v_conic[3] = {1.0f, -2.0f, 3.0f};
      const double wide_v[3] = {1.0, -2.0, 3.0};
      Vec3<float> v0, v1;
      Vec3<double> w0, w1;
      footprint_vjp(footprint, v_conic, 0.5f, &v0, &v1);
      footprint_vjp(exact, wide_v, 0.5, &w0, &w1);
      const double size = std::sqrt(dot(w0, w0) + dot(w1, w1));
      const Values got{v0.x, v0.y, v0.z, v1.x, v1.y, v1.z}, wanted{w0.x, w0.y, w0.z, w1.x, w1.y, w1.z};
      for (int k = 0; k < 6; ++k) REQUIRE(got[k] == Approx(wanted[k]).margin(3e-5 * size));
    }
  }
}

TEST_CASE("elongated and extreme splats keep their float determinant") {
  const ProjectOptions<double> exact{64, 48, 16, 0, 1, 0.01, 1e10, 0.3, 0.0, true, false};
  const ProjectOptions<float> rounded{64, 48, 16, 0, 1, 0.01f, 1e10f, 0.3f, 0.0f, true, false};
  for (const double size : {1e-8, 1e-4, 1.0, 1e4}) {
    for (const double ratio : {1.0, 1e-4}) {
      const float quat[4] = {0.7f, 0.2f, -0.4f, 0.5f};
      const double wide[4] = {quat[0], quat[1], quat[2], quat[3]};
      const float length = float(size), thin = float(size * ratio);
      const auto a = activate_gaussian<double>({0.1, 0.2, -0.3}, wide, {length, thin, thin}, 0.9);
      const auto b = activate_gaussian<float>({0.1f, 0.2f, -0.3f}, quat, {length, thin, thin}, 0.9f);
      const Camera<double> camera = test_camera<double>();
      const Camera<float> camera_f = test_camera<float>();
      const Footprint<double> s =
          make_footprint(pixel_gradients(camera, project_mean(camera, a.mean)), a.axes, 0.3);
      const Footprint<float> f =
          make_footprint(pixel_gradients(camera_f, project_mean(camera_f, b.mean)), b.axes, 0.3f);
      INFO("size " << size << ", ratio " << ratio);
      REQUIRE(f.root_det * f.magnitude == Approx(s.root_det * s.magnitude).epsilon(1e-5));
      REQUIRE(f.conic[0] == Approx(s.conic[0]).epsilon(1e-5));
      REQUIRE(f.conic[1] == Approx(s.conic[1]).epsilon(1e-5).margin(1e-6 * s.conic[0]));
      REQUIRE(f.conic[2] == Approx(s.conic[2]).epsilon(1e-5));
      REQUIRE(compensation(f) == Approx(compensation(s)).epsilon(1e-4).margin(1e-7));
      Splat<double> splat_exact{};
      Splat<float> splat{};
      REQUIRE(project_splat(camera, a, exact, &splat_exact) == project_splat(camera_f, b, rounded, &splat));
      const GeometryGradient<float> v{{1, 1}, {1, 1, 1}, 1, 1};
      GaussianGradient<float> gradient{};
      project_splat_vjp(camera_f, b, rounded, v, &gradient, static_cast<PoseGradient<float>*>(nullptr));
      for (const Vec3<float>& g : {gradient.mean, gradient.axes.x, gradient.axes.y, gradient.axes.z}) {
        REQUIRE(is_finite(g.x + g.y + g.z));
      }
    }
  }
}

TEST_CASE("the frustum never drops a splat that exists") {
  std::mt19937 engine(7);
  std::normal_distribution<float> normal;
  const Camera<float> camera = test_camera<float>();
  const ProjectOptions<float> options{64, 48, 16, 0, 1, 0.01f, 1e10f, 0.3f, 0.0f, false, false};
  const Frustum view = frustum_of(camera, options);
  int exist = 0, spared = 0;
  for (int i = 0; i < 20000; ++i) {
    const Vec3<float> mean{3 * normal(engine), 3 * normal(engine), 3 * normal(engine)};
    const Vec3<float> scale{std::exp(normal(engine) - 2), std::exp(normal(engine) - 2),
                            std::exp(normal(engine) - 2)};
    const float quat[4] = {normal(engine), normal(engine), normal(engine), normal(engine)};
    const float opacity = 1 / (1 + std::exp(-3 * normal(engine)));
    Splat<float> splat{};
    const bool exists = project_splat(camera, activate_gaussian(mean, quat, scale, opacity), options, &splat);
    const float norm = norm1(mean), widest = larger(larger(scale.x, scale.y), scale.z);
    const bool maybe = may_be_in_depth(view, mean, norm) && may_overlap(view, mean, norm, widest);
    REQUIRE((maybe || !exists));
    exist += exists;
    spared += !maybe;
  }
  REQUIRE(exist > 1000);
  REQUIRE(spared > 5000);
}

TEST_CASE("a camera with a skew or another scale than 1 sees nothing") {
  const float viewmat[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1};
  const float p[11] = {0.1f, 0.2f, -0.3f, 1, 0, 0, 0, 0.1f, 0.1f, 0.1f, 0.5f};
  const ProjectOptions<float> options{64, 48, 16, 0, 1, 0.01f, 1e10f, 0.3f, 0.0f, false, false};
  const auto gaussian = activate_gaussian(load3(p), p + 3, load3(p + 7), p[10]);
  const auto is_seen = [&](int entry, float value) {
    float K[9] = {100, 0, 40, 0, 110, 30, 0, 0, 1};
    K[entry] += value;
    Splat<float> splat{};
    return project_splat(make_camera(viewmat, K, 64, 48), gaussian, options, &splat);
  };
  for (const int entry : {1, 3, 6, 7, 8}) {
    INFO("entry " << entry);
    REQUIRE(is_seen(entry, 0.0f));
    REQUIRE(is_seen(entry, 5e-7f));
    REQUIRE_FALSE(is_seen(entry, 0.01f));
    REQUIRE_FALSE(is_seen(entry, -0.01f));
    REQUIRE_FALSE(is_seen(entry, std::numeric_limits<float>::quiet_NaN()));
  }
}

namespace {
using Lanes = blitzgs::PlainLanes<float>;
float exp2_of(float x) { return blitzgs::exp2_nonpositive(Lanes::broadcast(x)).v[3]; }
}  // namespace

TEST_CASE("2^x is accurate to an ulp for x <= 0") {
  double worst = 0;
  for (int i = 0; i <= 400000; ++i) {
    const float x = -126.0f * float(i) / 400000.0f;
    const double exact = std::exp2(double(x));
    worst = std::max(worst, std::fabs(exp2_of(x) - exact) / exact);
  }
  REQUIRE(worst < 1.1e-7);
  REQUIRE(exp2_of(0.0f) == 1.0f);
  REQUIRE(exp2_of(-126.0f) == exp2_of(-1e30f));
  REQUIRE(std::isnan(exp2_of(std::numeric_limits<float>::quiet_NaN())));
}

TEST_CASE("lanes treat NaN as the vector instructions do") {
  const Lanes nan = Lanes::broadcast(std::numeric_limits<float>::quiet_NaN()), one = Lanes::broadcast(1.0f);
  REQUIRE(Lanes::min(nan, one).v[0] == 1.0f);
  REQUIRE(std::isnan(Lanes::min(one, nan).v[0]));
  REQUIRE(!Lanes::greater_equal(nan, one).any());
  REQUIRE(nan.to_int().v[0] == INT32_MIN);
  REQUIRE(Lanes::iota().sum() == 28.0f);
}
