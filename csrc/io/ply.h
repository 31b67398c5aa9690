// SPDX-License-Identifier: Apache-2.0
// PLY: the vertex table of a file, as rows of scalar properties in native byte order.
//
// Reads ASCII and binary of either byte order. Elements after the vertices are not read; list properties of
// the vertices are refused. Rows are packed in header order without padding.
#pragma once
#include <iosfwd>

#include "io/byte_reader.h"

namespace blitzgs::io {

enum class PlyType : uint8_t { kInt8, kUint8, kInt16, kUint16, kInt32, kUint32, kFloat32, kFloat64 };

struct PlyProperty {
  std::string name;
  PlyType type;

  int bytes() const;
};
uint64_t row_bytes(const std::vector<PlyProperty>& properties);

struct PlyTable {
  std::vector<std::string> comments;  // whole header lines: "comment ..." and "obj_info ..."
  std::vector<PlyProperty> properties;
  uint64_t count = 0;
  std::vector<uint8_t> rows;  // count x row_bytes
  uint64_t total = 0;         // rows of the file, of which `rows` may hold some
};

// Reads `most` rows from row `first` on, or as many as there are. Throws FormatError with the file, byte
// offset or header line, and reason.
PlyTable read_ply(std::istream& in, const std::string& name, uint64_t first = 0,
                  uint64_t most = std::numeric_limits<uint64_t>::max());
}  // namespace blitzgs::io
