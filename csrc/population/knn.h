// SPDX-License-Identifier: Apache-2.0
// The exact distances of each point to its k nearest other points.
//
// points [N, 3]; distances [N, k] ascending, in the unit of the points. Duplicates have distance 0. A row
// that is not finite is no point's neighbour, and its distances are infinite. Distances are exact as long as
// their squares fit into T, for floats from 1e-19 to 1e19. If fewer than k other points
// exist, the remaining entries are infinite, too.
//
// Points are sorted along a Morton curve. Boxes around 8 consecutive points are the leaves of an implicit
// tree, whose nodes are boxes around 8 boxes of the level below. A query starts in the leaf of its point and
// goes up the tree; at each level it descends into the siblings whose box is nearer than the k-th neighbour
// so far. The distance to a box is computed by the same operations as the distance to a point, so rounding is
// monotone and the query misses no neighbour. The cost is O(N log N).
#pragma once
#include <cmath>

#include "common/rows.h"
#include "math/morton.h"

namespace blitzgs {

constexpr int kKnnFan = 8;      // points per leaf and children per node
constexpr int kKnnLevels = 11;  // 8^11 > 2^31 points
constexpr int kKnnMaxK = 32;

template <class T> struct KnnBox {
  T low[3], high[3];
};

template <class T> struct KnnTree {
  const T* points;       // [n, 3], in curve order
  const int32_t* order;  // [n], row of each sorted point
  int32_t n;             // finite points
  int levels;            // the top level has one node
  int64_t offset[kKnnLevels];
  int32_t count[kKnnLevels];
  KnnBox<T>* boxes;
};

// Row i: the box of node i of a level, around 8 points (level 0) or around 8 boxes of the level below.
template <class T> struct KnnLevel {
  KnnTree<T> tree;
  int level;
  int64_t n;

  BLITZGS_HD void operator()(int64_t i) const {
    const int64_t begin = i * kKnnFan;
    const int64_t below = level == 0 ? tree.n : tree.count[level - 1];
    const int64_t end = begin + kKnnFan < below ? begin + kKnnFan : below;
    KnnBox<T> box;
    for (int64_t j = begin; j < end; ++j) {
      const T* low = level == 0 ? tree.points + 3 * j : tree.boxes[tree.offset[level - 1] + j].low;
      const T* high = level == 0 ? low : tree.boxes[tree.offset[level - 1] + j].high;
      for (int axis = 0; axis < 3; ++axis) {
        box.low[axis] = j == begin || low[axis] < box.low[axis] ? low[axis] : box.low[axis];
        box.high[axis] = j == begin || high[axis] > box.high[axis] ? high[axis] : box.high[axis];
      }
    }
    tree.boxes[tree.offset[level] + i] = box;
  }
};

// A query for one point. best: the K smallest squared distances found so far, ascending.
template <class T, int K> struct KnnQuery {
  const KnnTree<T>& tree;
  T p[3];
  T best[K];

  // Compares the points of a leaf. self: the query's own point, which is skipped; -1: none.
  BLITZGS_HD void scan_leaf(int32_t leaf, int32_t self) {
    const int32_t begin = leaf * kKnnFan;
    const int32_t end = tree.n - begin < kKnnFan ? tree.n : begin + kKnnFan;
    for (int32_t j = begin; j < end; ++j) {
      if (j == self) continue;
      const T* q = tree.points + 3 * int64_t{j};
      const T x = q[0] - p[0], y = q[1] - p[1], z = q[2] - p[2];
      const T d = x * x + y * y + z * z;
      if (!(d < best[K - 1])) continue;
      for (int i = K - 1; i > 0; --i) best[i] = d < best[i - 1] ? best[i - 1] : (d < best[i] ? d : best[i]);
      best[0] = d < best[0] ? d : best[0];
    }
  }

  BLITZGS_HD bool reaches(int level, int32_t node) const {
    const KnnBox<T>& box = tree.boxes[tree.offset[level] + node];
    T d[3];
    for (int axis = 0; axis < 3; ++axis) {
      const T below = box.low[axis] - p[axis], above = p[axis] - box.high[axis];
      d[axis] = below > 0 ? below : (above > 0 ? above : T(0));
    }
    return d[0] * d[0] + d[1] * d[1] + d[2] * d[2] < best[K - 1];
  }

  // Visits the leaves below one node whose boxes are near enough.
  BLITZGS_HD void descend(int from_level, int32_t from_node) {
    int32_t nodes[kKnnLevels * kKnnFan];
    signed char levels[kKnnLevels * kKnnFan];
    int top = 0;
    nodes[0] = from_node;
    levels[0] = static_cast<signed char>(from_level);
    while (top >= 0) {
      const int32_t node = nodes[top];
      const int level = levels[top--];
      if (!reaches(level, node)) continue;
      if (level == 0) {
        scan_leaf(node, -1);
        continue;
      }
      const int32_t begin = node * kKnnFan;
      const int32_t count = tree.count[level - 1];
      const int32_t end = count - begin < kKnnFan ? count : begin + kKnnFan;
      for (int32_t child = begin; child < end; ++child) {
        nodes[++top] = child;
        levels[top] = static_cast<signed char>(level - 1);
      }
    }
  }

  BLITZGS_HD void run(int32_t self) {
    for (int i = 0; i < K; ++i) best[i] = T(INFINITY);
    int32_t node = self / kKnnFan;
    scan_leaf(node, self);
    for (int level = 0; level + 1 < tree.levels; ++level) {
      const int32_t begin = node / kKnnFan * kKnnFan;
      const int32_t count = tree.count[level];
      const int32_t end = count - begin < kKnnFan ? count : begin + kKnnFan;
      for (int32_t sibling = begin; sibling < end; ++sibling) {
        if (sibling != node) descend(level, sibling);
      }
      node /= kKnnFan;
    }
  }
};

template <class T, int K> BLITZGS_HD void knn_row(const KnnTree<T>& tree, int32_t i, int k, T* distances) {
  const T* p = tree.points + 3 * int64_t{i};
  KnnQuery<T, K> query{tree, {p[0], p[1], p[2]}, {}};
  query.run(i);
  T* out = distances + int64_t{tree.order[i]} * k;
#ifdef __CUDA_ARCH__
#pragma unroll
#endif
  for (int j = 0; j < K; ++j) {
    if (j < k) out[j] = std::sqrt(query.best[j]);
  }
}

// Calls f with a compile-time constant K >= k, the length of the list of neighbours.
template <class F> void with_knn_length(int k, const F& f) {
  if (k == 1) return f.template operator()<1>();
  if (k == 2) return f.template operator()<2>();
  if (k == 3) return f.template operator()<3>();
  if (k == 4) return f.template operator()<4>();
  return k <= 8 ? f.template operator()<8>() : f.template operator()<kKnnMaxK>();
}

namespace BLITZGS_BACKEND {
// Makes the levels of a tree above its sorted points.
template <class T> void make_knn_boxes(KnnTree<T>& tree, Workspace& workspace, CudaStream stream) {
  int64_t total = 0;
  int32_t count = tree.n;
  do {
    count = int32_t((int64_t(count) + kKnnFan - 1) / kKnnFan);
    tree.offset[tree.levels] = total;
    tree.count[tree.levels++] = count;
    total += count;
  } while (count > 1);
  tree.boxes = workspace.allocate<KnnBox<T>>(total);
  for (int level = 0; level < tree.levels; ++level) {
    for_each_row(KnnLevel<T>{tree, level, tree.count[level]}, stream);
  }
}

template <class T>
void knn_distances(const T* points, int32_t n, int k, T* distances, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
