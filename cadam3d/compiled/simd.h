// Vectors of many pixels or Gaussians, with the width of this machine, and the operations on them.
//
// A compiler lowers vectors that are wider than those of the machine to scalar code. Therefore the width
// depends on the instruction set: 16 lanes for AVX-512, 8 for AVX2, 4 for everything else (SSE2, NEON, ...).
// A product and a sum are fused only where the code calls fma(), so that the forward and the backward pass
// compute the same bits.
#pragma once

#if defined(__x86_64__) || defined(_M_X64)
#include <immintrin.h>
#endif
#if defined(__ARM_NEON) && defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace simd {

// Some versions of clang use AVX-512 instructions without 64-byte registers. They do not define __EVEX512__.
#if __clang_major__ >= 18 && !defined(__EVEX512__)
#define SIMD_HALF_AVX512 1
#endif

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__) && !defined(SIMD_HALF_AVX512)
#define SIMD_AVX512 1
#define SIMD_NAME "avx512"
constexpr int LANES = 16;
#elif defined(__AVX2__) && defined(__FMA__)
#define SIMD_AVX2 1
#define SIMD_NAME "avx2"
constexpr int LANES = 8;
#elif defined(__SSE2__)
#define SIMD_SSE2 1
#define SIMD_NAME "sse2"
constexpr int LANES = 4;
#elif defined(__ARM_NEON) && defined(__aarch64__)
#define SIMD_NEON 1
#define SIMD_NAME "neon"
constexpr int LANES = 4;
#else
#define SIMD_NAME "generic"
constexpr int LANES = 4;
#endif

typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int Ints __attribute__((vector_size(4 * LANES)));
typedef unsigned Bits __attribute__((vector_size(4 * LANES)));  // unsigned, because masked lanes overflow
typedef float Quad __attribute__((vector_size(16)));

inline Floats spread(float x) { return x - Floats{}; }  // x - 0 is x, bit for bit
inline Ints spread(int x) { return x + Ints{}; }
inline Floats load(const float* from) {
  Floats x;
  __builtin_memcpy(&x, from, sizeof x);
  return x;
}
inline Ints load(const int* from) {
  Ints x;
  __builtin_memcpy(&x, from, sizeof x);
  return x;
}
inline void store(float* to, Floats x) { __builtin_memcpy(to, &x, sizeof x); }
inline void store(int* to, Ints x) { __builtin_memcpy(to, &x, sizeof x); }
inline Floats as_floats(Ints x) { return (Floats)x; }
inline Ints as_ints(Floats x) { return (Ints)x; }

