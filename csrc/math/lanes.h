// SPDX-License-Identifier: Apache-2.0
// Types of eight numbers for CPU kernels: Avx2Lanes in files that are compiled with -mavx2 -mfma, PlainLanes
// in all files (and for float64). Each operation gives the same bits in both, NaN included:
//   min(a, b), max(a, b)  return b when either is NaN;   comparisons with NaN are false;
//   sum()                 adds in one fixed order.
// Files for different instruction sets must not share inline functions, so the types have internal linkage.
#pragma once
#include <bit>
#include <cmath>
#include <cstdint>
#include <functional>

#ifdef __AVX2__
#include <immintrin.h>
#endif

namespace blitzgs {
namespace {

constexpr int kLanes = 8;

// Eight values, of lane i f(i).
template <class Eight, class F> Eight make_eight(F f) {
  Eight r;
  for (int i = 0; i < kLanes; ++i) r.v[i] = f(i);
  return r;
}

// Eight values, f of those of each lane.
template <class Eight, class F, class... Lanes> Eight map_eight(F f, Lanes... lanes) {
  return make_eight<Eight>([&](int i) { return f(lanes.v[i]...); });
}

template <class T> struct PlainLanes {
  using Scalar = T;
  struct Mask {
    bool v[kLanes];
    friend Mask operator&(Mask a, Mask b) { return map_eight<Mask>(std::logical_and<>(), a, b); }
    Mask and_not(Mask b) const { return map_eight<Mask>(std::greater<>(), *this, b); }  // this and not b
    bool any() const { return bits() != 0; }
    unsigned bits() const {
      unsigned result = 0;
      for (int i = 0; i < kLanes; ++i) result |= unsigned(v[i]) << i;
      return result;
    }
  };
  struct Int {
    int32_t v[kLanes];
    static Int load(const int32_t* p) {
      return make_eight<Int>([&](int i) { return p[i]; });
    }
    void store(int32_t* p) const {
      for (int i = 0; i < kLanes; ++i) p[i] = v[i];
    }
    static Int broadcast(int32_t x) {
      return make_eight<Int>([&](int) { return x; });
    }
    static Mask greater(Int a, Int b) { return map_eight<Mask>(std::greater<>(), a, b); }
    static Int select(Mask m, Int a, Int b) {
      return make_eight<Int>([&](int i) { return m.v[i] ? a.v[i] : b.v[i]; });
    }
  };

  T v[kLanes];

  template <class F> static PlainLanes make(F f) { return make_eight<PlainLanes>(f); }
  template <class F> static PlainLanes map(F f, PlainLanes a, PlainLanes b) {
    return map_eight<PlainLanes>(f, a, b);
  }
  static PlainLanes map(T (*f)(T), PlainLanes a) { return map_eight<PlainLanes>(f, a); }
  static PlainLanes load(const T* p) {
    return make([&](int i) { return p[i]; });
  }
  void store(T* p) const {
    for (int i = 0; i < kLanes; ++i) p[i] = v[i];
  }
  static PlainLanes broadcast(T x) {
    return make([&](int) { return x; });
  }
  static PlainLanes zero() { return broadcast(T(0)); }
  static PlainLanes iota() {
    return make([](int i) { return T(i); });
  }
  friend PlainLanes operator+(PlainLanes a, PlainLanes b) { return map(std::plus<>(), a, b); }
  friend PlainLanes operator-(PlainLanes a, PlainLanes b) { return map(std::minus<>(), a, b); }
  friend PlainLanes operator*(PlainLanes a, PlainLanes b) { return map(std::multiplies<>(), a, b); }
  friend PlainLanes operator/(PlainLanes a, PlainLanes b) { return map(std::divides<>(), a, b); }
  // In float64 there is no vector version with the same bits, so the plain expression is enough.
  static T fma1(T a, T b, T c) {
    if constexpr (sizeof(T) == 4) return std::fma(a, b, c);
    return a * b + c;
  }
  static PlainLanes fma(PlainLanes a, PlainLanes b, PlainLanes c) {
    return map_eight<PlainLanes>(fma1, a, b, c);
  }
  static PlainLanes fnma(PlainLanes a, PlainLanes b, PlainLanes c) {  // c - a b
    return make([&](int i) { return fma1(-a.v[i], b.v[i], c.v[i]); });
  }
  static PlainLanes min(PlainLanes a, PlainLanes b) {
    return make([&](int i) { return a.v[i] < b.v[i] ? a.v[i] : b.v[i]; });
  }
  static PlainLanes max(PlainLanes a, PlainLanes b) {
    return make([&](int i) { return a.v[i] > b.v[i] ? a.v[i] : b.v[i]; });
  }
  static PlainLanes sqrt(PlainLanes a) { return map(std::sqrt, a); }
  static PlainLanes abs(PlainLanes a) { return map(std::fabs, a); }
  static PlainLanes round(PlainLanes a) { return map(std::nearbyint, a); }
  static PlainLanes ceil(PlainLanes a) { return map(std::ceil, a); }
  static PlainLanes floor(PlainLanes a) { return map(std::floor, a); }
  // Returns a 2^n for a in [1/2, 2] and an integer n in [-126, 0]; NaN if n is NaN (a is NaN then, too).
  static PlainLanes scale_exponent(PlainLanes a, PlainLanes n) {
    return make([&](int i) {
      if (n.v[i] != n.v[i]) return a.v[i];
      const auto shift = uint32_t(int32_t(n.v[i])) << 23;
      return std::bit_cast<T>(std::bit_cast<uint32_t>(a.v[i]) + shift);
    });
  }
  static Mask greater_equal(PlainLanes a, PlainLanes b) {
    return map_eight<Mask>(std::greater_equal<>(), a, b);
  }
  static Mask greater(PlainLanes a, PlainLanes b) { return map_eight<Mask>(std::greater<>(), a, b); }
  static PlainLanes select(Mask m, PlainLanes a, PlainLanes b) {
    return make([&](int i) { return m.v[i] ? a.v[i] : b.v[i]; });
  }
  static PlainLanes keep(Mask m, PlainLanes a) {  // a where m, else +0
    return make([&](int i) { return m.v[i] ? a.v[i] : T(0); });
  }
  Int to_int() const {  // truncates; a value that does not fit becomes the lowest integer
    return make_eight<Int>(
        [&](int i) { return std::fabs(v[i]) < T(2147483648.0) ? int32_t(v[i]) : INT32_MIN; });
  }
  T sum() const {
    const T a = v[0] + v[4], b = v[1] + v[5], c = v[2] + v[6], d = v[3] + v[7];
    return (a + c) + (b + d);
  }
};

#ifdef __AVX2__
struct Avx2Lanes {
  using Scalar = float;
  struct Mask {
    __m256 v;
    friend Mask operator&(Mask a, Mask b) { return {_mm256_and_ps(a.v, b.v)}; }
    Mask and_not(Mask b) const { return {_mm256_andnot_ps(b.v, v)}; }
    bool any() const { return !_mm256_testz_ps(v, v); }
    unsigned bits() const { return unsigned(_mm256_movemask_ps(v)); }
  };
  struct Int {
    __m256i v;
    static Int load(const int32_t* p) { return {_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p))}; }
    void store(int32_t* p) const { _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), v); }
    static Int broadcast(int32_t x) { return {_mm256_set1_epi32(x)}; }
    static Mask greater(Int a, Int b) { return {_mm256_castsi256_ps(_mm256_cmpgt_epi32(a.v, b.v))}; }
    static Int select(Mask m, Int a, Int b) {
      return {_mm256_castps_si256(_mm256_blendv_ps(_mm256_castsi256_ps(b.v), _mm256_castsi256_ps(a.v), m.v))};
    }
  };

  __m256 v;

  static Avx2Lanes load(const float* p) { return {_mm256_loadu_ps(p)}; }
  void store(float* p) const { _mm256_storeu_ps(p, v); }
  static Avx2Lanes broadcast(float x) { return {_mm256_set1_ps(x)}; }
  static Avx2Lanes zero() { return {_mm256_setzero_ps()}; }
  static Avx2Lanes iota() { return {_mm256_setr_ps(0, 1, 2, 3, 4, 5, 6, 7)}; }
  friend Avx2Lanes operator+(Avx2Lanes a, Avx2Lanes b) { return {_mm256_add_ps(a.v, b.v)}; }
  friend Avx2Lanes operator-(Avx2Lanes a, Avx2Lanes b) { return {_mm256_sub_ps(a.v, b.v)}; }
  friend Avx2Lanes operator*(Avx2Lanes a, Avx2Lanes b) { return {_mm256_mul_ps(a.v, b.v)}; }
  friend Avx2Lanes operator/(Avx2Lanes a, Avx2Lanes b) { return {_mm256_div_ps(a.v, b.v)}; }
  static Avx2Lanes fma(Avx2Lanes a, Avx2Lanes b, Avx2Lanes c) { return {_mm256_fmadd_ps(a.v, b.v, c.v)}; }
  static Avx2Lanes fnma(Avx2Lanes a, Avx2Lanes b, Avx2Lanes c) { return {_mm256_fnmadd_ps(a.v, b.v, c.v)}; }
  static Avx2Lanes min(Avx2Lanes a, Avx2Lanes b) { return {_mm256_min_ps(a.v, b.v)}; }
  static Avx2Lanes max(Avx2Lanes a, Avx2Lanes b) { return {_mm256_max_ps(a.v, b.v)}; }
  static Avx2Lanes sqrt(Avx2Lanes a) { return {_mm256_sqrt_ps(a.v)}; }
  static Avx2Lanes abs(Avx2Lanes a) { return {_mm256_andnot_ps(_mm256_set1_ps(-0.0f), a.v)}; }
  static Avx2Lanes round(Avx2Lanes a) {
    return {_mm256_round_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)};
  }
  static Avx2Lanes ceil(Avx2Lanes a) { return {_mm256_ceil_ps(a.v)}; }
  static Avx2Lanes floor(Avx2Lanes a) { return {_mm256_floor_ps(a.v)}; }
  static Avx2Lanes scale_exponent(Avx2Lanes a, Avx2Lanes n) {
    // NaN converts to 0x80000000, whose shift is 0.
    const __m256i shift = _mm256_slli_epi32(_mm256_cvtps_epi32(n.v), 23);
    return {_mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.v), shift))};
  }
  static Mask greater_equal(Avx2Lanes a, Avx2Lanes b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
  static Mask greater(Avx2Lanes a, Avx2Lanes b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)}; }
  static Avx2Lanes select(Mask m, Avx2Lanes a, Avx2Lanes b) { return {_mm256_blendv_ps(b.v, a.v, m.v)}; }
  static Avx2Lanes keep(Mask m, Avx2Lanes a) { return {_mm256_and_ps(m.v, a.v)}; }
  Int to_int() const { return {_mm256_cvttps_epi32(v)}; }
  float sum() const {
    const __m128 four = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    const __m128 two = _mm_add_ps(four, _mm_movehl_ps(four, four));
    return _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)));
  }
};
#endif

}  // namespace

