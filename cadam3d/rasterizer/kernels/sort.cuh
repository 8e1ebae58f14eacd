// Prefix sums that saturate, and a stable radix sort of 32-bit keys with 32-bit values.
//
// The sort handles one digit of the keys per pass, the least significant one first. A pass counts the values
// of the digit in the share of each block (sort_count), adds the counts of the blocks before each one
// (sort_columns), and moves the items to their positions (sort_scatter). A warp owns consecutive items of a
// chunk and ranks them by votes, so equal keys keep their order.
//
// Digits have up to 11 bits, because three passes over a depth move 13 words per key where four passes of
// 8 bits would move 18, and the number of a tile takes no more than two. The counters of the warps have 16 bits
// and share their memory with the items of a chunk, which leave it in order and so in fewer, larger pieces; a
// block needs 44 KiB and at most 128 registers per thread, so two of them fit on a multiprocessor (on Turing,
// one).
//
// No kernel reads what another block of the same launch has written, so blocks need neither fences nor tickets:
// the end of a launch makes its stores visible to the next one on the stream. Within a block, __syncthreads
// separates the stores to shared memory from the loads of other warps. Within a warp, votes and shuffles do not
// order memory, but __syncwarp does.
#pragma once

#include "device.cuh"

typedef unsigned short u16;

constexpr int WARPS = BLOCK / WARP;             // of a block
constexpr int SCAN_ITEMS = 8;                   // of one thread
constexpr int SCAN_CHUNK = BLOCK * SCAN_ITEMS;  // of a block at a time; mirrored in ../cuda_sort.py
constexpr int DIGIT_BITS = 11;                  // at most; mirrored in ../cuda_sort.py
constexpr int DIGITS = 1 << DIGIT_BITS;         // at most
constexpr int SORT_ITEMS = 16;                  // of one thread, at most; mirrored in ../cuda_sort.py
constexpr int SORT_CHUNK = BLOCK * SORT_ITEMS;  // of a block at a time, at most
constexpr int COLUMN_BLOCK = 1024;              // threads of sort_columns; mirrored in ../cuda_sort.py
constexpr int COLUMN_ROWS = 16;                 // of one warp there; its 32 warps handle 512 blocks
static_assert(DIGITS == BLOCK * SCAN_ITEMS, "a block scans all digits at once");

// Returns a + b, or the largest number if that needs more than 32 bits. So a total that is too large is never
// mistaken for a small one.
SPLAT_FN u32 add_saturating(u32 a, u32 b) { return a + b < a ? ALL : a + b; }

// The items are divided among the blocks into shares of as many whole chunks each; the last blocks may have
// less or nothing. There are fewer than 2^31 items, so the end of a share fits into 32 bits.
SPLAT_FN u32 share_size(u32 n, u32 blocks, u32 chunk) {
  const u32 chunks = (n + chunk - 1) / chunk;
  return (chunks + blocks - 1) / blocks * chunk;
}

struct Share {
  u32 begin, end;  // empty if begin >= end
};

SPLAT_FN Share share_of_block(u32 n, u32 chunk) {
  const u32 size = share_size(n, gridDim.x, chunk), begin = blockIdx.x * size;
  return {begin, begin + size < n ? begin + size : n};
}

// The index of number r of a thread if each has ``rounds`` of them: neighbours belong to neighbouring lanes.
SPLAT_FN u32 striped(int r, int rounds) {
  return u32((int(threadIdx.x) / WARP * rounds + r) * WARP + lane_index());
}

