// SPDX-License-Identifier: Apache-2.0
// The C interface of the host-side readers and writers, libblitzgs_io.so: one function that runs another one
// by its name. Arguments and results are columns of numbers or of characters. The library depends neither on
// torch nor on the version of Python; blitzgs/formats/native.py is its public face.
#include <stddef.h>
#include <stdint.h>

#include <algorithm>
#include <atomic>
#include <fstream>
#include <iterator>
#include <memory>
#include <new>
#include <tuple>
#include <utility>

#include "io/colmap.h"
#include "io/image_file.h"
#include "io/ply.h"

// The interface. Only these types and functions cross the border of the library, so that it contains the C++
// library that it was built with.
#define BLITZGS_IO_API __attribute__((visibility("default")))

extern "C" {

// The order is that of the numpy types in blitzgs/formats/native.py.
enum blitzgs_io_type {
  BLITZGS_IO_UINT8,
  BLITZGS_IO_UINT32,
  BLITZGS_IO_INT64,
  BLITZGS_IO_UINT64,
  BLITZGS_IO_FLOAT64,
};

// The order is that of the exceptions in blitzgs/formats/native.py.
enum blitzgs_io_status_code {
  BLITZGS_IO_OK,
  BLITZGS_IO_FORMAT_ERROR,  // a file is damaged
  BLITZGS_IO_VALUE_ERROR,   // arguments do not fit each other
  BLITZGS_IO_MEMORY_ERROR,
  BLITZGS_IO_ERROR,
  BLITZGS_IO_SYSTEM_ERROR,  // the message is that of io::SystemError
};

// Contiguous values of one type, or the characters of a text. Texts are two columns: their characters, and
// the end of each (uint64).
struct blitzgs_io_column {
  const void* data;
  size_t size;  // in values
  int32_t type;
};

struct blitzgs_io_reply;

// Runs a function of io_api.cpp. The columns of the reply live until it is freed. Null: no memory.
BLITZGS_IO_API blitzgs_io_reply* blitzgs_io_call(const char* name, const blitzgs_io_column* arguments,
                                                 size_t count);
BLITZGS_IO_API int blitzgs_io_status(const blitzgs_io_reply* reply);
BLITZGS_IO_API const char* blitzgs_io_message(const blitzgs_io_reply* reply);
BLITZGS_IO_API size_t blitzgs_io_columns(const blitzgs_io_reply* reply, const blitzgs_io_column** columns);
BLITZGS_IO_API void blitzgs_io_free(blitzgs_io_reply* reply);
}

namespace {

namespace io = blitzgs::io;
using Bytes = std::span<const uint8_t>;

template <class T> constexpr int32_t type_of() {
  if constexpr (std::is_same_v<T, uint8_t>) return BLITZGS_IO_UINT8;
  if constexpr (std::is_same_v<T, uint32_t>) return BLITZGS_IO_UINT32;
  if constexpr (std::is_same_v<T, int64_t>) return BLITZGS_IO_INT64;
  if constexpr (std::is_same_v<T, uint64_t>) return BLITZGS_IO_UINT64;
  if constexpr (std::is_same_v<T, double>) return BLITZGS_IO_FLOAT64;
}

class Arguments {
 public:
  explicit Arguments(std::span<const blitzgs_io_column> columns) : columns_(columns) {}

  template <class T> std::span<const T> take() {
    if (next_ == columns_.size()) throw std::logic_error("an argument is missing");
    const blitzgs_io_column& column = columns_[next_++];
    if (column.type != type_of<T>()) throw std::logic_error("an argument has another type");
    return {static_cast<const T*>(column.data), column.size};
  }
  template <class T = uint64_t> T number() { return take<T>()[0]; }
  std::string text() {
    const Bytes bytes = take<uint8_t>();
    return {bytes.begin(), bytes.end()};
  }

 private:
  std::span<const blitzgs_io_column> columns_;
  size_t next_ = 0;
};

}  // namespace

struct blitzgs_io_reply {
  int status = BLITZGS_IO_OK;
  std::string message;
  std::vector<blitzgs_io_column> columns;
  std::vector<std::shared_ptr<const void>> held;

  template <class... T> void add(std::vector<T>&&... values) {
    const auto add_one = [&]<class V>(std::vector<V>&& one) {
      const auto owner = std::make_shared<const std::vector<V>>(std::move(one));
      columns.push_back({owner->data(), owner->size(), type_of<V>()});
      held.push_back(owner);
    };
    (add_one(std::move(values)), ...);
  }
  template <class T = uint64_t> void add_number(T value) { add(std::vector<T>{value}); }
  void add_text(std::string_view text) { add(std::vector<uint8_t>(text.begin(), text.end())); }
  template <class Texts> void add_texts(const Texts& texts) {
    std::vector<uint8_t> bytes;
    std::vector<uint64_t> ends;
    for (const std::string_view text : texts) {
      bytes.insert(bytes.end(), text.begin(), text.end());
      ends.push_back(bytes.size());
    }
    add(std::move(bytes), std::move(ends));
  }
  uint8_t* add_uninitialised(size_t size) {
    const auto owner = std::make_shared_for_overwrite<uint8_t[]>(size);
    columns.push_back({owner.get(), size, BLITZGS_IO_UINT8});
    held.push_back(owner);
    return owner.get();
  }
};

