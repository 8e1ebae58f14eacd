// Counts and lists the tiles that each splat touches, and splits the slots into one list per tile.
//
// A splat gets one slot per tile it touches. Slots are numbered in depth order, so a stable sort by tile
// leaves every list in depth order. The slots of a splat are consecutive; the backward pass writes its
// records there.
#pragma once

#include "device.cuh"

// The tiles of a view. Their height is a power of two.
struct Grid {
  int tiles_x, tiles_y, width, height, tile_height, log2_tile_height;
};

SPLAT_FN Grid make_grid(i64 height, i64 width, i64 tile_height) {
  const int log2_tile_height = __ffs(int(tile_height)) - 1;
  const int tiles_x = (int(width) + TILE_WIDTH - 1) / TILE_WIDTH;
  const int tiles_y = int((height + tile_height - 1) >> log2_tile_height);
  return {tiles_x, tiles_y, int(width), int(height), int(tile_height), log2_tile_height};
}

struct Range {
  int first, last;  // both included; empty if last < first
};

// The pixels with centres in [low, high], extended by more than the rounding error of either bound.
SPLAT_FN Range pixels_between(float low, float high, int size) {
  const float slack = 2e-3f + 2e-6f * (fabsf(low) + fabsf(high));
  const float first = ceilf(low - slack - 0.5f), last = floorf(high + slack - 0.5f);
  return {int(fminf(fmaxf(first, 0.0f), float(size))), int(fmaxf(fminf(last, float(size - 1)), -1.0f))};
}

// Calls visit(tile row, first column, last column) for each row of tiles that the ellipse |L d|^2 <= cut
// touches, from top to bottom. Counting and listing both use this function, so they agree on every tile.
template <class Visit>
SPLAT_FN void each_tile_row(const Splat& s, const Grid& grid, const Visit& visit) {
  const float reach_x = s.reach_x, reach_y = sqrtf(s.cut) / s.l22;
  const Range rows = pixels_between(s.y - reach_y, s.y + reach_y, grid.height);
  if (rows.last < rows.first) return;
  const float slope = -s.l12 / s.l11;  // the middle of the row at height d: slope * d
  const float extreme = slope * reach_y * (reach_y / reach_x);  // height of the rightmost point
  const float cut = s.cut * (1 + 1e-5f) + 4e-6f;                // rounding matters most at the tips
  const int last_row = rows.last >> grid.log2_tile_height;
  for (int row = rows.first >> grid.log2_tile_height; row <= last_row; ++row) {
    const int first_line = row << grid.log2_tile_height, last_line = first_line + grid.tile_height - 1;
    const int top = first_line > rows.first ? first_line : rows.first;
    const int bottom = last_line < rows.last ? last_line : rows.last;
    const float low = float(top) + 0.5f - s.y - 1e-3f, high = float(bottom) + 0.5f - s.y + 1e-3f;
    const float left = fminf(fmaxf(-extreme, low), high), right = fminf(fmaxf(extreme, low), high);
    const float left_t = s.l22 * left, right_t = s.l22 * right;
    const float left_width = sqrtf(fmaxf(cut - left_t * left_t, 0.0f)) / s.l11;
    const float right_width = sqrtf(fmaxf(cut - right_t * right_t, 0.0f)) / s.l11;
    const Range columns = pixels_between(fmaxf(slope * left - left_width, -reach_x) + s.x,
                                         fminf(slope * right + right_width, reach_x) + s.x, grid.width);
    if (columns.first <= columns.last) visit(row, columns.first / TILE_WIDTH, columns.last / TILE_WIDTH);
  }
}

SPLAT_FN u32 count_tiles(const Splat& s, const Grid& grid) {
  u32 count = 0;
  each_tile_row(s, grid, [&](int, int first, int last) { count += u32(last - first + 1); });
  return count;
}

