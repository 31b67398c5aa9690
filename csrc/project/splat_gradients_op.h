// SPDX-License-Identifier: Apache-2.0
// Gradients of splats as the ops of the projection's backward pass are given them, `v_splats`: the columns
// v_means2d, v_conics, v_opacities and perhaps v_colors; or (CUDA) one table of SplatGradient; or (CUDA),
// with `places`, this rank's part of such a table at each rank that composited its splats.
#pragma once
#include <optional>
#include <vector>

#include "common/op.h"
#include "project/splat_gradients.h"
#include "scatter/scatter_op.h"

namespace blitzgs {

class HeldSplatGradients {
 public:
#ifdef BLITZGS_BACKEND_CUDA
  template <class T>
  using Source = SplatGradientSource;
#else
  template <class T>
  using Source = SplatGradientColumns<T>;
#endif

  // splats: P. sums: none, or [P, 2], for the sums of the gradients of means2d from the ranks, or (absolute)
  // of their absolute values over pixels.
  HeldSplatGradients(const char* op, ScalarType dtype, std::int64_t splats,
                     const std::vector<Tensor>& v_splats, const std::optional<Tensor>& v_depths,
                     const std::optional<Tensor>& places, const std::optional<Tensor>& sums,
                     bool absolute = false)
      : held_(v_splats), depths_(v_depths), in_tables_(places || v_splats.size() == 1) {
#ifndef BLITZGS_BACKEND_CUDA
    STD_TORCH_CHECK(!in_tables_, "blitzgs::", op, ": tables of gradients need CUDA; give columns");
#endif
    STD_TORCH_CHECK(places || !sums, "blitzgs::", op, ": means2d_sums needs gradients at ranks");
    if (in_tables_) {
      STD_TORCH_CHECK(!v_depths, "blitzgs::", op, ": v_depths needs gradients in columns");
      for (const Tensor& table : held_) check_table(op, table);
      if (!places) check_shape(op, "v_splats[0]", held_[0], {splats, kSplatGradient});
      if (places) hold_ranks(op, splats, *places, sums);
      ranks_.absolute = absolute;
      return;
    }
    STD_TORCH_CHECK(v_splats.size() == 3 || v_splats.size() == 4, "blitzgs::", op,
                    ": v_splats must be v_means2d, v_conics, v_opacities[, v_colors] or one table, got ",
                    v_splats.size(), " tensors");
    check_column(op, "v_means2d", held_[0], dtype, {splats, 2});
    check_column(op, "v_conics", held_[1], dtype, {splats, 3});
    check_column(op, "v_opacities", held_[2], dtype, {splats});
    if (held_.size() == 4) check_column(op, "v_colors", held_[3], dtype, {splats, 3});
    if (depths_) check_column(op, "v_depths", *depths_, dtype, {splats});
  }

  // What the kernels read; this has to outlive them.
  template <class T>
  Source<T> source() const {
#ifdef BLITZGS_BACKEND_CUDA
    if (places_) return ranks_;
    if (in_tables_) return PackedSplatGradients{table(held_[0])};
#endif
    return SplatGradientColumns<T>{data<T>(held_[0]), data<T>(held_[1]), data_or_null<T>(depths_),
                                   data<T>(held_[2]), held_.size() == 4 ? data<T>(held_[3]) : nullptr};
  }

 private:
  static const SplatGradient* table(const Tensor& tensor) {
    return reinterpret_cast<const SplatGradient*>(data<float>(tensor));
  }

  static void check_column(const char* op, const char* name, Tensor& column, ScalarType dtype,
                           std::initializer_list<std::int64_t> shape) {
    check_shape(op, name, column, shape);
    check_dtype(op, name, column, dtype);
    column = as_contiguous(column);
  }

  static void check_table(const char* op, const Tensor& tensor) {
    check_shape(op, "a table of v_splats", tensor, {-1, kSplatGradient});
    check_dtype(op, "a table of v_splats", tensor, ScalarType::Float);
    STD_TORCH_CHECK(
        tensor.is_contiguous() &&
            reinterpret_cast<std::uintptr_t>(tensor.const_data_ptr()) % alignof(SplatGradient) == 0,
        "blitzgs::", op, ": a table of v_splats must be contiguous, at a multiple of 16 bytes");
  }

  void hold_ranks(const char* op, std::int64_t splats, const Tensor& places,
                  const std::optional<Tensor>& sums) {
    const auto n_ranks = static_cast<std::int64_t>(held_.size());
    STD_TORCH_CHECK(n_ranks >= 1 && n_ranks <= kMaxPeers, "blitzgs::", op, ": 1 to ", kMaxPeers,
                    " ranks can hold gradients, got ", n_ranks);
    places_ = checked_places(op, places, splats, n_ranks);
    ranks_.places = places_in(*places_);
    ranks_.n_ranks = static_cast<int>(n_ranks);
    for (std::int64_t m = 0; m < n_ranks; ++m) {
      ranks_.tables[m] = table(held_[m]);
      ranks_.sizes[m] = static_cast<std::int32_t>(held_[m].size(0));
    }
    if (!sums) return;
    check_shape(op, "means2d_sums", *sums, {splats, 2});
    check_dtype(op, "means2d_sums", *sums, ScalarType::Float);
    STD_TORCH_CHECK(sums->is_contiguous(), "blitzgs::", op, ": means2d_sums must be contiguous");
    ranks_.means2d = const_cast<float*>(data<float>(*sums));
  }

  std::vector<Tensor> held_;
  std::optional<Tensor> depths_, places_;
  bool in_tables_;
  RankSplatGradients ranks_{};
};

}  // namespace blitzgs