// ------------------------------------------------------------------------------------- fused multiply-add
#if defined(SIMD_AVX512)
inline Floats fma(Floats a, Floats b, Floats c) {
  return (Floats)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
}
inline Floats min(Floats a, Floats b) { return (Floats)_mm512_min_ps((__m512)a, (__m512)b); }
inline Floats max(Floats a, Floats b) { return (Floats)_mm512_max_ps((__m512)a, (__m512)b); }
inline Floats root(Floats x) { return (Floats)_mm512_sqrt_ps((__m512)x); }
inline Floats reciprocal(Floats x) {  // within 2 units in the last place, and faster than a division
  const Floats guess = (Floats)_mm512_rcp14_ps((__m512)x);
  return fma(fma(-x, guess, spread(1.0f)), guess, guess);
}
#elif defined(SIMD_AVX2)
inline Floats fma(Floats a, Floats b, Floats c) {
  return (Floats)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
}
inline Floats min(Floats a, Floats b) { return (Floats)_mm256_min_ps((__m256)a, (__m256)b); }
inline Floats max(Floats a, Floats b) { return (Floats)_mm256_max_ps((__m256)a, (__m256)b); }
inline Floats root(Floats x) { return (Floats)_mm256_sqrt_ps((__m256)x); }
#elif defined(SIMD_NEON)
inline Floats fma(Floats a, Floats b, Floats c) {
  return (Floats)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
inline Floats min(Floats a, Floats b) { return (Floats)vminq_f32((float32x4_t)a, (float32x4_t)b); }
inline Floats max(Floats a, Floats b) { return (Floats)vmaxq_f32((float32x4_t)a, (float32x4_t)b); }
inline Floats root(Floats x) { return (Floats)vsqrtq_f32((float32x4_t)x); }
#elif defined(SIMD_SSE2)
inline Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
inline Floats min(Floats a, Floats b) { return (Floats)_mm_min_ps((__m128)a, (__m128)b); }
inline Floats max(Floats a, Floats b) { return (Floats)_mm_max_ps((__m128)a, (__m128)b); }
inline Floats root(Floats x) { return (Floats)_mm_sqrt_ps((__m128)x); }
#else
inline Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
inline Floats min(Floats a, Floats b) { return a < b ? a : b; }
inline Floats max(Floats a, Floats b) { return a > b ? a : b; }
inline Floats root(Floats x) {
  for (int lane = 0; lane < LANES; ++lane) x[lane] = __builtin_sqrtf(x[lane]);
  return x;
}
#endif
#if !defined(SIMD_AVX512)
inline Floats reciprocal(Floats x) { return spread(1.0f) / x; }
#endif
inline Floats absolute(Floats x) { return (Floats)((Ints)x & 0x7fffffff); }
inline Floats to_floats(Ints x) { return __builtin_convertvector(x, Floats); }
inline Ints to_ints(Floats x) { return __builtin_convertvector(x, Ints); }  // towards zero

// ------------------------------------------------------------------------------------- masks
// One boolean per lane; a comparison with NaN is false.
#if defined(SIMD_AVX512)
typedef __mmask16 Mask;
inline Mask none() { return 0; }
inline unsigned bits(Mask a) { return a; }
inline Mask less_equal(Floats a, Floats b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ); }
inline Mask greater(Floats a, Floats b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
inline Mask less(Ints a, Ints b) { return _mm512_cmp_epi32_mask((__m512i)a, (__m512i)b, _MM_CMPINT_LT); }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask either(Mask a, Mask b) { return a | b; }
inline Mask first_only(Mask a, Mask b) { return a & (Mask)~b; }
inline bool any(Mask a) { return a != 0; }
inline Floats select(Mask m, Floats a, Floats b) {
  return (Floats)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a);
}
inline Ints select(Mask m, Ints a, Ints b) {
  return (Ints)_mm512_mask_blend_epi32(m, (__m512i)b, (__m512i)a);
}
inline Floats keep(Mask m, Floats a) { return (Floats)_mm512_maskz_mov_ps(m, (__m512)a); }
#else
typedef Ints Mask;  // all bits of a lane are equal
inline Mask none() { return Mask{}; }
inline Mask less_equal(Floats a, Floats b) { return a <= b; }
inline Mask greater(Floats a, Floats b) { return a > b; }
inline Mask less(Ints a, Ints b) { return a < b; }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask either(Mask a, Mask b) { return a | b; }
inline Mask first_only(Mask a, Mask b) { return a & ~b; }
inline Ints select(Mask m, Ints a, Ints b) { return (m & a) | (~m & b); }
inline Floats select(Mask m, Floats a, Floats b) { return as_floats(select(m, as_ints(a), as_ints(b))); }
inline Floats keep(Mask m, Floats a) { return as_floats(m & as_ints(a)); }
#if defined(SIMD_AVX2)
inline unsigned bits(Mask a) { return unsigned(_mm256_movemask_ps((__m256)a)); }
inline bool any(Mask a) { return bits(a) != 0; }
#elif defined(SIMD_SSE2)
inline unsigned bits(Mask a) { return unsigned(_mm_movemask_ps((__m128)a)); }
inline bool any(Mask a) { return bits(a) != 0; }
#elif defined(SIMD_NEON)
inline unsigned bits(Mask a) { return vaddvq_u32((uint32x4_t)(a & Ints{1, 2, 4, 8})); }
inline bool any(Mask a) { return vmaxvq_u32((uint32x4_t)a) != 0; }
#else
inline unsigned bits(Mask a) { return unsigned((a[0] & 1) | (a[1] & 2) | (a[2] & 4) | (a[3] & 8)); }
inline bool any(Mask a) { return bits(a) != 0; }
#endif
#endif

// ------------------------------------------------------------------------------------- exp and sums

