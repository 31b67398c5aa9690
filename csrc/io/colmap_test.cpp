// SPDX-License-Identifier: Apache-2.0
#include "io/colmap.h"

#include <functional>
#include <sstream>

#include "common/catch.h"

using namespace blitzgs::io;

namespace {

using Reader = std::function<void(std::istream&)>;
using Writer = std::function<void(std::ostream&)>;

std::vector<ColmapCamera> some_cameras() {
  std::vector<ColmapCamera> cameras;
  for (const CameraModel& model : camera_models()) {
    ColmapCamera camera{static_cast<std::uint32_t>(model.id + 1), model.id, 640, 480, {}};
    for (int k = 0; k < model.num_params; ++k) camera.params.push_back(0.1 * k + 1e-17);
    cameras.push_back(camera);
  }
  return cameras;
}

ColmapImages some_images() {
  return {{3, 9},
          {1, 2},
          {1, 0, 0, 0, 0.5, -0.5, 0.5, 0.5},
          {1, 2, 3, -4, 5e-300, 6},
          {"a.jpg", "b/c.png"},
          {0, 2, 2},
          {1.5, 2.5, -3, 4},
          {-1, 7}};
}

ColmapPoints some_points() {
  return {{7, 8}, {0, 1, 2, 3, 4, 5}, {255, 0, 1, 2, 3, 4}, {0.25, -1}, {0, 1, 3}, {3, 3, 9}, {1, 0, 0}};
}

struct Format {
  const char* name;
  Writer write;
  Reader read;
};

std::vector<Format> binary_formats() {
  return {{"cameras", [](std::ostream& out) { write_cameras_binary(out, some_cameras()); },
           [](std::istream& in) { read_cameras_binary(in, "f"); }},
          {"images", [](std::ostream& out) { write_images_binary(out, some_images()); },
           [](std::istream& in) { read_images_binary(in, "f", true); }},
          {"images without observations", [](std::ostream& out) { write_images_binary(out, some_images()); },
           [](std::istream& in) { read_images_binary(in, "f", false); }},
          {"points", [](std::ostream& out) { write_points_binary(out, some_points()); },
           [](std::istream& in) { read_points_binary(in, "f", true); }},
          {"points without tracks", [](std::ostream& out) { write_points_binary(out, some_points()); },
           [](std::istream& in) { read_points_binary(in, "f", false); }}};
}

std::vector<Format> text_formats() {
  return {{"cameras", [](std::ostream& out) { write_cameras_text(out, some_cameras()); },
           [](std::istream& in) { read_cameras_text(in, "f"); }},
          {"images", [](std::ostream& out) { write_images_text(out, some_images()); },
           [](std::istream& in) { read_images_text(in, "f", true); }},
          {"points", [](std::ostream& out) { write_points_text(out, some_points()); },
           [](std::istream& in) { read_points_text(in, "f", true); }}};
}

std::string written(const Format& format) {
  std::ostringstream out;
  format.write(out);
  return out.str();
}

// Whether the bytes are refused; anything but success or FormatError fails the test.
bool refused(const Format& format, const std::string& bytes) {
  std::istringstream in(bytes);
  try {
    format.read(in);
    return false;
  } catch (const FormatError&) {
    return true;
  }
}

// Deterministic noise (splitmix64).
std::uint64_t next_random(std::uint64_t& state) {
  state += 0x9e3779b97f4a7c15ULL;
  std::uint64_t z = state;
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
  return z ^ (z >> 31);
}

}  // namespace

TEST_CASE("COLMAP cameras survive both formats") {
  for (const bool text : {false, true}) {
    std::stringstream file;
    text ? write_cameras_text(file, some_cameras()) : write_cameras_binary(file, some_cameras());
    const auto found = text ? read_cameras_text(file, "f") : read_cameras_binary(file, "f");
    const auto expected = some_cameras();
    REQUIRE(found.size() == expected.size());
    for (std::size_t i = 0; i < found.size(); ++i) {
      REQUIRE(found[i].id == expected[i].id);
      REQUIRE(found[i].model == expected[i].model);
      REQUIRE(found[i].width == expected[i].width);
      REQUIRE(found[i].height == expected[i].height);
      REQUIRE(found[i].params == expected[i].params);
    }
  }
}

TEST_CASE("COLMAP images survive both formats") {
  for (const bool text : {false, true}) {
    std::stringstream file;
    text ? write_images_text(file, some_images()) : write_images_binary(file, some_images());
    const auto found = text ? read_images_text(file, "f", true) : read_images_binary(file, "f", true);
    const auto expected = some_images();
    REQUIRE(found.ids == expected.ids);
    REQUIRE(found.camera_ids == expected.camera_ids);
    REQUIRE(found.quats == expected.quats);
    REQUIRE(found.translations == expected.translations);
    REQUIRE(found.names == expected.names);
    REQUIRE(found.point2d_offsets == expected.point2d_offsets);
    REQUIRE(found.points2d == expected.points2d);
    REQUIRE(found.point3d_ids == expected.point3d_ids);
  }
}

