// SPDX-License-Identifier: Apache-2.0
// The torch helpers of all *_op.cpp files: checks with full messages, allocation, dispatch over dtypes. Each
// is compiled once per backend; `backend` names the namespace of that backend's kernels.
#pragma once
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <array>
#include <initializer_list>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/rows.h"
#include "math/tiles.h"

#ifdef BLITZGS_BACKEND_CUDA
#define BLITZGS_DISPATCH_KEY CUDA
#define BLITZGS_ON_CUDA true
#else
#define BLITZGS_DISPATCH_KEY CPU
#define BLITZGS_ON_CUDA false
#endif

// STABLE_TORCH_LIBRARY_IMPL pastes its key, so the macro of the key is expanded first. One a file.
#define BLITZGS_REGISTER_EXPANDED(key, m) STABLE_TORCH_LIBRARY_IMPL(blitzgs, key, m)
#define BLITZGS_REGISTER(m) BLITZGS_REGISTER_EXPANDED(BLITZGS_DISPATCH_KEY, m)
#define BLITZGS_OP(m, name, function) m.impl(name, ::blitzgs::named_op<name, TORCH_BOX(&::blitzgs::function)>)

namespace blitzgs::BLITZGS_BACKEND {}

namespace blitzgs {

namespace backend = BLITZGS_BACKEND;
inline constexpr bool kOnCuda = BLITZGS_ON_CUDA;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using OptionalTensor = std::optional<Tensor>;
using TensorList = std::vector<Tensor>;
using IntList = std::vector<int64_t>;
using FloatList = std::vector<double>;
// The N results of an op.
template <size_t N> using Tensors = decltype(std::tuple_cat(std::array<Tensor, N>()));

inline std::string shape_of(const Tensor& tensor) {
  std::ostringstream text;
  text << '[';
  for (int64_t i = 0; i < tensor.dim(); ++i) text << (i ? ", " : "") << tensor.size(i);
  text << ']';
  return text.str();
}

// The number of elements of a row behind its first `axis` dimensions.
inline int64_t elements_behind(const Tensor& column, int64_t axis = 1) {
  int64_t elements = 1;
  for (; axis < column.dim(); ++axis) elements *= column.size(axis);
  return elements;
}

// An error in the arguments of an op, without the op's name, which BLITZGS_OP adds.
struct CheckFailed : std::runtime_error {
  using std::runtime_error::runtime_error;
};

template <typename... Parts> [[noreturn]] void fail(const Parts&... parts) {
  std::ostringstream text;
  (text << ... << parts);
  throw CheckFailed(text.str());
}

// Throws the message unless a condition holds. Unlike STD_TORCH_CHECK, without the path of the source.
#define BLITZGS_CHECK(condition, ...) \
  do {                                \
    if (!(condition)) [[unlikely]]    \
      ::blitzgs::fail(__VA_ARGS__);   \
  } while (false)

template <size_t Length> struct OpName {
  char text[Length];
  constexpr OpName(const char (&name)[Length]) { std::copy_n(name, Length, text); }
};

// The boxed function of an op, whose errors begin with "blitzgs::<op>: ".
template <OpName name, auto boxed>
void named_op(StableIValue* stack, uint64_t n_arguments, uint64_t n_results) {
  try {
    boxed(stack, n_arguments, n_results);
  } catch (const CheckFailed& error) {
    throw std::runtime_error("blitzgs::" + std::string(name.text) + ": " + error.what());
  }
}

// shape: one entry per dimension, -1 for any size. The message is built only if the check fails, because a
// step checks some two hundred tensors while the GPU waits for its next kernel.
inline void check_shape(const char* name, const Tensor& tensor, std::initializer_list<int64_t> shape) {
  bool ok = tensor.dim() == int64_t(shape.size());
  int64_t axis = 0;
  for (const int64_t size : shape) {
    ok = ok && (size < 0 || tensor.size(axis) == size);
    ++axis;
  }
  if (ok) return;
  std::ostringstream wanted;
  for (const int64_t size : shape) {
    wanted << (wanted.tellp() > 0 ? ", " : "") << (size < 0 ? "*" : std::to_string(size));
  }
  BLITZGS_CHECK(false, name, " must have shape [", wanted.str(), "], got ", shape_of(tensor));
}

// Checks the number of entries of a group of arguments, whose `names` are for the message.
template <class List> void check_group(const char* names, const List& list, size_t least, size_t most) {
  BLITZGS_CHECK(list.size() >= least && list.size() <= most, "expected ", names, ", got ", list.size(),
                " entries");
}

inline void check_dtype(const char* name, const Tensor& tensor, ScalarType dtype) {
  BLITZGS_CHECK(tensor.scalar_type() == dtype, name, " must be ", torch::headeronly::toString(dtype),
                ", got ", torch::headeronly::toString(tensor.scalar_type()));
}

// Checks that a tensor is on the device of `like`, which the message calls `of`. A kernel that reads memory
// of the host ends all further work of the process on the GPU.
inline void check_device(const char* name, const Tensor& tensor, const Tensor& like, const char* of) {
  BLITZGS_CHECK(tensor.is_cpu() == like.is_cpu() && tensor.get_device_index() == like.get_device_index(),
                name, " must be on the device of ", of);
}

inline void check_contiguous(const char* name, const Tensor& tensor) {
  BLITZGS_CHECK(tensor.is_contiguous(), name, " must be contiguous");
}

// Checks a tensor that kernels read or write in its own memory, so that it must be contiguous.
inline void check_in_place(const char* name, const Tensor& tensor, ScalarType dtype,
                           std::initializer_list<int64_t> shape) {
  check_dtype(name, tensor, dtype);
  check_shape(name, tensor, shape);
  check_contiguous(name, tensor);
}

// float32 everywhere; float64 on the CPU, where it serves gradcheck and accuracy figures.
inline void check_floating(const char* name, const Tensor& tensor) {
  const ScalarType dtype = tensor.scalar_type();
  BLITZGS_CHECK(dtype == ScalarType::Float || (!kOnCuda && dtype == ScalarType::Double), name,
                kOnCuda ? " must be float32 on CUDA (float64 runs on the CPU), got "
                        : " must be float32 or float64, got ",
                torch::headeronly::toString(dtype));
}

// Tests is_contiguous() first, because most tensors are contiguous, and torch::stable::contiguous() looks the
// op up by name, which takes microseconds.
inline Tensor as_contiguous(const Tensor& tensor) {
  return tensor.is_contiguous() ? tensor : torch::stable::contiguous(tensor);
}

// Checks a tensor that kernels only read, and returns it in contiguous memory.
inline Tensor checked(const char* name, const Tensor& tensor, ScalarType dtype,
                      std::initializer_list<int64_t> shape) {
  check_dtype(name, tensor, dtype);
  check_shape(name, tensor, shape);
  return as_contiguous(tensor);
}

inline OptionalTensor checked(const char* name, const OptionalTensor& tensor, ScalarType dtype,
                              std::initializer_list<int64_t> shape) {
  return tensor ? std::optional(checked(name, *tensor, dtype, shape)) : std::nullopt;
}

template <class T> const T* data(const Tensor& tensor) {
  return static_cast<const T*>(tensor.const_data_ptr());
}
template <class T> T* mutable_data(const Tensor& tensor) {
  return static_cast<T*>(tensor.mutable_data_ptr());
}
template <class T> const T* data_or_null(const OptionalTensor& tensor) {
  return tensor ? static_cast<const T*>(tensor->const_data_ptr()) : nullptr;
}

// A tensor whose values are of type T, and which converts to their address. const T: they are only read.
template <class T> struct Values : Tensor {
  explicit Values(const Tensor& tensor) : Tensor(tensor) {}
  T* data() const {
    if constexpr (std::is_const_v<T>) return static_cast<T*>(const_data_ptr());
    return static_cast<T*>(mutable_data_ptr());
  }
  T* data_if(bool wanted) const { return wanted ? data() : nullptr; }
  operator T*() const { return data(); }
};

template <class T> struct OptionalValues : std::optional<Values<T>> {
  operator T*() const { return this->has_value() ? (*this)->data() : nullptr; }
};

template <class T> using dtype_of = torch::headeronly::CppTypeToScalarType<T>;

template <class T>
Values<const T> checked(const char* name, const Tensor& tensor, std::initializer_list<int64_t> shape) {
  return Values<const T>(checked(name, tensor, dtype_of<T>::value, shape));
}

template <class T>
OptionalValues<const T> checked(const char* name, const OptionalTensor& tensor,
                                std::initializer_list<int64_t> shape) {
  OptionalValues<const T> values;
  if (tensor) values.emplace(checked<T>(name, *tensor, shape));
  return values;
}

// Checks a tensor that kernels read or write in its own memory, so that it must be contiguous.
template <class T>
Values<T> checked_in_place(const char* name, const Tensor& tensor, std::initializer_list<int64_t> shape) {
  check_in_place(name, tensor, dtype_of<T>::value, shape);
  return Values<T>(tensor);
}

// Calls the C functions of torch directly, because a step allocates some sixty tensors.
inline Tensor make_empty(const Tensor& like, const IntList& shape,
                         std::optional<ScalarType> dtype = std::nullopt) {
  const auto rank = int64_t(shape.size());
  IntList strides(shape.size(), 1);
  for (int64_t i = rank - 1; i > 0; --i) strides[i - 1] = strides[i] * std::max<int64_t>(shape[i], 1);
  int32_t device_type = 0;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_device_type(like.get(), &device_type));
  AtenTensorHandle handle = nullptr;
  TORCH_ERROR_CODE_CHECK(aoti_torch_empty_strided(rank, shape.data(), strides.data(),
                                                  int32_t(dtype.value_or(like.scalar_type())), device_type,
                                                  like.get_device_index(), &handle));
  return Tensor(handle);
}