// exp(-x) for 0 <= x < 80, with a relative error below 3e-7. For other x the result is arbitrary, and the
// caller masks the lane. exp(-x) = 2^n 2^f, where n is the nearest integer; the polynomial is the minimax
// approximation of 2^f on [-1/2, 1/2] (Lawson).
inline Floats exp_minus(Floats x) {
  const Floats scaled = x * spread(-1.44269504f);
  const Floats magic = spread(12582912.0f);  // 1.5 * 2^23; adding it rounds, and n is in the low bits
  const Floats shifted = scaled + magic;
  const Floats f = scaled - (shifted - magic);
  Floats p = spread(1.3276472e-3f);
  p = fma(p, f, spread(9.6755413e-3f));
  p = fma(p, f, spread(5.5507133e-2f));
  p = fma(p, f, spread(2.4022120e-1f));
  p = fma(p, f, spread(6.9314697e-1f));
  p = fma(p, f, spread(1.0000001f));
  return (Floats)((Bits)p + ((Bits)shifted << 23));
}

// exp(x) for any x except NaN, with a relative error below 3e-7 except for denormals; inf beyond the largest
// float.
inline Floats exp(Floats x) {
  x = min(max(x, spread(-104.0f)), spread(89.0f));
  const Floats magic = spread(12582912.0f);
  const Floats shifted = fma(x, spread(1.44269504f), magic), n = shifted - magic;
  const Floats r = fma(n, spread(-1.42860677e-6f), fma(n, spread(-0.693145752f), x));  // ln 2 in two parts
  Floats p = spread(1.3888889e-3f);
  p = fma(p, r, spread(8.3333333e-3f));
  p = fma(p, r, spread(4.1666667e-2f));
  p = fma(p, r, spread(1.6666667e-1f));
  p = fma(p, r, spread(0.5f));
  p = fma(p * r, r, r) + spread(1.0f);
  const Ints whole = to_ints(n), half = whole >> 1;  // 2^n may overflow where 2^(n/2) does not
  return p * as_floats((half + 127) << 23) * as_floats((whole - half + 127) << 23);
}

// The natural logarithm of a normal positive number, with an absolute error below 1e-7 (1 + |log x|).
inline Floats log(Floats x) {
  const Ints above = as_ints(x) - 0x3f3504f3;  // the bits of the square root of 1/2
  const Floats m = as_floats((above & 0x7fffff) + 0x3f3504f3), n = to_floats(above >> 23);
  const Floats s = (m - 1.0f) / (m + 1.0f), square = s * s;  // ln m = 2 artanh s
  Floats p = spread(2.2222222e-1f);
  p = fma(p, square, spread(2.8571429e-1f));
  p = fma(p, square, spread(0.4f));
  p = fma(p, square, spread(6.6666667e-1f));
  return fma(n, spread(0.693147181f), fma(p * square, s, s + s));
}

