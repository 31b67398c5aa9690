// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>

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

}  // namespace blitzgs::io
