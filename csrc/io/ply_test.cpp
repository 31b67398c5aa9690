// SPDX-License-Identifier: Apache-2.0
#include "io/ply.h"

#include <sstream>

#include "common/catch.h"

using namespace blitzgs::io;

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
  try {
    parsed(bytes);
    return false;
  } catch (const FormatError&) {
    return true;
  }
}

}  // namespace

TEST_CASE("a PLY table is its rows, properties and comments") {
  const PlyTable found = parsed(kTable);
  REQUIRE(found.count == 3);
  REQUIRE(found.rows == std::vector<std::uint8_t>{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14});
  REQUIRE(found.comments == std::vector<std::string>{"comment by hand"});
  REQUIRE((found.properties[0].type == PlyType::kFloat32 && found.properties[1].name == "n"));
}

TEST_CASE("ASCII and big-endian PLY give the rows of the little-endian one") {
  const std::string header = "element vertex 2\r\nproperty short a\r\nproperty float64 b\r\nend_header\r\n";
  const PlyTable text = parsed("ply\r\nformat ascii 1.0\r\n" + header + "1 -2.5\r\n-3 1e10");
  std::string big = "ply\r\nformat binary_big_endian 1.0\r\n" + header;
  big += std::string("\x00\x01\xc0\x04\x00\x00\x00\x00\x00\x00", 10);
  big += std::string("\xff\xfd\x42\x02\xa0\x5f\x20\x00\x00\x00", 10);
  REQUIRE(parsed(big).rows == text.rows);
  REQUIRE(text.rows.size() == 20);
}

TEST_CASE("ASCII PLY may have signs, and numbers that its types do not hold") {
  const PlyTable table = parsed(
      "ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nproperty double b\nproperty uchar c\n"
      "end_header\n1e-46 -1e-400 +7\n");
  REQUIRE(table.rows == std::vector<std::uint8_t>{0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 7});
}

TEST_CASE("elements around the vertices are passed over") {
  const std::string header =
      "ply\nformat ascii 1.0\nelement camera 2\nproperty float f\nelement vertex 1\nproperty int x\n"
      "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
  const PlyTable table = parsed(header + "1.5\n2.5\n7\n3 0 0 0\n");
  REQUIRE(table.rows == std::vector<std::uint8_t>{7, 0, 0, 0});
}

TEST_CASE("some rows are those rows of all") {
  const std::string header = "element vertex 4\nproperty uchar a\nproperty uchar b\nend_header\n";
  const std::string ascii = "ply\nformat ascii 1.0\n" + header + "1 2\n3 4\n5 6\n7 8\n";
  const std::string binary = "ply\nformat binary_big_endian 1.0\n" + header + "\1\2\3\4\5\6\7\10";
  for (const std::string& bytes : {ascii, binary}) {
    const auto rows = [&](std::uint64_t first, std::uint64_t most) {
      std::istringstream in(bytes);
      const PlyTable table = read_ply(in, "f", first, most);
      REQUIRE((table.total == 4 && table.rows.size() == 2 * table.count));
      return table.rows;
    };
    REQUIRE(rows(1, 2) == std::vector<std::uint8_t>{3, 4, 5, 6});
    REQUIRE(rows(3, 9) == std::vector<std::uint8_t>{7, 8});
    REQUIRE((rows(0, 0).empty() && rows(99, 1).empty()));
  }
}

TEST_CASE("every truncation of a PLY file is refused, and wrong bytes are never worse") {
  const std::string& bytes = kTable;
  for (std::size_t n = 0; n < bytes.size(); ++n) REQUIRE(refused(bytes.substr(0, n)));
  int refusals = 0;
  for (std::size_t at = 0; at < bytes.size(); ++at) {
    for (const int value : {0, 10, 32, 57, 128, 255}) {
      std::string damaged = bytes;
      damaged[at] = static_cast<char>(value);
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
