// Prefix sums that saturate, and a stable radix sort.
//
// The sort handles eight bits per pass, least significant first. A pass counts the digits of each chunk,
// converts the counts (digit after digit, chunk after chunk) to positions with one prefix sum, and scatters
// the items. Within a chunk a warp owns consecutive items and ranks them by votes, so equal keys keep their
// order.
#pragma once

#include "device.cuh"

constexpr int SCAN_ITEMS = 8;                    // consecutive items of one thread
constexpr int SCAN_CHUNK = BLOCK * SCAN_ITEMS;   // of one block; mirrored in ../cuda_sort.py
constexpr int RADIX_BITS = 8;                    // mirrored in ../cuda_sort.py
constexpr int BINS = 1 << RADIX_BITS;            // one thread of a block per bin
constexpr int WARPS = BLOCK / WARP;              // of a block
constexpr int SORT_ROUNDS = 16;                  // items of one thread
constexpr int SORT_CHUNK = BLOCK * SORT_ROUNDS;  // of one block; mirrored in ../cuda_sort.py
static_assert(BINS == BLOCK, "a thread per bin");

// Returns a + b, or the largest number if that needs more than 32 bits. So a total that is too large is never
// mistaken for a small one.
SPLAT_FN u32 add_saturating(u32 a, u32 b) { return a + b < a ? ALL : a + b; }

// Returns the sum over the threads before this one; ``total`` is the sum over all threads of the block.
// ``sums`` is shared memory for BLOCK numbers.
SPLAT_FN u32 block_scan(u32 value, u32* sums, u32* total) {
  const int t = int(threadIdx.x);
  u32 inclusive = value;
  sums[t] = inclusive;
  __syncthreads();
  for (int reach = 1; reach < BLOCK; reach *= 2) {
    const u32 before = t >= reach ? sums[t - reach] : 0;
    __syncthreads();
    inclusive = add_saturating(inclusive, before);
    sums[t] = inclusive;
    __syncthreads();
  }
  *total = sums[BLOCK - 1];
  const u32 exclusive = t > 0 ? sums[t - 1] : 0;
  __syncthreads();  // after this, the shared memory may be used again
  return exclusive;
}

// Item i of the numbers to add: in[i], or in[index[i]] if there is an index.
SPLAT_FN u32 item_at(const u32* in, const u32* index, i64 i) { return in[index ? i64(index[i]) : i]; }

// Exclusive prefix sums of one chunk, all increased by ``carry``; returns the sum of the chunk. Without an
// index, ``out`` may be ``in``, because each thread reads and writes only its own items.
SPLAT_FN u32 scan_chunk(const u32* in, const u32* index, i64 begin, i64 n, u32 carry, u32* out, u32* sums) {
  const i64 first = begin + i64(threadIdx.x) * SCAN_ITEMS;
  const i64 end = first + SCAN_ITEMS < n ? first + SCAN_ITEMS : n;
  u32 sum = 0, total;
  for (i64 i = first; i < end; ++i) sum = add_saturating(sum, item_at(in, index, i));
  u32 before = add_saturating(carry, block_scan(sum, sums, &total));
  for (i64 i = first; i < end; ++i) {
    const u32 item = item_at(in, index, i);
    out[i] = before;
    before = add_saturating(before, item);
  }
  return total;
}

// One block loops over all chunks. This is for short arrays, and in place for the sums of chunks. ``index`` and
// ``grand_total`` may be null.
KERNEL(BLOCK) scan_short(const u32* in, const u32* index, i64 n, u32* out, u32* grand_total) {
  __shared__ u32 shared[BLOCK];
  u32 carry = 0;
  for (i64 begin = 0; begin < n; begin += SCAN_CHUNK)
    carry = add_saturating(carry, scan_chunk(in, index, begin, n, carry, out, shared));
  if (grand_total && threadIdx.x == 0) *grand_total = carry;
}