// 2^x for x <= 0, with the same bits for all lane types and a relative error below 1.1e-7 (1 ulp). x below
// -126 counts as -126. NaN stays NaN. x is split into the nearest integer, which is added to the exponent
// bits, and f in [-1/2, 1/2], of which a minimax polynomial of degree 6 gives 2^f (relative error 2e-9).
template <class Lanes> inline Lanes exp2_nonpositive(Lanes x) {
  const Lanes clamped = Lanes::max(Lanes::broadcast(-126.0f), x);
  const Lanes n = Lanes::round(clamped);
  const Lanes f = clamped - n;
  Lanes p = Lanes::fma(Lanes::broadcast(1.5345811984583603e-4f), f, Lanes::broadcast(1.3399931218929e-3f));
  p = Lanes::fma(p, f, Lanes::broadcast(9.618488957179101e-3f));
  p = Lanes::fma(p, f, Lanes::broadcast(5.550328776965966e-2f));
  p = Lanes::fma(p, f, Lanes::broadcast(2.4022646890633564e-1f));
  p = Lanes::fma(p, f, Lanes::broadcast(6.931472057372674e-1f));
  p = Lanes::fma(p, f, Lanes::broadcast(1.0f));
  return Lanes::scale_exponent(p, n);
}

}  // namespace blitzgs
