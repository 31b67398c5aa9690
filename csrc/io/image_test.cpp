// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "common/catch.h"
#include "io/image_file.h"

using blitzgs::next_random;
using namespace blitzgs::io;
using namespace std::string_view_literals;

namespace {

using Bytes = std::vector<uint8_t>;

void append(Bytes& out, const Bytes& more) { out.insert(out.end(), more.begin(), more.end()); }

// The reason that a reader gives for refusing a file, or an empty string.
template <class F> std::string refusal(const F& read, const Bytes& file) {
  try {
    read(file);
    return "";
  } catch (const FormatError& error) {
    return error.what();
  }
}

// JPEG

Bytes segment(uint8_t marker, const Bytes& payload) {
  const size_t length = payload.size() + 2;
  Bytes out = {0xff, marker, uint8_t(length >> 8), uint8_t(length)};
  append(out, payload);
  return out;
}

// A Huffman table; symbols[k] are the symbols with codes of k + 1 bits.
Bytes table(uint8_t number, const std::vector<Bytes>& symbols) {
  Bytes payload = {number};
  for (size_t k = 0; k < 16; ++k) payload.push_back(uint8_t(k < symbols.size() ? symbols[k].size() : 0));
  for (const Bytes& some : symbols) append(payload, some);
  return segment(0xc4, payload);
}

// The headers of a grey image. DC codes: 0 (no bits), 10 (one bit). AC codes: 0 (end of block), 10 (one bit),
// 110 (sixteen zeros). A flat block is the bits 00.
Bytes head(uint8_t width, uint8_t height, uint8_t frame, uint8_t restart = 0) {
  Bytes out = {0xff, 0xd8};
  append(out, segment(0xe0, {'a', 'n', 'y', 0xff, 0xd9}));
  append(out, table(0x00, {{0x00}, {0x01}}));
  append(out, table(0x10, {{0x00}, {0x01}, {0xf0}}));
  if (restart) append(out, segment(0xdd, {0, restart}));
  append(out, segment(frame, {8, 0, height, 0, width, 1, 1, 0x11, 0}));
  return out;
}

Bytes jpeg(uint8_t width, uint8_t height, const Bytes& data, uint8_t frame = 0xc0, uint8_t restart = 0) {
  Bytes out = head(width, height, frame, restart);
  append(out, segment(0xda, {1, 1, 0x00, 0, 63, 0}));
  append(out, data);
  append(out, {0xff, 0xd9});
  return out;
}

// A progressive file of four blocks, of which the first has one coefficient beside the DC, in three scans.
Bytes progressive(const Bytes& dc, const Bytes& first, const Bytes& refinement) {
  Bytes out = head(16, 16, 0xc2);
  append(out, segment(0xda, {1, 1, 0x00, 0, 0, 0x00}));
  append(out, dc);
  append(out, segment(0xda, {1, 1, 0x00, 1, 63, 0x01}));
  append(out, first);
  append(out, segment(0xda, {1, 1, 0x00, 1, 63, 0x10}));
  append(out, refinement);
  append(out, {0xff, 0xd9});
  return out;
}

std::string problem(const Bytes& file) {
  return refusal([](const Bytes& jpeg) { check_jpeg(jpeg, "f"); }, file);
}

bool mentions(const Bytes& file, const char* reason) {
  return problem(file).find(reason) != std::string::npos;
}

}  // namespace

TEST_CASE("whole JPEGs pass") {
  REQUIRE(problem(jpeg(16, 16, {0x00})).empty());              // four blocks
  REQUIRE(problem(jpeg(17, 8, {0x03})).empty());               // three blocks and padding
  REQUIRE(problem(jpeg(16, 16, {0x00, 0x00, 0x00})).empty());  // zeros that a camera appended
  REQUIRE(problem(jpeg(8, 8, {0xb1})).empty());                // a DC and an AC code with a bit each
  REQUIRE(problem(jpeg(24, 8, {0x3f, 0xff, 0xd0, 0x3f, 0xff, 0xd1, 0x3f}, 0xc0, 1)).empty());
  REQUIRE(problem(jpeg(8, 8, {0x12, 0xff, 0x00, 0x34}, 0xc9)).empty());  // arithmetic codes: markers alone
  Bytes followed = jpeg(16, 16, {0x00});
  append(followed, {0xff, 0xd8, 1, 2, 3});  // another picture after the end
  REQUIRE(problem(followed).empty());
}

TEST_CASE("bytes after the last block are skipped as decoders do, if they are no blocks") {
  REQUIRE(problem(jpeg(8, 8, {0x3f, 0x12, 0x35})).empty());
  REQUIRE(problem(jpeg(8, 8, {0x3f, 0x12, 0x3f})).empty());
  REQUIRE(problem(jpeg(8, 8, {0x3f, 0xff, 0x00, 0xff, 0x00, 0xfe})).empty());
  Bytes many = {0x3f};
  append(many, Bytes(4096, 0xfe));
  REQUIRE(problem(jpeg(8, 8, many)).empty());
  many.push_back(0xfe);
  REQUIRE(mentions(jpeg(8, 8, many), "image data go on after the last block"));
  // Between restart intervals a block may be lost.
  REQUIRE(mentions(jpeg(16, 8, {0x3f, 0xfe, 0xff, 0xd0, 0x3f}, 0xc0, 1), "go on after the last block"));
}