// Replaces the numbers of a block by the sums of those before them, in the order of ``striped``, and returns
// the sum of all. ``sums`` is shared memory for WARPS numbers.
template <int MOST>
SPLAT_FN u32 block_scan(u32 (&numbers)[MOST], int rounds, u32* sums) {
  const int lane = lane_index(), warp = int(threadIdx.x) / WARP;
  u32 carry = 0;
#pragma unroll
  for (int r = 0; r < MOST; ++r) {
    if (r >= rounds) break;
    u32 inclusive = numbers[r];
#pragma unroll
    for (int reach = 1; reach < WARP; reach *= 2) {
      const u32 below = __shfl_sync(ALL, inclusive, (lane - reach) & (WARP - 1));
      if (lane >= reach) inclusive = add_saturating(inclusive, below);
    }
    const u32 before = __shfl_sync(ALL, inclusive, (lane - 1) & (WARP - 1));
    numbers[r] = lane > 0 ? add_saturating(carry, before) : carry;
    carry = add_saturating(carry, __shfl_sync(ALL, inclusive, WARP - 1));
  }
  if (lane == 0) sums[warp] = carry;
  __syncthreads();
  u32 before = 0, total = 0;
#pragma unroll
  for (int w = 0; w < WARPS; ++w) {
    if (w == warp) before = total;
    total = add_saturating(total, sums[w]);
  }
#pragma unroll
  for (int r = 0; r < MOST; ++r) numbers[r] = add_saturating(before, numbers[r]);
  __syncthreads();  // after this, the shared memory may be used again
  return total;
}

// Returns the sum of one number of each thread.
SPLAT_FN u32 block_sum(u32 number, u32* sums) {
  u32 numbers[1] = {number};
  return block_scan(numbers, 1, sums);
}

// Loads the numbers of a chunk in the order of ``striped``, and zeros behind ``end``: in[i], or in[index[i]].
SPLAT_FN void load_chunk(const u32* in, const u32* index, u32 begin, u32 end, u32 (&numbers)[SCAN_ITEMS]) {
  u32 at[SCAN_ITEMS];
#pragma unroll
  for (int r = 0; r < SCAN_ITEMS; ++r) {
    at[r] = begin + striped(r, SCAN_ITEMS);
    if (index && at[r] < end) at[r] = index[at[r]];
  }
#pragma unroll
  for (int r = 0; r < SCAN_ITEMS; ++r)
    numbers[r] = begin + striped(r, SCAN_ITEMS) < end ? in[at[r]] : 0;
}

SPLAT_FN void store_chunk(const u32 (&numbers)[SCAN_ITEMS], u32 begin, u32 end, u32* out) {
#pragma unroll
  for (int r = 0; r < SCAN_ITEMS; ++r) {
    const u32 i = begin + striped(r, SCAN_ITEMS);
    if (i < end) out[i] = numbers[r];
  }
}

// sums [blocks]: the sum of the share of each block. If there is an index, ``gathered`` receives the numbers
// in its order, so that the next kernel reads them in a row.
KERNEL(BLOCK)
scan_reduce(const u32* __restrict__ in, const u32* __restrict__ index, i64 n, u32* __restrict__ gathered,
            u32* __restrict__ sums) {
  __shared__ u32 shared[WARPS];
  const Share share = share_of_block(u32(n), SCAN_CHUNK);
  u32 sum = 0;
  for (u32 begin = share.begin; begin < share.end; begin += SCAN_CHUNK) {
    u32 numbers[SCAN_ITEMS];
    load_chunk(in, index, begin, share.end, numbers);
#pragma unroll
    for (int r = 0; r < SCAN_ITEMS; ++r) sum = add_saturating(sum, numbers[r]);
    if (index) store_chunk(numbers, begin, share.end, gathered);
  }
  const u32 total = block_sum(sum, shared);
  if (threadIdx.x == 0) sums[blockIdx.x] = total;
}

