// SPDX-License-Identifier: Apache-2.0
#include "io/text_reader.h"

namespace blitzgs::io {

namespace {
constexpr std::string_view kByteOrderMark = "\xef\xbb\xbf";
}  // namespace

bool TextReader::next_line() {
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
