// SPDX-License-Identifier: Apache-2.0
#include <cub/cub.cuh>

#include "common/cuda.cuh"
#include "common/rows.h"
#include "math/morton.h"
#include "population/columns.h"
#include "population/density.h"
#include "population/knn.h"
#include "population/placement.h"
#include "population/relocation.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 256, kBlocks = 512;

// Each block takes a part of the column blockIdx.y.
__global__ void __launch_bounds__(kThreads)
    check_columns_kernel(const __grid_constant__ CheckedColumns<float> checked) {
  const auto& column = checked.columns[blockIdx.y];
  bool bad = false;
  for (int64_t i = blockIdx.x * int64_t{kThreads} + threadIdx.x; i < column.length;
       i += gridDim.x * int64_t{kThreads}) {
    bad |= is_bad(column.values[i], column.zero_is_bad);
  }
  if (bad) *checked.bad = 1;
}

// A row of features in shared memory. One feature is contiguous, without bank conflicts.
struct StridedRow {
  const float* first;
  __device__ float operator[](int feature) const { return first[feature * kThreads]; }
};

// sums [M] (density.h), one thread per row. All threads of a block take the same tree at a time, so that its
// nodes stay in the L1 cache.
__global__ void __launch_bounds__(kThreads) tree_sums_kernel(const TreeSumsArgs args) {
  extern __shared__ float shared[];
  wait_for_earlier_kernels();
  const int64_t row = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= args.n_rows) return;
  float* const row_features = shared + threadIdx.x;
  const float* const features = args.features + row * args.n_features;
  for (int i = 0; i < args.n_features; ++i) row_features[i * kThreads] = features[i];
  args.sums[row] = tree_sum_of(args, StridedRow{row_features});
}

// out (columns.h). A block copies kThreads rows, a thread one word at a time. units: the words in a row.
template <class Word>
__global__ void __launch_bounds__(kThreads) copy_rows_kernel(const CopyRows copy, uint32_t units) {
  __shared__ int64_t from[kThreads], to[kThreads];
  const int64_t first = blockIdx.x * int64_t{kThreads};
  const auto n = uint32_t(copy.n - first < kThreads ? copy.n - first : kThreads);
  if (threadIdx.x < n) {
    const int64_t i = first + threadIdx.x;
    from[threadIdx.x] = copy.from ? copy.from[i] : i;
    to[threadIdx.x] = copy.to ? copy.to[i] : i;
  }
  __syncthreads();
  const auto* column = reinterpret_cast<const Word*>(copy.column);
  Word* out = reinterpret_cast<Word*>(copy.out);
#pragma unroll 4
  for (uint32_t i = threadIdx.x; i < n * units; i += kThreads) {
    const uint32_t place = i / units;
    const int64_t k = i - place * units;
    out[to[place] * units + k] = column ? column[from[place] * units + k] : Word{};
  }
}

// Launches the kernel and returns true if the rows are whole, aligned numbers of words of this type.
template <class Word> bool launch_if_whole(const CopyRows& copy, CudaStream stream) {
  const auto places =
      reinterpret_cast<std::uintptr_t>(copy.column) | reinterpret_cast<std::uintptr_t>(copy.out);
  if (copy.row_bytes % sizeof(Word) != 0 || places % sizeof(Word) != 0) return false;
  copy_rows_kernel<Word>
      <<<blocks_for(copy.n, kThreads), kThreads, 0, stream>>>(copy, uint32_t(copy.row_bytes / sizeof(Word)));
  check_launch("copy_rows");
  return true;
}

constexpr int kKeyThreads = 512, kResident = 4;  // blocks per multiprocessor

// Adds to counts [2^width] (columns.h), one thread per key in a grid-stride loop. A block counts in shared
// memory first.
__global__ void __launch_bounds__(kKeyThreads) key_histogram_kernel(const KeyHistogram args) {
  __shared__ unsigned counts[1 << kMaxDigitBits];
  const int digits = 1 << args.width;
  for (int i = threadIdx.x; i < digits; i += kKeyThreads) counts[i] = 0;
  __syncthreads();
  const int64_t prefix = *args.prefix, stride = gridDim.x * int64_t{kKeyThreads};
  for (int64_t i = blockIdx.x * int64_t{kKeyThreads} + threadIdx.x; i < args.n; i += stride) {
    const int digit = digit_of(args, prefix, args.keys[i]);
    if (digit >= 0) atomicAdd(counts + digit, 1u);
  }
  __syncthreads();
  for (int i = threadIdx.x; i < digits; i += kKeyThreads) {
    if (counts[i] > 0) atomic_add(args.counts + i, counts[i]);
  }
}

// One block; each thread adds up its part of the counts.
__global__ void __launch_bounds__(kKeyThreads) find_digit_kernel(const FindDigit args) {
  __shared__ typename cub::BlockScan<int64_t, kKeyThreads>::TempStorage scratch;
  const int64_t digits = int64_t{1} << args.width, part = (digits + kKeyThreads - 1) / kKeyThreads;
  const int64_t begin = threadIdx.x * part, end = begin + part < digits ? begin + part : digits;
  const int64_t wanted = args.search[1];
  int64_t sum = 0, before;
  for (int64_t digit = begin; digit < end; ++digit) sum += args.counts[digit];
  cub::BlockScan<int64_t, kKeyThreads>(scratch).ExclusiveSum(sum, before);
  __syncthreads();  // all have read what one of them writes
  const bool is_last = begin < digits && end == digits;
  if (before >= wanted || (before + sum < wanted && !is_last)) return;
  int64_t digit = begin;
  while (digit < end - 1 && before + args.counts[digit] < wanted) before += args.counts[digit++];
  take_digit(args, digit, before);
}