// Exclusive prefix sums, and the sum of all numbers in ``total``, which may be null. ``sums`` are the results
// of scan_reduce with the same grid. If ``sums`` is null, each block adds all numbers before its share itself,
// which saves a launch for short arrays. ``out`` may be ``in`` if there are ``sums`` and no index, because then
// each thread reads only the numbers that it replaces.
KERNEL(BLOCK)
scan_apply(const u32* in, const u32* index, i64 n, const u32* sums, u32* out, u32* total) {
  __shared__ u32 shared[WARPS];
  const Share share = share_of_block(u32(n), SCAN_CHUNK);
  if (share.begin >= share.end && n > 0) return;
  u32 before = 0, numbers[SCAN_ITEMS];
  if (sums) {
    for (u32 i = threadIdx.x; i < blockIdx.x; i += BLOCK) before = add_saturating(before, sums[i]);
  } else {
    for (u32 begin = 0; begin < share.begin; begin += SCAN_CHUNK) {
      load_chunk(in, index, begin, share.begin, numbers);
#pragma unroll
      for (int r = 0; r < SCAN_ITEMS; ++r) before = add_saturating(before, numbers[r]);
    }
  }
  u32 carry = block_sum(before, shared);
  for (u32 begin = share.begin; begin < share.end; begin += SCAN_CHUNK) {
    load_chunk(in, index, begin, share.end, numbers);
    const u32 sum = block_scan(numbers, SCAN_ITEMS, shared);
#pragma unroll
    for (int r = 0; r < SCAN_ITEMS; ++r) numbers[r] = add_saturating(carry, numbers[r]);
    store_chunk(numbers, begin, share.end, out);
    carry = add_saturating(carry, sum);
  }
  if (total && threadIdx.x == 0 && share.end == u32(n)) *total = carry;
}

// Some bits of a key.
struct Digit {
  int shift, bits;
  SPLAT_FN Digit(i64 shift, i64 bits) : shift(int(shift)), bits(int(bits)) {}
  SPLAT_FN u32 values() const { return 1u << bits; }
  SPLAT_FN u32 of(u32 key) const { return key >> shift & (values() - 1); }
};

// The number of items of a thread if a block divides ``count`` of them in the order of ``striped``. If there are
// fewer items than threads, the index of some threads is too large. The count is a power of two.
SPLAT_FN int rounds_for(u32 count) { return count > BLOCK ? int(count / BLOCK) : 1; }

// Counters of digits in shared memory. Many keys may have the same digit, and atomics on one address wait for
// one another. So the lanes of a warp spread over copies of each counter, as many as there is memory for.
struct Counters {
  static constexpr int SIZE = 4 * DIGITS;
  u32* memory;  // SIZE numbers
  int copies;

  SPLAT_FN Counters(u32* memory, Digit digit) : memory(memory) {
    const int most = SIZE >> digit.bits;
    copies = most < WARP ? most : WARP;
    for (int i = int(threadIdx.x); i < int(digit.values()) * copies; i += BLOCK) memory[i] = 0;
    __syncthreads();
  }
  // Adds 1 for each key in [begin, middle), and 2^16 for each key in [middle, end). All keys of a batch are
  // loaded before the first one is counted.
  SPLAT_FN void count(const u32* keys, u32 begin, u32 middle, u32 end, Digit digit) {
    constexpr int BATCH = 16;
    const int copy = lane_index() & (copies - 1);
    for (u32 first = begin + threadIdx.x; first < end; first += BATCH * BLOCK) {
      const int rest = int(end - first);
      u32 loaded[BATCH];
#pragma unroll
      for (int j = 0; j < BATCH; ++j) loaded[j] = j * BLOCK < rest ? (keys + first)[j * BLOCK] : 0;
#pragma unroll
      for (int j = 0; j < BATCH; ++j) {
        u32* const counter = memory + int(digit.of(loaded[j])) * copies + copy;
        if (j * BLOCK < rest) atomicAdd(counter, first + j * BLOCK < middle ? 1u : 1u << 16);
      }
    }
    __syncthreads();
  }
  SPLAT_FN u32 sum(u32 value) const {
    u32 sum = 0;
    for (int copy = 0; copy < copies; ++copy) sum += memory[int(value) * copies + copy];
    return sum;
  }
};

