// SPDX-License-Identifier: Apache-2.0
#include "io/parse_number.h"

#include <cmath>
#include <cstdint>
#include <optional>

#include "common/catch.h"

using namespace blitzgs::io;

namespace {

template <class T>
std::optional<T> parsed(std::string_view text) {
  T value{};
  return parse_number(text, value) ? std::optional<T>(value) : std::nullopt;
}

}  // namespace

TEST_CASE("numbers may have a sign and end where their text ends") {
  REQUIRE(parsed<double>("+1.5e3") == 1500.0);
  REQUIRE(parsed<double>("-.5") == -0.5);
  REQUIRE(parsed<std::uint8_t>("+255") == 255);
  REQUIRE(parsed<std::int32_t>("-7") == -7);
  for (const char* text : {"", "+", "-", "+-1", "++1", " 1", "1 ", "1x", "0x1p3", "1e400x", "1,5"}) {
    CAPTURE(text);
    REQUIRE_FALSE(parsed<double>(text));
  }
}

TEST_CASE("real numbers beyond the range are zero or infinity with their sign, integers are refused") {
  const std::string small = "0." + std::string(400, '0') + "1", large(400, '9');
  REQUIRE(parsed<float>("1e-46") == 0.0f);
  REQUIRE(parsed<float>("1e39") == std::numeric_limits<float>::infinity());
  REQUIRE(parsed<float>("1e-40") == 1e-40f);
  for (const std::string& text : {std::string("1e-400"), small, std::string("1e-99999999999999999999")}) {
    REQUIRE(parsed<double>(text) == 0.0);
    REQUIRE_FALSE(std::signbit(*parsed<double>("+" + text)));
    REQUIRE(std::signbit(*parsed<double>("-" + text)));
  }
  for (const std::string& text : {std::string("1e400"), large, std::string("1e99999999999999999999")}) {
    REQUIRE(parsed<double>("+" + text) == std::numeric_limits<double>::infinity());
    REQUIRE(parsed<double>("-" + text) == -std::numeric_limits<double>::infinity());
  }
  REQUIRE_FALSE(parsed<std::uint8_t>("256"));
  REQUIRE_FALSE(parsed<std::int64_t>("9223372036854775808"));
}
