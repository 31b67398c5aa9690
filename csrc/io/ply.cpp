// SPDX-License-Identifier: Apache-2.0
#include "io/ply.h"

#include <algorithm>
#include <iterator>
#include <optional>

#include "io/byte_reader.h"

namespace blitzgs::io {
namespace {

std::string read_token(ByteReader& reader) {
  const auto blank = [](char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\n'; };
  std::string token;
  while (reader.remaining() > 0) {
    const char c = reader.read<char>("a value");
    if (!blank(c)) {
      token.push_back(c);
      if (token.size() > 400) reader.fail("a value of more than 400 characters");
    } else if (!token.empty()) {
      return token;
    }
  }
  if (token.empty()) reader.fail("the file ends before its last value");
  return token;
}

template <class T> void parse_value(ByteReader& reader, uint8_t* out) {
  const std::string token = read_token(reader);
  T value{};
  if (!parse_number(token, value)) reader.fail("'" + token.substr(0, 40) + "' is not a valid value");
  std::memcpy(out, &value, sizeof value);
}

struct TypeInfo {
  std::string_view name, alias;
  int bytes;
  void (*parse)(ByteReader&, uint8_t* out);  // a value in text
};
// In the order of PlyType.
constexpr TypeInfo kTypes[] = {
    {"char", "int8", 1, parse_value<int8_t>},    {"uchar", "uint8", 1, parse_value<uint8_t>},
    {"short", "int16", 2, parse_value<int16_t>}, {"ushort", "uint16", 2, parse_value<uint16_t>},
    {"int", "int32", 4, parse_value<int32_t>},   {"uint", "uint32", 4, parse_value<uint32_t>},
    {"float", "float32", 4, parse_value<float>}, {"double", "float64", 8, parse_value<double>}};
const TypeInfo& info_of(PlyType type) { return kTypes[size_t(type)]; }

std::optional<PlyType> find_type(std::string_view name) {
  for (size_t i = 0; i < std::size(kTypes); ++i) {
    if (name == kTypes[i].name || name == kTypes[i].alias) return static_cast<PlyType>(i);
  }
  return std::nullopt;
}

constexpr size_t kMaxLine = 1 << 16;
constexpr size_t kMaxProperties = 1 << 12;

enum class Encoding { kAscii, kLittle, kBig };

struct Element {
  std::string name;
  uint64_t count = 0;
  std::vector<PlyProperty> properties;
  bool has_list = false;

  uint64_t row_bytes() const { return io::row_bytes(properties); }
};

std::string read_line(ByteReader& reader) {
  std::string line;
  for (char c; (c = reader.read<char>("the header")) != '\n';) {
    if (line.size() == kMaxLine) reader.fail("a header line is longer than 65536 bytes: not a PLY file");
    line.push_back(c);
  }
  if (!line.empty() && line.back() == '\r') line.pop_back();
  return line;
}

std::vector<std::string> split(const std::string& line) {
  std::istringstream stream(line);
  std::vector<std::string> words;
  for (std::string word; stream >> word;) words.push_back(word);
  return words;
}

struct Header {
  Encoding encoding = Encoding::kAscii;
  std::vector<std::string> comments;
  std::vector<Element> elements;
};

Encoding parse_format(const ByteReader& reader, const std::vector<std::string>& words,
                      const std::string& line) {
  if (words.size() == 3 && words[2] == "1.0") {
    if (words[1] == "ascii") return Encoding::kAscii;
    if (words[1] == "binary_little_endian") return Encoding::kLittle;
    if (words[1] == "binary_big_endian") return Encoding::kBig;
  }
  reader.fail("unknown format line '" + line + "'");
}

Element parse_element(const ByteReader& reader, const std::vector<std::string>& words,
                      const std::string& line) {
  Element element;
  if (words.size() != 3) reader.fail("bad element line '" + line + "'");
  element.name = words[1];
  const char* end = words[2].data() + words[2].size();
  const auto [stop, error] = std::from_chars(words[2].data(), end, element.count);
  if (error != std::errc() || stop != end) reader.fail("bad element count '" + words[2] + "'");
  return element;
}

void parse_property(const ByteReader& reader, const std::vector<std::string>& words, const std::string& line,
                    Header& header) {
  if (header.elements.empty()) reader.fail("a property comes before any element: '" + line + "'");
  Element& element = header.elements.back();
  if (words.size() == 5 && words[1] == "list") {
    element.has_list = true;
    return;
  }
  const auto type = words.size() == 3 ? find_type(words[1]) : std::nullopt;
  if (!type) reader.fail("bad property line '" + line + "'");
  const auto same = [&](const PlyProperty& p) { return p.name == words[2]; };
  if (std::any_of(element.properties.begin(), element.properties.end(), same)) {
    reader.fail("property " + words[2] + " comes twice");
  }
  if (element.properties.size() == kMaxProperties) reader.fail("more than 4096 properties");
  element.properties.push_back({words[2], *type});
}

Header read_header(ByteReader& reader) {
  if (read_line(reader) != "ply") reader.fail("the first line is not 'ply'");
  Header header;
  bool has_format = false;
  while (true) {
    const std::string line = read_line(reader);
    const std::vector<std::string> words = split(line);
    const std::string key = words.empty() ? "" : words[0];
    if (key == "comment" || key == "obj_info") {
      header.comments.push_back(line);
    } else if (key == "format") {
      header.encoding = parse_format(reader, words, line);
      has_format = true;
    } else if (key == "element") {
      header.elements.push_back(parse_element(reader, words, line));
    } else if (key == "property") {
      parse_property(reader, words, line, header);
    } else if (key == "end_header") {
      if (!has_format) reader.fail("the header has no format line");
      return header;
    } else {
      reader.fail("unknown header line '" + line.substr(0, 80) + "'");
    }
  }
}

void skip_element(ByteReader& reader, const Element& element, Encoding encoding) {
  if (element.has_list) reader.fail("element " + element.name + " has lists and comes before the vertices");
  if (encoding == Encoding::kAscii) {
    for (uint64_t i = 0; i < element.count && !element.properties.empty(); ++i) {
      for (size_t k = 0; k < element.properties.size(); ++k) read_token(reader);
    }
  } else if (element.row_bytes() > 0) {
    reader.check_count(element.count, element.row_bytes(), "rows before the vertices");
    reader.skip(element.count * element.row_bytes(), "the elements before the vertices");
  }
}

void swap_bytes(const Element& vertex, std::vector<uint8_t>& rows) {
  for (auto at = rows.begin(); at != rows.end();) {
    for (const PlyProperty& property : vertex.properties) {
      std::reverse(at, at + property.bytes());
      at += property.bytes();
    }
  }
}

}  // namespace

int PlyProperty::bytes() const { return info_of(type).bytes; }

uint64_t row_bytes(const std::vector<PlyProperty>& properties) {
  uint64_t bytes = 0;
  for (const PlyProperty& property : properties) bytes += property.bytes();
  return bytes;
}

PlyTable read_ply(std::istream& in, const std::string& name, uint64_t first, uint64_t most) {
  ByteReader reader(in, name);
  Header header = read_header(reader);
  const auto vertex = std::find_if(header.elements.begin(), header.elements.end(),
                                   [](const Element& element) { return element.name == "vertex"; });
  if (vertex == header.elements.end()) reader.fail("the header has no vertex element");
  if (vertex->has_list) reader.fail("the vertices have a list property");
  if (vertex->properties.empty()) reader.fail("the vertices have no properties");
  for (auto element = header.elements.begin(); element != vertex; ++element) {
    skip_element(reader, *element, header.encoding);
  }
  // In text a value takes at least a digit and a separator; the last one needs no separator.
  const bool ascii = header.encoding == Encoding::kAscii;
  const uint64_t min_bytes = ascii ? 2 * vertex->properties.size() - 1 : vertex->row_bytes();
  reader.check_count(vertex->count, min_bytes, "vertices");
  first = std::min(first, vertex->count);
  PlyTable table{std::move(header.comments),
                 vertex->properties,
                 std::min(most, vertex->count - first),
                 {},
                 vertex->count};
  table.rows.resize(table.count * vertex->row_bytes());
  if (ascii) {
    for (uint64_t i = 0; i < first * table.properties.size(); ++i) read_token(reader);
    uint8_t* out = table.rows.data();
    for (uint64_t i = 0; i < table.count; ++i) {
      for (const PlyProperty& property : table.properties) {
        info_of(property.type).parse(reader, out);
        out += property.bytes();
      }
    }
    return table;
  }
  reader.skip(first * vertex->row_bytes(), "the vertices");
  reader.read_bytes(table.rows.data(), table.rows.size(), "the vertices");
  if (header.encoding == Encoding::kBig) swap_bytes(*vertex, table.rows);
  if (first + table.count == table.total && vertex + 1 == header.elements.end()) reader.expect_end();
  return table;
}

}  // namespace blitzgs::io