// Nearest neighbours (knn.h).

constexpr int kQueryThreads = 128;

// The Morton codes and rows of points [n, 3], one thread per point.
__global__ void make_codes(const float* points, int32_t n, const MortonBounds* bounds, uint64_t* codes,
                           int32_t* rows) {
  const int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x;
  if (i >= n) return;
  codes[i] = morton_code(points + 3 * i, frame_of(*bounds));
  rows[i] = int32_t(i);
}

// sorted [n, 3] = the points in the order of the curve, one thread per point.
__global__ void gather_points(const float* points, const int32_t* order, int32_t n, float* sorted) {
  const int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x;
  if (i >= n) return;
  for (int axis = 0; axis < 3; ++axis) sorted[3 * i + axis] = points[3 * int64_t{order[i]} + axis];
}

// distances [N, k], one thread per sorted point.
template <int K>
__global__ void __launch_bounds__(kQueryThreads)
    query_kernel(const KnnTree<float> tree, int k, float* distances) {
  const int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x;
  if (i < tree.n) knn_row<float, K>(tree, int32_t(i), k, distances);
}

__global__ void fill_infinite(float* values, int64_t n) {
  const int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x;
  if (i < n) values[i] = INFINITY;
}

// Sorts the rows along the curve and returns the number of finite points. It waits for the stream, because
// this number determines the shape of the tree.
int32_t sort_along_curve(const float* points, int32_t n, int32_t* order, Workspace& workspace,
                         cudaStream_t stream) {
  MortonBounds* bounds = find_morton_bounds(points, n, workspace, stream);
  uint64_t* codes = workspace.allocate<uint64_t>(2 * int64_t{n});
  int32_t* rows = workspace.allocate<int32_t>(n);
  make_codes<<<blocks_for(n, 256), 256, 0, stream>>>(points, n, bounds, codes, rows);
  run_cub("knn", workspace, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, codes, codes + n, rows, order, n, 0, 64, stream);
  });
  return read_back("knn", &bounds->finite, stream);
}

}  // namespace

void clear_flag(int32_t* bad, CudaStream stream) {
  check(cudaMemsetAsync(bad, 0, sizeof(*bad), stream), "find_non_finite");
}

template <> void check_columns<float>(const CheckedColumns<float>& checked, CudaStream stream) {
  if (checked.n == 0) return;
  check_columns_kernel<<<dim3(kBlocks, unsigned(checked.n)), kThreads, 0, stream>>>(checked);
  check_launch("find_non_finite");
}

void tree_sums(const TreeSumsArgs& args, CudaStream stream) {
  if (args.n_rows == 0) return;
  const size_t bytes = args.n_features * kThreads * sizeof(float);
  launch_early("tree_sums", tree_sums_kernel, {blocks_for(args.n_rows, kThreads), kThreads, stream, bytes},
               args);
}

template void for_each_row(const DensityStats<float>&, CudaStream);
template void for_each_row(const SpawnFeatures&, CudaStream);
template void for_each_row(const HashKey&, CudaStream);
template void for_each_row(const Overlap&, CudaStream);
template void for_each_row(const DrawWeights&, CudaStream);
template void for_each_row(const ResidualDraws&, CudaStream);
template void for_each_row(const ShareMoments&, CudaStream);
template void for_each_row(const ShareRows&, CudaStream);
template void for_each_row(const BracketKeys&, CudaStream);
template void for_each_row(const MatchBrackets&, CudaStream);
template void for_each_row(const SamplingKeys&, CudaStream);
template void for_each_row(const KeysUpTo&, CudaStream);
template void for_each_row(const KnnLevel<float>&, CudaStream);

void copy_rows(const CopyRows& copy, CudaStream stream) {
  if (copy.n == 0 || copy.row_bytes == 0) return;
  if (launch_if_whole<uint4>(copy, stream) || launch_if_whole<uint2>(copy, stream)) return;
  if (launch_if_whole<uint32_t>(copy, stream)) return;
  launch_if_whole<uint8_t>(copy, stream);
}

void key_histogram(const KeyHistogram& args, CudaStream stream) {
  check(cudaMemsetAsync(args.counts, 0, sizeof(*args.counts) << args.width, stream), "key_histogram");
  if (args.n == 0) return;
  key_histogram_kernel<<<resident_blocks(args.n, kKeyThreads, kResident), kKeyThreads, 0, stream>>>(args);
  check_launch("key_histogram");
}

void find_digit(const FindDigit& args, CudaStream stream) {
  find_digit_kernel<<<1, kKeyThreads, 0, stream>>>(args);
  check_launch("find_digit");
}

template <class T>
void knn_distances(const T* points, int32_t n, int k, T* distances, Workspace& workspace, CudaStream stream) {
  if (n == 0) return;
  const int64_t values = int64_t{n} * k;
  fill_infinite<<<blocks_for(values, 256), 256, 0, stream>>>(distances, values);
  int32_t* order = workspace.allocate<int32_t>(n);
  KnnTree<float> tree{};
  tree.n = sort_along_curve(points, n, order, workspace, stream);
  if (tree.n == 0) return;
  float* sorted = workspace.allocate<float>(3 * int64_t{tree.n});
  gather_points<<<blocks_for(tree.n, 256), 256, 0, stream>>>(points, order, tree.n, sorted);
  tree.points = sorted;
  tree.order = order;
  make_knn_boxes(tree, workspace, stream);
  with_knn_length(k, [&]<int K>() {
    query_kernel<K><<<blocks_for(tree.n, kQueryThreads), kQueryThreads, 0, stream>>>(tree, k, distances);
  });
  check_launch("knn_distances");
}

template void knn_distances<float>(const float*, int32_t, int, float*, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