// A long array needs three kernels: the sums of the chunks, their prefix sums (scan_short), then each chunk.
KERNEL(BLOCK) scan_reduce(const u32* in, const u32* index, i64 n, u32* sums) {
  __shared__ u32 shared[BLOCK];
  const i64 first = i64(blockIdx.x) * SCAN_CHUNK + i64(threadIdx.x) * SCAN_ITEMS;
  u32 sum = 0, total;
  for (int i = 0; i < SCAN_ITEMS; ++i)
    sum = add_saturating(sum, first + i < n ? item_at(in, index, first + i) : 0);
  block_scan(sum, shared, &total);
  if (threadIdx.x == 0) sums[blockIdx.x] = total;
}

KERNEL(BLOCK) scan_apply(const u32* in, const u32* index, i64 n, const u32* sums, u32* out) {
  __shared__ u32 shared[BLOCK];
  scan_chunk(in, index, i64(blockIdx.x) * SCAN_CHUNK, n, sums[blockIdx.x], out, shared);
}

SPLAT_FN u32 digit_of(u32 key, i64 shift) { return (key >> shift) & (BINS - 1); }

// counts [BINS chunks]. For ``total`` and ``capacity`` see ``usable``.
KERNEL(BLOCK)
sort_count(const u32* keys, const u32* total, i64 capacity, i64 shift, i64 chunks, u32* counts) {
  __shared__ u32 bins[BINS];
  const i64 n = usable(total, capacity);
  const int t = int(threadIdx.x);
  bins[t] = 0;
  __syncthreads();
  const i64 begin = i64(blockIdx.x) * SORT_CHUNK;
  for (int round = 0; round < SORT_ROUNDS; ++round) {
    const i64 i = begin + round * BLOCK + t;
    if (i < n) atomicAdd(&bins[digit_of(keys[i], shift)], 1u);
  }
  __syncthreads();
  counts[t * chunks + blockIdx.x] = bins[t];
}

// ``positions`` are the prefix sums of the counts. If ``values`` is null, the value of an item is its index.
KERNEL(BLOCK)
sort_scatter(const u32* keys, const u32* values, const u32* total, i64 capacity, i64 shift, i64 chunks,
             const u32* positions, u32* sorted_keys, u32* sorted_values) {
  __shared__ u32 bins[WARPS][BINS];  // first the number of items, then the position of the next one
  const int t = int(threadIdx.x), lane = lane_index(), warp = t / WARP;
  const i64 n = usable(total, capacity);
  for (int w = 0; w < WARPS; ++w) bins[w][t] = 0;
  __syncthreads();
  const i64 begin = i64(blockIdx.x) * SORT_CHUNK + warp * (WARP * SORT_ROUNDS) + lane;
  for (int round = 0; round < SORT_ROUNDS; ++round) {
    const i64 i = begin + round * WARP;
    if (i < n) atomicAdd(&bins[warp][digit_of(keys[i], shift)], 1u);
  }
  __syncthreads();
  u32 position = positions[t * chunks + blockIdx.x];
  for (int w = 0; w < WARPS; ++w) {
    const u32 count = bins[w][t];
    bins[w][t] = position;
    position += count;
  }
  __syncthreads();
  for (int round = 0; round < SORT_ROUNDS; ++round) {
    const i64 i = begin + round * WARP;
    const bool is_item = i < n;
    const u32 key = is_item ? keys[i] : 0, digit = digit_of(key, shift);
    u32 peers = __ballot_sync(ALL, is_item);  // lanes with the same digit
    for (int bit = 0; bit < RADIX_BITS; ++bit) {
      const bool is_set = (digit >> bit) & 1;
      const u32 votes = __ballot_sync(ALL, is_set);
      peers &= is_set ? votes : ~votes;
    }
    const u32 at = bins[warp][digit] + u32(__popc(peers & ((1u << lane) - 1)));
    __syncwarp();  // all lanes have read before the last of the peers advances the bin
    if (is_item && peers >> lane == 1) bins[warp][digit] = at + 1;
    __syncwarp();
    if (is_item) {
      sorted_keys[at] = key;
      sorted_values[at] = values ? values[i] : u32(i);
    }
  }
}
