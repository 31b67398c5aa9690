// SPDX-License-Identifier: Apache-2.0
#include "io/image_file.h"

#include <algorithm>

namespace blitzgs::io {
namespace {

using namespace std::string_view_literals;

ImageHeader not_supported(std::string format) { return {.format = std::move(format), .supported = false}; }

ImageHeader read_jpeg(ImageBytes file, const std::string& name) {
  ImageHeader header{.format = "JPEG", .is_lossy = true};
  const auto need = [&](size_t end) {
    if (end > file.size()) throw FormatError(name, "truncated JPEG: the file ends inside its header");
  };
  size_t at = 2;
  while (true) {
    need(at + 4);
    // Decoders skip what lies between two segments.
    if (file[at] != 0xff || file[at + 1] == 0xff || file[at + 1] == 0) {
      ++at;
      continue;
    }
    const unsigned marker = file[at + 1];
    if (marker == 0x01 || (marker >= 0xd0 && marker <= 0xd8)) {  // markers without a payload
      at += 2;
      continue;
    }
    const auto length = size_t(big_endian(file, at + 2, 2));
    need(at + 2 + length);
    if (length < 2 || marker == 0xda || marker == 0xd9) break;
    const ImageBytes payload = file.subspan(at + 4, length - 2);
    if (marker == 0xe1 && text_of(payload).starts_with("Exif\0\0"sv)) {
      header.orientation = exif_orientation(payload.subspan(6));
    }
    if (marker >= 0xc0 && marker <= 0xcf && marker != 0xc4 && marker != 0xc8 && marker != 0xcc) {
      if (payload.size() < 6) break;
      header.bits = payload[0];
      header.height = big_endian(payload, 1, 2);
      header.width = big_endian(payload, 3, 2);
      header.colors = payload[5];
      return header;
    }
    at += 2 + length;
  }
  throw FormatError(name, "damaged JPEG: no size in its header");
}

ImageHeader read_png(ImageBytes file, const std::string& name) {
  ImageHeader header{.format = "PNG"};
  size_t at = 8;
  unsigned kind = 0;
  while (true) {
    if (file.size() < at + 8) throw FormatError(name, "truncated PNG: the file ends inside its header");
    const uint64_t length = big_endian(file, at, 4);
    const std::string_view chunk = text_of(file).substr(at + 4, 4);
    if (chunk == "IDAT" || chunk == "IEND") break;
    if (length > file.size() - at - 8)
      throw FormatError(name, "truncated PNG: the file ends inside its header");
    const ImageBytes payload = file.subspan(at + 8, size_t(length));
    if (chunk == "IHDR" && payload.size() >= 13) {
      header.width = big_endian(payload, 0, 4);
      header.height = big_endian(payload, 4, 4);
      header.bits = payload[8];
      kind = payload[9];
      header.colors = kind == 0 || kind == 4 ? 1 : 3;
      if (kind == 4 || kind == 6) header.alpha = Alpha::kStraight;
    }
    if (chunk == "tRNS" && kind == 0 && payload.size() >= 2) {
      header.transparent_grey = unsigned(big_endian(payload, 0, 2));
    }
    if (chunk == "tRNS" && (kind == 0 || kind == 2 || kind == 3)) header.alpha = Alpha::kStraight;
    at += 12 + size_t(length);
  }
  return header;
}

// Calls `visit(kind, payload)` for the boxes of a JPEG 2000, HEIF or AVIF file or of one of their boxes. The
// last one may be cut off: the codestream is not needed.
template <class Visit> void each_box(ImageBytes bytes, Visit visit) {
  while (bytes.size() >= 8) {
    uint64_t length = big_endian(bytes, 0, 4), header = 8;
    if (length == 1 && bytes.size() >= 16) {
      length = big_endian(bytes, 8, 8);
      header = 16;
    }
    if (length == 0 || length > bytes.size()) length = bytes.size();
    if (length < header) return;
    visit(text_of(bytes).substr(4, 4), bytes.subspan(size_t(header), size_t(length - header)));
    bytes = bytes.subspan(size_t(length));
  }
}

ImageHeader read_jpeg_2000(ImageBytes file) {
  ImageHeader header{.format = "JPEG 2000", .is_lossy = true};  // not always, but its header does not say so
  unsigned bands = 3;
  // The first segment of a bare codestream has the size and the number of bands.
  if (file[0] == 0xff && file.size() >= 43) {
    bands = unsigned(big_endian(file, 40, 2));
    header.bits = (file[42] & 0x7fu) + 1;
  }
  each_box(file[0] == 0xff ? ImageBytes{} : file, [&](std::string_view kind, ImageBytes payload) {
    if (kind != "jp2h") return;
    each_box(payload, [&](std::string_view inner, ImageBytes p) {
      if (inner == "ihdr" && p.size() >= 11) {
        bands = unsigned(big_endian(p, 8, 2));
        if (p[10] != 255) header.bits = (p[10] & 0x7fu) + 1;
      }
      if (inner == "bpcc" && !p.empty()) header.bits = (p[0] & 0x7fu) + 1;
      if (inner != "cdef") return;
      for (size_t at = 2; at + 6 <= p.size(); at += 6) {
        const uint64_t type = big_endian(p, at + 2, 2);
        if (type == 1) header.alpha = Alpha::kStraight;
        if (type == 2) header.alpha = Alpha::kAssociated;
      }
    });
  });
  const unsigned others = bands - (header.alpha == Alpha::kNone || bands == 0 ? 0 : 1);
  header.colors = others >= 3 ? 3 : 1;
  header.extras = others > header.colors ? others - header.colors : 0;
  return header;
}

// HEIF files: AVIF, and those that need another decoder.
ImageHeader read_heif(ImageBytes file) {
  ImageHeader header{.format = "AVIF", .is_lossy = true};
  std::string_view brands = text_of(file).substr(8, 4);
  each_box(file, [&](std::string_view kind, ImageBytes payload) {
    if (kind == "ftyp") brands = text_of(payload);
    if (kind != "meta" || payload.size() < 4) return;
    each_box(payload.subspan(4), [&](std::string_view inner, ImageBytes p) {
      if (inner != "iprp") return;
      each_box(p, [&](std::string_view container, ImageBytes properties) {
        if (container != "ipco") return;
        each_box(properties, [&](std::string_view property, ImageBytes values) {
          if (property == "av1C" && values.size() >= 3 && (values[2] & 0x40)) {
            header.bits = std::max(header.bits, values[2] & 0x20 ? 12u : 10u);
          }
          // The decoder divides colours that are multiplied by alpha.
          if (property == "auxC" && text_of(values).find("alpha") != std::string_view::npos) {
            header.alpha = Alpha::kStraight;
          }
        });
      });
    });
  });
  if (brands.starts_with("crx ")) return not_supported("camera raw");
  if (brands.find("avif") == std::string_view::npos && brands.find("avis") == std::string_view::npos) {
    return not_supported("HEIC");
  }
  return header;
}

ImageHeader read_webp(ImageBytes file) {
  const std::string_view kind = text_of(file).substr(12, 4);
  const bool says_so = (kind == "VP8X" && file.size() > 20 && (file[20] & 0x10)) ||
                       (kind == "VP8L" && file.size() > 24 && (file[24] & 0x10));
  return {.format = "WebP",
          .alpha = says_so ? Alpha::kStraight : Alpha::kNone,
          .is_lossy = kind != "VP8L" && text_of(file).find("VP8L") == std::string_view::npos};
}

ImageHeader read_gif(ImageBytes file) {
  ImageHeader header{.format = "GIF"};
  size_t at = 13;
  if (file.size() > 10 && (file[10] & 0x80)) at += size_t{3} << ((file[10] & 7) + 1);
  while (at + 4 < file.size() && file[at] == 0x21) {  // extensions before the first picture
    if (file[at + 1] == 0xf9 && (file[at + 3] & 1)) header.alpha = Alpha::kStraight;
    at += 2;
    while (at < file.size() && file[at] != 0) at += file[at] + size_t{1};
    ++at;
  }
  return header;
}

ImageHeader read_bmp(ImageBytes file) {
  // Only longer headers with masks of the colours have a mask of alpha.
  const bool has_masks = file.size() >= 70 && (file[30] == 3 || file[30] == 6) && file[14] >= 56;
  const bool has_alpha = has_masks && big_endian(file, 66, 4) != 0;
  return {.format = "BMP", .alpha = has_alpha ? Alpha::kStraight : Alpha::kNone};
}

ImageHeader read_pam(ImageBytes file) {
  const std::string_view start = text_of(file).substr(0, 1024);
  const bool has_alpha = start.substr(0, start.find("ENDHDR")).find("_ALPHA") != std::string_view::npos;
  return {.format = "PAM", .alpha = has_alpha ? Alpha::kStraight : Alpha::kNone};
}

}  // namespace

ImageHeader read_image_header(ImageBytes file, const std::string& name) {
  const std::string_view start = text_of(file);
  if (start.starts_with("\xff\xd8"sv)) return read_jpeg(file, name);
  if (start.starts_with("\x89PNG\r\n\x1a\n"sv)) return read_png(file, name);
  if (is_tiff(file)) return read_tiff_header(file, name);
  if (start.starts_with("\0\0\0\x0cjP  "sv) || start.starts_with("\xff\x4f\xff\x51"sv)) {
    return read_jpeg_2000(file);
  }
  if (start.size() >= 12 && start.substr(4, 4) == "ftyp") return read_heif(file);
  if (start.size() >= 16 && start.starts_with("RIFF") && start.substr(8, 4) == "WEBP") return read_webp(file);
  if (start.starts_with("GIF8")) return read_gif(file);
  if (start.starts_with("BM")) return read_bmp(file);
  if (start.starts_with("P7")) return read_pam(file);
  constexpr std::pair<std::string_view, const char*> kOthers[] = {
      {"\xff\x0a"sv, "JPEG XL"},
      {"\0\0\0\x0cJXL "sv, "JPEG XL"},
      {"8BPS"sv, "Photoshop"},
      {"v/1\x01"sv, "OpenEXR"},
      {"#?RADIANCE"sv, "Radiance HDR of floating-point numbers"},
      {"#?RGBE"sv, "Radiance HDR of floating-point numbers"},
      {"PF\n"sv, "PFM of floating-point numbers"},
      {"Pf\n"sv, "PFM of floating-point numbers"},
      {"FUJIFILM"sv, "camera raw"},
      {"IIU\0"sv, "camera raw"},
      {"IIRO"sv, "camera raw"},
      {"DDS "sv, "DDS"},
      {"%PDF"sv, "PDF"},
      {"<svg"sv, "SVG"},
      {"qoif"sv, "QOI"},
  };
  for (const auto& [magic, format] : kOthers) {
    if (start.starts_with(magic)) return not_supported(format);
  }
  if (start.size() >= 26 && start.substr(start.size() - 18).starts_with("TRUEVISION-XFILE.")) {
    return not_supported("TGA");
  }
  return {};
}

}  // namespace blitzgs::io
