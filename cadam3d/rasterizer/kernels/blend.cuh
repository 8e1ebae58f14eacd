// Blending and its gradient: one warp per tile, which is 8 pixels wide. A lane has one pixel of a tile of
// 8x4, or two of a tile of 8x8, four rows apart.
//
// A warp loads 32 splats at once, one per lane, and then all lanes loop over them. Lanes never wait for
// another warp. The backward pass goes back to front with one running sum per pixel. It writes ten sums over
// the pixels of the tile into the slot of the splat, so a warp never adds to a number that another warp
// wrote.
#pragma once

#include "device.cuh"

constexpr int BLEND_BLOCK = 128;  // threads; mirrored in ../cuda.py
constexpr int BLEND_WARPS = BLEND_BLOCK / WARP;
constexpr int STRIDE = WARP / TILE_WIDTH;  // rows between two pixels of a lane; the height of a small tile

// The tile of a warp and the pixels of its lanes, of which PIXELS are in one column.
template <int PIXELS>
struct Place {
  i64 view, pixel[PIXELS];  // pixel: index into [v h w]
  float x, y;               // centre of the first pixel
  bool is_inside[PIXELS];
};

template <int PIXELS>
SPLAT_FN Place<PIXELS> make_place(u32 tile, i64 height, i64 width) {
  const u32 lane = u32(lane_index()), tile_height = PIXELS * STRIDE;
  const u32 tiles_x = (u32(width) + TILE_WIDTH - 1) / TILE_WIDTH;
  const u32 tiles = tiles_x * ((u32(height) + tile_height - 1) / tile_height);
  Place<PIXELS> place;
  place.view = tile / tiles;
  const u32 in_view = tile % tiles, x = in_view % tiles_x * TILE_WIDTH + lane % TILE_WIDTH;
  const u32 y = in_view / tiles_x * tile_height + lane / TILE_WIDTH;
  place.x = float(x) + 0.5f, place.y = float(y) + 0.5f;
  for (int p = 0; p < PIXELS; ++p) {
    place.is_inside[p] = x < u32(width) && y + p * STRIDE < u32(height);
    place.pixel[p] = (place.view * height + y + p * STRIDE) * width + x;
  }
  return place;
}

// The splats that a warp has loaded. The vectors are those of store_splat.
typedef float4 StagedSplats[3][WARP];

SPLAT_FN void load_splat(StagedSplats& stage, int lane, const float4* from) {
  for (int part = 0; part < 3; ++part) stage[part][lane] = from[part];
}

// y = L d at the pixels of a lane, and the logarithm (base 2) of alpha before it is capped. The forward and
// the backward pass both call these functions, and products are fused only where they call __fmaf_rn.
// Therefore they agree to the last bit on which splats are skipped.
struct Offset {
  float u, t;
};
SPLAT_FN Offset first_offset(float4 centre, float l22, float x, float y) {
  const float dx = x - centre.x, dy = y - centre.y;
  return {__fmaf_rn(centre.z, dx, centre.w * dy), l22 * dy};
}
SPLAT_FN Offset next_offset(float4 centre, float l22, Offset o) {
  return {__fmaf_rn(float(STRIDE), centre.w, o.u), __fmaf_rn(float(STRIDE), l22, o.t)};
}
SPLAT_FN float log2_alpha(float peak, Offset o) {
  return __fmaf_rn(-o.u, o.u, __fmaf_rn(-o.t, o.t, peak));
}

// The transmittance of a closed pixel is negative, and so is that of a pixel outside of the image. Such a
// product with 1 - alpha is below every limit, so no flag has to be kept and tested.
struct Pixel {
  float transmittance, red, green, blue, weight, depth;  // depth: sum w z
  u32 last;                                              // 1 + rank of the last splat that reached it
};

