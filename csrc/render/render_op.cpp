// SPDX-License-Identifier: Apache-2.0
#include "render/render.h"

#include <numeric>

#include "project/project_op.h"
#include "rasterize/rasterize_op.h"

namespace blitzgs {
// Colours, tile lists, compositing and alphas in one op, because each takes the host microseconds.
namespace {

// Words of 4 bytes in the elements of a row behind its first `axis` dimensions.
int64_t words_behind(const Tensor& column, int64_t axis) {
  return int64_t(column.element_size()) / 4 * elements_behind(column, axis);
}

void check_column(const Tensor& column) {
  BLITZGS_CHECK(column.dim() >= 1 && column.element_size() % 4 == 0,
                "columns must have rows and elements of 4 or 8 bytes, got ", shape_of(column), " of ",
                column.element_size(), " bytes");
  BLITZGS_CHECK(words_behind(column, 1) < (1 << 16), "rows must be shorter than 256 KiB, got ",
                shape_of(column));
}

IntList shape_with(const Tensor& column, int64_t rows) {
  IntList shape{rows};
  for (int64_t axis = 1; axis < column.dim(); ++axis) shape.push_back(column.size(axis));
  return shape;
}

// The rows `ids` of `columns`, and then of `joined`, side by side along their second dimension. ids: int32
// [n], contiguous; known: as in GatherRows.
TensorList gathered_rows(const TensorList& columns, const TensorList& joined, const Tensor& ids,
                         const int64_t* known) {
  BLITZGS_CHECK(columns.size() + joined.size() <= kMaxGatheredColumns, "at most ", kMaxGatheredColumns,
                " columns, got ", columns.size() + joined.size());
  const int64_t n = ids.size(0);
  GatherRows gather{data<int32_t>(ids), n, known, 0, {}};
  TensorList held, found;
  const auto add = [&](const Tensor& column, uint32_t* to, int64_t stride) {
    const Tensor& from = held.emplace_back(as_contiguous(column));
    const auto width = uint32_t(words_behind(from, 1));
    gather.columns[gather.n_columns++] = {static_cast<const uint32_t*>(from.const_data_ptr()), to, stride,
                                          width};
    return width;
  };
  for (const Tensor& column : columns) {
    check_column(column);
    Tensor& rows = found.emplace_back(make_empty(column, shape_with(column, n)));
    add(column, static_cast<uint32_t*>(rows.mutable_data_ptr()), words_behind(column, 1));
  }
  if (!joined.empty()) {
    int64_t length = 0, stride = 0;
    for (const Tensor& part : joined) {
      check_column(part);
      check_dtype("joined columns", part, joined[0].scalar_type());
      BLITZGS_CHECK(part.dim() >= 2 && part.dim() == joined[0].dim() &&
                        words_behind(part, 2) == words_behind(joined[0], 2),
                    "joined columns must be alike behind their second dimension, got ", shape_of(part),
                    " beside ", shape_of(joined[0]));
      length += part.size(1);
      stride += words_behind(part, 1);
    }
    IntList shape = shape_with(joined[0], n);
    shape[1] = length;
    Tensor& rows = found.emplace_back(make_empty(joined[0], shape));
    auto* to = static_cast<uint32_t*>(rows.mutable_data_ptr());
    for (const Tensor& part : joined) to += add(part, to, stride);
  }
  DeviceScope scope(ids);
  backend::gather_rows(gather, scope.stream);
  return found;
}

TensorList first_rows(const TensorList& columns, const IntList& lengths) {
  BLITZGS_CHECK(columns.size() == lengths.size(), columns.size(), " columns need a length each, got ",
                lengths.size());
  TensorList found;
  for (size_t c = 0; c < columns.size(); ++c) {
    BLITZGS_CHECK(columns[c].dim() >= 1 && lengths[c] >= 0,
                  "columns must have rows, and lengths be at least 0, got ", shape_of(columns[c]), " and ",
                  lengths[c]);
    IntList shape = shape_with(columns[c], std::min(columns[c].size(0), lengths[c])), strides;
    for (int64_t axis = 0; axis < columns[c].dim(); ++axis) strides.push_back(columns[c].stride(axis));
    found.push_back(view_of(columns[c], shape, strides, 0));
  }
  return found;
}

// The totals of the projection; null: the splats have no spare capacity.
const int64_t* checked_totals(const OptionalTensor& totals) {
  if (!totals) return nullptr;
  check_in_place("totals", *totals, ScalarType::Long, {-1});
  BLITZGS_CHECK(totals->size(0) > kTotalSplats, "totals must be those of project_fwd, got ",
                shape_of(*totals));
  BLITZGS_CHECK(kOnCuda, "on the CPU splats have no spare capacity, so give no totals");
  return data<int64_t>(*totals);
}

// The columns of splats that their colours are computed from, and those that hide a splat.
struct ColoredSplats {
  const Tensor &visible_ids, &splat_offsets, &camera_ids, &opacities, &radii, &tiles_touched;
};

// The visible rows of the Gaussians and the colours of their splats: colors, numbers, indices, rows.
TensorList color_rows(const TensorList& gaussians, const TensorList& sh, const Tensor& viewmats,
                      const Tensor& Ks, const ProjectOptions<double>& options, const ColoredSplats& splats,
                      const int64_t* totals) {
  check_group("gaussians (means, quats, scales, opacities)", gaussians, 4, 4);
  check_floating("means", gaussians[0]);
  const int64_t U = splats.visible_ids.numel(), P = splats.camera_ids.numel();
  const auto visible_ids = checked_in_place<int32_t>("visible_ids", splats.visible_ids, {U}),
             offsets = checked_in_place<int32_t>("splat_offsets", splats.splat_offsets, {U + 1}),
             camera_ids = checked_in_place<int32_t>("camera_ids", splats.camera_ids, {P}),
             radii = checked_in_place<int32_t>("radii", splats.radii, {P, 2}),
             tiles = checked_in_place<int32_t>("tiles_touched", splats.tiles_touched, {P});
  check_in_place("splat_opacities", splats.opacities, gaussians[0].scalar_type(), {P});
  const ProjectCapacity capacity{{U, P}, totals};
  TensorList found =
      gathered_rows(gaussians, sh, splats.visible_ids, totals ? totals + kTotalVisible : nullptr);
  const ProjectArguments p(found, viewmats, Ks, options);
  const auto numbers = make<int32_t>(visible_ids, {U});
  const auto indices = make<int64_t>(visible_ids, {U});
  const Tensor colors = make_empty(p.means, {p.sh ? P : 0, 3});
  DeviceScope scope(p.means);
  auto* row_of_splat = scope.workspace.allocate<int32_t>(P);
  backend::for_each_row(NumberedRows{capacity, visible_ids, offsets, numbers, indices, row_of_splat, U},
                        scope.stream);
  if (p.sh) {
    dispatch_floating(p.means, [&]<class T>() {
      ProjectColumns<T> columns{};
      columns.ids.gaussian_ids = row_of_splat;
      columns.ids.camera_ids = camera_ids;
      columns.values.colors = mutable_data<T>(colors);
      columns.values.opacities = mutable_data<T>(splats.opacities);
      columns.values.radii = radii;
      columns.values.tiles_touched = tiles;
      backend::color_splats(p.inputs<T>(), capacity, columns, scope.stream);
    });
  }
  found.insert(found.begin(), {colors, numbers, indices});
  return found;
}

// The columns side by side, by torch.
Tensor joined(const Tensor& colors, const Tensor& depths) {
  std::array<StableIValue, 2> stack{
      torch::stable::detail::from(TensorList{colors, torch::stable::unsqueeze(depths, 1)}),
      torch::stable::detail::from(int64_t{1})};
  TORCH_ERROR_CODE_CHECK(torch_call_dispatcher("aten::cat", "", stack.data(), TORCH_ABI_VERSION));
  return torch::stable::detail::to<Tensor>(stack[0]);
}

TensorList render(const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities,
                  const Tensor& depths, const Tensor& camera_ids, const Tensor& visible_ids,
                  const Tensor& splat_offsets, const Tensor& radii, const Tensor& tiles_touched,
                  const OptionalTensor& channels_in, bool with_depth, const TensorList& gaussians,
                  const TensorList& sh, const Tensor& viewmats, const Tensor& Ks, BLITZGS_PROJECT_OPTIONS,
                  const FloatList& fade, const OptionalTensor& backgrounds, int64_t n_isects,
                  bool backward_follows, const OptionalTensor& totals_in) {
  const int64_t* totals = checked_totals(totals_in);
  OptionalTensor n_splats;
  if (totals) n_splats = view_of(*totals_in, {1}, {1}, kTotalSplats);
  TensorList rows;
  if (!gaussians.empty()) {
    const auto options = checked_options(BLITZGS_PROJECT_OPTION_NAMES, fade);
    rows =
        color_rows(gaussians, sh, viewmats, Ks, options,
                   {visible_ids, splat_offsets, camera_ids, splat_opacities, radii, tiles_touched}, totals);
  }
  BLITZGS_CHECK(channels_in || !sh.empty(), "splats without sh need channels");
  const Tensor channels = channels_in ? *channels_in : with_depth ? joined(rows[0], depths) : rows[0];
  const int64_t views = viewmats.size(0);
  const auto lists = intersect(means2d, conics, splat_opacities, depths, camera_ids, std::nullopt, views,
                               width, height, tile_size, 0, -1, n_isects, n_splats, /*unchecked=*/true);
  const auto outputs = rasterize_fwd(means2d, conics, splat_opacities, channels, backgrounds,
                                     std::get<0>(lists), std::get<1>(lists), views, width, height, tile_size,
                                     0, -1, /*clear_rest=*/true, backward_follows, n_splats);
  const Tensor& transmittances = std::get<1>(outputs);
  const Tensor alphas = make_empty(transmittances, {views, height, width});
  dispatch_floating(alphas, [&]<class T>() {
    run_rows(alphas, Alphas<T>{data<T>(transmittances), mutable_data<T>(alphas), alphas.numel()});
  });
  TensorList found = std::apply([&](const auto&... tensors) { return TensorList{tensors..., alphas}; },
                                std::tuple_cat(lists, outputs));
  found.insert(found.end(), rows.begin(), rows.end());
  return found;
}

// Where the splats are in the arrangement, which has the dimensions `shape`.
struct Places {
  TensorList index;
  IntList shape;
  ArrangeSplats moves{};

