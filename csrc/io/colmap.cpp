// SPDX-License-Identifier: Apache-2.0
#include <iterator>

#include "io/byte_reader.h"
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
  const auto& models = camera_models();  // ordered by id
  return id >= 0 && id < std::ssize(models) ? &models[size_t(id)] : nullptr;
}

const CameraModel* find_camera_model(std::string_view name) {
  for (const CameraModel& model : camera_models()) {
    if (model.name == name) return &model;
  }
  return nullptr;
}

std::string camera_problem(const ColmapCamera& camera) {
  constexpr uint64_t kMaxSide = std::numeric_limits<int32_t>::max();
  const std::string who = "camera " + std::to_string(camera.id);
  const CameraModel* model = find_camera_model(camera.model);
  if (!model) return who + " has the unknown model id " + std::to_string(camera.model);
  if (camera.params.size() != size_t(model->num_params)) {
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

constexpr uint64_t kCameraBytes = 4 + 4 + 8 + 8;         // without the parameters
constexpr uint64_t kImageBytes = 4 + 7 * 8 + 4 + 1 + 8;  // with an empty name and no observations
constexpr uint64_t kPoint2dBytes = 2 * 8 + 8;
constexpr uint64_t kPointBytes = 8 + 3 * 8 + 3 + 8 + 8;  // with an empty track
constexpr uint64_t kTrackBytes = 4 + 4;

// Without the empty line of an image that has no observations, the next image stands here and would be lost.
void skip_observations(TextReader& reader) {
  uint64_t tokens = 0;
  std::string_view last;
  for (; reader.has_token(); ++tokens) last = reader.token("an observation");
  int64_t id = 0;
  if (tokens % 3 != 0 || (tokens > 0 && !parse_number(last, id))) {
    reader.fail(
        "expected the observations of an image (x, y and point id of each), which may be an empty line");
  }
}

}  // namespace

std::vector<ColmapCamera> read_cameras_binary(std::istream& in, const std::string& name) {
  ByteReader reader(in, name);
  const uint64_t n = reader.read_count(kCameraBytes, "cameras");
  std::vector<ColmapCamera> cameras(n);
  for (ColmapCamera& camera : cameras) {
    camera.id = reader.read<uint32_t>("a camera id");
    camera.model = reader.read<int32_t>("a camera model id");
    camera.width = reader.read<uint64_t>("a camera width");
    camera.height = reader.read<uint64_t>("a camera height");
    if (const CameraModel* model = find_camera_model(camera.model)) camera.params.resize(model->num_params);
    if (const std::string problem = camera_problem(camera); !problem.empty()) reader.fail(problem);
    reader.read_bytes(camera.params.data(), 8 * camera.params.size(), "camera parameters");
  }
  reader.expect_end();
  return cameras;
}

ColmapImages read_images_binary(std::istream& in, const std::string& name, bool with_points2d) {
  ByteReader reader(in, name);
  const uint64_t n = reader.read_count(kImageBytes, "images");
  ColmapImages images;
  images.ids.resize(n);
  images.camera_ids.resize(n);
  images.quats.resize(4 * n);
  images.translations.resize(3 * n);
  images.names.resize(n);
  images.point2d_offsets.assign(n + 1, 0);
  for (uint64_t i = 0; i < n; ++i) {
    images.ids[i] = reader.read<uint32_t>("an image id");
    reader.read_bytes(&images.quats[4 * i], 4 * 8, "an image rotation");
    reader.read_bytes(&images.translations[3 * i], 3 * 8, "an image translation");
    images.camera_ids[i] = reader.read<uint32_t>("the camera id of an image");
    images.names[i] = reader.read_c_string("an image name");
    if (images.names[i].empty()) reader.fail("image " + std::to_string(images.ids[i]) + " has no name");
    const uint64_t count = reader.read_count(kPoint2dBytes, "observations");
    if (!with_points2d) {
      reader.skip(count * kPoint2dBytes, "observations");
      continue;
    }
    const uint64_t begin = images.point3d_ids.size();
    images.points2d.resize(2 * (begin + count));
    images.point3d_ids.resize(begin + count);
    for (uint64_t k = begin; k < begin + count; ++k) {
      reader.read_bytes(&images.points2d[2 * k], 2 * 8, "an observation");
      images.point3d_ids[k] = reader.read<int64_t>("the point id of an observation");
    }
    images.point2d_offsets[i + 1] = begin + count;
  }
  reader.expect_end();
  return images;
}

ColmapPoints read_points_binary(std::istream& in, const std::string& name, bool with_tracks) {
  ByteReader reader(in, name);
  const uint64_t n = reader.read_count(kPointBytes, "points");
  ColmapPoints points;
  points.ids.resize(n);
  points.positions.resize(3 * n);
  points.colors.resize(3 * n);
  points.errors.resize(n);
  points.track_offsets.assign(n + 1, 0);
  for (uint64_t i = 0; i < n; ++i) {
    points.ids[i] = reader.read<int64_t>("a point id");
    reader.read_bytes(&points.positions[3 * i], 3 * 8, "a point position");
    reader.read_bytes(&points.colors[3 * i], 3, "a point colour");
    points.errors[i] = reader.read<double>("a point error");
    const uint64_t length = reader.read_count(kTrackBytes, "track elements");
    points.track_offsets[i + 1] = points.track_offsets[i] + length;
    if (!with_tracks) {
      reader.skip(length * kTrackBytes, "a track");
      continue;
    }
    points.track_image_ids.resize(points.track_offsets[i + 1]);
    points.track_point2d_ids.resize(points.track_offsets[i + 1]);
    for (uint64_t k = points.track_offsets[i]; k < points.track_offsets[i + 1]; ++k) {
      points.track_image_ids[k] = reader.read<uint32_t>("the image id of a track element");
      points.track_point2d_ids[k] = reader.read<uint32_t>("the observation of a track element");
    }
  }
  reader.expect_end();
  return points;
}

std::vector<ColmapCamera> read_cameras_text(std::istream& in, const std::string& name) {
  TextReader reader(in, name);
  std::vector<ColmapCamera> cameras;
  while (reader.next_record()) {
    ColmapCamera camera;
    camera.id = reader.number<uint32_t>("camera id");
    const std::string model(reader.token("the camera model"));
    const CameraModel* known = find_camera_model(model);
    if (!known) reader.fail("camera " + std::to_string(camera.id) + " has the unknown model " + model);
    camera.model = known->id;
    camera.width = reader.number<uint64_t>("camera width");
    camera.height = reader.number<uint64_t>("camera height");
    while (reader.has_token()) camera.params.push_back(reader.number<double>("camera parameter"));
    if (const std::string problem = camera_problem(camera); !problem.empty()) reader.fail(problem);
    cameras.push_back(std::move(camera));
  }
  return cameras;
}

ColmapImages read_images_text(std::istream& in, const std::string& name, bool with_points2d) {
  TextReader reader(in, name);
  ColmapImages images;
  images.point2d_offsets.push_back(0);
  while (reader.next_record()) {
    images.ids.push_back(reader.number<uint32_t>("image id"));
    for (int k = 0; k < 4; ++k) images.quats.push_back(reader.number<double>("rotation"));
    for (int k = 0; k < 3; ++k) images.translations.push_back(reader.number<double>("translation"));
    images.camera_ids.push_back(reader.number<uint32_t>("camera id"));
    images.names.emplace_back(reader.rest());  // a name may have blanks in it
    if (images.names.back().empty()) {
      reader.fail("image " + std::to_string(images.ids.back()) + " has no name");
    }
    // Every image has a line of observations, which may be empty; only the last one may be missing.
    const bool has_line = reader.next_line();
    if (has_line && !with_points2d) skip_observations(reader);
    if (has_line && with_points2d) {
      while (reader.has_token()) {
        images.points2d.push_back(reader.number<double>("observation x"));
        images.points2d.push_back(reader.number<double>("observation y"));
        images.point3d_ids.push_back(reader.number<int64_t>("observation point id"));
      }
    }
    images.point2d_offsets.push_back(images.point3d_ids.size());
  }
  return images;
}

ColmapPoints read_points_text(std::istream& in, const std::string& name, bool with_tracks) {
  TextReader reader(in, name);
  ColmapPoints points;
  points.track_offsets.push_back(0);
  while (reader.next_record()) {
    points.ids.push_back(reader.number<int64_t>("point id"));
    for (int k = 0; k < 3; ++k) points.positions.push_back(reader.number<double>("coordinate"));
    for (int k = 0; k < 3; ++k) points.colors.push_back(reader.number<uint8_t>("colour (0 to 255)"));
    points.errors.push_back(reader.number<double>("error"));
    uint64_t length = 0;
    for (; reader.has_token(); ++length) {
      const auto image_id = reader.number<uint32_t>("track image id");
      const auto point2d_id = reader.number<uint32_t>("track observation");
      if (!with_tracks) continue;
      points.track_image_ids.push_back(image_id);
      points.track_point2d_ids.push_back(point2d_id);
    }
    points.track_offsets.push_back(points.track_offsets.back() + length);
  }
  return points;
}

}  // namespace blitzgs::io
