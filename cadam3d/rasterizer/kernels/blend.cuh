// Blending and its gradient: one warp per 8x8 tile, two pixels per lane, four rows apart.
//
// A warp loads 32 splats at once, one per lane, and then all lanes loop over them. Lanes never wait for
// another warp. The backward pass goes back to front with one running sum per pixel. It writes ten sums over
// the pixels of the tile into the slot of the splat, so a warp never adds to a number that another warp
// wrote.
#pragma once

#include "device.cuh"

constexpr int BLEND_BLOCK = 128;  // threads; mirrored in ../cuda.py
constexpr int BLEND_WARPS = BLEND_BLOCK / WARP;

// The tile of a warp and the pixels of its lanes.
struct Place {
  i64 view, pixel[2];  // pixel: index into [v h w]
  float x, y[2];       // pixel centres
  bool is_inside[2];
};

SPLAT_FN Place make_place(i64 tile, i64 height, i64 width) {
  const i64 tiles_x = (width + TILE - 1) / TILE, tiles = tiles_x * ((height + TILE - 1) / TILE);
  Place place;
  place.view = tile / tiles;
  const i64 in_view = tile % tiles, x = in_view % tiles_x * TILE + lane_index() % TILE;
  place.x = float(x) + 0.5f;
  for (int p = 0; p < 2; ++p) {
    const i64 y = in_view / tiles_x * TILE + lane_index() / TILE + p * (TILE / 2);
    place.y[p] = float(y) + 0.5f;
    place.is_inside[p] = x < width && y < height;
    place.pixel[p] = (place.view * height + y) * width + x;
  }
  return place;
}

// |L d|^2. The forward and the backward pass both call this function, and products are fused only where it
// calls __fmaf_rn. Therefore they agree to the last bit on which splats are skipped.
struct Falloff {
  float u, t, exponent;
};
SPLAT_FN Falloff falloff(const Splat& s, float dx, float dy) {
  Falloff f;
  f.u = __fmaf_rn(s.l11, dx, s.l12 * dy);
  f.t = s.l22 * dy;
  f.exponent = __fmaf_rn(f.u, f.u, f.t * f.t);
  return f;
}

struct Pixel {
  float transmittance, red, green, blue, weight, depth;  // depth: sum w z
  u32 last;                                              // 1 + rank of the last splat that reached it
  bool is_open;
};

SPLAT_FN void shade(Pixel& pixel, const Splat& s, float dx, float dy, u32 mark) {
  const Falloff f = falloff(s, dx, dy);
  if (!pixel.is_open || !(f.exponent <= s.cut)) return;
  const float alpha = fminf(s.opacity * __expf(-f.exponent), float(SPLAT_ALPHA_MAX));
  const float before = pixel.transmittance, after = __fmaf_rn(-alpha, before, before);
  if (after <= float(SPLAT_TRANSMITTANCE_MIN)) {
    pixel.is_open = false;
    return;
  }
  const float w = alpha * before;
  pixel.transmittance = after;
  pixel.last = mark;
  pixel.red = __fmaf_rn(w, s.red, pixel.red);
  pixel.green = __fmaf_rn(w, s.green, pixel.green);
  pixel.blue = __fmaf_rn(w, s.blue, pixel.blue);
  pixel.depth = __fmaf_rn(w, s.depth, pixel.depth);
  pixel.weight += w;
}