template <class T> Values<T> make(const Tensor& like, const IntList& shape) {
  return Values<T>(make_empty(like, shape, dtype_of<T>::value));
}

// A tensor in the memory of another one, `offset` elements after its begin. Autograd sees no view.
inline Tensor view_of(const Tensor& tensor, const IntList& shape, const IntList& strides, int64_t offset) {
  AtenTensorHandle handle = nullptr;
  // Despite the name of its parameter, torch adds the offset to that of the tensor.
  TORCH_ERROR_CODE_CHECK(aoti_torch__reinterpret_tensor(tensor.get(), int64_t(shape.size()), shape.data(),
                                                        strides.data(), offset, &handle));
  return Tensor(handle);
}

// An upper bound on the number of valid entries of a list of `capacity`, of which the first count [1] are
// valid (absent: all). On CUDA it is the capacity: kernels alone read the count.
inline int64_t max_listed(const OptionalTensor& count, int64_t capacity) {
  if (!count) return capacity;
  check_dtype("the count of a list", *count, ScalarType::Int);
  check_shape("the count of a list", *count, {1});
  if (kOnCuda) return capacity;
  const int64_t listed = *data<int32_t>(*count);
  BLITZGS_CHECK(listed >= 0 && listed <= capacity, "a list of ", capacity, " cannot have ", listed,
                " entries");
  return listed;
}

