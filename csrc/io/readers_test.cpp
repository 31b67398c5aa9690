// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <cmath>
#include <functional>
#include <optional>

#include "common/catch.h"
#include "io/byte_reader.h"
#include "io/colmap.h"
#include "io/ply.h"

using blitzgs::next_random;
using namespace blitzgs::io;

namespace {

using Reader = std::function<void(std::istream&)>;
// The bytes of values, one after the other; a text ends with a NUL.
template <class... T> std::string bytes_of(const T&... values) {
  std::string out;
  const auto add = [&]<class V>(const V& value) {
    if constexpr (std::is_convertible_v<V, std::string>) {
      out += std::string(value) + '\0';
    } else {
      out.append(reinterpret_cast<const char*>(&value), sizeof value);
    }
  };
  (add(values), ...);
  return out;
}

using u32 = uint32_t;
using u64 = uint64_t;
using i64 = int64_t;

const std::string kCameras = bytes_of(u64{2}, u32{5}, 1, u64{640}, u64{480}, 500.0, 510.0, 320.0, 240.0) +
                             bytes_of(u32{6}, 3, u64{64}, u64{48}, 50.0, 32.0, 24.0, 1e-17, -0.1);
const std::string kImages =
    bytes_of(u64{2}, u32{3}, 1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, u32{5}, "a.jpg", u64{2}, 1.5, 2.5, i64{-1},
             -3.0, 4.0, i64{7}) +
    bytes_of(u32{9}, 0.5, -0.5, 0.5, 0.5, -4.0, 5e-300, 6.0, u32{6}, "b/c.png", u64{0});
const std::string kPoints =
    bytes_of(u64{2}, i64{7}, 0.0, 1.0, 2.0, std::array<uint8_t, 3>{255, 0, 1}, 0.25, u64{1}, u32{3}, u32{1}) +
    bytes_of(i64{8}, 3.0, 4.0, 5.0, std::array<uint8_t, 3>{2, 3, 4}, -1.0, u64{2}, u32{3}, u32{0}, u32{9},
             u32{0});
const std::string kCamerasText = "5 PINHOLE 640 480 500 510 320 240\n6 RADIAL 64 48 50 32 24 1e-17 -0.1\n";
const std::string kImagesText =
    "3 1 0 0 0 1 2 3 5 a.jpg\n1.5 2.5 -1 -3 4 7\n9 0.5 -0.5 0.5 0.5 -4 5e-300 6 6 b/c.png\n\n";
const std::string kPointsText = "7 0 1 2 255 0 1 0.25 3 1\n8 3 4 5 2 3 4 -1 3 0 9 0\n";

struct Format {
  const char* name;
  std::string bytes;
  Reader read;
  bool is_text = false;
};

std::vector<Format> formats() {
  return {
      {"cameras", kCameras, [](std::istream& in) { read_cameras_binary(in, "f"); }},
      {"images", kImages, [](std::istream& in) { read_images_binary(in, "f", true); }},
      {"images without observations", kImages, [](std::istream& in) { read_images_binary(in, "f", false); }},
      {"points", kPoints, [](std::istream& in) { read_points_binary(in, "f", true); }},
      {"points without tracks", kPoints, [](std::istream& in) { read_points_binary(in, "f", false); }},
      {"text of cameras", kCamerasText, [](std::istream& in) { read_cameras_text(in, "f"); }, true},
      {"text of images", kImagesText, [](std::istream& in) { read_images_text(in, "f", true); }, true},
      {"text of points", kPointsText, [](std::istream& in) { read_points_text(in, "f", true); }, true}};
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

}  // namespace

TEST_CASE("every truncation of a binary COLMAP file is refused") {
  for (const Format& format : formats()) {
    if (format.is_text) continue;
    INFO(format.name);
    const std::string& bytes = format.bytes;
    REQUIRE_FALSE(refused(format, bytes));
    for (size_t n = 0; n < bytes.size(); ++n) REQUIRE(refused(format, bytes.substr(0, n)));
    REQUIRE(refused(format, bytes + '\0'));
  }
}

TEST_CASE("COLMAP files with wrong bytes are read or refused, never worse") {
  uint32_t state = 1;
  for (const Format& format : formats()) {
    INFO(format.name);
    int refusals = 0;
    for (int round = 0; round < 2000; ++round) {
      std::string damaged = format.bytes;
      for (int k = 0; k <= round % 4; ++k) {
        damaged[next_random(state) % damaged.size()] = char(next_random(state));
      }
      refusals += refused(format, damaged);
    }
    REQUIRE(refusals > 0);
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

namespace {

template <class T> std::optional<T> parsed(std::string_view text) {
  T value{};
  return parse_number(text, value) ? std::optional<T>(value) : std::nullopt;
}

}  // namespace

TEST_CASE("numbers may have a sign and end where their text ends") {
  REQUIRE(parsed<double>("+1.5e3") == 1500.0);
  REQUIRE(parsed<double>("-.5") == -0.5);
  REQUIRE(parsed<uint8_t>("+255") == 255);
  REQUIRE(parsed<int32_t>("-7") == -7);
  for (const char* text : {"", "+", "-", "+-1", "++1", " 1", "1 ", "1x", "0x1p3", "1e400x", "1,5"}) {
    CAPTURE(text);
    REQUIRE_FALSE(parsed<double>(text));
  }
}

TEST_CASE("real numbers beyond the range are zero or infinity with their sign, integers are refused") {
  const std::string small = "0." + std::string(400, '0') + "1", large(400, '9');
  REQUIRE(parsed<float>("1e-46") == 0.0f);
  REQUIRE(parsed<float>("1e39") == std::numeric_limits<float>::infinity());
  REQUIRE(parsed<float>("1e-40") == 1e-40f);
  for (const std::string& text : {std::string("1e-400"), small, std::string("1e-99999999999999999999")}) {
    REQUIRE(parsed<double>(text) == 0.0);
    REQUIRE_FALSE(std::signbit(*parsed<double>("+" + text)));
    REQUIRE(std::signbit(*parsed<double>("-" + text)));
  }
  for (const std::string& text : {std::string("1e400"), large, std::string("1e99999999999999999999")}) {
    REQUIRE(parsed<double>("+" + text) == std::numeric_limits<double>::infinity());
    REQUIRE(parsed<double>("-" + text) == -std::numeric_limits<double>::infinity());
  }
  REQUIRE_FALSE(parsed<uint8_t>("256"));
  REQUIRE_FALSE(parsed<int64_t>("9223372036854775808"));
}

// PLY

namespace {

const std::string kTable =
    std::string(
        "ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex 3\nproperty float x\n") +
    "property uchar n\nend_header\n" + std::string("\0\1\2\3\4\5\6\7\10\11\12\13\14\15\16", 15);

PlyTable parsed(const std::string& bytes) {
  std::istringstream in(bytes);
  return read_ply(in, "f");
}

bool refused(const std::string& bytes) {
  return refused({"ply", "", [](std::istream& in) { read_ply(in, "f"); }}, bytes);
}

}  // namespace

TEST_CASE("ASCII PLY may have signs, and numbers that its types do not hold") {
  const std::string file =
      "ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nproperty double b\nproperty uchar c\n"
      "end_header\n1e-46 -1e-400 ";
  REQUIRE(parsed(file + "+7").rows == std::vector<uint8_t>{0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 7});
  REQUIRE(refused(file));
}

TEST_CASE("elements around the vertices are passed over") {
  const std::string header =
      "ply\nformat ascii 1.0\nelement camera 2\nproperty float f\nelement vertex 1\nproperty int x\n"
      "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
  const PlyTable table = parsed(header + "1.5\n2.5\n7\n3 0 0 0\n");
  REQUIRE(table.rows == std::vector<uint8_t>{7, 0, 0, 0});
}

TEST_CASE("some rows are those rows of all") {
  const std::string header = "element vertex 4\nproperty uchar a\nproperty uchar b\nend_header\n";
  const std::string ascii = "ply\nformat ascii 1.0\n" + header + "1 2\n3 4\n5 6\n7 8\n";
  const std::string binary = "ply\nformat binary_big_endian 1.0\n" + header + "\1\2\3\4\5\6\7\10";
  for (const std::string& bytes : {ascii, binary}) {
    const auto rows = [&](uint64_t first, uint64_t most) {
      std::istringstream in(bytes);
      const PlyTable table = read_ply(in, "f", first, most);
      REQUIRE((table.total == 4 && table.rows.size() == 2 * table.count));
      return table.rows;
    };
    REQUIRE(rows(1, 2) == std::vector<uint8_t>{3, 4, 5, 6});
    REQUIRE(rows(3, 9) == std::vector<uint8_t>{7, 8});
    REQUIRE((rows(0, 0).empty() && rows(99, 1).empty()));
  }
}

TEST_CASE("every truncation of a PLY file is refused, and wrong bytes are never worse") {
  const std::string& bytes = kTable;
  for (size_t n = 0; n < bytes.size(); ++n) REQUIRE(refused(bytes.substr(0, n)));
  int refusals = 0;
  for (size_t at = 0; at < bytes.size(); ++at) {
    for (const int value : {0, 10, 32, 57, 128, 255}) {
      std::string damaged = bytes;
      damaged[at] = char(value);
      refusals += refused(damaged);
    }
  }
  REQUIRE(refusals > 100);
}

TEST_CASE("a PLY count beyond the file is refused before anything is allocated") {
  for (const char* format : {"ascii", "binary_little_endian"}) {
    for (const char* count : {"4", "18446744073709551615", "9223372036854775807"}) {
      const std::string head = std::string("ply\nformat ") + format + " 1.0\nelement vertex " + count;
      REQUIRE(refused(head + "\nproperty float x\nend_header\n1 2"));
      REQUIRE(refused(head + "\nend_header\n1 2"));
    }
  }
  REQUIRE(
      refused("ply\nformat binary_little_endian 1.0\nelement a 18446744073709551615\nproperty double q\n"
              "element vertex 1\nproperty float x\nend_header\n1234"));
}
