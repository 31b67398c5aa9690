// SPDX-License-Identifier: Apache-2.0
#include "io/colmap.h"
#include "io/text_reader.h"

namespace blitzgs::io {

namespace {

// Without the empty line of an image that has no observations, the next image stands here and would be lost.
void skip_observations(TextReader& reader) {
  std::uint64_t tokens = 0;
  std::string_view last;
  for (; reader.has_token(); ++tokens) last = reader.token("an observation");
  std::int64_t id = 0;
  if (tokens % 3 != 0 || (tokens > 0 && !parse_number(last, id))) {
    reader.fail(
        "expected the observations of an image (x, y and point id of each), which may be an empty line");
  }
}

}  // namespace

std::vector<ColmapCamera> read_cameras_text(std::istream& in, const std::string& name) {
  TextReader reader(in, name);
  std::vector<ColmapCamera> cameras;
  while (reader.next_record()) {
    ColmapCamera camera;
    camera.id = reader.number<std::uint32_t>("camera id");
    const std::string model(reader.token("the camera model"));
    const CameraModel* known = find_camera_model(model);
    if (!known) reader.fail("camera " + std::to_string(camera.id) + " has the unknown model " + model);
    camera.model = known->id;
    camera.width = reader.number<std::uint64_t>("camera width");
    camera.height = reader.number<std::uint64_t>("camera height");
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
    images.ids.push_back(reader.number<std::uint32_t>("image id"));
    for (int k = 0; k < 4; ++k) images.quats.push_back(reader.number<double>("rotation"));
    for (int k = 0; k < 3; ++k) images.translations.push_back(reader.number<double>("translation"));
    images.camera_ids.push_back(reader.number<std::uint32_t>("camera id"));
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
        images.point3d_ids.push_back(reader.number<std::int64_t>("observation point id"));
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
    points.ids.push_back(reader.number<std::int64_t>("point id"));
    for (int k = 0; k < 3; ++k) points.positions.push_back(reader.number<double>("coordinate"));
    for (int k = 0; k < 3; ++k) points.colors.push_back(reader.number<std::uint8_t>("colour (0 to 255)"));
    points.errors.push_back(reader.number<double>("error"));
    std::uint64_t length = 0;
    for (; reader.has_token(); ++length) {
      const auto image_id = reader.number<std::uint32_t>("track image id");
      const auto point2d_id = reader.number<std::uint32_t>("track observation");
      if (!with_tracks) continue;
      points.track_image_ids.push_back(image_id);
      points.track_point2d_ids.push_back(point2d_id);
    }
    points.track_offsets.push_back(points.track_offsets.back() + length);
  }
  return points;
}

}  // namespace blitzgs::io