// counts [blocks values]: how often each value of the digit occurs in the share of each block. A block without
// a share writes nothing. For ``count`` and ``capacity`` see ``usable``; ``items`` is the number of items of
// a thread in a chunk.
KERNEL(BLOCK)
sort_count(const u32* __restrict__ keys, const u32* __restrict__ count, i64 capacity, i64 items, i64 shift,
           i64 bits, u32* __restrict__ counts) {
  __shared__ u32 shared[Counters::SIZE];
  const Digit digit(shift, bits);
  const Share share = share_of_block(u32(usable(count, capacity)), u32(items) * BLOCK);
  if (share.begin >= share.end) return;
  Counters counters(shared, digit);
  counters.count(keys, share.begin, share.end, share.end, digit);
  for (u32 d = threadIdx.x; d < digit.values(); d += BLOCK)
    counts[blockIdx.x * digit.values() + d] = counters.sum(d);
}

// Replaces the counts of each block by the sums over the blocks before it; totals [values]: the sums over all
// blocks. A lane handles one value, and a warp 16 of the blocks.
KERNEL(COLUMN_BLOCK)
sort_columns(const u32* __restrict__ count, i64 capacity, i64 items, i64 bits, i64 blocks,
             u32* __restrict__ counts, u32* __restrict__ totals) {
  __shared__ u32 sums[WARP][WARP];
  const int lane = lane_index(), warp = int(threadIdx.x) / WARP;
  const u32 n = u32(usable(count, capacity)), size = share_size(n, u32(blocks), u32(items) * BLOCK);
  const u32 rows = n > 0 ? (n + size - 1) / size : 0;  // the other blocks have written nothing
  const u32 values = 1u << bits, d = blockIdx.x * WARP + u32(lane), first = u32(warp) * COLUMN_ROWS;
  u32 numbers[COLUMN_ROWS], sum = 0;
#pragma unroll
  for (int r = 0; r < COLUMN_ROWS; ++r)
    numbers[r] = d < values && first + r < rows ? counts[(first + r) * values + d] : 0;
#pragma unroll
  for (int r = 0; r < COLUMN_ROWS; ++r) sum += numbers[r];
  sums[warp][lane] = sum;
  __syncthreads();
  u32 before = 0, total = 0;
  for (int w = 0; w < WARP; ++w) {
    if (w == warp) before = total;
    total += sums[w][lane];
  }
#pragma unroll
  for (int r = 0; r < COLUMN_ROWS; ++r) {
    if (d < values && first + r < rows) counts[(first + r) * values + d] = before;
    before += numbers[r];
  }
  if (warp == 0 && d < values) totals[d] = total;
}

// Shared memory of sort_scatter, for three purposes in turn. A bin counts the items of a warp with one value of
// the digit, and then it is the place of the first of them in the chunk. Bins are also handled in pairs, the
// first of them in the lower half of a number; no half overflows, because a chunk has fewer than 2^16 items.
union SortStage {
  u32 counters[Counters::SIZE];
  u16 bins[WARPS * DIGITS];
  u32 pairs[WARPS * DIGITS / 2];
  struct {
    u32 keys[SORT_CHUNK], values[SORT_CHUNK];
  } sorted;
};