namespace {

using Reply = blitzgs_io_reply;

bool is_text(const std::string& path) { return path.ends_with(".txt"); }

std::ifstream opened(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  if (!in) throw io::FormatError(path, "cannot be opened");
  return in;
}

void camera_models(Arguments&, Reply& reply) {
  std::vector<std::string_view> names, params;
  std::vector<int64_t> ids;
  for (const io::CameraModel& model : io::camera_models()) {
    ids.push_back(model.id);
    names.push_back(model.name);
    params.push_back(model.params);
  }
  reply.add(std::move(ids));
  reply.add_texts(names);
  reply.add_texts(params);
}

void read_cameras(Arguments& arguments, Reply& reply) {
  const std::string path = arguments.text();
  std::ifstream in = opened(path);
  const auto cameras = is_text(path) ? io::read_cameras_text(in, path) : io::read_cameras_binary(in, path);
  std::vector<uint32_t> ids;
  std::vector<std::string_view> models;
  std::vector<uint64_t> widths, heights, ends;
  std::vector<double> params;
  for (const io::ColmapCamera& camera : cameras) {
    ids.push_back(camera.id);
    models.push_back(io::find_camera_model(camera.model)->name);
    widths.push_back(camera.width);
    heights.push_back(camera.height);
    params.insert(params.end(), camera.params.begin(), camera.params.end());
    ends.push_back(params.size());
  }
  reply.add(std::move(ids));
  reply.add_texts(models);
  reply.add(std::move(widths), std::move(heights), std::move(params), std::move(ends));
}

void read_images(Arguments& arguments, Reply& reply) {
  const std::string path = arguments.text();
  const bool with_points2d = arguments.number() != 0;
  std::ifstream in = opened(path);
  auto i = (is_text(path) ? io::read_images_text : io::read_images_binary)(in, path, with_points2d);
  reply.add(std::move(i.ids), std::move(i.quats), std::move(i.translations), std::move(i.camera_ids));
  reply.add_texts(i.names);
  reply.add(std::move(i.point2d_offsets), std::move(i.points2d), std::move(i.point3d_ids));
}

void read_points(Arguments& arguments, Reply& reply) {
  const std::string path = arguments.text();
  const bool with_tracks = arguments.number() != 0;
  std::ifstream in = opened(path);
  auto p = (is_text(path) ? io::read_points_text : io::read_points_binary)(in, path, with_tracks);
  reply.add(std::move(p.ids), std::move(p.positions), std::move(p.colors), std::move(p.errors),
            std::move(p.track_offsets), std::move(p.track_image_ids), std::move(p.track_point2d_ids));
}

constexpr std::string_view kNumpyTypes[] = {"i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"};

void read_ply(Arguments& arguments, Reply& reply) {
  const std::string path = arguments.text();
  const uint64_t first = arguments.number(), most = arguments.number();
  std::ifstream in = opened(path);
  io::PlyTable table = io::read_ply(in, path, first, most);
  std::vector<std::string_view> names, types;
  for (const io::PlyProperty& property : table.properties) {
    names.push_back(property.name);
    types.push_back(kNumpyTypes[int(property.type)]);
  }
  reply.add_texts(table.comments);
  reply.add_texts(names);
  reply.add_texts(types);
  reply.add_number(table.count);
  reply.add(std::move(table.rows));
  reply.add_number(table.total);
}

std::string as_json(const io::ImageHeader& header) {
  constexpr std::string_view kAlpha[] = {"", "straight", "associated"};
  constexpr std::string_view kSamples[] = {"uint", "int", "float"};
  std::ostringstream json;
  json << std::boolalpha << R"({"format": ")" << header.format << R"(", "supported": )" << header.supported
       << R"(, "width": )" << header.width << R"(, "height": )" << header.height << R"(, "orientation": )"
       << header.orientation << R"(, "bits": )" << header.bits << R"(, "colors": )" << header.colors
       << R"(, "extras": )" << header.extras << R"(, "samples": ")" << kSamples[int(header.samples)]
       << R"(", "alpha": ")" << kAlpha[int(header.alpha)] << R"(", "transparent_grey": )"
       << (header.transparent_grey ? std::to_string(*header.transparent_grey) : "null")
       << R"(, "is_planar": )" << header.is_planar << R"(, "is_white_zero": )" << header.is_white_zero
       << R"(, "is_lossy": )" << header.is_lossy << "}";
  return json.str();
}

