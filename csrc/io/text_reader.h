// SPDX-License-Identifier: Apache-2.0
// Lines and numbers of untrusted text, independent of the locale.
#pragma once
#include <charconv>
#include <cstdint>
#include <istream>
#include <limits>
#include <locale>
#include <sstream>
#include <string>
#include <string_view>
#include <type_traits>

#include "io/byte_reader.h"

namespace blitzgs::io {

// Reads all of `text` as a number; false if it is none. A sign + is allowed, which std::from_chars refuses.
// A real number beyond the range of T becomes zero or infinity with its sign, as it does in other readers; an
// integer beyond it is refused.
template <class T>
bool parse_number(std::string_view text, T& value) {
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

  // Goes to the next line; false at the end of the file.
  bool next_line();
  // Goes to the next line that is not blank and no comment (#); false at the end of the file.
  bool next_record();

  // The next token of the line. Throws if the line has no more; `what` names the token in the message.
  std::string_view token(const char* what);
  bool has_token();
  // The rest of the line, without surrounding blanks.
  std::string_view rest();

  template <class T>
  T number(const char* what) {
    const std::string_view text = token(what);
    T value{};
    if (!parse_number(text, value)) fail("'" + std::string(text.substr(0, 40)) + "' is not a valid " + what);
    return value;
  }

  // Throws FormatError at the current line.
  [[noreturn]] void fail(const std::string& reason) const;

 private:
  void skip_blanks();

  std::istream& in_;
  std::string name_;
  std::string line_;
  std::string_view left_;
  std::uint64_t line_number_ = 0;
};

}  // namespace blitzgs::io
