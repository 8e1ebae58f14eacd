// A row of pixels at a time: vectors of this machine's own width, and the few operations the blend needs.
//
// Wider vectors than the machine has would be lowered to scalar code, so the width follows the instruction
// set: AVX-512 16 lanes, AVX2 8, everything else (SSE2, NEON, ...) 4. Products that are added are fused where
// written fma() and nowhere else, so that forward and backward see the same bits.
#pragma once

#if defined(__x86_64__) || defined(_M_X64)
#include <immintrin.h>
#endif
#if defined(__ARM_NEON) && defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace simd {

// Some clangs have AVX-512 instructions and yet no 64-byte registers: they say so by what they do not define.
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
typedef unsigned Bits __attribute__((vector_size(4 * LANES)));  // wraps around, as masked lanes will
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
#elif defined(SIMD_AVX2)
inline Floats fma(Floats a, Floats b, Floats c) {
  return (Floats)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
}
inline Floats min(Floats a, Floats b) { return (Floats)_mm256_min_ps((__m256)a, (__m256)b); }
#elif defined(SIMD_NEON)
inline Floats fma(Floats a, Floats b, Floats c) {
  return (Floats)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
inline Floats min(Floats a, Floats b) { return (Floats)vminq_f32((float32x4_t)a, (float32x4_t)b); }
#elif defined(SIMD_SSE2)
inline Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
inline Floats min(Floats a, Floats b) { return (Floats)_mm_min_ps((__m128)a, (__m128)b); }
#else
inline Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
inline Floats min(Floats a, Floats b) { return a < b ? a : b; }
#endif

// ------------------------------------------------------------------------------------- masks
// One truth per lane; a comparison with a NaN is false.
#if defined(SIMD_AVX512)
typedef __mmask16 Mask;
inline Mask none() { return 0; }
inline Mask less_equal(Floats a, Floats b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ); }
inline Mask greater(Floats a, Floats b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
inline Mask less(Ints a, Ints b) { return _mm512_cmp_epi32_mask((__m512i)a, (__m512i)b, _MM_CMPINT_LT); }
inline Mask both(Mask a, Mask b) { return a & b; }
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
typedef Ints Mask;  // all bits of a lane, or none
inline Mask none() { return Mask{}; }
inline Mask less_equal(Floats a, Floats b) { return a <= b; }
inline Mask greater(Floats a, Floats b) { return a > b; }
inline Mask less(Ints a, Ints b) { return a < b; }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask first_only(Mask a, Mask b) { return a & ~b; }
inline Ints select(Mask m, Ints a, Ints b) { return (m & a) | (~m & b); }
inline Floats select(Mask m, Floats a, Floats b) { return as_floats(select(m, as_ints(a), as_ints(b))); }
inline Floats keep(Mask m, Floats a) { return as_floats(m & as_ints(a)); }
#if defined(SIMD_AVX2)
inline bool any(Mask a) { return _mm256_movemask_ps((__m256)a) != 0; }
#elif defined(SIMD_SSE2)
inline bool any(Mask a) { return _mm_movemask_ps((__m128)a) != 0; }
#elif defined(SIMD_NEON)
inline bool any(Mask a) { return vmaxvq_u32((uint32x4_t)a) != 0; }
#else
inline bool any(Mask a) { return (a[0] | a[1] | a[2] | a[3]) != 0; }
#endif
#endif

// ------------------------------------------------------------------------------------- exp and sums

// exp(-x) for 0 <= x < 80, relative error below 3e-7; anything elsewhere, where the caller masks the lane.
// exp(-x) = 2^n 2^f with n the nearest integer; the polynomial is the minimax of 2^f on [-1/2, 1/2] (Lawson).
inline Floats exp_minus(Floats x) {
  const Floats scaled = x * spread(-1.44269504f);
  const Floats magic = spread(12582912.0f);  // 1.5 * 2^23: adding it rounds, and leaves n in the low bits
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

// The four lanes of the result are the sums of a, b, c and d, always in the same order.
#if defined(SIMD_AVX512)
inline Quad sums(Floats a, Floats b, Floats c, Floats d) {
  const __m512 p = (__m512)a, q = (__m512)b, r = (__m512)c, s = (__m512)d;
  const __m512 pq = _mm512_add_ps(_mm512_shuffle_f32x4(p, q, 0x44), _mm512_shuffle_f32x4(p, q, 0xEE));
  const __m512 rs = _mm512_add_ps(_mm512_shuffle_f32x4(r, s, 0x44), _mm512_shuffle_f32x4(r, s, 0xEE));
  __m512 quads = _mm512_add_ps(_mm512_shuffle_f32x4(pq, rs, 0x88), _mm512_shuffle_f32x4(pq, rs, 0xDD));
  quads = _mm512_add_ps(quads, _mm512_permute_ps(quads, 0x4E));
  quads = _mm512_add_ps(quads, _mm512_permute_ps(quads, 0xB1));
  const __m512i firsts = _mm512_castsi128_si512(_mm_setr_epi32(0, 4, 8, 12));
  return (Quad)_mm512_castps512_ps128(_mm512_permutexvar_ps(firsts, quads));
}
#elif defined(SIMD_AVX2) || defined(SIMD_SSE2)
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

}  // namespace simd