SPLAT_FN void shade(Pixel& pixel, float power, float4 colour, u32 mark) {
  if (!(power >= LOG2_ALPHA_MIN)) return;
  const float alpha = fminf(exp2_approx(power), float(SPLAT_ALPHA_MAX));
  const float before = pixel.transmittance, after = __fmaf_rn(-alpha, before, before);
  const bool is_open = after > float(SPLAT_TRANSMITTANCE_MIN);
  pixel.transmittance = is_open ? after : -fabsf(before);
  if (!is_open) return;
  const float w = alpha * before;
  pixel.last = mark;
  pixel.red = __fmaf_rn(w, colour.x, pixel.red);
  pixel.green = __fmaf_rn(w, colour.y, pixel.green);
  pixel.blue = __fmaf_rn(w, colour.z, pixel.blue);
  pixel.depth = __fmaf_rn(w, colour.w, pixel.depth);
  pixel.weight += w;
}

// rgb [v h w 3]; alpha, depth, transmittance, last [v h w]
template <int PIXELS>
SPLAT_FN void blend_tile(const float4* splats, const u32* slots, const u32* pair_of_slot, const u32* ranges,
                         i64 tiles, const float* background, i64 height, i64 width, float* rgb, float* alpha,
                         float* depth, float* transmittance, u32* last) {
  __shared__ StagedSplats stages[BLEND_WARPS];
  const i64 tile = thread_index() / WARP;
  if (tile >= tiles) return;
  const int lane = lane_index();
  StagedSplats& stage = stages[threadIdx.x / WARP];
  const Place<PIXELS> place = make_place<PIXELS>(u32(tile), height, width);
  Pixel pixels[PIXELS];
  for (int p = 0; p < PIXELS; ++p) pixels[p] = {place.is_inside[p] ? 1.0f : -1.0f, 0, 0, 0, 0, 0, 0};

  const u32 begin = ranges[2 * tile], end = ranges[2 * tile + 1];
  for (u32 base = begin; base < end; base += WARP) {
    bool is_open = false;
    for (int p = 0; p < PIXELS; ++p) is_open = is_open || pixels[p].transmittance > 0;
    if (!__any_sync(ALL, is_open)) break;
    // All lanes have finished with the previous stage. The vote alone would not order memory accesses.
    __syncwarp();
    if (base + lane < end) load_splat(stage, lane, splats + 3 * i64(pair_of_slot[slots[base + lane]]));
    __syncwarp();
    const u32 count = end - base < WARP ? end - base : WARP;
    const float4* at = stage[0];
#pragma unroll 1
    for (u32 mark = base - begin + 1; mark <= base - begin + count; ++mark, ++at) {
      const float4 centre = at[0], form = at[WARP], colour = at[2 * WARP];
      Offset offset = first_offset(centre, form.x, place.x, place.y);
      for (int p = 0; p < PIXELS; ++p) {
        if (p > 0) offset = next_offset(centre, form.x, offset);
        shade(pixels[p], log2_alpha(form.y, offset), colour, mark);
      }
    }
  }

  const float* behind = background + 3 * place.view;
  for (int p = 0; p < PIXELS; ++p) {
    if (!place.is_inside[p]) continue;
    const Pixel& pixel = pixels[p];
    const i64 at = place.pixel[p];
    const float through = fabsf(pixel.transmittance);
    rgb[3 * at] = pixel.red + through * behind[0];
    rgb[3 * at + 1] = pixel.green + through * behind[1];
    rgb[3 * at + 2] = pixel.blue + through * behind[2];
    alpha[at] = pixel.weight;
    depth[at] = pixel.weight > 0 ? pixel.depth / pixel.weight : 0.0f;
    transmittance[at] = through;
    last[at] = pixel.last;
  }
}

// A pixel in the backward pass. With w = alpha T, the loss depends on it through sum w v, where v = rgb .
// g_rgb + (z - D) g_depth / A, and through its final transmittance. ``suffix`` is the sum over everything
// behind a splat: dLoss/dalpha = T v - suffix / (1 - alpha).
struct PixelBackward {
  // red to far: gradients of the weighted sums. shift: -D g_depth / A
  float transmittance, suffix, red, green, blue, far, shift;
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
  pixel.shift = -depth[at] * pixel.far;
  pixel.suffix = -pixel.transmittance * through;
  return pixel;
}

// The ten sums of a record over the pixels processed so far.
struct Sums {
  float g, gu, gt, guu, gut, gtt, red, green, blue, depth;
};

// Two more sums for absgrad: the absolute values of what each pixel adds to the gradient of the centre.
struct Absolutes {
  float u, y;  // sums of |g u| and of |g (l12 u + l22 t)|: see splat::mean2d_absolute
};

