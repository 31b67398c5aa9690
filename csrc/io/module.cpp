// SPDX-License-Identifier: Apache-2.0
// blitzgs._lib._io: the Python module of the host-side readers and writers. This is the only code that
// depends on the version of Python. Columns are returned as numpy arrays that own the parsed memory; files
// are parsed and written without the GIL.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <memory>
#include <span>
#include <stdexcept>
#include <string_view>

#include "io/colmap.h"
#include "io/image_header.h"
#include "io/jpeg.h"
#include "io/ply.h"
#include "io/qoi.h"

namespace py = pybind11;
using namespace py::literals;  // NOLINT
namespace io = blitzgs::io;

namespace {

template <class T>
using Column = py::array_t<T, py::array::c_style | py::array::forcecast>;

template <class T>
py::array_t<T> to_array(std::vector<T>&& values, py::ssize_t width = 0) {
  auto owner = std::make_unique<std::vector<T>>(std::move(values));
  const py::ssize_t size = static_cast<py::ssize_t>(owner->size());
  T* data = owner->data();
  py::capsule capsule(owner.get(), [](void* p) { delete static_cast<std::vector<T>*>(p); });
  owner.release();
  if (width == 0) return py::array_t<T>({size}, data, capsule);
  return py::array_t<T>({size / width, width}, data, capsule);
}

template <class T>
std::vector<T> to_vector(const py::dict& columns, const char* name) {
  const auto column = columns[name].cast<Column<T>>();
  return std::vector<T>(column.data(), column.data() + column.size());
}

// File names are bytes in the file system. Bytes that are not UTF-8 are decoded as by os.fsdecode.
py::list to_names(const std::vector<std::string>& names) {
  py::list out;
  for (const std::string& name : names) {
    PyObject* text = PyUnicode_DecodeFSDefaultAndSize(name.data(), static_cast<Py_ssize_t>(name.size()));
    if (!text) throw py::error_already_set();
    out.append(py::reinterpret_steal<py::object>(text));
  }
  return out;
}

std::vector<std::string> from_names(const py::handle& names) {
  std::vector<std::string> out;
  for (const py::handle name : names) {
    PyObject* bytes = PyUnicode_EncodeFSDefault(name.ptr());
    if (!bytes) throw py::error_already_set();
    out.push_back(py::reinterpret_steal<py::bytes>(bytes));
  }
  return out;
}

// Thrown if a file cannot be written; OSError in Python.
struct WriteError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

bool is_text(const std::string& path) { return path.ends_with(".txt"); }

// Runs `read(stream)` on the file without the GIL.
template <class Read>
auto from_file(const std::string& path, Read read) {
  py::gil_scoped_release release;
  std::ifstream in(path, std::ios::binary);
  if (!in) throw io::FormatError(path, "cannot be opened");
  return read(in);
}

template <class Write>
void to_file(const std::string& path, Write write) {
  py::gil_scoped_release release;
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  if (!out) throw WriteError(path + ": cannot be opened for writing: " + std::strerror(errno));
  write(out);
  out.close();
  if (!out) throw WriteError(path + ": writing failed: " + std::strerror(errno));
}

py::list camera_models() {
  py::list models;
  for (const io::CameraModel& model : io::camera_models()) {
    models.append(py::make_tuple(model.id, std::string(model.name), std::string(model.params)));
  }
  return models;
}

py::list read_cameras(const std::string& path) {
  auto cameras = from_file(path, [&](std::istream& in) {
    return is_text(path) ? io::read_cameras_text(in, path) : io::read_cameras_binary(in, path);
  });
  py::list out;
  for (io::ColmapCamera& camera : cameras) {
    out.append(py::make_tuple(camera.id, std::string(io::find_camera_model(camera.model)->name), camera.width,
                              camera.height, to_array(std::move(camera.params))));
  }
  return out;
}

py::dict read_images(const std::string& path, bool with_points2d) {
  auto images = from_file(path, [&](std::istream& in) {
    return is_text(path) ? io::read_images_text(in, path, with_points2d)
                         : io::read_images_binary(in, path, with_points2d);
  });
  return py::dict("ids"_a = to_array(std::move(images.ids)), "quats"_a = to_array(std::move(images.quats), 4),
                  "translations"_a = to_array(std::move(images.translations), 3),
                  "camera_ids"_a = to_array(std::move(images.camera_ids)), "names"_a = to_names(images.names),
                  "point2d_offsets"_a = to_array(std::move(images.point2d_offsets)),
                  "points2d"_a = to_array(std::move(images.points2d), 2),
                  "point3d_ids"_a = to_array(std::move(images.point3d_ids)));
}

py::dict read_points(const std::string& path, bool with_tracks) {
  auto points = from_file(path, [&](std::istream& in) {
    return is_text(path) ? io::read_points_text(in, path, with_tracks)
                         : io::read_points_binary(in, path, with_tracks);
  });
  return py::dict(
      "ids"_a = to_array(std::move(points.ids)), "positions"_a = to_array(std::move(points.positions), 3),
      "colors"_a = to_array(std::move(points.colors), 3), "errors"_a = to_array(std::move(points.errors)),
      "track_offsets"_a = to_array(std::move(points.track_offsets)),
      "track_image_ids"_a = to_array(std::move(points.track_image_ids)),
      "track_point2d_ids"_a = to_array(std::move(points.track_point2d_ids)));
}

using CameraRow = std::tuple<std::uint32_t, std::string, std::uint64_t, std::uint64_t, std::vector<double>>;

void write_cameras(const std::string& path, const std::vector<CameraRow>& rows) {
  std::vector<io::ColmapCamera> cameras;
  for (const auto& [id, model, width, height, params] : rows) {
    const io::CameraModel* known = io::find_camera_model(model);
    if (!known) throw std::invalid_argument("unknown camera model " + model);
    cameras.push_back({id, known->id, width, height, params});
  }
  io::check_columns(cameras);
  to_file(path, [&](std::ostream& out) {
    is_text(path) ? io::write_cameras_text(out, cameras) : io::write_cameras_binary(out, cameras);
  });
}

void write_images(const std::string& path, const py::dict& columns) {
  const io::ColmapImages images{to_vector<std::uint32_t>(columns, "ids"),
                                to_vector<std::uint32_t>(columns, "camera_ids"),
                                to_vector<double>(columns, "quats"),
                                to_vector<double>(columns, "translations"),
                                from_names(columns["names"]),
                                to_vector<std::uint64_t>(columns, "point2d_offsets"),
                                to_vector<double>(columns, "points2d"),
                                to_vector<std::int64_t>(columns, "point3d_ids")};
  // Before the file is opened, so that bad columns leave no file behind.
  io::check_columns(images);
  if (is_text(path)) io::check_text_names(images);
  to_file(path, [&](std::ostream& out) {
    is_text(path) ? io::write_images_text(out, images) : io::write_images_binary(out, images);
  });
}

void write_points(const std::string& path, const py::dict& columns) {
  const io::ColmapPoints points{to_vector<std::int64_t>(columns, "ids"),
                                to_vector<double>(columns, "positions"),
                                to_vector<std::uint8_t>(columns, "colors"),
                                to_vector<double>(columns, "errors"),
                                to_vector<std::uint64_t>(columns, "track_offsets"),
                                to_vector<std::uint32_t>(columns, "track_image_ids"),
                                to_vector<std::uint32_t>(columns, "track_point2d_ids")};
  io::check_columns(points);
  to_file(path, [&](std::ostream& out) {
    is_text(path) ? io::write_points_text(out, points) : io::write_points_binary(out, points);
  });
}

constexpr const char* kNumpyTypes[] = {"i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"};

py::tuple read_ply(const std::string& path, std::uint64_t first, std::uint64_t most) {
  auto table = from_file(path, [&](std::istream& in) { return io::read_ply(in, path, first, most); });
  py::list properties;
  for (const io::PlyProperty& property : table.properties) {
    properties.append(
        py::make_tuple(to_names({property.name})[0], kNumpyTypes[static_cast<int>(property.type)]));
  }
  return py::make_tuple(to_names(table.comments), properties, table.count, to_array(std::move(table.rows)),
                        table.total);
}

void write_ply(const std::string& path, const py::list& comments,
               const std::vector<std::pair<std::string, std::string>>& properties, std::uint64_t count,
               const Column<std::uint8_t>& rows) {
  io::PlyTable table{from_names(comments), {}, count, {}, count};
  for (const auto& [name, type] : properties) {
    const auto found = std::find(std::begin(kNumpyTypes), std::end(kNumpyTypes), type);
    if (found == std::end(kNumpyTypes)) throw std::invalid_argument("ply: unknown type " + type);
    table.properties.push_back({name, static_cast<io::PlyType>(found - std::begin(kNumpyTypes))});
  }
  table.rows.assign(rows.data(), rows.data() + rows.size());
  to_file(path, [&](std::ostream& out) { io::write_ply(out, table); });
}

void check_jpeg(const py::bytes& data, const std::string& name) {
  const std::string_view view = data;
  py::gil_scoped_release release;
  io::check_jpeg({reinterpret_cast<const std::uint8_t*>(view.data()), view.size()}, name);
}

io::ImageBytes bytes_of(const std::string_view& view) {
  return {reinterpret_cast<const std::uint8_t*>(view.data()), view.size()};
}

void check_png(const py::bytes& data, const std::string& name) {
  const std::string_view view = data;
  py::gil_scoped_release release;
  io::check_png(bytes_of(view), name);
}

py::dict read_image_header(const py::bytes& data, const std::string& name) {
  const io::ImageHeader header = io::read_image_header(bytes_of(data), name);
  constexpr const char* kAlpha[] = {"", "straight", "associated"};
  constexpr const char* kSamples[] = {"uint", "int", "float"};
  return py::dict("format"_a = header.format, "supported"_a = header.supported, "width"_a = header.width,
                  "height"_a = header.height, "orientation"_a = header.orientation, "bits"_a = header.bits,
                  "colors"_a = header.colors, "extras"_a = header.extras,
                  "samples"_a = kSamples[static_cast<int>(header.samples)],
                  "alpha"_a = kAlpha[static_cast<int>(header.alpha)],
                  "transparent_grey"_a = header.transparent_grey, "is_white_zero"_a = header.is_white_zero,
                  "is_planar"_a = header.is_planar, "is_lossy"_a = header.is_lossy);
}

py::bytes tiff_as_stored(const py::bytes& data, const std::string& name) {
  const std::vector<std::uint8_t> changed = io::tiff_as_stored(bytes_of(data), name);
  if (changed.empty()) return data;
  return py::bytes(reinterpret_cast<const char*>(changed.data()), changed.size());
}

py::bytes encode_qoi(const Column<std::uint8_t>& rgb) {
  if (rgb.ndim() != 3 || rgb.shape(2) != 3) throw std::invalid_argument("qoi: the image must be [H, W, 3]");
  const io::QoiSize size{static_cast<std::uint32_t>(rgb.shape(1)), static_cast<std::uint32_t>(rgb.shape(0))};
  std::vector<std::uint8_t> file;
  {
    py::gil_scoped_release release;
    file = io::encode_qoi(rgb.data(), size);
  }
  return py::bytes(reinterpret_cast<const char*>(file.data()), file.size());
}

py::array_t<std::uint8_t> decode_qoi(const py::bytes& data) {
  const std::string_view view = data;
  const std::span file(reinterpret_cast<const std::uint8_t*>(view.data()), view.size());
  const io::QoiSize size = io::qoi_size(file);
  py::array_t<std::uint8_t> rgb({static_cast<py::ssize_t>(size.height), static_cast<py::ssize_t>(size.width),
                                 static_cast<py::ssize_t>(3)});
  std::uint8_t* out = rgb.mutable_data();
  py::gil_scoped_release release;
  io::decode_qoi(file, out);
  return rgb;
}

// Flags in memory that several processes share: a process that sees a flag also sees all that was written
// before the flag was set.
std::atomic_ref<std::uint8_t> flag_of(py::array_t<std::uint8_t>& flags, py::ssize_t index) {
  return std::atomic_ref(flags.mutable_at(index));
}
void set_flag(py::array_t<std::uint8_t> flags, py::ssize_t index) {
  flag_of(flags, index).store(1, std::memory_order_release);
}
bool flag_is_set(py::array_t<std::uint8_t> flags, py::ssize_t index) {
  return flag_of(flags, index).load(std::memory_order_acquire) != 0;
}

}  // namespace

