// SPDX-License-Identifier: Apache-2.0
#include "io/image_header.h"

#include <string_view>
#include <vector>

#include "common/catch.h"

using namespace blitzgs::io;
using namespace std::string_view_literals;

namespace {

using Bytes = std::vector<std::uint8_t>;

Bytes bytes(std::string_view text) { return {text.begin(), text.end()}; }

void append(Bytes& out, const Bytes& more) { out.insert(out.end(), more.begin(), more.end()); }

// A directory entry of a little-endian TIFF with one SHORT.
Bytes entry(std::uint16_t tag, std::uint16_t value) {
  return {static_cast<std::uint8_t>(tag),   static_cast<std::uint8_t>(tag >> 8),   3, 0, 1, 0, 0, 0,
          static_cast<std::uint8_t>(value), static_cast<std::uint8_t>(value >> 8), 0, 0};
}

Bytes tiff(const std::vector<std::pair<std::uint16_t, std::uint16_t>>& tags) {
  Bytes out = {'I', 'I', 42, 0, 8, 0, 0, 0, static_cast<std::uint8_t>(tags.size()), 0};
  for (const auto& [tag, value] : tags) append(out, entry(tag, value));
  append(out, {0, 0, 0, 0});
  return out;
}

Bytes rgba(std::uint16_t extra, std::uint16_t orientation = 1) {
  return tiff({{256, 3}, {257, 2}, {258, 8}, {262, 2}, {274, orientation}, {277, 4}, {338, extra}});
}

ImageHeader read(const Bytes& file) { return read_image_header(file, "f"); }

std::string problem(const Bytes& file) {
  try {
    read(file);
    return "";
  } catch (const FormatError& error) {
    return error.what();
  }
}

}  // namespace

TEST_CASE("the fourth band of a TIFF is alpha if the file says so") {
  REQUIRE(read(rgba(0)).alpha == Alpha::kNone);
  REQUIRE(read(rgba(0)).extras == 1);
  REQUIRE(read(rgba(1)).alpha == Alpha::kAssociated);
  REQUIRE(read(rgba(2)).alpha == Alpha::kStraight);
  REQUIRE(read(rgba(2)).extras == 0);
  REQUIRE(read(tiff({{256, 3}, {257, 2}, {262, 2}, {277, 4}})).alpha == Alpha::kNone);
  REQUIRE(read(rgba(2, 6)).orientation == 6);
  REQUIRE(read(rgba(2, 9)).orientation == 1);
}

TEST_CASE("a TIFF is changed where a decoder would change its pixels") {
  REQUIRE(tiff_as_stored(rgba(0), "f").empty());
  REQUIRE(tiff_as_stored(rgba(1), "f").empty());
  REQUIRE(tiff_as_stored(rgba(2), "f") == rgba(1));
  REQUIRE(tiff_as_stored(rgba(0, 5), "f") == rgba(0));
  REQUIRE(tiff_as_stored(rgba(2, 5), "f") == rgba(1));
}

TEST_CASE("damaged and cut headers are refused") {
  const Bytes file = rgba(2);
  for (std::size_t n = 10; n < file.size() - 4; ++n) {
    REQUIRE_FALSE(problem(Bytes(file.begin(), file.begin() + static_cast<std::ptrdiff_t>(n))).empty());
  }
  REQUIRE(problem(tiff({{262, 2}})) == "f: damaged TIFF: it has no size");
  REQUIRE(problem(tiff({{256, 3}, {257, 2}, {262, 2}, {277, 1}})).find("too few bands") != std::string::npos);
  REQUIRE(problem(bytes("\xff\xd8\xff"sv)) == "f: truncated JPEG: the file ends inside its header");
  REQUIRE(problem(bytes("\x89PNG\r\n\x1a\n\0\0\0\x0d"sv)).find("truncated PNG") != std::string::npos);
}

TEST_CASE("formats are known by their content") {
  const auto format = [](std::string_view text) { return read(bytes(text)).format; };
  REQUIRE(format("8BPS\0\1"sv) == "Photoshop");
  REQUIRE(format("\0\0\0\x10"
                 "ftypheic\0\0\0\0"sv) == "HEIC");
  REQUIRE(format("\0\0\0\x14"
                 "ftypmif1\0\0\0\0avif"sv) == "AVIF");
  REQUIRE(format("RIFF\0\0\0\0WEBPVP8 "sv) == "WebP");
  REQUIRE(format("anything"sv).empty());
  REQUIRE(format(""sv).empty());
}