TEST_CASE("cut JPEGs are refused wherever they end") {
  for (const uint8_t frame : {0xc0, 0xc2}) {
    const Bytes file = jpeg(16, 16, {0x00, 0x00, 0x00, 0x00}, frame);
    for (size_t n = 0; n < file.size(); ++n)
      REQUIRE_FALSE(problem(Bytes(file.begin(), file.begin() + n)).empty());
  }
}

TEST_CASE("damaged image data are refused with the reason") {
  REQUIRE(mentions(jpeg(32, 16, {0x00}), "image data end before the last block"));
  REQUIRE(mentions(jpeg(8, 8, {0x00, 0x3f}), "image data go on after the last block"));
  REQUIRE(mentions(jpeg(8, 8, {0x1f, 0xd2, 0x34}), "image data go on after the last block"));
  REQUIRE(mentions(jpeg(8, 8, {0x7e, 0x00}), "no such Huffman code"));         // 0 then 111
  REQUIRE(mentions(jpeg(8, 8, {0x6d, 0xb0, 0x00}), "too many coefficients"));  // 0 then 110 four times
  REQUIRE(mentions(jpeg(24, 8, {0x3f, 0xff, 0xd0, 0x3f, 0xff, 0xd2, 0x3f}, 0xc0, 1), "out of order"));
  REQUIRE(mentions({1, 2, 3}, "f: at byte 0: not a JPEG"));
  REQUIRE(mentions({0xff, 0xd8, 0xff, 0xd9}, "it has no image data"));
}

TEST_CASE("every code of a progressive JPEG is read") {
  // DC: 0 four times. First AC scan: 10 1 0, then 0 three times. Refinement: 0 and the coefficient's bit, 0 0
  // 0.
  REQUIRE(problem(progressive({0x0f}, {0xa1}, {0x47})).empty());
  REQUIRE(mentions(progressive({}, {0xa1}, {0x47}), "image data end before the last block"));
  REQUIRE(mentions(progressive({0x0f}, {0xbf}, {0x47}), "no such Huffman code"));
  REQUIRE(mentions(progressive({0x0f}, {0xa1, 0x55}, {0x47}), "image data go on after the last block"));
  REQUIRE(problem(progressive({0x0f, 0xfe, 0xfe}, {0xa1}, {0x47, 0xfe, 0xfe})).empty());
  // Without its bit the last block's code is missing: bits 0000, and 0 more than the scan has.
  REQUIRE(mentions(progressive({0x0f}, {0xa1}, {}), "image data end before the last block"));
  Bytes file = progressive({0x0f}, {0xa1}, {0x47});
  for (size_t n = 0; n < file.size(); ++n)
    REQUIRE_FALSE(problem(Bytes(file.begin(), file.begin() + n)).empty());
}

TEST_CASE("the sizes that a small JPEG claims are limited over all its components") {
  // A progressive file of n components of the greatest width, with an empty scan of each.
  const auto huge = [](uint8_t n, uint8_t height) {
    Bytes out = {0xff, 0xd8};
    append(out, table(0x10, {{0xe0}}));
    Bytes frame = {8, height, 0, 0xff, 0xff, n};
    for (uint8_t k = 0; k < n; ++k) append(frame, {k, 0x11, 0});
    append(out, segment(0xc2, frame));
    for (uint8_t k = 0; k < n; ++k) append(out, segment(0xda, {1, k, 0x00, 1, 63, 0}));
    append(out, {0xff, 0xd9});
    return out;
  };
  REQUIRE(mentions(huge(5, 1), "it claims 5 components"));
  REQUIRE(mentions(huge(255, 0xff), "it claims 255 components"));
  // 0x4000 rows are 2^24 blocks in one component, so the scan is walked and found to be empty; in more
  // components only the markers are read.
  REQUIRE(mentions(huge(1, 0x40), "image data end before the last block"));
  REQUIRE(problem(huge(2, 0x40)).empty());
}

TEST_CASE("JPEGs with wrong bytes pass or are refused, never worse") {
  const Bytes file = jpeg(40, 40, {0x3f, 0xff, 0xd0, 0x00, 0x55, 0xff, 0x00, 0xd7}, 0xc0, 9);
  int refusals = 0;
  for (size_t at = 0; at < file.size(); ++at) {
    for (int value = 0; value < 256; ++value) {
      Bytes damaged = file;
      damaged[at] = uint8_t(value);
      refusals += !problem(damaged).empty();
    }
  }
  REQUIRE(refusals > 0);
}

// QOI