void read_image_header(Arguments& arguments, Reply& reply) {
  const Bytes file = arguments.take<uint8_t>();
  reply.add_text(as_json(io::read_image_header(file, arguments.text())));
}

void read_image_file(Arguments& arguments, Reply& reply) {
  const std::string path = arguments.text();
  std::vector<uint8_t> bytes = io::read_image_file(path);
  reply.add_text(as_json(io::read_image_header(bytes, path)));
  reply.add(std::move(bytes));
}

void tiff_as_stored(Arguments& arguments, Reply& reply) {
  const Bytes file = arguments.take<uint8_t>();
  reply.add(io::tiff_as_stored(file, arguments.text()));
}

void encode_qoi(Arguments& arguments, Reply& reply) {
  const Bytes rgb = arguments.take<uint8_t>();
  const auto height = uint32_t(arguments.number());
  const auto width = uint32_t(arguments.number());
  reply.add(io::encode_qoi(rgb.data(), {width, height}));
}

void decode_qoi(Arguments& arguments, Reply& reply) {
  const Bytes file = arguments.take<uint8_t>();
  const io::QoiSize size = io::qoi_size(file);
  reply.add(std::vector<uint64_t>{size.height, size.width});
  io::decode_qoi(file, reply.add_uninitialised(size_t{3} * size.height * size.width));
}

// Flags in memory that several processes share: a process that sees a flag sees all that was written before.
std::atomic_ref<uint8_t> flag_of(Arguments& arguments) {
  return std::atomic_ref(*const_cast<uint8_t*>(arguments.take<uint8_t>().data()));
}
void set_flag(Arguments& arguments, Reply&) { flag_of(arguments).store(1, std::memory_order_release); }
void flag_is_set(Arguments& arguments, Reply& reply) {
  reply.add_number<uint8_t>(flag_of(arguments).load(std::memory_order_acquire));
}

struct Function {
  std::string_view name;
  void (*call)(Arguments&, Reply&);
};
#define BLITZGS_IO_FUNCTION(name) {#name, &name}
constexpr Function kFunctions[] = {
    BLITZGS_IO_FUNCTION(camera_models),     BLITZGS_IO_FUNCTION(read_cameras),
    BLITZGS_IO_FUNCTION(read_images),       BLITZGS_IO_FUNCTION(read_points),
    BLITZGS_IO_FUNCTION(read_ply),          BLITZGS_IO_FUNCTION(read_image_file),
    BLITZGS_IO_FUNCTION(read_image_header), BLITZGS_IO_FUNCTION(tiff_as_stored),
    BLITZGS_IO_FUNCTION(encode_qoi),        BLITZGS_IO_FUNCTION(decode_qoi),
    BLITZGS_IO_FUNCTION(set_flag),          BLITZGS_IO_FUNCTION(flag_is_set),
};

std::pair<int, std::string> run(std::string_view name, Arguments arguments, Reply& reply) {
  try {
    const auto found = std::find_if(std::begin(kFunctions), std::end(kFunctions),
                                    [&](const Function& function) { return function.name == name; });
    if (found == std::end(kFunctions)) throw std::logic_error("there is no such function");
    found->call(arguments, reply);
    return {BLITZGS_IO_OK, ""};
  } catch (const io::FormatError& error) {
    return {BLITZGS_IO_FORMAT_ERROR, error.what()};
  } catch (const io::SystemError& error) {
    return {BLITZGS_IO_SYSTEM_ERROR, error.what()};
  } catch (const std::logic_error& error) {  // std::invalid_argument, mostly
    return {BLITZGS_IO_VALUE_ERROR, error.what()};
  } catch (const std::bad_alloc& error) {
    return {BLITZGS_IO_MEMORY_ERROR, error.what()};
  } catch (const std::exception& error) {
    return {BLITZGS_IO_ERROR, error.what()};
  }
}

}  // namespace

blitzgs_io_reply* blitzgs_io_call(const char* name, const blitzgs_io_column* arguments, size_t count) {
  try {
    auto reply = std::make_unique<blitzgs_io_reply>();
    std::tie(reply->status, reply->message) = run(name, Arguments({arguments, count}), *reply);
    return reply.release();
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}

int blitzgs_io_status(const blitzgs_io_reply* reply) { return reply->status; }
const char* blitzgs_io_message(const blitzgs_io_reply* reply) { return reply->message.c_str(); }
size_t blitzgs_io_columns(const blitzgs_io_reply* reply, const blitzgs_io_column** columns) {
  *columns = reply->columns.data();
  return reply->columns.size();
}
void blitzgs_io_free(blitzgs_io_reply* reply) { delete reply; }
