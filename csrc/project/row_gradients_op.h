// SPDX-License-Identifier: Apache-2.0
// Gradients of rows as the ops of the projection's backward pass are given them: four or five columns of the
// rows, or (CUDA) where they lie in the tables of the ranks that composited these. Columns may be views of
// one table, which CUDA then reads where it lies.
#pragma once
#include <algorithm>
#include <optional>
#include <vector>

#include "common/op.h"
#include "peers/peers_op.h"
#include "project/row_gradients.h"

namespace blitzgs {

// Buffers of all ranks, int32 [words], with a table from word `offset` on; in that of rank m, rows starts[m]
// to starts[m] + group_sizes[m] are of this rank, at the places [runs, M] of scatter/scatter.h.
struct GivenTables {
  const std::optional<Tensor>& places;
  const std::vector<std::int64_t>& group_sizes;
  const std::vector<std::int64_t>& starts;
  const std::optional<std::vector<Tensor>>& buffers;
  std::int64_t offset;
};

class HeldRowGradients {
 public:
#ifdef BLITZGS_BACKEND_CUDA
  template <class T>
  using Source = RowGradientSource;
#else
  template <class T>
  using Source = ProjectRowGradients<T>;
#endif

  // rows: P. sums: null, or [P, 2], for the sums of the gradients of means2d from tables.
  HeldRowGradients(const char* op, ScalarType dtype, std::int64_t rows, const std::optional<Tensor>& means2d,
                   const std::optional<Tensor>& conics, const std::optional<Tensor>& depths,
                   const std::optional<Tensor>& opacities, const std::optional<Tensor>& colors,
                   const GivenTables& tables, const std::optional<Tensor>& sums)
      : means2d_(means2d), conics_(conics), opacities_(opacities), depths_(depths), colors_(colors) {
    STD_TORCH_CHECK(
        tables.places ? !means2d && !conics && !depths && !opacities && !colors
                      : means2d && conics && opacities,
        "blitzgs::", op,
        ": gradients of rows must be columns (v_means2d, v_conics and opacities at least) or, with ",
        "places, in tables");
    if (tables.places) {
      hold_tables(op, rows, tables, sums);
      return;
    }
    STD_TORCH_CHECK(!sums, "blitzgs::", op, ": means2d_sums needs tables");
    check_shape(op, "v_means2d", *means2d, {rows, 2});
    check_shape(op, "v_conics", *conics, {rows, 3});
    check_shape(op, "v_row_opacities", *opacities, {rows});
    if (depths) check_shape(op, "v_depths", *depths, {rows});
    if (colors) check_shape(op, "v_colors", *colors, {rows, 3});
    each_column([&](const Tensor& column) { check_dtype(op, "row gradients", column, dtype); });
  }

  // What the kernels read; this has to outlive them.
  template <class T>
  Source<T> source() {
#ifdef BLITZGS_BACKEND_CUDA
    if (places_) return tables_;
    if (in_packed_table()) {
      return PackedRowGradients{reinterpret_cast<const PackedRowGradients::Row*>(data<float>(*means2d_))};
    }
#endif
    each_column([&](Tensor& column) { column = as_contiguous(column); });
    return ProjectRowGradients<T>{data<T>(*means2d_), data<T>(*conics_), data_or_null<T>(depths_),
                                  data<T>(*opacities_), data_or_null<T>(colors_)};
  }

 private:
  template <class F>
  void each_column(const F& f) {
    for (std::optional<Tensor>* column : {&means2d_, &conics_, &opacities_, &depths_, &colors_}) {
      if (*column) f(**column);
    }
  }

  static bool lies_at(const void* address, std::uintptr_t multiple) {
    return reinterpret_cast<std::uintptr_t>(address) % multiple == 0;
  }

  void hold_tables(const char* op, std::int64_t rows, const GivenTables& given,
                   const std::optional<Tensor>& sums) {
#ifdef BLITZGS_BACKEND_CUDA
    constexpr std::int64_t kWords = sizeof(PackedRowGradients::Row) / sizeof(std::int32_t);
    const RowGroups groups = checked_groups(op, "group_sizes", given.group_sizes);
    places_ = checked_places(op, *given.places, rows, groups.count);
    STD_TORCH_CHECK(given.buffers && !given.buffers->empty(), "blitzgs::", op, ": places need buffers");
    const std::vector<Tensor>& buffers = *given.buffers;
    STD_TORCH_CHECK(given.offset >= 0 && given.offset <= buffers[0].size(0), "blitzgs::", op,
                    ": offset must lie in the buffers, got ", given.offset);
    check_starts(op, buffers, given.starts, groups, (buffers[0].size(0) - given.offset) / kWords);
    tables_.places = places_in(*places_);
    tables_.n_ranks = groups.count;
    for (int m = 0; m < groups.count; ++m) {
      const std::int32_t* table = data<std::int32_t>(buffers[m]) + given.offset;
      STD_TORCH_CHECK(lies_at(table, alignof(PackedRowGradients::Row)), "blitzgs::", op,
                      ": tables must lie at a multiple of 16 bytes");
      tables_.tables[m] = reinterpret_cast<const PackedRowGradients::Row*>(table) + given.starts[m];
      tables_.sizes[m] = static_cast<std::int32_t>(groups.size[m]);
    }
    if (!sums) return;
    check_shape(op, "means2d_sums", *sums, {rows, 2});
    check_dtype(op, "means2d_sums", *sums, ScalarType::Float);
    STD_TORCH_CHECK(sums->is_contiguous(), "blitzgs::", op, ": means2d_sums must be contiguous");
    tables_.means2d = const_cast<float*>(data<float>(*sums));
#else
    STD_TORCH_CHECK(false, "blitzgs::", op, ": tables of ranks need CUDA");
#endif
  }

#ifdef BLITZGS_BACKEND_CUDA
  // Whether the columns are views of a table as the rasteriser's backward pass leaves it.
  bool in_packed_table() const {
    if (depths_ || !colors_) return false;
    const auto* table = data<float>(*means2d_);
    const std::int64_t width = sizeof(PackedRowGradients::Row) / sizeof(float);
    const auto follows = [&](const Tensor& column, int offset) {
      return data<float>(column) == table + offset && column.stride(0) == width &&
             (column.dim() == 1 || column.stride(1) == 1);
    };
    return lies_at(table, alignof(PackedRowGradients::Row)) && follows(*means2d_, 0) &&
           follows(*conics_, 2) && follows(*opacities_, 5) && follows(*colors_, 6);
  }

  TableRowGradients tables_{};
#endif

  std::optional<Tensor> means2d_, conics_, opacities_, depths_, colors_;
  std::optional<Tensor> places_;
};

}  // namespace blitzgs
