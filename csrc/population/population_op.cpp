// SPDX-License-Identifier: Apache-2.0
#include "population/density.h"

#include <bit>

#include "common/op.h"
#include "population/columns.h"
#include "population/knn.h"
#include "population/placement.h"
#include "population/relocation.h"

namespace blitzgs {
namespace {

void density_stats_(const Tensor& grad_sum, const Tensor& grad_count, const Tensor& max_radii,
                    const Tensor& visible_ids_in, const Tensor& splat_offsets_in, const Tensor& v_means2d_in,
                    const Tensor& conics_in, const OptionalTensor& phi_in, int64_t width, int64_t height,
                    double weight) {
  check_floating("grad_sum", grad_sum);
  const auto visible_ids = checked<int32_t>("visible_ids", visible_ids_in, {-1});
  const int64_t rows = grad_sum.numel(), visible = visible_ids.size(0);
  const auto splat_offsets = checked<int32_t>("splat_offsets", splat_offsets_in, {visible + 1});
  dispatch_floating(grad_sum, [&]<class T>() {
    const auto conics = checked<T>("conics", conics_in, {-1, 3});
    const auto phi = checked<T>("phi", phi_in, {rows});
    check_dtype("v_means2d", v_means2d_in, dtype_of<T>::value);
    check_shape("v_means2d", v_means2d_in, {conics.size(0), 2});
    // If v_means2d is a part of the rows of a gradient table, the kernel reads it there, without a copy.
    const Tensor v_means2d = v_means2d_in.stride(1) == 1 ? v_means2d_in : as_contiguous(v_means2d_in);
    const DensityStats<T> args{checked_in_place<T>("grad_sum", grad_sum, {rows}),
                               checked_in_place<int32_t>("grad_count", grad_count, {rows}),
                               checked_in_place<T>("max_radii", max_radii, {rows}),
                               visible_ids,
                               splat_offsets,
                               data<T>(v_means2d),
                               v_means2d.stride(0),
                               conics,
                               phi,
                               visible,
                               T(width) / 2,
                               T(height) / 2,
                               T(weight)};
    if (visible > 0) run_rows(grad_sum, args);
  });
}

// Copies n rows of `column` (null: zeros) to `out`; from and to: columns.h.
void copy_rows(const Tensor& out, const int64_t* to, const void* column, const int64_t* from, int64_t n,
               CudaStream stream) {
  const int64_t row_bytes = elements_behind(out) * int64_t(out.element_size());
  BLITZGS_CHECK(row_bytes < (1 << 16), "rows must be shorter than 64 KiB, got ", row_bytes, " bytes");
  backend::copy_rows({static_cast<const std::byte*>(column), from,
                      static_cast<std::byte*>(out.mutable_data_ptr()), to, n, row_bytes},
                     stream);
}

// Checks that there are n rows like those of `column`.
void check_rows(const char* name, const Tensor& rows, int64_t n, const Tensor& column) {
  check_dtype(name, rows, column.scalar_type());
  BLITZGS_CHECK(rows.dim() == column.dim() && elements_behind(rows) == elements_behind(column), "rows of ",
                name, " must be like those of column, got ", shape_of(rows), " for ", shape_of(column));
  BLITZGS_CHECK(rows.size(0) == n, name, " must have ", n, " rows, got ", shape_of(rows));
}

// Checks a column on the device of `rows`.
void check_column(const char* name, const Tensor& column, const Tensor& rows) {
  BLITZGS_CHECK(column.dim() >= 1, name, " must have rows, got ", shape_of(column));
  check_device(name, column, rows, "rows");
}

// check_column() of a column that the op writes in its own memory.
void check_written(const char* name, const Tensor& written, const Tensor& rows) {
  check_column(name, written, rows);
  check_contiguous(name, written);
}

void take_rows_(const TensorList& out, const TensorList& columns, const Tensor& rows_in) {
  BLITZGS_CHECK(out.size() == columns.size(), "there must be as many out as columns, got ", out.size(),
                " for ", columns.size());
  const auto rows = checked<int64_t>("rows", rows_in, {-1});
  DeviceScope scope(rows);
  for (size_t c = 0; c < columns.size(); ++c) {
    check_column("column", columns[c], rows);
    check_written("out", out[c], rows);
    check_rows("out", out[c], rows.size(0), columns[c]);
    const Tensor column = as_contiguous(columns[c]);
    copy_rows(out[c], nullptr, column.const_data_ptr(), rows, rows.size(0), scope.stream);
  }
}

void put_rows_(const TensorList& columns, const Tensor& rows_in, const TensorList& fresh) {
  BLITZGS_CHECK(fresh.empty() || fresh.size() == columns.size(),
                "fresh must be empty or as many as columns, got ", fresh.size(), " for ", columns.size());
  const auto rows = checked<int64_t>("rows", rows_in, {-1});
  const int64_t n = rows.size(0);
  DeviceScope scope(rows);
  for (size_t c = 0; c < columns.size(); ++c) {
    check_written("column", columns[c], rows);
    if (fresh.empty()) {
      copy_rows(columns[c], rows, nullptr, nullptr, n, scope.stream);
      continue;
    }
    check_device("fresh", fresh[c], rows, "rows");
    check_rows("fresh", fresh[c], n, columns[c]);
    const Tensor values = as_contiguous(fresh[c]);
    copy_rows(columns[c], rows, values.const_data_ptr(), nullptr, n, scope.stream);
  }
}

Tensor hash_with_key(const Tensor& hashes_in, const OptionalTensor& keys_in, int64_t number) {
  const auto hashes = checked<int64_t>("hashes", hashes_in, {-1});
  const int64_t n = hashes.size(0);
  const auto keys = checked<int64_t>("keys", keys_in, {n});
  const auto out = make<int64_t>(hashes, {n});
  run_rows(hashes, HashKey{hashes, keys, number, n, out});
  return out;
}

Tensor overlap(const Tensor& opacities_in, const Tensor& copies_in) {
  const auto opacities = checked<double>("opacities", opacities_in, {-1});
  const int64_t n = opacities.size(0);
  const auto copies = checked<int64_t>("copies", copies_in, {n});
  const auto overlaps = make<double>(opacities, {n});
  run_rows(opacities, Overlap{opacities, copies, n, overlaps});
  return overlaps;
}

Tensor draw_weights(const Tensor& opacities_in, const Tensor& causes_in) {
  const auto opacities = checked<float>("opacities", opacities_in, {-1});
  const int64_t n = opacities.size(0);
  const auto causes = checked<uint8_t>("causes", causes_in, {n});
  const auto weights = make<int64_t>(opacities, {n});
  run_rows(opacities, DrawWeights{opacities, causes, n, weights});
  return weights;
}

Tensors<2> residual_draws(const Tensor& weights_in, const Tensor& ids_in, int64_t draws, int64_t total,
                          int64_t seed, int64_t event) {
  const auto weights = checked<int64_t>("weights", weights_in, {-1});
  const int64_t n = weights.size(0);
  const auto ids = checked<int64_t>("ids", ids_in, {n});
  BLITZGS_CHECK(total > 0, "total must be positive, got ", total);
  const auto whole = make<int64_t>(weights, {n});
  const auto keys = make<float>(weights, {n});
  run_rows(weights, ResidualDraws{weights, ids, n, draws, total, seed, event, whole, keys});
  return {whole, keys};
}

void share_rows_(const Tensor& opacities_in, const Tensor& scales, const TensorList& moments,
                 const Tensor& rows_in, const Tensor& copies_in, double least) {
  const auto opacities = checked_in_place<float>("opacities", opacities_in, {-1});
  const int64_t count = opacities.size(0);
  const auto rows = checked<int64_t>("rows", rows_in, {-1});
  const int64_t n = rows.size(0);
  const auto copies = checked<int64_t>("copies", copies_in, {n});
  constexpr size_t kParameters = ShareMoments::kColumns + 1, kOpacity = 3;
  BLITZGS_CHECK(moments.size() == 2 * kParameters, "there must be ", 2 * kParameters, " moments, got ",
                moments.size());
  constexpr int kLanes = kOnCuda ? 16 : 1;
  ShareMoments scaled{{}, {}, rows, copies, kLanes, n * kLanes};
  float* of_opacity[2];
  for (size_t c = 0; c < moments.size(); ++c) {
    check_dtype("a moment", moments[c], ScalarType::Float);
    check_written("a moment", moments[c], rows);
    BLITZGS_CHECK(moments[c].size(0) == count, "a moment must have ", count, " rows, got ",
                  shape_of(moments[c]));
    float* const values = mutable_data<float>(moments[c]);
    const size_t parameter = c % kParameters, order = c / kParameters;
    if (parameter == kOpacity) {
      check_shape("a moment of the opacity", moments[c], {count});
      of_opacity[order] = values;
    } else {
      auto& columns = order == 0 ? scaled.avgs : scaled.avg_sqs;
      columns[parameter - (parameter > kOpacity)] = {values, int(elements_behind(moments[c]))};
    }
  }
  const ShareRows shared{opacities,
                         checked_in_place<float>("scales", scales, {count, 3}),
                         of_opacity[0],
                         of_opacity[1],
                         rows,
                         copies,
                         n,
                         float(least)};
  run_rows(opacities, scaled);
  run_rows(opacities, shared);
}

Tensor bracket_keys(const Tensor& gone_in, const Tensor& blocks_in) {
  const auto gone = checked<int64_t>("gone", gone_in, {-1});
  const auto blocks = checked<int64_t>("blocks", blocks_in, {-1});
  const int64_t leaving = gone.size(0), joining = blocks.size(0), n = leaving + joining;
  const auto keys = make<int64_t>(gone, {n});
  run_rows(gone, BracketKeys{gone, blocks, leaving, joining, n, keys});
  return keys;
}

void match_brackets_(const Tensor& rows_in, const Tensor& is_left_in, const Tensor& keys_in,
                     const Tensor& order_in, const Tensor& gone_in, const Tensor& by_block_in) {
  const auto gone = checked<int64_t>("gone", gone_in, {-1});
  const auto by_block = checked<int64_t>("by_block", by_block_in, {-1});
  const int64_t leaving = gone.size(0), joining = by_block.size(0), n = leaving + joining;
  const auto keys = checked<int64_t>("keys", keys_in, {n});
  const auto order = checked<int64_t>("order", order_in, {n});
  const auto rows = checked_in_place<int64_t>("rows", rows_in, {joining});
  const auto is_left = checked_in_place<bool>("is_left", is_left_in, {leaving});
  const int64_t neighbours = n > 0 ? n - 1 : 0;
  run_rows(gone, MatchBrackets{keys, order, gone, by_block, leaving, neighbours, n + 1, rows, is_left});
}

Tensor sampling_keys(const Tensor& weights_in, const Tensor& ids_in, int64_t seed, int64_t event) {
  const auto weights = checked<float>("weights", weights_in, {-1});
  const auto ids = checked<int64_t>("ids", ids_in, {weights.size(0)});
  const auto keys = make<float>(weights, {weights.size(0)});
  run_rows(weights, SamplingKeys{weights, ids, weights.size(0), seed, event, keys});
  return keys;
}

Tensor key_histogram(const Tensor& keys_in, const Tensor& prefix_in, int64_t shift, int64_t width) {
  const auto keys = checked<float>("keys", keys_in, {-1});
  const auto prefix = checked<int64_t>("prefix", prefix_in, {1});
  BLITZGS_CHECK(width >= 1 && width <= kMaxDigitBits && shift >= 0 && shift + width <= 32,
                "a digit must have 1 to ", kMaxDigitBits, " of 32 bits, got ", width, " after ", shift);
  const auto counts = make<int64_t>(keys, {int64_t{1} << width});
  DeviceScope scope(keys);
  backend::key_histogram({keys, prefix, keys.size(0), int(shift), int(width), counts}, scope.stream);
  return counts;
}

void find_digit_(const Tensor& search_in, const Tensor& counts_in) {
  const auto search = checked_in_place<int64_t>("search", search_in, {3});
  const auto counts = checked<int64_t>("counts", counts_in, {-1});
  const auto n = uint64_t(counts.size(0));
  BLITZGS_CHECK(std::has_single_bit(n), "there must be a power of two counts, got ", n);
  DeviceScope scope(search);
  backend::find_digit({counts, std::countr_zero(n), search}, scope.stream);
}

Tensor keys_up_to(const Tensor& keys_in, const Tensor& limit_in) {
  const auto keys = checked<float>("keys", keys_in, {-1});
  const auto limit = checked<int64_t>("limit", limit_in, {1});
  const int64_t n = keys.size(0);
  const auto marks = make<bool>(keys, {n});
  run_rows(keys, KeysUpTo{keys, limit, n, marks});
  return marks;
}

Tensor find_non_finite(const TensorList& columns_in, const TensorList& nonzero_in) {
  BLITZGS_CHECK(!columns_in.empty(), "there must be columns");
  TensorList columns;
  for (const TensorList* list : {&columns_in, &nonzero_in}) {
    for (const Tensor& column : *list) {
      check_floating("a column", column);
      check_dtype("a column", column, columns_in[0].scalar_type());
      columns.push_back(as_contiguous(column));
    }
  }
  const auto bad = make<int32_t>(columns[0], {});
  DeviceScope scope(columns[0]);
  backend::clear_flag(bad, scope.stream);
  dispatch_floating(columns[0], [&]<class T>() {
    for (size_t first = 0; first < columns.size(); first += kMaxCheckedColumns) {
      CheckedColumns<T> checked{{}, 0, bad};
      for (size_t c = first; c < columns.size() && checked.n < kMaxCheckedColumns; ++c) {
        checked.columns[checked.n++] = {data<T>(columns[c]), columns[c].numel(), c >= columns_in.size()};
      }
      backend::check_columns(checked, scope.stream);
    }
  });
  return bad;
}

constexpr int64_t kMaxFeatures = 32;  // the features of a block's rows are in shared memory

Tensor tree_sums(const Tensor& features_in, const Tensor& roots_in, const Tensor& nodes_in,
                 const Tensor& leaves_in, int64_t depth) {
  const auto features = checked<float>("features", features_in, {-1, -1});
  const auto roots = checked<int32_t>("roots", roots_in, {-1}),
             nodes = checked<int32_t>("nodes", nodes_in, {-1, 4});
  const auto leaves = checked<int64_t>("leaves", leaves_in, {nodes.size(0)});
  const int64_t rows = features.size(0), n_features = features.size(1);
  BLITZGS_CHECK(n_features <= kMaxFeatures, "at most ", kMaxFeatures, " features, got ", n_features);
  BLITZGS_CHECK(depth >= 0, "depth must not be negative, got ", depth);
  const auto sums = make<int64_t>(features, {rows});
  DeviceScope scope(features);
  backend::tree_sums({features, roots, reinterpret_cast<const TreeNode*>(nodes.data()), leaves, rows,
                      n_features, int(roots.numel()), int(depth), sums},
                     scope.stream);
  return sums;
}

Tensor spawn_features(const TensorList& columns, const Tensor& rows_in, const Tensor& is_split_in,
                      int64_t time, double extent, int64_t level_count) {
  check_group("columns (grad_sum, grad_count, opacities, scales, birth, level, exp_avg_sq.sh)", columns, 7,
              7);
  const int64_t n = columns[0].size(0);
  const auto grad_sum = checked<float>("grad_sum", columns[0], {n}),
             opacities = checked<float>("opacities", columns[2], {n}),
             scales = checked<float>("scales", columns[3], {n, 3}),
             moments = checked<float>("exp_avg_sq.sh", columns[6], {n, -1, 3});
  const auto grad_count = checked<int32_t>("grad_count", columns[1], {n}),
             birth = checked<int32_t>("birth", columns[4], {n});
  const auto level = checked<uint8_t>("level", columns[5], {n});
  BLITZGS_CHECK(moments.size(1) > 0, "exp_avg_sq.sh must have coefficients");
  BLITZGS_CHECK(extent > 0, "extent must be positive, got ", extent);
  BLITZGS_CHECK(level_count > 0, "level_count must be positive, got ", level_count);
  const auto rows = checked<int64_t>("rows", rows_in, {-1});
  const auto is_split = checked<bool>("is_split", is_split_in, {rows.size(0)});
  const auto features = make<float>(grad_sum, {rows.size(0), kSpawnFeatures});
  const SpawnFeatures args{grad_sum, grad_count,          opacities, scales,   birth,        level,
                           moments,  3 * moments.size(1), rows,      is_split, rows.size(0), time,
                           extent,   int(level_count),    features};
  run_rows(grad_sum, args);
  return features;
}

Tensor knn_distances(const Tensor& points, int64_t k) {
  check_floating("points", points);
  check_shape("points", points, {-1, 3});
  BLITZGS_CHECK(k >= 1 && k <= kKnnMaxK, "k must be in [1, ", kKnnMaxK, "], got ", k);
  const int64_t n = points.size(0);
  BLITZGS_CHECK(n < (int64_t{1} << 31) - kKnnFan, "at most 2^31 points, got ", n);
  DeviceScope scope(points);
  return dispatch_floating(points, [&]<class T>() -> Tensor {
    const auto distances = make<T>(points, {n, k});
    backend::knn_distances<T>(checked<T>("points", points, {n, 3}), int32_t(n), int(k), distances,
                              scope.workspace, scope.stream);
    return distances;
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "density_stats_", density_stats_);
  BLITZGS_OP(m, "take_rows_", take_rows_);
  BLITZGS_OP(m, "put_rows_", put_rows_);
  BLITZGS_OP(m, "hash_key", hash_with_key);
  BLITZGS_OP(m, "overlap", overlap);
  BLITZGS_OP(m, "draw_weights", draw_weights);
  BLITZGS_OP(m, "residual_draws", residual_draws);
  BLITZGS_OP(m, "share_rows_", share_rows_);
  BLITZGS_OP(m, "bracket_keys", bracket_keys);
  BLITZGS_OP(m, "match_brackets_", match_brackets_);
  BLITZGS_OP(m, "sampling_keys", sampling_keys);
  BLITZGS_OP(m, "key_histogram", key_histogram);
  BLITZGS_OP(m, "find_digit_", find_digit_);
  BLITZGS_OP(m, "keys_up_to", keys_up_to);
  BLITZGS_OP(m, "find_non_finite", find_non_finite);
  BLITZGS_OP(m, "tree_sums", tree_sums);
  BLITZGS_OP(m, "spawn_features", spawn_features);
  BLITZGS_OP(m, "knn_distances", knn_distances);
}
