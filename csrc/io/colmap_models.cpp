// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <stdexcept>

#include "io/colmap.h"

namespace blitzgs::io {

const std::vector<CameraModel>& camera_models() {
  static const std::vector<CameraModel> models = {
      {0, "SIMPLE_PINHOLE", "f,cx,cy", 3},
      {1, "PINHOLE", "fx,fy,cx,cy", 4},
      {2, "SIMPLE_RADIAL", "f,cx,cy,k", 4},
      {3, "RADIAL", "f,cx,cy,k1,k2", 5},
      {4, "OPENCV", "fx,fy,cx,cy,k1,k2,p1,p2", 8},
      {5, "OPENCV_FISHEYE", "fx,fy,cx,cy,k1,k2,k3,k4", 8},
      {6, "FULL_OPENCV", "fx,fy,cx,cy,k1,k2,p1,p2,k3,k4,k5,k6", 12},
      {7, "FOV", "fx,fy,cx,cy,omega", 5},
      {8, "SIMPLE_RADIAL_FISHEYE", "f,cx,cy,k", 4},
      {9, "RADIAL_FISHEYE", "f,cx,cy,k1,k2", 5},
      {10, "THIN_PRISM_FISHEYE", "fx,fy,cx,cy,k1,k2,p1,p2,k3,k4,sx1,sy1", 12},
      {11, "RAD_TAN_THIN_PRISM_FISHEYE", "fx,fy,cx,cy,k0,k1,k2,k3,k4,k5,p0,p1,s0,s1,s2,s3", 16},
      {12, "SIMPLE_DIVISION", "f,cx,cy,k", 4},
      {13, "DIVISION", "fx,fy,cx,cy,k", 5},
      {14, "SIMPLE_FISHEYE", "f,cx,cy", 3},
      {15, "FISHEYE", "fx,fy,cx,cy", 4},
      {16, "EUCM", "fx,fy,cx,cy,alpha,beta", 6},
      {17, "EQUIRECTANGULAR", "w,h", 2},
  };
  return models;
}

const CameraModel* find_camera_model(int id) {
  const auto& models = camera_models();
  const auto found = std::find_if(models.begin(), models.end(), [&](const auto& m) { return m.id == id; });
  return found == models.end() ? nullptr : &*found;
}

const CameraModel* find_camera_model(std::string_view name) {
  const auto& models = camera_models();
  const auto found =
      std::find_if(models.begin(), models.end(), [&](const auto& m) { return m.name == name; });
  return found == models.end() ? nullptr : &*found;
}

std::string camera_problem(const ColmapCamera& camera) {
  constexpr std::uint64_t kMaxSide = std::numeric_limits<std::int32_t>::max();
  const std::string who = "camera " + std::to_string(camera.id);
  const CameraModel* model = find_camera_model(camera.model);
  if (!model) return who + " has the unknown model id " + std::to_string(camera.model);
  if (camera.params.size() != static_cast<std::size_t>(model->num_params)) {
    return who + " of model " + std::string(model->name) + " needs " + std::to_string(model->num_params) +
           " parameters (" + std::string(model->params) + "), got " + std::to_string(camera.params.size());
  }
  if (camera.width < 1 || camera.height < 1 || camera.width > kMaxSide || camera.height > kMaxSide) {
    return who + " has the impossible size " + std::to_string(camera.width) + " x " +
           std::to_string(camera.height);
  }
  return "";
}

namespace {

void require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(message);
}

void check_offsets(const std::vector<std::uint64_t>& offsets, std::size_t records, std::size_t rows,
                   const char* message) {
  require(offsets.size() == records + 1 && offsets.front() == 0 && offsets.back() == rows &&
              std::is_sorted(offsets.begin(), offsets.end()),
          message);
}

}  // namespace

void check_columns(const std::vector<ColmapCamera>& cameras) {
  for (const ColmapCamera& camera : cameras) {
    const std::string problem = camera_problem(camera);
    require(problem.empty(), problem.c_str());
  }
}

void check_columns(const ColmapImages& images) {
  const std::size_t n = images.ids.size();
  require(images.camera_ids.size() == n && images.quats.size() == 4 * n &&
              images.translations.size() == 3 * n && images.names.size() == n,
          "images: camera_ids [N], quats [N, 4], translations [N, 3] and names [N] must match ids [N]");
  check_offsets(images.point2d_offsets, n, images.point3d_ids.size(),
                "images: point2d_offsets [N + 1] must rise from 0 to the number of observations");
  require(images.points2d.size() == 2 * images.point3d_ids.size(),
          "images: points2d [O, 2] must match point3d_ids [O]");
  for (const std::string& name : images.names) {
    require(!name.empty() && name.find('\0') == std::string::npos && name.find('\n') == std::string::npos,
            "images: a name is empty or has a NUL or line break in it");
  }
}

void check_columns(const ColmapPoints& points) {
  const std::size_t n = points.ids.size();
  require(points.positions.size() == 3 * n && points.colors.size() == 3 * n && points.errors.size() == n,
          "points: positions [M, 3], colors [M, 3] and errors [M] must match ids [M]");
  check_offsets(points.track_offsets, n, points.track_image_ids.size(),
                "points: track_offsets [M + 1] must rise from 0 to the number of track elements");
  require(points.track_point2d_ids.size() == points.track_image_ids.size(),
          "points: track_point2d_ids must match track_image_ids");
}

}  // namespace blitzgs::io