namespace {

// An image that needs every kind of code: flat runs, gentle ramps, noise, and pixels that occur again.
Bytes some_image(QoiSize size) {
  Bytes rgb(3 * size_t{size.width} * size.height);
  uint32_t state = 7;
  for (size_t i = 0; i < rgb.size(); ++i) {
    const size_t pixel = i / 3;
    const uint32_t kind = (pixel / 97) % 4;
    if (kind == 0) rgb[i] = 200;
    if (kind == 1) rgb[i] = uint8_t(pixel);
    if (kind == 2) rgb[i] = uint8_t(next_random(state));
    if (kind == 3) rgb[i] = uint8_t(40 * (pixel % 3) + 9 * (i % 3) + next_random(state) % 7);
  }
  return rgb;
}

Bytes decoded(const Bytes& file) {
  const QoiSize size = qoi_size(file);
  Bytes rgb(3 * size_t{size.width} * size.height);
  decode_qoi(file, rgb.data());
  return rgb;
}

bool refused(const Bytes& file) { return !refusal(decoded, file).empty(); }

}  // namespace

TEST_CASE("QOI gives back every pixel") {
  for (const QoiSize size :
       {QoiSize{0, 0}, QoiSize{1, 1}, QoiSize{62, 1}, QoiSize{63, 1}, QoiSize{131, 37}}) {
    const Bytes rgb = some_image(size);
    const Bytes file = encode_qoi(rgb.data(), size);
    REQUIRE(qoi_size(file).width == size.width);
    REQUIRE(qoi_size(file).height == size.height);
    REQUIRE(decoded(file) == rgb);
  }
}

TEST_CASE("QOI codes are those of the format") {
  // A run of two black pixels (the start value), (1, 0, 255) as a difference, (11, 12, 13) led by green,
  // another in full, and the second colour again by its hash.
  const Bytes rgb = {0, 0, 0, 0, 0, 0, 1, 0, 255, 11, 12, 13, 100, 200, 30, 1, 0, 255};
  const Bytes file = encode_qoi(rgb.data(), {6, 1});
  const unsigned hash = (1 * 3 + 0 * 5 + 255 * 7 + 255 * 11) % 64;
  const Bytes codes = {0xc1, 0x79, 0x80 | 44,    (10 - 12 + 8) << 4 | (14 - 12 + 8), 0xfe, 100,
                       200,  30,   uint8_t(hash)};
  REQUIRE(Bytes(file.begin() + 14, file.end() - 8) == codes);
  REQUIRE(decoded(file) == rgb);
}

TEST_CASE("damaged QOI files are refused or decoded, never worse") {
  const QoiSize size{61, 13};
  const Bytes file = encode_qoi(some_image(size).data(), size);
  for (size_t n = 0; n < file.size(); ++n) REQUIRE(refused(Bytes(file.begin(), file.begin() + n)));
  uint32_t state = 3;
  int refusals = 0;
  for (int round = 0; round < 3000; ++round) {
    Bytes damaged = file;
    damaged[next_random(state) % damaged.size()] = uint8_t(next_random(state));
    refusals += refused(damaged);
  }
  REQUIRE(refusals > 0);
  Bytes huge = file;
  std::fill(huge.begin() + 4, huge.begin() + 12, 0xff);
  REQUIRE(refused(huge));
}

// Headers

namespace {

Bytes bytes(std::string_view text) { return {text.begin(), text.end()}; }

// A directory entry of a little-endian TIFF with one SHORT.
Bytes entry(uint16_t tag, uint16_t value) {
  return {uint8_t(tag), uint8_t(tag >> 8), 3, 0, 1, 0, 0, 0, uint8_t(value), uint8_t(value >> 8), 0, 0};
}

Bytes tiff(const std::vector<std::pair<uint16_t, uint16_t>>& tags) {
  Bytes out = {'I', 'I', 42, 0, 8, 0, 0, 0, uint8_t(tags.size()), 0};
  for (const auto& [tag, value] : tags) append(out, entry(tag, value));
  append(out, {0, 0, 0, 0});
  return out;
}

Bytes rgba(uint16_t extra, uint16_t orientation = 1) {
  return tiff({{256, 3}, {257, 2}, {258, 8}, {262, 2}, {274, orientation}, {277, 4}, {338, extra}});
}

ImageHeader read(const Bytes& file) { return read_image_header(file, "f"); }

std::string header_problem(const Bytes& file) { return refusal(read, file); }

}  // namespace

TEST_CASE("damaged and cut headers are refused") {
  const Bytes file = rgba(2);
  for (size_t n = 10; n < file.size() - 4; ++n) {
    REQUIRE_FALSE(header_problem(Bytes(file.begin(), file.begin() + ptrdiff_t(n))).empty());
  }
  REQUIRE(tiff_as_stored(rgba(2, 5), "f") == rgba(1));
  REQUIRE(header_problem(tiff({{262, 2}})) == "f: damaged TIFF: it has no size");
  REQUIRE(header_problem(tiff({{256, 3}, {257, 2}, {262, 2}, {277, 1}})).find("too few bands") !=
          std::string::npos);
  REQUIRE(header_problem(bytes("\xff\xd8\xff"sv)) == "f: truncated JPEG: the file ends inside its header");
  REQUIRE(header_problem(bytes("\x89PNG\r\n\x1a\n\0\0\0\x0d"sv)).find("truncated PNG") != std::string::npos);
}
