// SPDX-License-Identifier: Apache-2.0
// Numbers in text of other programs, independent of the locale.
#pragma once
#include <charconv>
#include <limits>
#include <locale>
#include <sstream>
#include <string>
#include <string_view>
#include <type_traits>

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

}  // namespace blitzgs::io
