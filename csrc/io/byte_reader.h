// SPDX-License-Identifier: Apache-2.0
// Readers of bytes and of text: they never leave their range, and errors name the place.
#pragma once
#include <bit>
#include <charconv>
#include <cstdint>
#include <cstring>
#include <istream>
#include <limits>
#include <locale>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

// Checked reading of untrusted binary data: a reader that allocates or skips bytes has checked their number.
namespace blitzgs::io {

static_assert(std::endian::native == std::endian::little, "the binary formats are little endian");

// The exception of all readers, with the message "<file>: <place>: <reason>". The reason may quote the file,
// so bytes that are not printable ASCII are shown as \xNN.
class FormatError : public std::runtime_error {
 public:
  FormatError(const std::string& place, const std::string& reason);
};

// Reads a seekable stream from its current position to its end. It has a buffer of its own, because the
// records are tens of bytes, and a call of std::istream::read costs more than the copy.
class ByteReader {
 public:
  // `name` is the name of the stream in messages. Throws FormatError if the size of the stream is unknown.
  ByteReader(std::istream& in, std::string name);

  uint64_t offset() const { return offset_; }
  uint64_t remaining() const { return size_ - offset_; }

  // Reads a value of fixed size; `what` names it in the message if the file ends first.
  template <class T> T read(const char* what) {
    static_assert(std::is_trivially_copyable_v<T>);
    T value;
    read_bytes(&value, sizeof value, what);
    return value;
  }
  void read_bytes(void* destination, uint64_t n, const char* what);  // null: skips them
  void skip(uint64_t n, const char* what) { read_bytes(nullptr, n, what); }
  std::string read_c_string(const char* what);

  // Reads a uint64 count of records of at least `min_bytes` bytes each. Throws if fewer are left.
  uint64_t read_count(uint64_t min_bytes, const char* what);
  void check_count(uint64_t count, uint64_t min_bytes, const char* what) const;

  [[noreturn]] void fail(const std::string& reason) const;
  // Throws if bytes are left, because the file then has another format than the reader expects.
  void expect_end() const;

 private:
  void require(uint64_t n, const char* what) const;
  void fill();

  std::istream& in_;
  std::string name_;
  uint64_t size_ = 0;
  uint64_t offset_ = 0;
  std::vector<char> buffer_;
  size_t buffer_at_ = 0;
  size_t buffer_end_ = 0;
};

// Lines and numbers of untrusted text, independent of the locale.

// Reads all of `text` as a number; false if it is none. A sign + is allowed, which std::from_chars refuses. A
// real number beyond the range of T becomes zero or infinity with its sign, as it does in other readers; an
// integer beyond it is refused.
template <class T> bool parse_number(std::string_view text, T& value) {
  if (text.starts_with('+')) {
    text.remove_prefix(1);
    if (text.starts_with('-')) return false;
  }
  const char* end = text.data() + text.size();
  const auto [stop, error] = std::from_chars(text.data(), end, value);
  if (stop != end || error == std::errc::invalid_argument) return false;
  if (error == std::errc()) return true;
  if constexpr (std::is_floating_point_v<T>) {
    // Unlike std::from_chars, a stream tells which end of the range was passed: it fails at the upper one.
    std::istringstream stream{std::string(text)};
    stream.imbue(std::locale::classic());
    if (!(stream >> value)) {
      value =
          text.starts_with('-') ? -std::numeric_limits<T>::infinity() : std::numeric_limits<T>::infinity();
    }
    return true;
  }
  return false;
}

inline constexpr std::string_view kBlanks = " \t\r\v\f";

class TextReader {
 public:
  TextReader(std::istream& in, std::string name) : in_(in), name_(std::move(name)) {
    if (!in_) throw FormatError(name_, "cannot be read");
  }

  bool next_line();
  // Goes to the next line that is not blank and no comment (#); false at the end of the file.
  bool next_record();

  // The next token of the line. Throws if the line has no more; `what` names the token in the message.
  std::string_view token(const char* what);
  bool has_token();
  std::string_view rest();

  template <class T> T number(const char* what) {
    const std::string_view text = token(what);
    T value{};
    if (!parse_number(text, value)) fail("'" + std::string(text.substr(0, 40)) + "' is not a valid " + what);
    return value;
  }

  [[noreturn]] void fail(const std::string& reason) const;

 private:
  void skip_blanks();

  std::istream& in_;
  std::string name_;
  std::string line_;
  std::string_view left_;
  uint64_t line_number_ = 0;
};

}  // namespace blitzgs::io