// rgb [v h w 3]; alpha, depth, transmittance, last [v h w]
KERNEL(BLEND_BLOCK)
blend_forward(const float4* splats, const u32* slots, const u32* pair_of_slot, const u32* ranges, i64 tiles,
              const float* background, i64 height, i64 width, float* rgb, float* alpha, float* depth,
              float* transmittance, u32* last) {
  __shared__ float4 staged[BLEND_WARPS][3][WARP];
  const i64 tile = thread_index() / WARP;
  if (tile >= tiles) return;
  const int lane = lane_index();
  float4(&stage)[3][WARP] = staged[threadIdx.x / WARP];
  const Place place = make_place(tile, height, width);
  Pixel pixels[2];
  for (int p = 0; p < 2; ++p) pixels[p] = {1, 0, 0, 0, 0, 0, 0, place.is_inside[p]};

  const i64 begin = ranges[2 * tile], end = ranges[2 * tile + 1];
  for (i64 base = begin; base < end; base += WARP) {
    if (!__any_sync(ALL, pixels[0].is_open || pixels[1].is_open)) break;
    // All lanes have finished with the previous stage. The vote alone would not order memory accesses.
    __syncwarp();
    if (base + lane < end) {
      const float4* from = splats + 3 * i64(pair_of_slot[slots[base + lane]]);
      for (int part = 0; part < 3; ++part) stage[part][lane] = from[part];
    }
    __syncwarp();
    const int count = int(end - base < WARP ? end - base : WARP);
    for (int j = 0; j < count; ++j) {
      const Splat s = make_splat(stage[0][j], stage[1][j], stage[2][j]);
      const float dx = place.x - s.x;
      for (int p = 0; p < 2; ++p) shade(pixels[p], s, dx, place.y[p] - s.y, u32(base - begin) + j + 1);
    }
  }

  const float* behind = background + 3 * place.view;
  for (int p = 0; p < 2; ++p) {
    if (!place.is_inside[p]) continue;
    const Pixel& pixel = pixels[p];
    const i64 at = place.pixel[p];
    rgb[3 * at] = pixel.red + pixel.transmittance * behind[0];
    rgb[3 * at + 1] = pixel.green + pixel.transmittance * behind[1];
    rgb[3 * at + 2] = pixel.blue + pixel.transmittance * behind[2];
    alpha[at] = pixel.weight;
    depth[at] = pixel.weight > 0 ? pixel.depth / pixel.weight : 0.0f;
    transmittance[at] = pixel.transmittance;
    last[at] = pixel.last;
  }
}

// A pixel in the backward pass. With w = alpha T, the loss depends on it through sum w v, where v = rgb .
// g_rgb + (z - D) g_depth / A, and through its final transmittance. ``suffix`` is the sum over everything
// behind a splat: dLoss/dalpha = T v - suffix / (1 - alpha).
struct PixelBackward {
  // red to far: gradients of the weighted sums.
  float transmittance, suffix, red, green, blue, far, depth;
  u32 last;
};

SPLAT_FN PixelBackward load_pixel(i64 at, const float* background, const float* alpha, const float* depth,
                                  const float* transmittance, const u32* last, const float* grad_rgb,
                                  const float* grad_alpha, const float* grad_depth) {
  PixelBackward pixel = {};
  pixel.transmittance = transmittance[at];
  pixel.last = last[at];
  float through = grad_alpha ? grad_alpha[at] : 0.0f;
  if (grad_rgb) {
    pixel.red = grad_rgb[3 * at], pixel.green = grad_rgb[3 * at + 1], pixel.blue = grad_rgb[3 * at + 2];
    through -= pixel.red * background[0] + pixel.green * background[1] + pixel.blue * background[2];
  }
  if (grad_depth && alpha[at] > 0) pixel.far = grad_depth[at] / alpha[at];
  pixel.depth = depth[at];
  pixel.suffix = -pixel.transmittance * through;
  return pixel;
}

// The ten sums of a record over the pixels processed so far.
struct Sums {
  float g, gu, gt, guu, gut, gtt, red, green, blue, depth;
};

// Two more sums for absgrad: the absolute values of what each pixel adds to the gradient of the centre.
struct Absolutes {
  float u, y;  // sums of |g u| and |g (l12 u + l22 t)|: see splat::mean2d_absolute
};