// Writes the sums over the lanes of each of the N vectors to ``to[0] .. to[15]``, always added in the same
// order. Numbers after the N-th are arbitrary. ``to`` is the start of a cache line.
#if defined(SIMD_AVX512)
// Lanes with the bit DISTANCE set hold sums of b, the others of a; each adds its partner DISTANCE lanes away.
template <int DISTANCE>
inline Floats fold(Floats a, Floats b) {
  const auto from = [](int lane) { return (lane ^ DISTANCE) + (lane & DISTANCE ? 16 : 0); };
  const __m512i partner =
      _mm512_setr_epi32(from(0), from(1), from(2), from(3), from(4), from(5), from(6), from(7), from(8),
                        from(9), from(10), from(11), from(12), from(13), from(14), from(15));
  constexpr __mmask16 OF_B = DISTANCE == 8   ? 0xff00
                             : DISTANCE == 4 ? 0xf0f0
                             : DISTANCE == 2 ? 0xcccc
                                             : 0xaaaa;
  return (Floats)_mm512_add_ps(_mm512_mask_blend_ps(OF_B, (__m512)a, (__m512)b),
                               _mm512_permutex2var_ps((__m512)a, partner, (__m512)b));
}
inline void store_sums(float* to, const Floats (&x)[10]) {
  const Floats a = fold<4>(fold<8>(x[0], x[1]), fold<8>(x[2], x[3]));
  const Floats b = fold<4>(fold<8>(x[4], x[5]), fold<8>(x[6], x[7]));
  const Floats c = fold<8>(x[8], x[9]), d = fold<4>(c, c);
  const Floats all = fold<1>(fold<2>(a, b), fold<2>(d, d));
  const __m512i home = _mm512_setr_epi32(0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 0, 0, 0, 0, 0, 0);
  _mm512_store_ps(to, _mm512_permutexvar_ps(home, (__m512)all));
}
inline void store_sums(float* to, const Floats (&x)[12]) {
  const Floats a = fold<4>(fold<8>(x[0], x[1]), fold<8>(x[2], x[3]));
  const Floats b = fold<4>(fold<8>(x[4], x[5]), fold<8>(x[6], x[7]));
  const Floats c = fold<4>(fold<8>(x[8], x[9]), fold<8>(x[10], x[11]));
  const Floats all = fold<1>(fold<2>(a, b), fold<2>(c, c));
  const __m512i home = _mm512_setr_epi32(0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13, 0, 0, 0, 0);
  _mm512_store_ps(to, _mm512_permutexvar_ps(home, (__m512)all));
}
#else
// The four lanes of the result are the sums of a, b, c and d.
#if defined(SIMD_AVX2) || defined(SIMD_SSE2)
inline Quad sums(Floats a, Floats b, Floats c, Floats d) {
#if defined(SIMD_AVX2)
  const auto fold = [](Floats v) {
    return _mm_add_ps(_mm256_castps256_ps128((__m256)v), _mm256_extractf128_ps((__m256)v, 1));
  };
#else
  const auto fold = [](Floats v) { return (__m128)v; };
#endif
  __m128 p = fold(a), q = fold(b), r = fold(c), s = fold(d);
  _MM_TRANSPOSE4_PS(p, q, r, s);
  return (Quad)_mm_add_ps(_mm_add_ps(p, q), _mm_add_ps(r, s));
}
#else
inline float sum(Floats v) { return (v[0] + v[1]) + (v[2] + v[3]); }
inline Quad sums(Floats a, Floats b, Floats c, Floats d) { return Quad{sum(a), sum(b), sum(c), sum(d)}; }
#endif
inline void store_sums(float* to, const Floats (&x)[10]) {
  const Quad all[4] = {sums(x[0], x[1], x[2], x[3]), sums(x[4], x[5], x[6], x[7]),
                       sums(x[8], x[9], x[9], x[9]), Quad{}};
  __builtin_memcpy(to, all, sizeof all);
}
inline void store_sums(float* to, const Floats (&x)[12]) {
  const Quad all[4] = {sums(x[0], x[1], x[2], x[3]), sums(x[4], x[5], x[6], x[7]),
                       sums(x[8], x[9], x[10], x[11]), Quad{}};
  __builtin_memcpy(to, all, sizeof all);
}
#endif

// ------------------------------------------------------------------------------------- as a scalar

// One boolean or one float per lane, with the operators of bool and float, so that code for one Gaussian
// (splat_math.h) works on LANES Gaussians.
struct Truths {
  Mask mask;
  friend Truths operator&(Truths a, Truths b) { return {both(a.mask, b.mask)}; }
  friend Truths operator|(Truths a, Truths b) { return {either(a.mask, b.mask)}; }
};

struct Wide {
  Floats lanes;
  Wide() = default;
  Wide(Floats x) : lanes(x) {}
  Wide(float x) : lanes(spread(x)) {}
  Wide(double x) : Wide(float(x)) {}
  Wide(int x) : Wide(float(x)) {}
  Wide& operator+=(Wide b) { return *this = *this + b; }
  Wide& operator-=(Wide b) { return *this = *this - b; }
  Wide& operator*=(Wide b) { return *this = *this * b; }
  Wide operator-() const { return -lanes; }
  friend Wide operator+(Wide a, Wide b) { return a.lanes + b.lanes; }
  friend Wide operator-(Wide a, Wide b) { return a.lanes - b.lanes; }
  friend Wide operator*(Wide a, Wide b) { return a.lanes * b.lanes; }
  friend Wide operator/(Wide a, Wide b) { return a.lanes / b.lanes; }
  friend Truths operator<=(Wide a, Wide b) { return {less_equal(a.lanes, b.lanes)}; }
  friend Truths operator>=(Wide a, Wide b) { return {less_equal(b.lanes, a.lanes)}; }
  friend Truths operator>(Wide a, Wide b) { return {greater(a.lanes, b.lanes)}; }
  friend Truths operator<(Wide a, Wide b) { return {greater(b.lanes, a.lanes)}; }
  friend Truths operator==(Wide a, Wide b) { return (a <= b) & (a >= b); }
};

inline Wide select(Truths condition, Wide yes, Wide no) {
  return select(condition.mask, yes.lanes, no.lanes);
}
inline Wide root(Wide x) { return root(x.lanes); }
inline Wide power_e(Wide x) { return exp(x.lanes); }
inline Wide log_e(Wide x) { return log(x.lanes); }

}  // namespace simd