TEST_CASE("COLMAP points survive both formats") {
  for (const bool text : {false, true}) {
    std::stringstream file;
    text ? write_points_text(file, some_points()) : write_points_binary(file, some_points());
    const auto found = text ? read_points_text(file, "f", true) : read_points_binary(file, "f", true);
    const auto expected = some_points();
    REQUIRE(found.ids == expected.ids);
    REQUIRE(found.positions == expected.positions);
    REQUIRE(found.colors == expected.colors);
    REQUIRE(found.errors == expected.errors);
    REQUIRE(found.track_offsets == expected.track_offsets);
    REQUIRE(found.track_image_ids == expected.track_image_ids);
    REQUIRE(found.track_point2d_ids == expected.track_point2d_ids);
  }
}

TEST_CASE("every truncation of a binary COLMAP file is refused") {
  for (const Format& format : binary_formats()) {
    INFO(format.name);
    const std::string bytes = written(format);
    REQUIRE_FALSE(refused(format, bytes));
    for (std::size_t n = 0; n < bytes.size(); ++n) REQUIRE(refused(format, bytes.substr(0, n)));
    REQUIRE(refused(format, bytes + '\0'));
  }
}

TEST_CASE("COLMAP files with wrong bytes are read or refused, never worse") {
  std::uint64_t state = 1;
  std::vector<Format> formats = binary_formats();
  const auto text = text_formats();
  formats.insert(formats.end(), text.begin(), text.end());
  for (const Format& format : formats) {
    INFO(format.name);
    const std::string bytes = written(format);
    int refusals = 0;
    for (int round = 0; round < 2000; ++round) {
      std::string damaged = bytes;
      for (std::uint64_t k = 0; k <= round % 4u; ++k) {
        damaged[next_random(state) % damaged.size()] = static_cast<char>(next_random(state));
      }
      refusals += refused(format, damaged);
    }
    REQUIRE(refusals > 0);
  }
}

TEST_CASE("a count beyond the file is refused before anything is allocated") {
  for (const Format& format : binary_formats()) {
    for (const char* count : {"\xff\xff\xff\xff\xff\xff\xff\xff", "\xff\xff\xff\xff\xff\xff\xff\x7f",
                              "\x01\x00\x00\x00\x00\x00\x00\x40"}) {
      std::string bytes = written(format);
      bytes.replace(0, 8, count, 8);
      REQUIRE(refused(format, bytes));
    }
  }
}

TEST_CASE("messages say file, place and reason in printable characters") {
  std::istringstream cut(std::string("\x02\0\0\0\0\0\0\0", 8) + std::string(60, 'x'));
  REQUIRE_THROWS_WITH(read_cameras_binary(cut, "c.bin"),
                      "c.bin: at byte 32: camera 2021161080 has the unknown model id "
                      "2021161080");
  std::istringstream text("# comment\n1 PINHOLE 4 3 1 2 \x80 4\n");
  REQUIRE_THROWS_WITH(read_cameras_text(text, "c.txt"),
                      "c.txt: line 2: '\\x80' is not a valid camera parameter");
}

TEST_CASE("an image in the place of observations is refused, whether these are read or not") {
  const std::string header = "\xef\xbb\xbf# a byte order mark comes before\n";
  const std::string first = "1 1 0 0 0 0 0 0 1 a.jpg\n", second = "2 1 0 0 0 0 0 0 1 b.jpg\n";
  for (const bool with_points2d : {false, true}) {
    std::istringstream whole(header + first + "\n" + second + "1.5 2 -1 3 4 7\n");
    REQUIRE(read_images_text(whole, "i.txt", with_points2d).names.size() == 2);
    std::istringstream joined(header + first + second);
    REQUIRE_THROWS_AS(read_images_text(joined, "i.txt", with_points2d), FormatError);
    std::istringstream torn(header + first + "1.5 2\n");
    REQUIRE_THROWS_AS(read_images_text(torn, "i.txt", with_points2d), FormatError);
    std::istringstream no_id(header + first + "1.5 2 x\n");
    REQUIRE_THROWS_AS(read_images_text(no_id, "i.txt", with_points2d), FormatError);
  }
}

TEST_CASE("columns that disagree are not written") {
  std::ostringstream out;
  ColmapImages images = some_images();
  images.quats.pop_back();
  REQUIRE_THROWS_AS(write_images_binary(out, images), std::invalid_argument);
  ColmapPoints points = some_points();
  points.track_offsets[1] = 9;
  REQUIRE_THROWS_AS(write_points_text(out, points), std::invalid_argument);
  auto cameras = some_cameras();
  cameras[0].params.pop_back();
  REQUIRE_THROWS_AS(write_cameras_binary(out, cameras), std::invalid_argument);
  REQUIRE(out.str().empty());
}
