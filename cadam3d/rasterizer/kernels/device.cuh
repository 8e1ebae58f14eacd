// Definitions that all CUDA kernels share: short names, sizes, and the indices of a thread.
//
// No header of the toolkit is included, because a run-time compiler has none. Every kernel parameter has
// eight bytes, a pointer or an i64, so that a launch is a list of numbers (see ``Launch`` in
// ../launcher.py). Grids have one dimension. No kernel adds floats atomically, so the input determines every
// bit of every result.
#pragma once

#include "splat_math.h"

// KERNEL(threads of a block), or KERNEL(threads of a block, blocks that must fit into a multiprocessor at once)
#define KERNEL(...) extern "C" __global__ void __launch_bounds__(__VA_ARGS__)

typedef unsigned int u32;
typedef unsigned long long u64;
typedef long long i64;

constexpr int WARP = 32;
constexpr u32 ALL = 0xffffffffu;  // every lane of a warp
constexpr int BLOCK = 256;        // threads of most kernels; mirrored in ../cuda.py
constexpr int TILE_WIDTH = 8;     // pixels; mirrored in ../cuda.py, which also chooses the height
constexpr int RECORD = 10;        // floats that the blend writes per (splat, tile); mirrored in ../cuda.py
constexpr int ABSOLUTES = 2;      // additional floats for absgrad; mirrored in ../cuda.py
constexpr u32 CULLED = ALL;       // depth key of a culled pair, which sorts last

// The number of slots of a group is on the device, because the host does not wait for it. Memory and grids have
// room for ``capacity`` slots. If that is too little, every kernel behaves as if there were no slots at all.
// ``total`` may be null if the host knows the number, which is the capacity then.
SPLAT_FN i64 usable(const u32* total, i64 capacity) {
  if (!total) return capacity;
  return i64(*total) <= capacity ? i64(*total) : 0;
}

SPLAT_FN i64 thread_index() { return i64(blockIdx.x) * blockDim.x + threadIdx.x; }
SPLAT_FN int lane_index() { return int(threadIdx.x) % WARP; }

// The exponents of the blend have base 2, which is the base of the hardware's exponential. The whitening of a
// splat is therefore stored times sqrt(log2 e), and the sums of a record are in the same units.
constexpr float SQRT_LOG2_E = 1.2011224087864498f;
constexpr float LOG2_E = 1.4426950408889634f;
constexpr float SQRT_LN_2 = 0.8325546111576977f;
constexpr float LN_2 = 0.6931471805599453f;

// log2 of a constant between 0 and 1, for the compiler: its own logarithm is not a constant expression.
SPLAT_FN constexpr double log2_of(double x) {
  double result = 0;
  for (; x < 1; x *= 2) result -= 1;
  for (double bit = 0.5; bit > 1e-12; bit /= 2) {
    x *= x;
    if (x >= 2) x /= 2, result += bit;
  }
  return result;
}
constexpr float LOG2_ALPHA_MIN = float(log2_of(SPLAT_ALPHA_MIN));

// The approximations of the hardware, without the instructions that handle denormal numbers: 2^x within 2
// ulp, and 1 / x within 1 ulp. The emulator of the tests has its own.
#if defined(__CUDACC__)
SPLAT_FN float exp2_approx(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
SPLAT_FN float reciprocal_approx(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// Returns its argument, and hides from the compiler how it was computed. Otherwise the compiler may compute it
// again in every round of a loop.
SPLAT_FN int keep_in_register(int x) {
  asm("" : "+r"(x));
  return x;
}
SPLAT_FN float* keep_in_register(float* x) {
  asm("" : "+l"(x));
  return x;
}
#endif

// The data of a projected Gaussian: three vectors of four floats. Tile lists read the first two; blending
// reads the first, half of the second, and the third.
struct Splat {
  float x, y;           // pixels
  float l11, l12, l22;  // whitening times sqrt(log2 e), see splat_math.h
  float peak;           // log2 of the opacity: alpha = 2^(peak - |y|^2)
  float cut;            // |y|^2 at which alpha is ALPHA_MIN
  float reach_x;        // half the width of its box; half the height is sqrt(cut) / l22
  float red, green, blue, depth;  // depth: camera z
};

SPLAT_FN void store_splat(float4* to, const Splat& s) {
  to[0] = make_float4(s.x, s.y, s.l11, s.l12);
  to[1] = make_float4(s.l22, s.peak, s.cut, s.reach_x);
  to[2] = make_float4(s.red, s.green, s.blue, s.depth);
}

SPLAT_FN Splat make_splat(float4 a, float4 b, float4 c) {
  return {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w};
}
