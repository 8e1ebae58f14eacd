// Definitions that all CUDA kernels share: short names, sizes, and the indices of a thread.
//
// No header of the toolkit is included, because a run-time compiler has none. Every kernel parameter has
// eight bytes, a pointer or an i64, so that a launch is a list of numbers (see ``Launch`` in
// ../launcher.py). Grids have one dimension. No kernel adds floats atomically, so the input determines every
// bit of every result.
#pragma once

#include "splat_math.h"

#define KERNEL(threads) extern "C" __global__ void __launch_bounds__(threads)

typedef unsigned int u32;
typedef unsigned long long u64;
typedef long long i64;

constexpr int WARP = 32;
constexpr u32 ALL = 0xffffffffu;  // every lane of a warp
constexpr int BLOCK = 256;        // threads of most kernels; mirrored in ../cuda.py
constexpr int TILE = 8;           // pixels along the edge of a tile; mirrored in ../cuda.py
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

// The data of a projected Gaussian that tile lists and blending read: three vectors of four floats.
struct Splat {
  float x, y;           // pixels
  float l11, l12, l22;  // whitening, see splat_math.h
  float cut, opacity;   // alpha = opacity exp(-|y|^2) where |y|^2 <= cut
  float depth;          // camera z
  float red, green, blue;
  float reach_x;  // half the width of its box; half the height is sqrt(cut) / l22
};

SPLAT_FN void store_splat(float4* to, const Splat& s) {
  to[0] = make_float4(s.x, s.y, s.l11, s.l12);
  to[1] = make_float4(s.l22, s.cut, s.opacity, s.depth);
  to[2] = make_float4(s.red, s.green, s.blue, s.reach_x);
}

SPLAT_FN Splat make_splat(float4 a, float4 b, float4 c) {
  return {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w};
}