class TorchWorkspace final : public Workspace {
 public:
  explicit TorchWorkspace(const Tensor& like) : like_(like) {}
  void* allocate_bytes(size_t bytes) override {
    held_.push_back(make_empty(like_, {int64_t(bytes)}, ScalarType::Byte));
    return held_.back().mutable_data_ptr();
  }

 private:
  Tensor like_;
  TensorList held_;
};

// Makes the device of the tensor current and finds its stream (CUDA), and lends scratch memory.
struct DeviceScope {
  explicit DeviceScope(const Tensor& like)
      : workspace(like)
#ifdef BLITZGS_BACKEND_CUDA
        ,
        guard(like.get_device_index())
#endif
  {
#ifdef BLITZGS_BACKEND_CUDA
    void* handle = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(like.get_device_index(), &handle));
    stream = static_cast<CudaStream>(handle);
#endif
  }

  TorchWorkspace workspace;
  CudaStream stream = nullptr;
#ifdef BLITZGS_BACKEND_CUDA
  torch::stable::accelerator::DeviceGuard guard;
#endif
};

// for_each_row() on the device and stream of `like`.
template <class Rows> void run_rows(const Tensor& like, const Rows& work) {
  DeviceScope scope(like);
  backend::for_each_row(work, scope.stream);
}

