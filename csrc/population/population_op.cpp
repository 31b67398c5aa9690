// SPDX-License-Identifier: Apache-2.0
#include "population/density.h"

#include "common/op.h"
#include "common/rows.h"
#include "population/columns.h"
#include "population/knn.h"
#include "population/relocation.h"

namespace blitzgs {
namespace {

constexpr const char* kDensityStats = "density_stats_";

void density_stats_(Tensor grad_sum, Tensor grad_count, Tensor max_radii, const Tensor& visible_ids_in,
                    const Tensor& splat_offsets_in, const Tensor& v_means2d_in, const Tensor& conics_in,
                    const std::optional<Tensor>& phi_in, std::int64_t width, std::int64_t height,
                    double weight) {
  check_floating(kDensityStats, "grad_sum", grad_sum);
  const ScalarType dtype = grad_sum.scalar_type();
  const std::int64_t rows = grad_sum.numel();
  check_in_place(kDensityStats, "grad_sum", grad_sum, dtype, {rows});
  check_in_place(kDensityStats, "grad_count", grad_count, ScalarType::Int, {rows});
  check_in_place(kDensityStats, "max_radii", max_radii, dtype, {rows});
  const Tensor visible_ids = checked(kDensityStats, "visible_ids", visible_ids_in, ScalarType::Int, {-1});
  const std::int64_t visible = visible_ids.size(0);
  const Tensor splat_offsets =
      checked(kDensityStats, "splat_offsets", splat_offsets_in, ScalarType::Int, {visible + 1});
  const Tensor conics = checked(kDensityStats, "conics", conics_in, dtype, {-1, 3});
  const std::optional<Tensor> phi = checked(kDensityStats, "phi", phi_in, dtype, {rows});
  check_dtype(kDensityStats, "v_means2d", v_means2d_in, dtype);
  check_shape(kDensityStats, "v_means2d", v_means2d_in, {conics.size(0), 2});
  if (visible == 0) return;
  // If v_means2d is a part of the rows of a gradient table, the kernel reads it there, without a copy.
  const Tensor v_means2d = v_means2d_in.stride(1) == 1 ? v_means2d_in : as_contiguous(v_means2d_in);

  DeviceScope scope(grad_sum);
  dispatch_floating(grad_sum, [&]<class T>() {
    const DensityStats<T> args{mutable_data<T>(grad_sum),
                               mutable_data<std::int32_t>(grad_count),
                               mutable_data<T>(max_radii),
                               data<std::int32_t>(visible_ids),
                               data<std::int32_t>(splat_offsets),
                               data<T>(v_means2d),
                               v_means2d.stride(0),
                               data<T>(conics),
                               data_or_null<T>(phi),
                               visible,
                               static_cast<T>(width) / 2,
                               static_cast<T>(height) / 2,
                               static_cast<T>(weight)};
    backend::for_each_row(args, scope.stream);
  });
}

std::int64_t row_elements(const Tensor& column) {
  std::int64_t elements = 1;
  for (std::int64_t axis = 1; axis < column.dim(); ++axis) elements *= column.size(axis);
  return elements;
}

// Copies rows of `column` (absent: zeros) to `out`; from and to (columns.h) are absent or int64 [n].
void copy_rows(const char* op, Tensor& out, const std::optional<Tensor>& to, const Tensor* column,
               const std::optional<Tensor>& from, std::int64_t n, CudaStream stream) {
  const std::int64_t row_bytes = row_elements(out) * static_cast<std::int64_t>(out.element_size());
  BLITZGS_CHECK(row_bytes < (1 << 16), op, "rows must be shorter than 64 KiB, got ", row_bytes, " bytes");
  backend::copy_rows({column ? static_cast<const std::byte*>(column->const_data_ptr()) : nullptr,
                      data_or_null<std::int64_t>(from), static_cast<std::byte*>(out.mutable_data_ptr()),
                      data_or_null<std::int64_t>(to), n, row_bytes},
                     stream);
}

void check_rows_alike(const char* op, const char* name, const Tensor& rows, const Tensor& column) {
  check_dtype(op, name, rows, column.scalar_type());
  BLITZGS_CHECK(rows.dim() == column.dim() && row_elements(rows) == row_elements(column), op, "rows of ",
                name, " must be like those of column, got ", shape_of(rows), " for ", shape_of(column));
}

// Checks tensors that the op writes: with rows, in contiguous memory, and on the device of `rows`.
void check_written(const char* op, const char* name, const Tensor& written, const Tensor& rows) {
  BLITZGS_CHECK(written.dim() >= 1, op, name, " must have rows, got ", shape_of(written));
  check_contiguous(op, name, written);
  check_device(op, name, written, rows, "rows");
}

void take_rows_(std::vector<Tensor> out, const std::vector<Tensor>& columns, const Tensor& rows_in) {
  constexpr const char* kOp = "take_rows";
  BLITZGS_CHECK(out.size() == columns.size(), kOp, "there must be as many out as columns, got ", out.size(),
                " for ", columns.size());
  const std::optional<Tensor> rows = checked(kOp, "rows", rows_in, ScalarType::Long, {-1});
  const std::int64_t n = rows->size(0);
  DeviceScope scope(*rows);
  for (std::size_t c = 0; c < columns.size(); ++c) {
    BLITZGS_CHECK(columns[c].dim() >= 1, kOp, "column must have rows, got ", shape_of(columns[c]));
    check_device(kOp, "column", columns[c], *rows, "rows");
    check_written(kOp, "out", out[c], *rows);
    check_rows_alike(kOp, "out", out[c], columns[c]);
    BLITZGS_CHECK(out[c].size(0) == n, kOp, "out must have ", n, " rows, got ", shape_of(out[c]));
    const Tensor column = as_contiguous(columns[c]);
    copy_rows(kOp, out[c], std::nullopt, &column, rows, n, scope.stream);
  }
}

void put_rows_(std::vector<Tensor> columns, const Tensor& rows_in, const std::vector<Tensor>& fresh) {
  constexpr const char* kOp = "put_rows_";
  BLITZGS_CHECK(fresh.empty() || fresh.size() == columns.size(), kOp,
                "fresh must be empty or as many as columns, got ", fresh.size(), " for ", columns.size());
  const std::optional<Tensor> rows = checked(kOp, "rows", rows_in, ScalarType::Long, {-1});
  const std::int64_t n = rows->size(0);
  DeviceScope scope(*rows);
  for (std::size_t c = 0; c < columns.size(); ++c) {
    check_written(kOp, "column", columns[c], *rows);
    if (fresh.empty()) {
      copy_rows(kOp, columns[c], rows, nullptr, std::nullopt, n, scope.stream);
      continue;
    }
    check_device(kOp, "fresh", fresh[c], *rows, "rows");
    check_rows_alike(kOp, "fresh", fresh[c], columns[c]);
    BLITZGS_CHECK(fresh[c].size(0) == n, kOp, "fresh must have ", n, " rows, got ", shape_of(fresh[c]));
    const Tensor values = as_contiguous(fresh[c]);
    copy_rows(kOp, columns[c], rows, &values, std::nullopt, n, scope.stream);
  }
}

Tensor hash_with_key(const Tensor& hashes_in, const std::optional<Tensor>& keys_in, std::int64_t number) {
  constexpr const char* kOp = "hash_key";
  const Tensor hashes = checked(kOp, "hashes", hashes_in, ScalarType::Long, {-1});
  const std::int64_t n = hashes.size(0);
  const std::optional<Tensor> keys = checked(kOp, "keys", keys_in, ScalarType::Long, {n});
  Tensor out = make_empty(hashes, {n});
  DeviceScope scope(hashes);
  backend::for_each_row(HashKey{data<std::int64_t>(hashes), data_or_null<std::int64_t>(keys), number, n,
                                mutable_data<std::int64_t>(out)},
                        scope.stream);
  return out;
}

Tensor overlap(const Tensor& opacities_in, const Tensor& copies_in) {
  constexpr const char* kOp = "overlap";
  const Tensor opacities = checked(kOp, "opacities", opacities_in, ScalarType::Double, {-1}),
               copies = checked(kOp, "copies", copies_in, ScalarType::Long, {opacities.size(0)});
  Tensor overlaps = make_empty(opacities, {opacities.size(0)});
  DeviceScope scope(opacities);
  backend::for_each_row(Overlap{data<double>(opacities), data<std::int64_t>(copies), opacities.size(0),
                                mutable_data<double>(overlaps)},
                        scope.stream);
  return overlaps;
}

void share_rows_(Tensor opacities, Tensor scales, std::vector<Tensor> moments, const Tensor& rows_in,
                 const Tensor& copies_in, double least) {
  constexpr const char* kOp = "share_rows_";
  check_in_place(kOp, "opacities", opacities, ScalarType::Float, {-1});
  const std::int64_t count = opacities.size(0);
  check_in_place(kOp, "scales", scales, ScalarType::Float, {count, 3});
  const Tensor rows = checked(kOp, "rows", rows_in, ScalarType::Long, {-1}),
               copies = checked(kOp, "copies", copies_in, ScalarType::Long, {rows.size(0)});
  BLITZGS_CHECK(moments.size() == ShareRows::kColumns, kOp, "there must be ", ShareRows::kColumns,
                " moments, got ", moments.size());
  DeviceScope scope(opacities);
  ShareRows args{mutable_data<float>(opacities), mutable_data<float>(scales), {},
                 data<std::int64_t>(rows),       data<std::int64_t>(copies),  rows.size(0),
                 static_cast<float>(least)};
  for (int c = 0; c < ShareRows::kColumns; ++c) {
    check_dtype(kOp, "a moment", moments[c], ScalarType::Float);
    check_written(kOp, "a moment", moments[c], rows);
    BLITZGS_CHECK(moments[c].size(0) == count, kOp, "a moment must have ", count, " rows, got ",
                  shape_of(moments[c]));
    args.moments[c] = {mutable_data<float>(moments[c]), static_cast<int>(row_elements(moments[c]))};
  }
  backend::for_each_row(args, scope.stream);
}

Tensor sampling_keys(const Tensor& weights_in, const Tensor& ids_in, std::int64_t seed, std::int64_t event) {
  constexpr const char* kOp = "sampling_keys";
  const Tensor weights = checked(kOp, "weights", weights_in, ScalarType::Float, {-1}),
               ids = checked(kOp, "ids", ids_in, ScalarType::Long, {weights.size(0)});
  Tensor keys = make_empty(weights, {weights.size(0)});
  DeviceScope scope(weights);
  backend::sampling_keys({data<float>(weights), data<std::int64_t>(ids), weights.size(0), seed, event,
                          mutable_data<float>(keys)},
                         scope.stream);
  return keys;
}

Tensor key_histogram(const Tensor& keys_in, const Tensor& prefix_in, std::int64_t shift, std::int64_t width) {
  constexpr const char* kOp = "key_histogram";
  const Tensor keys = checked(kOp, "keys", keys_in, ScalarType::Float, {-1}),
               prefix = checked(kOp, "prefix", prefix_in, ScalarType::Long, {1});
  BLITZGS_CHECK(width >= 1 && width <= kMaxDigitBits && shift >= 0 && shift + width <= 32, kOp,
                "a digit must have 1 to ", kMaxDigitBits, " of 32 bits, got ", width, " after ", shift);
  Tensor counts = make_empty(keys, {std::int64_t{1} << width}, ScalarType::Long);
  DeviceScope scope(keys);
  backend::key_histogram(
      {data<float>(keys), data<std::int64_t>(prefix), keys.size(0), static_cast<int>(shift),
       static_cast<int>(width), mutable_data<std::int64_t>(counts)},
      scope.stream);
  return counts;
}

Tensor find_non_finite(const std::vector<Tensor>& columns_in, const std::vector<Tensor>& nonzero_in) {
  constexpr const char* kOp = "find_non_finite";
  BLITZGS_CHECK(!columns_in.empty(), kOp, "there must be columns");
  std::vector<Tensor> columns;
  for (const std::vector<Tensor>* list : {&columns_in, &nonzero_in}) {
    for (const Tensor& column : *list) {
      check_floating(kOp, "a column", column);
      check_dtype(kOp, "a column", column, columns_in[0].scalar_type());
      columns.push_back(as_contiguous(column));
    }
  }
  Tensor bad = make_empty(columns[0], {}, ScalarType::Int);
  DeviceScope scope(columns[0]);
  backend::clear_flag(mutable_data<std::int32_t>(bad), scope.stream);
  dispatch_floating(columns[0], [&]<class T>() {
    for (std::size_t first = 0; first < columns.size(); first += kMaxCheckedColumns) {
      CheckedColumns<T> checked{{}, 0, mutable_data<std::int32_t>(bad)};
      for (std::size_t c = first; c < columns.size() && checked.n < kMaxCheckedColumns; ++c) {
        checked.columns[checked.n++] = {data<T>(columns[c]), columns[c].numel(), c >= columns_in.size()};
      }
      backend::check_columns(checked, scope.stream);
    }
  });
  return bad;
}

constexpr const char* kTreeSums = "tree_sums";
constexpr std::int64_t kMaxFeatures = 32;  // the features of a block's rows are in shared memory

Tensor tree_sums(const Tensor& features_in, const Tensor& roots_in, const Tensor& nodes_in,
                 const Tensor& leaves_in, std::int64_t depth) {
  const Tensor features = checked(kTreeSums, "features", features_in, ScalarType::Float, {-1, -1}),
               roots = checked(kTreeSums, "roots", roots_in, ScalarType::Int, {-1}),
               nodes = checked(kTreeSums, "nodes", nodes_in, ScalarType::Int, {-1, 4}),
               leaves = checked(kTreeSums, "leaves", leaves_in, ScalarType::Long, {nodes.size(0)});
  const std::int64_t rows = features.size(0), n_features = features.size(1);
  BLITZGS_CHECK(n_features <= kMaxFeatures, kTreeSums, "at most ", kMaxFeatures, " features, got ",
                n_features);
  BLITZGS_CHECK(depth >= 0, kTreeSums, "depth must not be negative, got ", depth);
  Tensor sums = make_empty(features, {rows}, ScalarType::Long);
  DeviceScope scope(features);
  const TreeSumsArgs args{data<float>(features),
                          data<std::int32_t>(roots),
                          reinterpret_cast<const TreeNode*>(data<std::int32_t>(nodes)),
                          data<std::int64_t>(leaves),
                          rows,
                          n_features,
                          static_cast<int>(roots.numel()),
                          static_cast<int>(depth),
                          mutable_data<std::int64_t>(sums)};
  backend::tree_sums(args, scope.stream);
  return sums;
}

constexpr const char* kSpawnOp = "spawn_features";

Tensor spawn_features(const std::vector<Tensor>& columns, const Tensor& rows_in, const Tensor& is_split_in,
                      std::int64_t time, double extent, std::int64_t level_count) {
  BLITZGS_CHECK(columns.size() == 7, kSpawnOp,
                "columns must be (grad_sum, grad_count, opacities, scales, birth, level, "
                "exp_avg_sq.sh), got ",
                columns.size(), " tensors");
  const std::int64_t n = columns[0].size(0);
  const auto column = [&](int i, const char* name, ScalarType dtype,
                          std::initializer_list<std::int64_t> shape) {
    return checked(kSpawnOp, name, columns[i], dtype, shape);
  };
  const Tensor grad_sum = column(0, "grad_sum", ScalarType::Float, {n}),
               grad_count = column(1, "grad_count", ScalarType::Int, {n}),
               opacities = column(2, "opacities", ScalarType::Float, {n}),
               scales = column(3, "scales", ScalarType::Float, {n, 3}),
               birth = column(4, "birth", ScalarType::Int, {n}),
               level = column(5, "level", ScalarType::Byte, {n}),
               moments = column(6, "exp_avg_sq.sh", ScalarType::Float, {n, -1, 3});
  BLITZGS_CHECK(moments.size(1) > 0, kSpawnOp, "exp_avg_sq.sh must have coefficients");
  BLITZGS_CHECK(extent > 0, kSpawnOp, "extent must be positive, got ", extent);
  BLITZGS_CHECK(level_count > 0, kSpawnOp, "level_count must be positive, got ", level_count);
  const Tensor rows = checked(kSpawnOp, "rows", rows_in, ScalarType::Long, {-1}),
               is_split = checked(kSpawnOp, "is_split", is_split_in, ScalarType::Bool, {rows.size(0)});
  Tensor features = make_empty(grad_sum, {rows.size(0), kSpawnFeatures});
  DeviceScope scope(grad_sum);
  const SpawnFeatures args{data<float>(grad_sum),
                           data<std::int32_t>(grad_count),
                           data<float>(opacities),
                           data<float>(scales),
                           data<std::int32_t>(birth),
                           data<std::uint8_t>(level),
                           data<float>(moments),
                           3 * moments.size(1),
                           data<std::int64_t>(rows),
                           data<bool>(is_split),
                           rows.size(0),
                           time,
                           extent,
                           static_cast<int>(level_count),
                           mutable_data<float>(features)};
  backend::for_each_row(args, scope.stream);
  return features;
}

Tensor knn_distances(const Tensor& points, std::int64_t k) {
  check_floating("knn_distances", "points", points);
  check_shape("knn_distances", "points", points, {-1, 3});
  BLITZGS_CHECK(k >= 1 && k <= kKnnMaxK, "knn_distances", "k must be in [1, ", kKnnMaxK, "], got ", k);
  const std::int64_t n = points.size(0);
  BLITZGS_CHECK(n < (std::int64_t{1} << 31) - kKnnFan, "knn_distances", "at most 2^31 points, got ", n);
  const Tensor rows = as_contiguous(points);
  Tensor distances = make_empty(rows, {n, k});
  DeviceScope scope(rows);
  dispatch_floating(rows, [&]<class T>() {
    backend::knn_distances(data<T>(rows), static_cast<std::int32_t>(n), static_cast<int>(k),
                           mutable_data<T>(distances), scope.workspace, scope.stream);
  });
  return distances;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("density_stats_", TORCH_BOX(&blitzgs::density_stats_));
  m.impl("take_rows_", TORCH_BOX(&blitzgs::take_rows_));
  m.impl("put_rows_", TORCH_BOX(&blitzgs::put_rows_));
  m.impl("hash_key", TORCH_BOX(&blitzgs::hash_with_key));
  m.impl("overlap", TORCH_BOX(&blitzgs::overlap));
  m.impl("share_rows_", TORCH_BOX(&blitzgs::share_rows_));
  m.impl("sampling_keys", TORCH_BOX(&blitzgs::sampling_keys));
  m.impl("key_histogram", TORCH_BOX(&blitzgs::key_histogram));
  m.impl("find_non_finite", TORCH_BOX(&blitzgs::find_non_finite));
  m.impl("tree_sums", TORCH_BOX(&blitzgs::tree_sums));
  m.impl("spawn_features", TORCH_BOX(&blitzgs::spawn_features));
  m.impl("knn_distances", TORCH_BOX(&blitzgs::knn_distances));
}