// The first pixel of a lane sets the sums, the next one adds to them.
template <bool IS_FIRST>
SPLAT_FN void add(float& sum, float x) {
  sum = IS_FIRST ? x : sum + x;
}
template <bool IS_FIRST>
SPLAT_FN void add_product(float& sum, float x, float y) {
  sum = IS_FIRST ? x * y : __fmaf_rn(x, y, sum);
}

template <bool ABSOLUTE, bool IS_FIRST>
SPLAT_FN void shade_backward(PixelBackward& pixel, float4 centre, float l22, float4 colour, Offset o,
                             float power, Sums& sums, Absolutes& absolutes) {
  const float free = exp2_approx(power), alpha = fminf(free, float(SPLAT_ALPHA_MAX));
  const float inverse = reciprocal_approx(1.0f - alpha);
  const float before = pixel.transmittance * inverse, w = alpha * before;
  const float ratio = alpha * inverse;
  float value = __fmaf_rn(colour.w, pixel.far, pixel.shift);
  value = __fmaf_rn(colour.x, pixel.red, value);
  value = __fmaf_rn(colour.y, pixel.green, value);
  value = __fmaf_rn(colour.z, pixel.blue, value);
  // -alpha dLoss/dalpha. A capped alpha has no gradient.
  const float here = w * value, slope = __fmaf_rn(ratio, pixel.suffix, -here);
  const float g = free <= float(SPLAT_ALPHA_MAX) ? slope : 0.0f;
  const float gu = g * o.u, gt = g * o.t;
  pixel.transmittance = before;
  pixel.suffix += here;
  add<IS_FIRST>(sums.g, g);
  add<IS_FIRST>(sums.gu, gu);
  add<IS_FIRST>(sums.gt, gt);
  add_product<IS_FIRST>(sums.guu, gu, o.u);
  add_product<IS_FIRST>(sums.gut, gu, o.t);
  add_product<IS_FIRST>(sums.gtt, gt, o.t);
  add_product<IS_FIRST>(sums.red, w, pixel.red);
  add_product<IS_FIRST>(sums.green, w, pixel.green);
  add_product<IS_FIRST>(sums.blue, w, pixel.blue);
  add_product<IS_FIRST>(sums.depth, w, pixel.far);
  if (!ABSOLUTE) return;
  add<IS_FIRST>(absolutes.u, fabsf(gu));
  add<IS_FIRST>(absolutes.y, fabsf(__fmaf_rn(centre.w, gu, l22 * gt)));
}

// Half of the lanes continue with ``low`` and the other half with ``high``. Each sends the other value to its
// partner.
SPLAT_FN float fold(bool is_high, float low, float high, int reach) {
  return (is_high ? high : low) + __shfl_xor_sync(ALL, is_high ? low : high, reach);
}

// Both partners continue with the same value.
SPLAT_FN float fold_one(float value, int reach) { return value + __shfl_xor_sync(ALL, value, reach); }

// The bits of the number of a lane, each zero or not.
struct Bits {
  int b4, b3, b2, b1;
};
SPLAT_FN Bits make_bits(int lane) {
  return {keep_in_register(lane & 16), keep_in_register(lane & 8), keep_in_register(lane & 4),
          keep_in_register(lane & 2)};
}

// Ten sums over the warp in twelve shuffles: each fold of two values halves the number of sums that a lane is
// responsible for. See component_of for the sum that a lane ends with. The sums are separate variables
// because an array would be placed in slow memory.
SPLAT_FN float fold_sums(const Sums& s, const Bits& bits) {
  const bool b4 = bits.b4, b3 = bits.b3, b2 = bits.b2, b1 = bits.b1;
  const float p0 = fold(b4, s.g, s.gtt, 16), p1 = fold(b4, s.gu, s.red, 16);
  const float p2 = fold(b4, s.gt, s.green, 16), p3 = fold(b4, s.guu, s.blue, 16);
  const float p4 = fold(b4, s.gut, s.depth, 16);
  const float q0 = fold(b3, p0, p3, 8), q1 = fold(b3, p1, p4, 8), q2 = fold_one(p2, 8);
  const float r0 = fold(b2, q0, q2, 4), r1 = fold_one(q1, 4);
  return fold_one(fold(b1, r0, r1, 2), 1);
}

