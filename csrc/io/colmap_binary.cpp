// SPDX-License-Identifier: Apache-2.0
#include "io/colmap.h"

namespace blitzgs::io {

namespace {

constexpr std::uint64_t kCameraBytes = 4 + 4 + 8 + 8;         // without the parameters
constexpr std::uint64_t kImageBytes = 4 + 7 * 8 + 4 + 1 + 8;  // with an empty name and no observations
constexpr std::uint64_t kPoint2dBytes = 2 * 8 + 8;
constexpr std::uint64_t kPointBytes = 8 + 3 * 8 + 3 + 8 + 8;  // with an empty track
constexpr std::uint64_t kTrackBytes = 4 + 4;

}  // namespace

std::vector<ColmapCamera> read_cameras_binary(std::istream& in, const std::string& name) {
  ByteReader reader(in, name);
  const std::uint64_t n = reader.read_count(kCameraBytes, "cameras");
  std::vector<ColmapCamera> cameras(n);
  for (ColmapCamera& camera : cameras) {
    camera.id = reader.read<std::uint32_t>("a camera id");
    camera.model = reader.read<std::int32_t>("a camera model id");
    camera.width = reader.read<std::uint64_t>("a camera width");
    camera.height = reader.read<std::uint64_t>("a camera height");
    if (const CameraModel* model = find_camera_model(camera.model)) camera.params.resize(model->num_params);
    if (const std::string problem = camera_problem(camera); !problem.empty()) reader.fail(problem);
    reader.read_bytes(camera.params.data(), 8 * camera.params.size(), "camera parameters");
  }
  reader.expect_end();
  return cameras;
}

ColmapImages read_images_binary(std::istream& in, const std::string& name, bool with_points2d) {
  ByteReader reader(in, name);
  const std::uint64_t n = reader.read_count(kImageBytes, "images");
  ColmapImages images;
  images.ids.resize(n);
  images.camera_ids.resize(n);
  images.quats.resize(4 * n);
  images.translations.resize(3 * n);
  images.names.resize(n);
  images.point2d_offsets.assign(n + 1, 0);
  for (std::uint64_t i = 0; i < n; ++i) {
    images.ids[i] = reader.read<std::uint32_t>("an image id");
    reader.read_bytes(&images.quats[4 * i], 4 * 8, "an image rotation");
    reader.read_bytes(&images.translations[3 * i], 3 * 8, "an image translation");
    images.camera_ids[i] = reader.read<std::uint32_t>("the camera id of an image");
    images.names[i] = reader.read_c_string("an image name");
    if (images.names[i].empty()) reader.fail("image " + std::to_string(images.ids[i]) + " has no name");
    const std::uint64_t count = reader.read_count(kPoint2dBytes, "observations");
    if (!with_points2d) {
      reader.skip(count * kPoint2dBytes, "observations");
      continue;
    }
    const std::uint64_t begin = images.point3d_ids.size();
    images.points2d.resize(2 * (begin + count));
    images.point3d_ids.resize(begin + count);
    for (std::uint64_t k = begin; k < begin + count; ++k) {
      reader.read_bytes(&images.points2d[2 * k], 2 * 8, "an observation");
      images.point3d_ids[k] = reader.read<std::int64_t>("the point id of an observation");
    }
    images.point2d_offsets[i + 1] = begin + count;
  }
  reader.expect_end();
  return images;
}

ColmapPoints read_points_binary(std::istream& in, const std::string& name, bool with_tracks) {
  ByteReader reader(in, name);
  const std::uint64_t n = reader.read_count(kPointBytes, "points");
  ColmapPoints points;
  points.ids.resize(n);
  points.positions.resize(3 * n);
  points.colors.resize(3 * n);
  points.errors.resize(n);
  points.track_offsets.assign(n + 1, 0);
  for (std::uint64_t i = 0; i < n; ++i) {
    points.ids[i] = reader.read<std::int64_t>("a point id");
    reader.read_bytes(&points.positions[3 * i], 3 * 8, "a point position");
    reader.read_bytes(&points.colors[3 * i], 3, "a point colour");
    points.errors[i] = reader.read<double>("a point error");
    const std::uint64_t length = reader.read_count(kTrackBytes, "track elements");
    points.track_offsets[i + 1] = points.track_offsets[i] + length;
    if (!with_tracks) {
      reader.skip(length * kTrackBytes, "a track");
      continue;
    }
    points.track_image_ids.resize(points.track_offsets[i + 1]);
    points.track_point2d_ids.resize(points.track_offsets[i + 1]);
    for (std::uint64_t k = points.track_offsets[i]; k < points.track_offsets[i + 1]; ++k) {
      points.track_image_ids[k] = reader.read<std::uint32_t>("the image id of a track element");
      points.track_point2d_ids[k] = reader.read<std::uint32_t>("the observation of a track element");
    }
  }
  reader.expect_end();
  return points;
}

}  // namespace blitzgs::io