// Writes to bases [values] the position of the first item of this block with each value of the digit.
//
// If there are ``totals``, sort_columns has added the ``counts``. If not, each block adds the counts of all
// blocks itself, and without ``counts`` it counts the keys of all blocks itself. For few keys, a launch more
// would take longer. A block counts at most 2^15 keys, so a half of a counter is enough.
SPLAT_FN void find_bases(const u32* keys, u32 n, u32 chunk, Share share, Digit digit, const u32* counts,
                         const u32* totals, u32* memory, u32* bases, u32* sums) {
  const u32 values = digit.values(), block = blockIdx.x;
  const int rounds = rounds_for(values);
  int stride = 1;  // of the sums over the blocks before this one, in ``memory``
  if (!counts) {
    Counters counters(memory, digit);
    counters.count(keys, 0, share.begin, n, digit);
    stride = counters.copies;
    for (int r = 0; r < rounds; ++r) {
      const u32 d = striped(r, rounds);
      if (d >= values) continue;
      const u32 halves = counters.sum(d);
      memory[int(d) * stride] = halves & 0xffff;
      bases[d] = (halves & 0xffff) + (halves >> 16);
    }
  } else if (!totals) {
    constexpr int BATCH = 16;
    const u32 size = share_size(n, gridDim.x, chunk), rows = (n + size - 1) / size;
    for (int r = 0; r < rounds; ++r) {
      const u32 d = striped(r, rounds);
      if (d >= values) continue;
      u32 before = 0, all = 0;
      for (u32 first = 0; first < rows; first += BATCH) {
        u32 loaded[BATCH];
#pragma unroll
        for (int j = 0; j < BATCH; ++j) loaded[j] = first + j < rows ? counts[(first + j) * values + d] : 0;
#pragma unroll
        for (int j = 0; j < BATCH; ++j) {
          before += first + j < block ? loaded[j] : 0;
          all += loaded[j];
        }
      }
      memory[d] = before, bases[d] = all;
    }
  } else {
    for (u32 i = threadIdx.x; i < values; i += BLOCK)
      memory[i] = counts[block * values + i], bases[i] = totals[i];
    __syncthreads();
  }
  u32 numbers[SCAN_ITEMS];
#pragma unroll
  for (int r = 0; r < SCAN_ITEMS; ++r) {
    const u32 d = striped(r, rounds);
    numbers[r] = r < rounds && d < values ? bases[d] : 0;
  }
  block_scan(numbers, rounds, sums);
#pragma unroll
  for (int r = 0; r < SCAN_ITEMS; ++r) {
    const u32 d = striped(r, rounds);
    if (r < rounds && d < values) bases[d] = numbers[r] + memory[int(d) * stride];
  }
  __syncthreads();
}

// Returns the lanes of the warp that have the same value of a digit as this one, among those with an item.
SPLAT_FN u32 find_peers(u32 value, bool is_item, Digit digit) {
  u32 peers = __ballot_sync(ALL, is_item);
#pragma unroll
  for (int step = 1; step <= DIGIT_BITS; ++step) {
    // Bits behind the last one change nothing. A branch for each of them would take longer than voting.
    if ((step == 8 || step == 10) && step > digit.bits) break;
    const u32 is_set = value & digit.values() >> step, votes = __ballot_sync(ALL, is_set);
    peers &= is_set ? votes : ~votes;
  }
  return peers;
}