  Places(const TensorList& places, const IntList& dimensions) : shape(dimensions) {
    BLITZGS_CHECK(places.size() == 1 || places.size() == 2,
                  "places must be (order) or (images, gaussians), got ", places.size(), " tensors");
    const bool ordered = places.size() == 1;
    BLITZGS_CHECK(shape.size() >= (ordered ? 1u : 2u), "shape has too few dimensions");
    for (const Tensor& tensor : places) {
      check_dtype(ordered ? "order" : "images and gaussians", tensor,
                  ordered ? ScalarType::Long : ScalarType::Int);
      check_shape("places", tensor, {places[0].size(0)});
      index.push_back(as_contiguous(tensor));
    }
    moves.n = index[0].size(0);
    moves.count = shape.back();
    BLITZGS_CHECK(!ordered || entries() == moves.n, "an arrangement of ", entries(),
                  " entries cannot be an order of ", moves.n, " splats");
    moves.order = ordered ? data<int64_t>(index[0]) : nullptr;
    moves.images = ordered ? nullptr : data<int32_t>(index[0]);
    moves.gaussians = ordered ? nullptr : data<int32_t>(index[1]);
  }

  int64_t entries() const {
    return std::accumulate(shape.begin(), shape.end(), int64_t{1}, std::multiplies<>());
  }
  bool has_empty_entries() const { return moves.order == nullptr; }
};

// Whether the elements of each row follow one another.
bool rows_are_contiguous(const Tensor& column, int64_t row_axis) {
  int64_t expected = 1;
  for (int64_t axis = column.dim() - 1; axis >= row_axis; --axis) {
    if (column.size(axis) != 1 && column.stride(axis) != expected) return false;
    expected *= column.size(axis);
  }
  return true;
}

// Allocates the targets of columns whose rows are indexed by the first `from` dimensions, with the dimensions
// `to` in place of these, and lists both in `moves`. `held` keeps the sources alive.
TensorList make_targets(const TensorList& columns, size_t from, const IntList& to, TensorList& held,
                        ArrangeSplats& moves) {
  BLITZGS_CHECK(columns.size() <= kMaxArranged, "at most ", kMaxArranged, " columns, got ", columns.size());
  TensorList targets;
  for (const Tensor& column : columns) {
    // Rows of a splat's gradient lie in a longer table: a column of it is read as it is.
    const bool strided = from == 1 && rows_are_contiguous(column, 1);
    held.push_back(strided ? column : as_contiguous(column));
    BLITZGS_CHECK(column.element_size() % 4 == 0, "columns must have elements of 4 or 8 bytes, got ",
                  torch::headeronly::toString(column.scalar_type()));
    IntList shape = to;
    for (auto axis = int64_t(from); axis < column.dim(); ++axis) shape.push_back(column.size(axis));
    const int64_t words = words_behind(column, int64_t(from));
    targets.push_back(make_empty(column, shape));
    moves.columns[moves.n_columns++] = {
        static_cast<const uint32_t*>(held.back().const_data_ptr()),
        static_cast<uint32_t*>(targets.back().mutable_data_ptr()), words,
        strided ? column.stride(0) * words_behind(column, column.dim()) : words};
  }
  return targets;
}

TensorList arrange_splats(const TensorList& columns, const TensorList& places_in, const IntList& shape,
                          const OptionalTensor& under) {
  Places places(places_in, shape);
  TensorList held;
  if (columns.empty()) return {};
  for (const Tensor& column : columns) {
    BLITZGS_CHECK(column.dim() >= 1 && column.size(0) == places.moves.n, "columns must have ", places.moves.n,
                  " rows, got ", shape_of(column));
  }
  TensorList arranged = make_targets(columns, 1, shape, held, places.moves);
  OptionalTensor below;
  const int64_t views = places.has_empty_entries() ? shape[shape.size() - 2] : 1;
  if (under) {
    const Tensor& last = columns.back();
    BLITZGS_CHECK(places.has_empty_entries() && last.dim() == 1,
                  "`under` is for a last column of numbers and an arrangement of all Gaussians");
    check_dtype("under", *under, last.scalar_type());
    BLITZGS_CHECK(under->numel() * views == places.entries(), "under must have ",
                  places.entries() / std::max<int64_t>(views, 1), " values, got ", shape_of(*under));
    below = as_contiguous(*under);
  }
  DeviceScope scope(columns[0]);
  for (int c = 0; places.has_empty_entries() && c < places.moves.n_columns; ++c) {
    const auto& [from, to, words, stride] = places.moves.columns[c];
    if (below && c == places.moves.n_columns - 1) {
      const auto* values = static_cast<const uint32_t*>(below->const_data_ptr());
      backend::for_each_row(UnderSplats{values, to, places.entries(), words, places.moves.count, views},
                            scope.stream);
    } else {
      backend::zero_words(to, places.entries() * words, scope.stream);
    }
  }
  backend::for_each_row(places.moves, scope.stream);
  return arranged;
}

TensorList splats_of_arranged(const TensorList& arranged, const TensorList& places_in, const IntList& shape) {
  Places places(places_in, shape);
  TensorList held;
  if (arranged.empty()) return {};
  for (const Tensor& column : arranged) {
    bool fits = column.dim() >= int64_t(shape.size());
    for (size_t axis = 0; fits && axis < shape.size(); ++axis) {
      fits = column.size(int64_t(axis)) == shape[axis];
    }
    BLITZGS_CHECK(fits, "columns must begin with the dimensions of the arrangement, got ", shape_of(column));
  }
  TensorList splats = make_targets(arranged, shape.size(), {places.moves.n}, held, places.moves);
  DeviceScope scope(arranged[0]);
  places.moves.back = true;
  backend::for_each_row(places.moves, scope.stream);
  return splats;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "render", render);
  BLITZGS_OP(m, "first_rows", first_rows);
  BLITZGS_OP(m, "arrange_splats", arrange_splats);
  BLITZGS_OP(m, "splats_of_arranged", splats_of_arranged);
}
