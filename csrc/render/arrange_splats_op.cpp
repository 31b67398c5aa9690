// SPDX-License-Identifier: Apache-2.0
#include "render/arrange_splats.h"

#include <functional>
#include <numeric>

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "arrange_splats";

// Where the splats are in the arrangement, which has the dimensions `shape`.
struct Places {
  std::vector<Tensor> index;
  std::vector<std::int64_t> shape;
  ArrangeSplats moves{};

  Places(const std::vector<Tensor>& places, const std::vector<std::int64_t>& dimensions) : shape(dimensions) {
    STD_TORCH_CHECK(places.size() == 1 || places.size() == 2, "blitzgs::", kOp,
                    ": places must be (order) or (images, gaussians), got ", places.size(), " tensors");
    const bool ordered = places.size() == 1;
    STD_TORCH_CHECK(shape.size() >= (ordered ? 1u : 2u), "blitzgs::", kOp, ": shape has too few dimensions");
    for (const Tensor& tensor : places) {
      check_dtype(kOp, ordered ? "order" : "images and gaussians", tensor,
                  ordered ? ScalarType::Long : ScalarType::Int);
      check_shape(kOp, "places", tensor, {places[0].size(0)});
      index.push_back(as_contiguous(tensor));
    }
    moves.n = index[0].size(0);
    moves.count = shape.back();
    STD_TORCH_CHECK(!ordered || entries() == moves.n, "blitzgs::", kOp, ": an arrangement of ", entries(),
                    " entries cannot be an order of ", moves.n, " splats");
    moves.order = ordered ? data<std::int64_t>(index[0]) : nullptr;
    moves.images = ordered ? nullptr : data<std::int32_t>(index[0]);
    moves.gaussians = ordered ? nullptr : data<std::int32_t>(index[1]);
  }

  std::int64_t entries() const {
    return std::accumulate(shape.begin(), shape.end(), std::int64_t{1}, std::multiplies<>());
  }
  bool has_empty_entries() const { return moves.order == nullptr; }
};

// Whether the elements of each row follow one another.
bool rows_are_contiguous(const Tensor& column, std::int64_t row_axis) {
  std::int64_t expected = 1;
  for (std::int64_t axis = column.dim() - 1; axis >= row_axis; --axis) {
    if (column.size(axis) != 1 && column.stride(axis) != expected) return false;
    expected *= column.size(axis);
  }
  return true;
}

// Allocates the targets of columns whose rows are indexed by the first `from` dimensions, with the dimensions
// `to` in place of these, and lists both in `moves`. `held` keeps the sources alive.
std::vector<Tensor> make_targets(const std::vector<Tensor>& columns, std::size_t from,
                                 const std::vector<std::int64_t>& to, std::vector<Tensor>& held,
                                 ArrangeSplats& moves) {
  STD_TORCH_CHECK(columns.size() <= kMaxArranged, "blitzgs::", kOp, ": at most ", kMaxArranged,
                  " columns, got ", columns.size());
  std::vector<Tensor> targets;
  for (const Tensor& column : columns) {
    // Rows of a splat's gradient lie in a longer table: a column of it is read as it is.
    const bool strided = from == 1 && rows_are_contiguous(column, 1);
    held.push_back(strided ? column : as_contiguous(column));
    const auto element_words = static_cast<std::int64_t>(column.element_size()) / 4;
    STD_TORCH_CHECK(column.element_size() % 4 == 0, "blitzgs::", kOp,
                    ": columns must have elements of 4 or 8 bytes, got ",
                    torch::headeronly::toString(column.scalar_type()));
    std::vector<std::int64_t> shape = to;
    std::int64_t words = element_words;
    for (auto axis = static_cast<std::int64_t>(from); axis < column.dim(); ++axis) {
      shape.push_back(column.size(axis));
      words *= column.size(axis);
    }
    targets.push_back(make_empty(column, shape));
    moves.columns[moves.n_columns++] = {static_cast<const std::uint32_t*>(held.back().const_data_ptr()),
                                        static_cast<std::uint32_t*>(targets.back().mutable_data_ptr()), words,
                                        strided ? column.stride(0) * element_words : words};
  }
  return targets;
}

std::vector<Tensor> arrange_splats(const std::vector<Tensor>& columns, const std::vector<Tensor>& places_in,
                                   const std::vector<std::int64_t>& shape,
                                   const std::optional<Tensor>& under) {
  Places places(places_in, shape);
  std::vector<Tensor> held;
  if (columns.empty()) return {};
  for (const Tensor& column : columns) {
    STD_TORCH_CHECK(column.dim() >= 1 && column.size(0) == places.moves.n, "blitzgs::", kOp,
                    ": columns must have ", places.moves.n, " rows, got ", shape_of(column));
  }
  std::vector<Tensor> arranged = make_targets(columns, 1, shape, held, places.moves);
  std::optional<Tensor> below;
  const std::int64_t views = places.has_empty_entries() ? shape[shape.size() - 2] : 1;
  if (under) {
    const Tensor& last = columns.back();
    STD_TORCH_CHECK(places.has_empty_entries() && last.dim() == 1, "blitzgs::", kOp,
                    ": `under` is for a last column of numbers and an arrangement of all Gaussians");
    check_dtype(kOp, "under", *under, last.scalar_type());
    STD_TORCH_CHECK(under->numel() * views == places.entries(), "blitzgs::", kOp, ": under must have ",
                    places.entries() / std::max<std::int64_t>(views, 1), " values, got ", shape_of(*under));
    below = as_contiguous(*under);
  }
  DeviceScope scope(columns[0]);
  for (int c = 0; places.has_empty_entries() && c < places.moves.n_columns; ++c) {
    const bool over = below && c == places.moves.n_columns - 1;
    backend::fill_entries({places.moves.columns[c], places.entries(), places.moves.count, views,
                           over ? static_cast<const std::uint32_t*>(below->const_data_ptr()) : nullptr},
                          scope.stream);
  }
  backend::arrange_splats(places.moves, /*back=*/false, scope.stream);
  return arranged;
}

std::vector<Tensor> splats_of_arranged(const std::vector<Tensor>& arranged,
                                       const std::vector<Tensor>& places_in,
                                       const std::vector<std::int64_t>& shape) {
  Places places(places_in, shape);
  std::vector<Tensor> held;
  if (arranged.empty()) return {};
  for (const Tensor& column : arranged) {
    bool fits = column.dim() >= static_cast<std::int64_t>(shape.size());
    for (std::size_t axis = 0; fits && axis < shape.size(); ++axis) {
      fits = column.size(static_cast<std::int64_t>(axis)) == shape[axis];
    }
    STD_TORCH_CHECK(fits, "blitzgs::", kOp,
                    ": columns must begin with the dimensions of the arrangement, got ", shape_of(column));
  }
  std::vector<Tensor> splats = make_targets(arranged, shape.size(), {places.moves.n}, held, places.moves);
  DeviceScope scope(arranged[0]);
  backend::arrange_splats(places.moves, /*back=*/true, scope.stream);
  return splats;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("arrange_splats", TORCH_BOX(&blitzgs::arrange_splats));
  m.impl("splats_of_arranged", TORCH_BOX(&blitzgs::splats_of_arranged));
}