// Fills the slots [slot, end) of one pair. Lane ``first_lane`` of ``lanes`` handles every lanes-th tile of a
// row.
SPLAT_FN void fill_slots(const Splat& s, const Grid& grid, u32 pair, u32 first_key, u32 sentinel, u32 slot,
                         u32 end, int first_lane, int lanes, u32* tile_keys, u32* pair_of_slot) {
  const auto write = [&](u32 at, u32 key) {
    if (at < end) tile_keys[at] = key, pair_of_slot[at] = pair;
  };
  each_tile_row(s, grid, [&](int row, int first, int last) {
    for (int column = first + first_lane; column <= last; column += lanes)
      write(slot + u32(column - first), first_key + u32(row * grid.tiles_x + column));
    slot += u32(last - first + 1);
  });
  for (u32 rest = slot + u32(first_lane); rest < end; rest += u32(lanes)) write(rest, sentinel);
}

constexpr u32 MANY_TILES = 32;  // a splat with more is listed by the whole warp

// order, offsets [pairs]: the pairs, nearest first, and the prefix sums of their counts. total, capacity: the
// number of slots, and of those that there is room for (see ``usable``). tile_keys, pair_of_slot [capacity].
// counts, first_slot [v n]: the number of slots of each pair, and the first of them. ranges: see tile_ranges,
// all of it zero after this kernel. overflowed: whether there is not enough room; report: the total and n, for
// the host. Both may be null.
KERNEL(BLOCK)
tile_list(const u32* order, const u32* counts, const u32* offsets, const u32* total, i64 capacity, i64 pairs,
          i64 n, const float4* splats, i64 views, i64 height, i64 width, i64 tile_height, u32* tile_keys,
          u32* pair_of_slot, u32* first_slot, u32* ranges, bool* overflowed, u64* report) {
  const i64 k = thread_index();
  const Grid grid = make_grid(height, width, tile_height);
  const u32 tiles = u32(grid.tiles_x) * u32(grid.tiles_y), sentinel = u32(views) * tiles;
  const bool fits = i64(*total) <= capacity;
  for (i64 i = k; i < 2 * (i64(sentinel) + 1); i += i64(gridDim.x) * blockDim.x) ranges[i] = 0;
  if (k == 0) {
    if (overflowed) *overflowed = !fits;
    // The host may read at any time. A single store of eight bytes is never seen by halves.
    if (report) *report = u64(n) << 32 | *total;
  }
  if (!fits) return;
  u32 pair = 0, slot = 0, count = 0;
  if (k < pairs) {
    pair = order[k], slot = offsets[k], count = counts[pair];
    first_slot[pair] = slot;
  }
  const auto fill = [&](u32 of_pair, u32 from, u32 many, int first_lane, int lanes) {
    const float4* at = splats + 3 * i64(of_pair);
    fill_slots(make_splat(at[0], at[1], float4()), grid, of_pair, u32(of_pair / n) * tiles, sentinel, from,
               from + many, first_lane, lanes, tile_keys, pair_of_slot);
  };
  if (count > 0 && count <= MANY_TILES) fill(pair, slot, count, 0, 1);
  u32 waiting = __ballot_sync(ALL, count > MANY_TILES);
  while (waiting) {
    const int owner = __ffs(int(waiting)) - 1;
    waiting &= waiting - 1;
    const u32 of_pair = __shfl_sync(ALL, pair, owner), from = __shfl_sync(ALL, slot, owner);
    const u32 many = __shfl_sync(ALL, count, owner);
    fill(of_pair, from, many, lane_index(), WARP);
  }
}

// ranges [v tiles + 1, 2]: begin and end of each list among the sorted keys; zeros before this kernel. The last
// list holds the slots that belong to no tile. It is empty as long as listing agrees with counting.
KERNEL(BLOCK) tile_ranges(const u32* tile_keys, const u32* total, i64 capacity, u32* ranges) {
  const i64 e = thread_index(), slots = usable(total, capacity);
  if (e >= slots) return;
  const u32 key = tile_keys[e];
  if (e == 0 || tile_keys[e - 1] != key) ranges[2 * i64(key)] = u32(e);
  if (e == slots - 1 || tile_keys[e + 1] != key) ranges[2 * i64(key) + 1] = u32(e + 1);
}