// Returns f<T>() with T = float or double by the tensor's dtype (CUDA: float only).
template <class F> auto dispatch_floating([[maybe_unused]] const Tensor& tensor, const F& f) {
#ifndef BLITZGS_BACKEND_CUDA
  if (tensor.scalar_type() == ScalarType::Double) return f.template operator()<double>();
#endif
  return f.template operator()<float>();
}

// The optional argument n_splats of an op, int64 [1]: how many splats of its columns are valid (kernel.h).
struct SplatCount {
  int64_t n_splats;             // the capacity of the columns
  const int64_t* known_splats;  // null: all n_splats are valid; else kernels read the number here
};

inline SplatCount checked_splat_count(const OptionalTensor& n_splats, const Tensor& splats) {
  const int64_t capacity = splats.size(0);
  BLITZGS_CHECK(capacity <= INT32_MAX, "splat indices are 32-bit, got ", capacity,
                " splats; render fewer views at once");
  if (!n_splats) return {capacity, nullptr};
  check_dtype("n_splats", *n_splats, ScalarType::Long);
  check_shape("n_splats", *n_splats, {1});
  check_device("n_splats", *n_splats, splats, "the splats");
  if (kOnCuda) return {capacity, data<int64_t>(*n_splats)};
  return {valid_splat_count(capacity, data<int64_t>(*n_splats)), nullptr};
}

inline void check_tile_range(int64_t begin, int64_t end, int64_t tiles) {
  BLITZGS_CHECK(0 <= begin && begin <= end && end <= tiles, "tile_begin and tile_end must be a range of the ",
                tiles, " tiles, got [", begin, ", ", end, ")");
}

// The tiles that an op composites, in its arguments. tile_end: -1 for all tiles.
#define BLITZGS_TILES \
  int64_t n_cameras, int64_t width, int64_t height, int64_t tile_size, int64_t tile_begin, int64_t tile_end

inline TileGrid checked_tile_grid(BLITZGS_TILES) {
  constexpr int64_t kMax = INT32_MAX;
  BLITZGS_CHECK(n_cameras >= 0 && n_cameras <= kMax, "n_cameras must be at least 0, got ", n_cameras);
  BLITZGS_CHECK(width > 0 && height > 0 && width <= (1 << 20) && height <= (1 << 20),
                "width and height must be in [1, 2^20], got ", width, " x ", height);
  BLITZGS_CHECK(tile_size > 0 && tile_size <= 64, "tile_size must be in [1, 64], got ", tile_size);
  const TileGrid grid =
      make_tile_grid(int(n_cameras), int(width), int(height), int(tile_size), tile_begin, tile_end);
  check_tile_range(grid.tile_begin, grid.tile_end, grid.count());
  return grid;
}

// Checks a tensor in pinned memory of the host to which kernels write.
inline void check_host_values(const Tensor& host, std::initializer_list<int64_t> shape) {
  check_in_place("host", host, ScalarType::Long, shape);
  BLITZGS_CHECK(host.is_cpu(), "host must be in pinned memory of the host");
}

}  // namespace blitzgs