// Moves each item to its position in the order of one digit. If ``values`` is null, the value of an item is
// its index; if ``sorted_keys`` is null, only the values are needed. See ``find_bases`` for counts and totals.
KERNEL(BLOCK, 2)
sort_scatter(const u32* __restrict__ keys, const u32* __restrict__ values, const u32* __restrict__ count,
             i64 capacity, i64 items, i64 shift, i64 bits, const u32* __restrict__ counts,
             const u32* __restrict__ totals, u32* __restrict__ sorted_keys,
             u32* __restrict__ sorted_values) {
  __shared__ SortStage stage;
  __shared__ u32 bases[DIGITS];     // the position of the next item with a value, minus its place in the chunk
  __shared__ u32 ends[DIGITS / 2];  // the places behind the last items with two values, in halves
  __shared__ u32 sums[WARPS];
  const Digit digit(shift, bits);
  const int t = int(threadIdx.x), lane = lane_index(), warp = t / WARP, rounds = int(items);
  const int pairs = int(digit.values() / 2), pair_rounds = rounds_for(u32(pairs));
  const u32 n = u32(usable(count, capacity)), size = u32(rounds) * BLOCK;
  const Share share = share_of_block(n, size);
  if (share.begin >= share.end) return;
  find_bases(keys, n, size, share, digit, counts, totals, stage.counters, bases, sums);
  for (u32 chunk = share.begin; chunk < share.end; chunk += size) {
    const int many = int(chunk + size < share.end ? size : share.end - chunk);  // items of the chunk
    const int begin = warp * rounds * WARP + lane, mine = many - begin;
    const u32 first = chunk + u32(begin);  // item of this thread; the next ones follow at a distance of WARP
    u32 key[SORT_ITEMS], value[SORT_ITEMS], place[SORT_ITEMS];
#pragma unroll
    for (int r = 0; r < SORT_ITEMS; ++r)
      key[r] = r < rounds && r * WARP < mine ? (keys + first)[r * WARP] : 0;
#pragma unroll
    for (int r = 0; r < SORT_ITEMS; ++r)
      value[r] = values && r < rounds && r * WARP < mine ? (values + first)[r * WARP] : first + r * WARP;
    for (int i = t; i < pairs * WARPS; i += BLOCK) stage.pairs[i] = 0;
    __syncthreads();
    // The rank of each item among those of its warp with the same digit.
    u16* const bins = stage.bins + warp * pairs * 2;
#pragma unroll
    for (int r = 0; r < SORT_ITEMS; ++r) {
      place[r] = 0;
      if (r >= rounds) continue;
      const bool is_item = r * WARP < mine;
      const u32 d = digit.of(key[r]), peers = find_peers(d, is_item, digit);
      place[r] = bins[d] + u32(__popc(peers & ((1u << lane) - 1)));
      __syncwarp();  // all lanes have read before the last of the peers advances the bin
      if (is_item && peers >> lane == 1) bins[d] = u16(place[r] + 1);
      __syncwarp();  // that store comes before the loads of the next round
    }
    __syncthreads();
    // Counts become places: value after value, and warp after warp.
    constexpr int OWN = DIGITS / 2 / BLOCK;  // pairs of a thread, at most
    u32 counted[OWN] = {}, places[OWN];
    const auto each_own = [&](const auto& visit) {
#pragma unroll
      for (int r = 0; r < OWN; ++r) {
        const int pair = int(striped(r, pair_rounds));
        if (r < pair_rounds && pair < pairs) visit(r, pair);
      }
    };
#pragma unroll 2
    for (int w = 0; w < WARPS; ++w)
      each_own([&](int r, int pair) { counted[r] += stage.pairs[w * pairs + pair]; });
#pragma unroll
    for (int r = 0; r < OWN; ++r) places[r] = (counted[r] & 0xffff) + (counted[r] >> 16);
    block_scan(places, pair_rounds, sums);
    each_own([&](int r, int pair) {
      const u32 begin = places[r], middle = begin + (counted[r] & 0xffff);
      bases[2 * pair] -= begin, bases[2 * pair + 1] -= middle;
      places[r] = begin | middle << 16;
      ends[pair] = places[r] + counted[r];
    });
#pragma unroll 2
    for (int w = 0; w < WARPS; ++w)
      each_own([&](int r, int pair) {
        const u32 next = places[r] + stage.pairs[w * pairs + pair];
        stage.pairs[w * pairs + pair] = places[r], places[r] = next;
      });
    __syncthreads();
#pragma unroll
    for (int r = 0; r < SORT_ITEMS; ++r) place[r] += bins[digit.of(key[r])];
    __syncthreads();  // the bins have been read
#pragma unroll
    for (int r = 0; r < SORT_ITEMS; ++r)
      if (r < rounds && r * WARP < mine) {
        stage.sorted.keys[place[r]] = key[r];
        stage.sorted.values[place[r]] = value[r];
      }
    __syncthreads();
#pragma unroll 4
    for (int i = t; i < many; i += BLOCK) {
      const u32 sorted = stage.sorted.keys[i], to = bases[digit.of(sorted)] + u32(i);
      if (sorted_keys) sorted_keys[to] = sorted;
      sorted_values[to] = stage.sorted.values[i];
    }
    __syncthreads();  // the bases and the items have been read
    for (int pair = t; pair < pairs; pair += BLOCK)
      bases[2 * pair] += ends[pair] & 0xffff, bases[2 * pair + 1] += ends[pair] >> 16;
    // The barrier behind the next clearing of the bins follows before anything reads the bases.
  }
}
