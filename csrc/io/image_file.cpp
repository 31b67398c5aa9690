// SPDX-License-Identifier: Apache-2.0
#include "io/image_file.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>

namespace blitzgs::io {
namespace {

using namespace std::string_view_literals;

constexpr std::string_view kPngStart = "\x89PNG\r\n\x1a\n"sv;
constexpr size_t kReadAhead = 1 << 16;

// Tables of the checksum of a byte that k zero bytes follow, for the polynomial of PNG (ISO/IEC 15948, D).
constexpr auto kChecksums = [] {
  std::array<std::array<uint32_t, 256>, 8> tables{};
  for (uint32_t byte = 0; byte < 256; ++byte) {
    uint32_t value = byte;
    for (int bit = 0; bit < 8; ++bit) value = value >> 1 ^ (value & 1 ? 0xedb88320u : 0u);
    tables[0][byte] = value;
  }
  for (size_t k = 1; k < tables.size(); ++k) {
    for (size_t byte = 0; byte < 256; ++byte) {
      const uint32_t before = tables[k - 1][byte];
      tables[k][byte] = before >> 8 ^ tables[0][before & 0xff];
    }
  }
  return tables;
}();

// Eight bytes at a time, because a step of one byte waits for the one before.
uint32_t checksum(ImageBytes bytes) {
  uint32_t value = ~0u;
  for (; bytes.size() >= 8; bytes = bytes.subspan(8)) {
    uint64_t word = 0;
    std::memcpy(&word, bytes.data(), 8);
    word ^= value;
    value = 0;
    for (size_t k = 0; k < 8; ++k) value ^= kChecksums[7 - k][word >> 8 * k & 0xff];
  }
  for (const uint8_t byte : bytes) value = value >> 8 ^ kChecksums[0][(value ^ byte) & 0xff];
  return ~value;
}

void check_png(ImageBytes file, const std::string& name) {
  bool has_pixels = false;
  for (size_t at = kPngStart.size();;) {
    const auto fail = [&](const char* reason) {
      throw FormatError(name + ": at byte " + std::to_string(at), reason);
    };
    const ImageBytes rest = file.subspan(at);
    if (rest.size() < 12 || rest.size() - 12 < big_endian(rest, 0, 4)) {
      fail("truncated PNG: it ends before its last chunk");
    }
    const ImageBytes chunk = rest.subspan(4, 4 + big_endian(rest, 0, 4));
    const std::string_view kind = text_of(chunk.first(4));
    // The names of chunks that a picture needs begin with a capital letter. Others may be damaged.
    const bool is_needed = !(chunk[0] & 0x20) || kind == "tRNS";
    if (is_needed && checksum(chunk) != big_endian(rest, 4 + chunk.size(), 4)) {
      fail("damaged PNG: the checksum of a chunk is wrong");
    }
    has_pixels |= kind == "IDAT";
    if (kind == "IEND") break;
    at += 8 + chunk.size();
  }
  if (!has_pixels) throw FormatError(name, "damaged PNG: it has no image data");
}

struct File {
  int number;
  ~File() { ::close(number); }
};

std::vector<uint8_t> read_file(const std::string& path) {
  const File file{::open(path.c_str(), O_RDONLY | O_CLOEXEC)};
  struct stat about{};
  if (file.number < 0 || ::fstat(file.number, &about) != 0) throw SystemError(errno, path);
  // One byte more than the file has, so that the read that fills the memory also finds the end.
  std::vector<uint8_t> bytes(size_t(std::max<off_t>(about.st_size, 0)) + 1);
  size_t size = 0;
  while (true) {
    const ssize_t count = ::read(file.number, bytes.data() + size, bytes.size() - size);
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) throw SystemError(errno, path);
    if (count == 0) break;
    size += size_t(count);
    if (size == bytes.size()) bytes.resize(size + kReadAhead);
  }
  bytes.resize(size);
  return bytes;
}

}  // namespace

void check_image(ImageBytes file, const std::string& name) {
  if (text_of(file).starts_with("\xff\xd8"sv)) check_jpeg(file, name);
  if (text_of(file).starts_with(kPngStart)) check_png(file, name);
}

std::vector<uint8_t> read_image_file(const std::string& path) {
  std::vector<uint8_t> bytes = read_file(path);
  check_image(bytes, path);
  return bytes;
}

}  // namespace blitzgs::io
