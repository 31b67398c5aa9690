// SPDX-License-Identifier: Apache-2.0
// COLMAP sparse models: cameras, images and points3D, binary and text, over standard streams.
//
// The formats are COLMAP's documented output format (colmap.github.io/format.html). Poses map world to
// camera: x_camera = R(q) x_world + t with q = (w, x, y, z). Pixel (i, j) has its centre at (i + 0.5,
// j + 0.5). Readers throw FormatError with the file, the byte offset (binary) or line (text) and the reason;
// every count is checked against the bytes left before anything is allocated, so memory stays within a small
// multiple of the file's size. Newer models also have rigs and frames files; they are not needed, because the
// images file still holds the pose of each image.
#pragma once
#include <iosfwd>

#include "io/byte_reader.h"

namespace blitzgs::io {

struct CameraModel {
  int id;
  std::string_view name;
  std::string_view params;  // names in file order, separated by commas
  int num_params;
};
// Every model of COLMAP 4.2, ordered by id.
const std::vector<CameraModel>& camera_models();
const CameraModel* find_camera_model(int id);
const CameraModel* find_camera_model(std::string_view name);

struct ColmapCamera {
  uint32_t id = 0;
  int model = 0;
  uint64_t width = 0;
  uint64_t height = 0;
  std::vector<double> params;
};

// N registered images, one column per field. Observations of image i are rows [point2d_offsets[i],
// point2d_offsets[i + 1]); all offsets are 0 if observations were not requested.
struct ColmapImages {
  std::vector<uint32_t> ids;
  std::vector<uint32_t> camera_ids;
  std::vector<double> quats;         // [N, 4] w, x, y, z
  std::vector<double> translations;  // [N, 3]
  std::vector<std::string> names;
  std::vector<uint64_t> point2d_offsets;  // [N + 1]
  std::vector<double> points2d;           // [O, 2] pixels
  std::vector<int64_t> point3d_ids;       // [O], -1 = no 3D point
};

// M points. The track of point i is rows [track_offsets[i], track_offsets[i + 1]). The offsets are always
// filled in; the rows are empty if tracks were not requested.
struct ColmapPoints {
  std::vector<int64_t> ids;
  std::vector<double> positions;  // [M, 3]
  std::vector<uint8_t> colors;    // [M, 3]
  std::vector<double> errors;     // [M] mean reprojection error in pixels, -1 = unknown
  std::vector<uint64_t> track_offsets;
  std::vector<uint32_t> track_image_ids;
  std::vector<uint32_t> track_point2d_ids;
};

std::vector<ColmapCamera> read_cameras_binary(std::istream& in, const std::string& name);
ColmapImages read_images_binary(std::istream& in, const std::string& name, bool with_points2d);
ColmapPoints read_points_binary(std::istream& in, const std::string& name, bool with_tracks);

std::vector<ColmapCamera> read_cameras_text(std::istream& in, const std::string& name);
ColmapImages read_images_text(std::istream& in, const std::string& name, bool with_points2d);
ColmapPoints read_points_text(std::istream& in, const std::string& name, bool with_tracks);

// Returns why a camera cannot be used, or an empty string.
std::string camera_problem(const ColmapCamera& camera);

}  // namespace blitzgs::io
