// SPDX-License-Identifier: Apache-2.0
// Marks inline maths that g++ and nvcc both compile.
#pragma once
#ifdef __CUDACC__
#define BLITZGS_HD __host__ __device__ __forceinline__
#else
#define BLITZGS_HD inline
#endif
