// SPDX-License-Identifier: Apache-2.0
// Lines and numbers of untrusted text, independent of the locale.
#pragma once
#include <cstdint>
#include <istream>
#include <string>
#include <string_view>

#include "io/byte_reader.h"
#include "io/parse_number.h"

namespace blitzgs::io {

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
