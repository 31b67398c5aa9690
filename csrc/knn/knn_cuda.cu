// SPDX-License-Identifier: Apache-2.0
#include <cub/cub.cuh>

#include "common/cuda_check.h"
#include "knn/knn.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 128;

// Floats as integers of the same order, so that atomicMin/Max find the bounds of the cloud.
__device__ std::int32_t ordered(float x) {
  const std::int32_t bits = __float_as_int(x);
  return bits < 0 ? bits ^ 0x7fffffff : bits;
}
__device__ float unordered(std::int32_t bits) { return __int_as_float(bits < 0 ? bits ^ 0x7fffffff : bits); }

struct Bounds {
  std::int32_t low[3], high[3];
  std::int32_t finite;  // number of finite points
};

__global__ void reset_bounds(Bounds* bounds) {
  const int axis = threadIdx.x;
  if (axis < 3) bounds->low[axis] = INT32_MAX, bounds->high[axis] = INT32_MIN;
  if (axis == 3) bounds->finite = 0;
}

__global__ void find_bounds(const float* points, std::int32_t n, Bounds* bounds) {
  std::int32_t low[3] = {INT32_MAX, INT32_MAX, INT32_MAX}, high[3] = {INT32_MIN, INT32_MIN, INT32_MIN},
               finite = 0;
  for (std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x; i < n;
       i += std::int64_t{gridDim.x} * blockDim.x) {
    const float* p = points + 3 * i;
    if (!is_finite_point(p)) continue;
    ++finite;
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = min(low[axis], ordered(p[axis]));
      high[axis] = max(high[axis], ordered(p[axis]));
    }
  }
  finite = __reduce_add_sync(~0u, finite);
  for (int axis = 0; axis < 3; ++axis) {
    const std::int32_t l = __reduce_min_sync(~0u, low[axis]), h = __reduce_max_sync(~0u, high[axis]);
    if (threadIdx.x % 32 == 0) {
      atomicMin(&bounds->low[axis], l);
      atomicMax(&bounds->high[axis], h);
    }
  }
  if (threadIdx.x % 32 == 0) atomicAdd(&bounds->finite, finite);
}

__global__ void make_codes(const float* points, std::int32_t n, const Bounds* bounds, std::uint64_t* codes,
                           std::int32_t* rows) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i >= n) return;
  MortonFrame frame{};
  double extent = 0;
  for (int axis = 0; axis < 3; ++axis) {
    frame.low[axis] = unordered(bounds->low[axis]);
    extent = fmax(extent, unordered(bounds->high[axis]) - frame.low[axis]);
  }
  frame.cells_per_unit = extent > 0 ? 2097152.0 / extent : 0.0;
  codes[i] = morton_code(points + 3 * i, frame);
  rows[i] = static_cast<std::int32_t>(i);
}

__global__ void gather_points(const float* points, const std::int32_t* order, std::int32_t n, float* sorted) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i >= n) return;
  for (int axis = 0; axis < 3; ++axis) sorted[3 * i + axis] = points[3 * std::int64_t{order[i]} + axis];
}

__global__ void make_boxes(const KnnTree<float> tree, int level, KnnBox<float>* boxes) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < tree.count[level]) {
    boxes[tree.offset[level] + i] = make_knn_box(tree, level, static_cast<std::int32_t>(i));
  }
}

template <int K>
__global__ void __launch_bounds__(kThreads) query_kernel(const KnnTree<float> tree, int k, float* distances) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < tree.n) knn_row<float, K>(tree, static_cast<std::int32_t>(i), k, distances);
}

__global__ void fill_infinite(float* values, std::int64_t n) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < n) values[i] = INFINITY;
}

// Rows in curve order; ends with the stream idle, as the number of finite points shapes the tree.
std::int32_t sort_along_curve(const float* points, std::int32_t n, std::int32_t* order, Workspace& workspace,
                              cudaStream_t stream) {
  Bounds* bounds = workspace.allocate<Bounds>(1);
  std::uint64_t* codes = workspace.allocate<std::uint64_t>(2 * std::int64_t{n});
  std::int32_t* rows = workspace.allocate<std::int32_t>(n);
  reset_bounds<<<1, 32, 0, stream>>>(bounds);
  find_bounds<<<min(blocks_for(n, 256), 1024u), 256, 0, stream>>>(points, n, bounds);
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