// The first half of the lanes get the sum of u, the other half the sum of y.
SPLAT_FN float fold_absolutes(const Absolutes& absolutes, const Bits& bits) {
  float sum = fold(bits.b4, absolutes.u, absolutes.y, 16);
  for (int reach = 8; reach > 0; reach /= 2) sum = fold_one(sum, reach);
  return sum;
}

// The sum that a lane (b4 b3 b2 b1 b0) holds after fold_sums; -1 if a lane before it holds the same one.
SPLAT_FN int component_of(int lane) {
  const bool b4 = lane & 16, b3 = lane & 8, b2 = lane & 4, b1 = lane & 2, b0 = lane & 1;
  if (b0 || (b2 && (b1 || b3))) return -1;
  return (b4 ? 5 : 0) + (b1 ? (b3 ? 4 : 1) : b2 ? 2 : b3 ? 3 : 0);
}

// records [slots 10], absolutes [slots 2]. There is one more list than tiles: it holds the slots that belong
// to no tile, and they get zeros too.
template <int PIXELS, bool ABSOLUTE>
SPLAT_FN void blend_tile_backward(const float4* splats, const u32* slots, const u32* pair_of_slot,
                                  const u32* ranges, i64 tiles, const float* background, i64 height, i64 width,
                                  const float* alpha, const float* depth, const float* transmittance,
                                  const u32* last, const float* grad_rgb, const float* grad_alpha,
                                  const float* grad_depth, float* records, float* absolutes) {
  __shared__ StagedSplats stages[BLEND_WARPS];
  const i64 tile = thread_index() / WARP;
  if (tile > tiles) return;
  const int lane = lane_index(), component = component_of(lane);
  const Bits bits = make_bits(lane);
  float* const record = keep_in_register(records + component);
  StagedSplats& stage = stages[threadIdx.x / WARP];
  const Place<PIXELS> place = make_place<PIXELS>(u32(tile), height, width);
  PixelBackward pixels[PIXELS] = {};
  u32 used = 0;  // number of splats up to the last one that reached a pixel of the tile
  for (int p = 0; p < PIXELS; ++p) {
    if (tile == tiles || !place.is_inside[p]) continue;
    pixels[p] = load_pixel(place.pixel[p], background + 3 * place.view, alpha, depth, transmittance, last,
                           grad_rgb, grad_alpha, grad_depth);
    used = pixels[p].last > used ? pixels[p].last : used;
  }
  for (int reach = WARP / 2; reach > 0; reach /= 2) {
    const u32 other = __shfl_xor_sync(ALL, used, reach);
    used = other > used ? other : used;
  }

  const u32 begin = ranges[2 * tile], end = ranges[2 * tile + 1], dead = begin + used;
  // Five lanes clear a record together, because they write to the same piece of memory. Two lanes are left.
  const u32 part = u32(lane) % (RECORD / 2), nth = u32(lane) / (RECORD / 2), at_once = WARP / (RECORD / 2);
  for (u32 e = dead + nth; nth < at_once && e < end; e += at_once)
    reinterpret_cast<float2*>(records)[RECORD / 2 * i64(slots[e]) + part] = make_float2(0, 0);
  if (ABSOLUTE)
    for (u32 e = dead + lane; e < end; e += WARP)
      reinterpret_cast<float2*>(absolutes)[slots[e]] = make_float2(0, 0);

  for (u32 top = dead; top > begin;) {
    const u32 base = top - begin < WARP ? begin : top - WARP;
    __syncwarp();  // all lanes have finished with the previous stage
    if (base + lane < top) {
      const u32 slot = slots[base + lane];
      load_splat(stage, lane, splats + 3 * i64(pair_of_slot[slot]));
      stage[1][lane].z = __uint_as_float(slot);  // takes the place of the cut
    }
    __syncwarp();
    const float4* at = stage[0] + (top - base);
    for (u32 mark = top - begin; mark > base - begin; --mark) {
      --at;
      const float4 centre = at[0], form = at[WARP];
      Offset offsets[PIXELS];
      float powers[PIXELS];
      bool is_hit[PIXELS], any_hit = false;
      for (int p = 0; p < PIXELS; ++p) {
        offsets[p] = p == 0 ? first_offset(centre, form.x, place.x, place.y)
                            : next_offset(centre, form.x, offsets[p - 1]);
        powers[p] = log2_alpha(form.y, offsets[p]);
        is_hit[p] = mark <= pixels[p].last && powers[p] >= LOG2_ALPHA_MIN;
        any_hit = any_hit || is_hit[p];
      }
      float sum = 0, absolute = 0;
      if (__any_sync(ALL, any_hit)) {
        const float4 colour = at[2 * WARP];
        Sums sums = {};
        Absolutes apart = {};
        if (is_hit[0])
          shade_backward<ABSOLUTE, true>(pixels[0], centre, form.x, colour, offsets[0], powers[0], sums, apart);
        if (PIXELS == 2 && is_hit[PIXELS - 1])
          shade_backward<ABSOLUTE, false>(pixels[PIXELS - 1], centre, form.x, colour, offsets[PIXELS - 1],
                                          powers[PIXELS - 1], sums, apart);
        sum = fold_sums(sums, bits);
        if (ABSOLUTE) absolute = fold_absolutes(apart, bits);
      }
      const i64 slot = __float_as_uint(form.z);
      if (component >= 0) record[RECORD * slot] = sum;
      if (ABSOLUTE && lane % 16 == 0) absolutes[ABSOLUTES * slot + lane / 16] = absolute;
    }
    top = base;
  }
}