template <bool ABSOLUTE>
SPLAT_FN void shade_backward(PixelBackward& pixel, const Splat& s, const Falloff& f, Sums& sums,
                             Absolutes& absolutes) {
  const float free = s.opacity * __expf(-f.exponent), alpha = fminf(free, float(SPLAT_ALPHA_MAX));
  const float inverse = __fdividef(1.0f, 1.0f - alpha), before = pixel.transmittance * inverse;
  const float w = alpha * before;
  float value = (s.depth - pixel.depth) * pixel.far;
  value = __fmaf_rn(s.red, pixel.red, value);
  value = __fmaf_rn(s.green, pixel.green, value);
  value = __fmaf_rn(s.blue, pixel.blue, value);
  const float g_alpha = __fmaf_rn(before, value, -(pixel.suffix * inverse));
  const float g = free <= float(SPLAT_ALPHA_MAX) ? -alpha * g_alpha : 0.0f;  // a capped alpha has no gradient
  const float gu = g * f.u, gt = g * f.t;
  pixel.transmittance = before;
  pixel.suffix = __fmaf_rn(w, value, pixel.suffix);
  sums.g += g;
  sums.gu += gu;
  sums.gt += gt;
  sums.guu = __fmaf_rn(gu, f.u, sums.guu);
  sums.gut = __fmaf_rn(gu, f.t, sums.gut);
  sums.gtt = __fmaf_rn(gt, f.t, sums.gtt);
  sums.red = __fmaf_rn(w, pixel.red, sums.red);
  sums.green = __fmaf_rn(w, pixel.green, sums.green);
  sums.blue = __fmaf_rn(w, pixel.blue, sums.blue);
  sums.depth = __fmaf_rn(w, pixel.far, sums.depth);
  if (!ABSOLUTE) return;
  absolutes.u += fabsf(gu);
  absolutes.y += fabsf(__fmaf_rn(s.l12, gu, s.l22 * gt));
}

// Half of the lanes continue with ``low`` and the other half with ``high``. Each sends the other value to its
// partner.
SPLAT_FN float fold(bool is_high, float low, float high, int reach) {
  return (is_high ? high : low) + __shfl_xor_sync(ALL, is_high ? low : high, reach);
}

// Ten sums over the warp in twelve shuffles: each fold halves the number of sums that a lane is responsible
// for. Lane (b4 b3 b2 b1 b0) ends with sum 5 b4 + 3 b3 + 2 b2 + b1, if that exists: see component_of. The
// sums are separate variables because an array would be placed in slow memory.
SPLAT_FN float fold_sums(const Sums& s) {
  const int lane = lane_index();
  const bool b4 = lane & 16, b3 = lane & 8, b2 = lane & 4, b1 = lane & 2;
  const float p0 = fold(b4, s.g, s.gtt, 16), p1 = fold(b4, s.gu, s.red, 16);
  const float p2 = fold(b4, s.gt, s.green, 16), p3 = fold(b4, s.guu, s.blue, 16);
  const float p4 = fold(b4, s.gut, s.depth, 16);
  const float q0 = fold(b3, p0, p3, 8), q1 = fold(b3, p1, p4, 8), q2 = fold(b3, p2, 0.0f, 8);
  const float r0 = fold(b2, q0, q2, 4), r1 = fold(b2, q1, 0.0f, 4);
  const float sum = fold(b1, r0, r1, 2);
  return sum + __shfl_xor_sync(ALL, sum, 1);
}

// The first half of the lanes get the sum of u, the other half the sum of y.
SPLAT_FN float fold_absolutes(const Absolutes& absolutes) {
  float sum = fold(lane_index() & 16, absolutes.u, absolutes.y, 16);
  for (int reach = 8; reach > 0; reach /= 2) sum += __shfl_xor_sync(ALL, sum, reach);
  return sum;
}

// The sum that a lane holds after fold_sums; -1 if it holds none, or the same one as its neighbour.
SPLAT_FN int component_of(int lane) {
  const int b4 = lane / 16, b3 = lane / 8 % 2, in_half = 3 * b3 + lane / 2 % 4;
  return lane % 2 == 0 && in_half < (b3 ? 5 : 3) ? 5 * b4 + in_half : -1;
}

