// SPDX-License-Identifier: Apache-2.0
#include <cub/cub.cuh>

#include "common/cuda.cuh"
#include "math/morton.h"
#include "population/knn.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 128;

// The Morton codes and rows of points [n, 3], one thread per point.
__global__ void make_codes(const float* points, std::int32_t n, const MortonBounds* bounds,
                           std::uint64_t* codes, std::int32_t* rows) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i >= n) return;
  codes[i] = morton_code(points + 3 * i, frame_of(*bounds));
  rows[i] = static_cast<std::int32_t>(i);
}

// sorted [n, 3] = the points in the order of the curve, one thread per point.
__global__ void gather_points(const float* points, const std::int32_t* order, std::int32_t n, float* sorted) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i >= n) return;
  for (int axis = 0; axis < 3; ++axis) sorted[3 * i + axis] = points[3 * std::int64_t{order[i]} + axis];
}

// The boxes of one level of the tree, one thread per box.
__global__ void make_boxes(const KnnTree<float> tree, int level, KnnBox<float>* boxes) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < tree.count[level]) {
    boxes[tree.offset[level] + i] = make_knn_box(tree, level, static_cast<std::int32_t>(i));
  }
}

// distances [N, k], one thread per sorted point.
template <int K>
__global__ void __launch_bounds__(kThreads) query_kernel(const KnnTree<float> tree, int k, float* distances) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < tree.n) knn_row<float, K>(tree, static_cast<std::int32_t>(i), k, distances);
}

__global__ void fill_infinite(float* values, std::int64_t n) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < n) values[i] = INFINITY;
}

// Sorts the rows along the curve and returns the number of finite points. It waits for the stream, because
// this number determines the shape of the tree.
std::int32_t sort_along_curve(const float* points, std::int32_t n, std::int32_t* order, Workspace& workspace,
                              cudaStream_t stream) {
  MortonBounds* bounds = find_morton_bounds(points, n, workspace, stream);
  std::uint64_t* codes = workspace.allocate<std::uint64_t>(2 * std::int64_t{n});
  std::int32_t* rows = workspace.allocate<std::int32_t>(n);
  make_codes<<<blocks_for(n, 256), 256, 0, stream>>>(points, n, bounds, codes, rows);
  std::size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, codes, codes + n, rows, order, n, 0, 64, stream),
        "knn");
  void* scratch = workspace.allocate_bytes(bytes);
  check(cub::DeviceRadixSort::SortPairs(scratch, bytes, codes, codes + n, rows, order, n, 0, 64, stream),
        "knn");
  std::int32_t finite = 0;
  check(cudaMemcpyAsync(&finite, &bounds->finite, sizeof(finite), cudaMemcpyDeviceToHost, stream), "knn");
  check(cudaStreamSynchronize(stream), "knn");
  return finite;
}

}  // namespace

template <class T>
void knn_distances(const T* points, std::int32_t n, int k, T* distances, Workspace& workspace,
                   CudaStream stream) {
  if (n == 0) return;
  const std::int64_t values = std::int64_t{n} * k;
  fill_infinite<<<blocks_for(values, 256), 256, 0, stream>>>(distances, values);
  std::int32_t* order = workspace.allocate<std::int32_t>(n);
  KnnTree<float> tree{};
  tree.n = sort_along_curve(points, n, order, workspace, stream);
  if (tree.n == 0) return;
  float* sorted = workspace.allocate<float>(3 * std::int64_t{tree.n});
  gather_points<<<blocks_for(tree.n, 256), 256, 0, stream>>>(points, order, tree.n, sorted);
  tree.points = sorted;
  tree.order = order;
  KnnBox<float>* boxes = workspace.allocate<KnnBox<float>>(plan_knn_levels(tree.n, tree));
  tree.boxes = boxes;
  for (int level = 0; level < tree.levels; ++level) {
    make_boxes<<<blocks_for(tree.count[level], 256), 256, 0, stream>>>(tree, level, boxes);
  }
  with_knn_length(k, [&]<int K>() {
    query_kernel<K><<<blocks_for(tree.n, kThreads), kThreads, 0, stream>>>(tree, k, distances);
  });
  check_launch("knn_distances");
}

template void knn_distances<float>(const float*, std::int32_t, int, float*, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