PYBIND11_MODULE(_io, m) {
  m.doc() = "Host-side I/O of BlitzGS; blitzgs.capture.colmap and blitzgs.formats.ply are its public face.";
  py::register_exception<io::FormatError>(m, "FormatError", PyExc_ValueError);
  py::register_exception<WriteError>(m, "WriteError", PyExc_OSError);
  m.def("camera_models", &camera_models);
  m.def("read_cameras", &read_cameras, "path"_a);
  m.def("read_images", &read_images, "path"_a, "with_points2d"_a);
  m.def("read_points", &read_points, "path"_a, "with_tracks"_a);
  m.def("write_cameras", &write_cameras, "path"_a, "cameras"_a);
  m.def("write_images", &write_images, "path"_a, "columns"_a);
  m.def("write_points", &write_points, "path"_a, "columns"_a);
  m.def("check_jpeg", &check_jpeg, "data"_a, "name"_a);
  m.def("check_png", &check_png, "data"_a, "name"_a);
  m.def("read_image_header", &read_image_header, "data"_a, "name"_a);
  m.def("tiff_as_stored", &tiff_as_stored, "data"_a, "name"_a);
  m.def("encode_qoi", &encode_qoi, "rgb"_a);
  m.def("decode_qoi", &decode_qoi, "data"_a);
  m.def("set_flag", &set_flag, "flags"_a.noconvert(), "index"_a);
  m.def("flag_is_set", &flag_is_set, "flags"_a.noconvert(), "index"_a);
  m.def("read_ply", &read_ply, "path"_a, "first"_a = 0, "most"_a = std::numeric_limits<std::uint64_t>::max());
  m.def("write_ply", &write_ply, "path"_a, "comments"_a, "properties"_a, "count"_a, "rows"_a);
}
