// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "io/byte_reader.h"

namespace blitzgs::io {
namespace {
constexpr uint64_t kBufferBytes = 1 << 18;

std::string printable(const std::string& text) {
  constexpr const char* kHex = "0123456789abcdef";
  std::string out;
  for (const char c : text) {
    const auto byte = static_cast<unsigned char>(c);
    if (byte >= 0x20 && byte < 0x7f) {
      out.push_back(c);
    } else {
      out += {'\\', 'x', kHex[byte >> 4], kHex[byte & 15]};
    }
  }
  return out;
}

}  // namespace

FormatError::FormatError(const std::string& place, const std::string& reason)
    : std::runtime_error(place + ": " + printable(reason)) {}

ByteReader::ByteReader(std::istream& in, std::string name) : in_(in), name_(std::move(name)) {
  const auto start = in_.tellg();
  in_.seekg(0, std::ios::end);
  const auto end = in_.tellg();
  in_.seekg(start);
  if (!in_ || start < 0 || end < start) throw FormatError(name_, "cannot be read, or its size is unknown");
  size_ = uint64_t(end - start);
  buffer_.resize(std::min(size_, kBufferBytes));
}

void ByteReader::fill() {
  const uint64_t wanted = std::min<uint64_t>(buffer_.size(), remaining());
  in_.read(buffer_.data(), static_cast<std::streamsize>(wanted));
  if (uint64_t(in_.gcount()) != wanted) fail("the file could not be read on");
  buffer_at_ = 0;
  buffer_end_ = wanted;
}

void ByteReader::require(uint64_t n, const char* what) const {
  if (n > remaining()) {
    fail(std::string("the file ends inside ") + what + " (" + std::to_string(n) + " bytes needed, " +
         std::to_string(remaining()) + " left)");
  }
}

void ByteReader::read_bytes(void* destination, uint64_t n, const char* what) {
  require(n, what);
  char* out = static_cast<char*>(destination);
  while (n > 0) {
    if (buffer_at_ == buffer_end_) fill();
    const uint64_t step = std::min<uint64_t>(n, buffer_end_ - buffer_at_);
    if (out) out = std::copy_n(buffer_.data() + buffer_at_, step, out);
    n -= step;
    buffer_at_ += step;
    offset_ += step;
  }
}

std::string ByteReader::read_c_string(const char* what) {
  std::string text;
  while (true) {
    require(1, what);
    if (buffer_at_ == buffer_end_) fill();
    const char* begin = buffer_.data() + buffer_at_;
    const char* end = buffer_.data() + buffer_end_;
    const char* nul = std::find(begin, end, '\0');
    text.append(begin, nul);
    const size_t step = size_t(nul - begin) + (nul != end ? 1 : 0);
    buffer_at_ += step;
    offset_ += step;
    if (nul != end) return text;
  }
}

uint64_t ByteReader::read_count(uint64_t min_bytes, const char* what) {
  const auto count = read<uint64_t>(what);
  check_count(count, min_bytes, what);
  return count;
}

void ByteReader::check_count(uint64_t count, uint64_t min_bytes, const char* what) const {
  if (count > remaining() / min_bytes) {
    fail("it claims " + std::to_string(count) + " " + what + " of at least " + std::to_string(min_bytes) +
         " bytes each, but " + std::to_string(remaining()) + " bytes are left");
  }
}

void ByteReader::fail(const std::string& reason) const {
  throw FormatError(name_ + ": at byte " + std::to_string(offset_), reason);
}

void ByteReader::expect_end() const {
  if (remaining() > 0) fail(std::to_string(remaining()) + " bytes are left after the last record");
}

bool TextReader::next_line() {
  constexpr std::string_view kByteOrderMark = "\xef\xbb\xbf";
  if (!std::getline(in_, line_)) return false;
  ++line_number_;
  left_ = line_;
  if (line_number_ == 1 && left_.starts_with(kByteOrderMark)) left_.remove_prefix(kByteOrderMark.size());
  if (!left_.empty() && left_.back() == '\r') left_.remove_suffix(1);
  return true;
}

bool TextReader::next_record() {
  while (next_line()) {
    skip_blanks();
    if (!left_.empty() && left_.front() != '#') return true;
  }
  return false;
}

void TextReader::skip_blanks() {
  const auto start = left_.find_first_not_of(kBlanks);
  left_.remove_prefix(start == std::string_view::npos ? left_.size() : start);
}

bool TextReader::has_token() {
  skip_blanks();
  return !left_.empty();
}

std::string_view TextReader::token(const char* what) {
  if (!has_token()) fail(std::string("the line ends before ") + what);
  const std::string_view found = left_.substr(0, left_.find_first_of(kBlanks));
  left_.remove_prefix(found.size());
  return found;
}

std::string_view TextReader::rest() {
  skip_blanks();
  const auto last = left_.find_last_not_of(kBlanks);
  return left_.substr(0, last == std::string_view::npos ? 0 : last + 1);
}

void TextReader::fail(const std::string& reason) const {
  throw FormatError(name_ + ": line " + std::to_string(line_number_), reason);
}

}  // namespace blitzgs::io