// records [slots 10], absolutes [slots 2]. There is one more list than tiles: it holds the slots that belong
// to no tile, and they get zeros too.
template <bool ABSOLUTE>
SPLAT_FN void blend_tile_backward(const float4* splats, const u32* slots, const u32* pair_of_slot,
                                  const u32* ranges, i64 tiles, const float* background, i64 height, i64 width,
                                  const float* alpha, const float* depth, const float* transmittance,
                                  const u32* last, const float* grad_rgb, const float* grad_alpha,
                                  const float* grad_depth, float* records, float* absolutes) {
  __shared__ float4 staged[BLEND_WARPS][3][WARP];
  __shared__ u32 staged_slots[BLEND_WARPS][WARP];
  const i64 tile = thread_index() / WARP;
  if (tile > tiles) return;
  const int lane = lane_index(), component = component_of(lane);
  float4(&stage)[3][WARP] = staged[threadIdx.x / WARP];
  u32(&stage_slots)[WARP] = staged_slots[threadIdx.x / WARP];
  const Place place = make_place(tile, height, width);
  PixelBackward pixels[2] = {};
  u32 used = 0;  // number of splats up to the last one that reached a pixel of the tile
  for (int p = 0; p < 2; ++p) {
    if (tile == tiles || !place.is_inside[p]) continue;
    pixels[p] = load_pixel(place.pixel[p], background + 3 * place.view, alpha, depth, transmittance, last,
                           grad_rgb, grad_alpha, grad_depth);
    used = pixels[p].last > used ? pixels[p].last : used;
  }
  for (int reach = WARP / 2; reach > 0; reach /= 2) {
    const u32 other = __shfl_xor_sync(ALL, used, reach);
    used = other > used ? other : used;
  }

  const i64 begin = ranges[2 * tile], end = ranges[2 * tile + 1];
  for (i64 e = begin + used + lane; e < end; e += WARP) {
    for (int j = 0; j < RECORD; ++j) records[RECORD * i64(slots[e]) + j] = 0;
    if (ABSOLUTE)
      for (int j = 0; j < ABSOLUTES; ++j) absolutes[ABSOLUTES * i64(slots[e]) + j] = 0;
  }

  for (i64 top = begin + used; top > begin; top -= WARP) {
    const i64 base = top - begin < WARP ? begin : top - WARP;
    __syncwarp();  // all lanes have finished with the previous stage
    if (base + lane < top) {
      const u32 slot = slots[base + lane];
      const float4* from = splats + 3 * i64(pair_of_slot[slot]);
      for (int part = 0; part < 3; ++part) stage[part][lane] = from[part];
      stage_slots[lane] = slot;
    }
    __syncwarp();
    for (int j = int(top - base) - 1; j >= 0; --j) {
      const Splat s = make_splat(stage[0][j], stage[1][j], stage[2][j]);
      const u32 rank = u32(base - begin) + u32(j);
      const float dx = place.x - s.x;
      const Falloff f0 = falloff(s, dx, place.y[0] - s.y), f1 = falloff(s, dx, place.y[1] - s.y);
      const bool hit0 = rank < pixels[0].last && f0.exponent <= s.cut;
      const bool hit1 = rank < pixels[1].last && f1.exponent <= s.cut;
      float sum = 0, absolute = 0;
      if (__any_sync(ALL, hit0 || hit1)) {
        Sums sums = {};
        Absolutes apart = {};
        if (hit0) shade_backward<ABSOLUTE>(pixels[0], s, f0, sums, apart);
        if (hit1) shade_backward<ABSOLUTE>(pixels[1], s, f1, sums, apart);
        sum = fold_sums(sums);
        if (ABSOLUTE) absolute = fold_absolutes(apart);
      }
      if (component >= 0) records[RECORD * i64(stage_slots[j]) + component] = sum;
      if (ABSOLUTE && lane % 16 == 0) absolutes[ABSOLUTES * i64(stage_slots[j]) + lane / 16] = absolute;
    }
  }
}

KERNEL(BLEND_BLOCK)
blend_backward(const float4* splats, const u32* slots, const u32* pair_of_slot, const u32* ranges, i64 tiles,
               const float* background, i64 height, i64 width, const float* alpha, const float* depth,
               const float* transmittance, const u32* last, const float* grad_rgb, const float* grad_alpha,
               const float* grad_depth, float* records) {
  blend_tile_backward<false>(splats, slots, pair_of_slot, ranges, tiles, background, height, width, alpha,
                             depth, transmittance, last, grad_rgb, grad_alpha, grad_depth, records, nullptr);
}

KERNEL(BLEND_BLOCK)
blend_backward_absolute(const float4* splats, const u32* slots, const u32* pair_of_slot, const u32* ranges,
                        i64 tiles, const float* background, i64 height, i64 width, const float* alpha,
                        const float* depth, const float* transmittance, const u32* last,
                        const float* grad_rgb, const float* grad_alpha, const float* grad_depth,
                        float* records, float* absolutes) {
  blend_tile_backward<true>(splats, slots, pair_of_slot, ranges, tiles, background, height, width, alpha,
                            depth, transmittance, last, grad_rgb, grad_alpha, grad_depth, records, absolutes);
}