// Blocks of a multiprocessor: 32 warps, which may have 64 registers per thread. Without this number, some
// compilers store registers in slow memory to make room for more warps.
constexpr int BLENDS_AT_ONCE = 8;

// The kernels for tiles of 8 x (4 PIXELS).
#define KERNELS_FOR_TILES(SIZE, PIXELS)                                                                      \
  KERNEL(BLEND_BLOCK, BLENDS_AT_ONCE)                                                                        \
  blend_forward_##SIZE(const float4* splats, const u32* slots, const u32* pair_of_slot, const u32* ranges,   \
                       i64 tiles, const float* background, i64 height, i64 width, float* rgb, float* alpha,  \
                       float* depth, float* transmittance, u32* last) {                                      \
    blend_tile<PIXELS>(splats, slots, pair_of_slot, ranges, tiles, background, height, width, rgb, alpha,    \
                       depth, transmittance, last);                                                          \
  }                                                                                                          \
  KERNEL(BLEND_BLOCK, BLENDS_AT_ONCE)                                                                        \
  blend_backward_##SIZE(const float4* splats, const u32* slots, const u32* pair_of_slot, const u32* ranges,  \
                        i64 tiles, const float* background, i64 height, i64 width, const float* alpha,       \
                        const float* depth, const float* transmittance, const u32* last,                     \
                        const float* grad_rgb, const float* grad_alpha, const float* grad_depth,             \
                        float* records) {                                                                    \
    blend_tile_backward<PIXELS, false>(splats, slots, pair_of_slot, ranges, tiles, background, height,       \
                                       width, alpha, depth, transmittance, last, grad_rgb, grad_alpha,       \
                                       grad_depth, records, nullptr);                                        \
  }                                                                                                          \
  KERNEL(BLEND_BLOCK, BLENDS_AT_ONCE)                                                                        \
  blend_backward_absolute_##SIZE(                                                                            \
      const float4* splats, const u32* slots, const u32* pair_of_slot, const u32* ranges, i64 tiles,         \
      const float* background, i64 height, i64 width, const float* alpha, const float* depth,                \
      const float* transmittance, const u32* last, const float* grad_rgb, const float* grad_alpha,           \
      const float* grad_depth, float* records, float* absolutes) {                                           \
    blend_tile_backward<PIXELS, true>(splats, slots, pair_of_slot, ranges, tiles, background, height, width, \
                                      alpha, depth, transmittance, last, grad_rgb, grad_alpha, grad_depth,   \
                                      records, absolutes);                                                   \
  }

KERNELS_FOR_TILES(8x4, 1)
KERNELS_FOR_TILES(8x8, 2)
