// The CPU rasterizer: projection, tile lists, blending and their gradients, behind a C interface.
//
// The forward pass projects every Gaussian into every view, sorts the visible ones of each view by depth,
// lists for each 16x16 tile the Gaussians with boxes that touch it, front to back, and blends the tiles. The
// backward pass processes each tile back to front, writes one record per (Gaussian, tile), sums the records
// of each Gaussian in a fixed order and applies the chain rule. No two threads ever add to the same number,
// and no sum of floats depends on how the work is divided. Therefore any number of threads gives the same
// bits.
//
// In the projection a vector holds LANES Gaussians. In the blending it holds LANES pixels of a cell of 4x4
// pixels: splats are small, and on a square they leave fewer lanes unused than on a row.
#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <thread>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "simd.h"
#include "splat_math.h"

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

namespace splat {
template <>
struct Kinds<simd::Wide> {
  typedef simd::Truths Truth;
  typedef simd::Wide Stored;
};
}  // namespace splat

namespace {

using simd::Floats;
using simd::Ints;
using simd::LANES;
using simd::Mask;
using simd::spread;
using simd::Truths;
using simd::Wide;

constexpr int TILE = 16;  // pixels along the edge
constexpr int AREA = TILE * TILE;
constexpr int CELL = 4;  // pixels along the edge
constexpr int CELLS = (TILE / CELL) * (TILE / CELL);
constexpr int PARTS = CELL * CELL / LANES;  // vectors per cell
// Gaussians that a thread processes at a time; a whole number of vectors. A core loads ahead, so with 256 it
// takes cache lines from the core that writes the next block, and two threads are no faster than one.
constexpr int64_t BLOCK = 2048;
// Gaussians of each thread when lists are made, at least. With fewer, another thread saves no time.
constexpr int64_t PIECE = 8192;
constexpr int RECORD = 16;    // floats that the backward pass writes per (Gaussian, tile): one cache line
constexpr int MOMENTS = 10;   // the first floats of a record
constexpr int ABSOLUTES = 2;  // the next floats, used for absgrad
static_assert(CELLS == CELL * CELL && BLOCK % LANES == 0, "a vector of cells is as long as one of pixels");

// Bytes of the records that exist at the same time, unless a single view needs more. Tests set a small
// number.
#if !defined(SPLAT_RECORD_BUDGET)
#define SPLAT_RECORD_BUDGET (256 << 20)
#endif

// Bytes that the library keeps between calls, at most. With 0 every array is exactly as large as it must be
// and is freed with its pass, so that a sanitizer sees each of them.
#if !defined(SPLAT_KEPT_BYTES)
#define SPLAT_KEPT_BYTES (512 << 20)
#endif

enum Status : int { OK = 0, OUT_OF_MEMORY = 1, TOO_LARGE = 2 };

// Mirrored by ``Scene`` in cpu.py: same order, same types.
struct Scene {
  int64_t gaussians, views, coefficients, height, width, threads;
  const float *means, *log_scales, *quats, *opacity_logits, *sh, *world_to_camera, *intrinsics, *background;
};

// The data of a projected Gaussian that blending reads: one cache line.
struct alignas(64) Splat {
  float x, y;                 // pixels
  float l11, l12, l22;        // whitening, see splat_math.h
  float cut, opacity, depth;  // alpha = opacity exp(-|y|^2) where |y|^2 <= cut
  float rgb[3];
  float spare[5];
};
constexpr int SPLAT_FIELDS = 11;  // floats; ``project_batch`` lists them in this order

struct Range {
  uint32_t first, end;
  uint32_t size() const { return end - first; }
};
inline Range unpack(uint32_t range) { return {range & 0xffff, range >> 16}; }

// The data of a projected Gaussian that the lists are made from, separate because it is read in depth order.
struct Box {
  uint32_t columns, rows;  // tiles that the Gaussian touches: first | end << 16; 0 = none
  uint32_t key;            // the bits of its depth, which are in the same order as positive depths
  uint32_t slot;           // the first of its slots, one per tile, row by row
  uint32_t slots() const { return unpack(columns).size() * unpack(rows).size(); }
};

// The sums over a block of Gaussians of one view. The lists replace them by the sums over all earlier blocks.
struct Block {
  uint64_t slots = 0;
  uint32_t visible = 0, low = UINT32_MAX, high = 0;  // Gaussians; keys
};

// ---------------------------------------------------------------------------------------------- memory

// A large array starts on a huge page and consists of huge pages where the system has them: the first write
// to a page costs about a microsecond, and a large scene would touch tens of thousands of small pages.
constexpr size_t HUGE_PAGE = size_t(2) << 20;

// Suggests huge pages for a large array that the caller is about to receive, if its pages are new.
void prefer_huge_pages(float* array, int64_t count) {
#if defined(__linux__)
  if (!array || size_t(count) * sizeof(float) < 2 * HUGE_PAGE) return;
  const uintptr_t begin = reinterpret_cast<uintptr_t>(array), end = begin + size_t(count) * sizeof(float);
  const uintptr_t first = (begin + HUGE_PAGE - 1) / HUGE_PAGE * HUGE_PAGE, last = end / HUGE_PAGE * HUGE_PAGE;
  madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#else
  (void)array, (void)count;
#endif
}

// Uninitialized memory, which a new size replaces only if it does not fit. std::vector would first write
// zeros.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(Buffer&& other) noexcept { swap(other); }
  Buffer& operator=(Buffer&& other) noexcept {
    swap(other);
    return *this;
  }
  ~Buffer() { release(); }
  void swap(Buffer& other) noexcept {
    std::swap(data_, other.data_), std::swap(bytes_, other.bytes_);
  }

  void allocate(int64_t count) {
    const size_t wanted = size_t(std::max<int64_t>(count, 1)) * sizeof(T);
    // Memory that is much too large goes back to the system, so that one large pass does not hold it forever.
    if (wanted <= bytes_ && bytes_ / 4 <= wanted + HUGE_PAGE) return;
    release();
    // The next pass often needs a little more. Pages that are never touched cost nothing.
    reserve(SPLAT_KEPT_BYTES > 0 ? wanted + wanted / 4 : wanted);
  }
  void release() {
    if (!data_) return;
#if defined(__linux__)
    if (is_mapped(bytes_)) {
      munmap(data_, bytes_);
      data_ = nullptr, bytes_ = 0;
      return;
    }
#endif
    ::operator delete(data_, ALIGNMENT);
    data_ = nullptr, bytes_ = 0;
  }
  size_t bytes() const { return bytes_; }
  T* data() { return data_; }
  const T* data() const { return data_; }
  T& operator[](int64_t i) { return data_[i]; }
  const T& operator[](int64_t i) const { return data_[i]; }

 private:
  static constexpr std::align_val_t ALIGNMENT{64};
  static bool is_mapped(size_t bytes) { return SPLAT_KEPT_BYTES > 0 && bytes >= 2 * HUGE_PAGE; }

  void reserve(size_t bytes) {
#if defined(__linux__)
    if (is_mapped(bytes)) {
      bytes = (bytes + HUGE_PAGE - 1) / HUGE_PAGE * HUGE_PAGE;
      // The system chooses any page, so a map that is longer by one huge page contains the wanted one.
      void* const all =
          mmap(nullptr, bytes + HUGE_PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
      if (all == MAP_FAILED) throw std::bad_alloc();
      char* const begin = static_cast<char*>(all);
      const size_t before = (HUGE_PAGE - reinterpret_cast<uintptr_t>(all) % HUGE_PAGE) % HUGE_PAGE;
      if (before > 0) munmap(begin, before);
      munmap(begin + before + bytes, HUGE_PAGE - before);
      madvise(begin + before, bytes, MADV_HUGEPAGE);
      data_ = reinterpret_cast<T*>(begin + before), bytes_ = bytes;
      return;
    }
#endif
    data_ = static_cast<T*>(::operator new(bytes, ALIGNMENT)), bytes_ = bytes;
  }

  T* data_ = nullptr;
  size_t bytes_ = 0;
};

struct alignas(64) Record {
  float sums[RECORD];
};

// One Gaussian in the list of one tile, and the slot of the record of this pair.
struct Entry {
  uint32_t gaussian, slot;
};

// The data of one view that the backward pass needs again.
struct View {
  splat::Camera<Wide> camera;
  Buffer<Block> blocks;
  uint32_t visible, slots;       // Gaussians; (Gaussian, tile) pairs, grouped by Gaussian
  Buffer<uint32_t> first_entry;  // tiles + 1
  Buffer<Entry> entries;         // tile by tile, near to far
  Buffer<uint16_t> reached;      // entries; one bit for each cell that the entry reached
  Buffer<uint32_t> used;         // tiles; entries processed before every pixel was opaque
  Buffer<float> transmittance;   // tiles x AREA; after the last splat
  Buffer<int32_t> last;          // tiles x AREA; rank of the splat at which the pixel was opaque

  size_t bytes() const {
    return blocks.bytes() + first_entry.bytes() + entries.bytes() + reached.bytes() + used.bytes() +
           transmittance.bytes() + last.bytes();
  }
};

// The memory in which the lists of one view are made.
struct Scratch {
  Buffer<Entry> order;      // visible Gaussians, near to far, with the key of the depth as ``slot``
  Buffer<uint32_t> counts;  // pieces x BINS
  Buffer<uint32_t> next;    // pieces x (tile rows + 1) x (tile columns + 1)

  size_t bytes() const { return order.bytes() + counts.bytes() + next.bytes(); }
};

// Mirrored by ``CPU_STAGES`` in scripts/rasterizer_bench/stages.py.
enum Stage : int { PROJECT, ORDER, LISTS, BLEND, BLEND_BACKWARD, GATHER, CENTRE, STAGES };

struct Frame {
  int64_t tiles_x = 0, tiles_y = 0;
  Buffer<Splat> splats;  // views x gaussians
  Buffer<Box> boxes;     // views x gaussians
  Buffer<Record> records;
  std::vector<View> views;
  std::vector<Scratch> scratch;
  std::atomic<int64_t> nanoseconds[STAGES] = {};  // time in each stage; views that run at once add up

  int64_t tiles() const { return tiles_x * tiles_y; }
  size_t bytes() const {
    size_t sum = splats.bytes() + boxes.bytes() + records.bytes();
    for (const View& view : views) sum += view.bytes();
    for (const Scratch& each : scratch) sum += each.bytes();
    return sum;
  }
};

// The memory of the last pass that ended. The next one uses it again, because touching new pages takes a
// large scene as long as half of its arithmetic.
std::atomic<Frame*> spare_frame{nullptr};

class Stopwatch {
 public:
  Stopwatch(Frame& frame, Stage stage) : total_(frame.nanoseconds[stage]) {}
  ~Stopwatch() {
    const auto time = std::chrono::steady_clock::now() - start_;
    total_ += std::chrono::duration_cast<std::chrono::nanoseconds>(time).count();
  }

 private:
  std::atomic<int64_t>& total_;
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

// ---------------------------------------------------------------------------------------------- threads

// The threads of one call of the library. They start with the first work for more than one thread and end
// with the call, so that none exists when the process forks.
class Team {
 public:
  explicit Team(int64_t threads) : threads_(threads) {}
  ~Team() {
    if (helpers_.empty()) return;
    publish(nullptr, nullptr, 0);
    for (std::thread& helper : helpers_) helper.join();
  }
  Team(const Team&) = delete;

  // Runs body(0) .. body(items - 1), each once. Throws the status of a body that fails.
  template <class Body>
  void run(int64_t items, const Body& body) {
    if (std::min(items, threads_) <= 1) {
      for (int64_t i = 0; i < items; ++i) body(i);
      return;
    }
    start(std::min(items, threads_) - 1);
    publish([](const void* data, int64_t i) { (*static_cast<const Body*>(data))(i); }, &body, items);
    work();
    wait(done_, [&] { return busy_.load() == 0; });
    if (trouble_ != OK) throw Status(trouble_.exchange(OK));
  }

 private:
  typedef void (*Call)(const void*, int64_t);

  void start(int64_t count) {
    if (is_refused_) return;
    try {
      helpers_.reserve(size_t(count));
      while (int64_t(helpers_.size()) < count)
        helpers_.emplace_back([this, round = round_.load()] { help(round); });
    } catch (...) {  // the system refuses another thread, so the existing ones do the work
      is_refused_ = true;
    }
  }
  void publish(Call call, const void* body, int64_t items) {
    call_ = call, body_ = body, items_ = items;
    next_ = 0, busy_ = int64_t(helpers_.size());
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ++round_;
    }
    begun_.notify_all();
  }
  void help(uint64_t round) {
    for (;;) {
      wait(begun_, [&] { return round_.load() != round; });
      ++round;
      if (!call_) return;
      work();
      if (--busy_ == 0) {
        const std::lock_guard<std::mutex> lock(mutex_);
        done_.notify_one();
      }
    }
  }
  void work() {
    for (int64_t i = next_++; i < items_; i = next_++) {
      int status = OK;
      try {
        call_(body_, i);
      } catch (Status failure) {  // an exception must not leave a thread
        status = failure;
      } catch (...) {
        status = OUT_OF_MEMORY;
      }
      if (status != OK) trouble_ = status, next_ = items_;
    }
  }
  // The next stage usually begins within microseconds, and waking a thread that sleeps takes longer.
  template <class Ready>
  void wait(std::condition_variable& changed, const Ready& is_ready) {
    for (int spin = 0; spin < 4000; ++spin) {
      if (is_ready()) return;
#if defined(__x86_64__)
      __builtin_ia32_pause();
#elif defined(__aarch64__)
      asm volatile("yield");
#endif
    }
    std::unique_lock<std::mutex> lock(mutex_);
    changed.wait(lock, is_ready);
  }

  int64_t threads_;
  bool is_refused_ = false;
  std::vector<std::thread> helpers_;
  Call call_ = nullptr;
  const void* body_ = nullptr;
  int64_t items_ = 0;
  std::atomic<int64_t> next_{0}, busy_{0};
  std::atomic<uint64_t> round_{0};
  std::atomic<int> trouble_{OK};
  std::mutex mutex_;
  std::condition_variable begun_, done_;
};

int64_t ceil_div(int64_t a, int64_t b) { return (a + b - 1) / b; }

// LANES rows of a tensor from ``first`` on. After the end of the tensor the last row is repeated.
struct Rows {
  int64_t first, of_lane[LANES];
  int count;

  Rows(const Scene& scene, int64_t first_)
      : first(first_), count(int(std::min<int64_t>(LANES, scene.gaussians - first))) {
    for (int lane = 0; lane < LANES; ++lane) of_lane[lane] = first + std::min(lane, count - 1);
  }
  Wide gather(const float* from, int64_t stride) const {
    float x[LANES];
    for (int lane = 0; lane < LANES; ++lane) x[lane] = from[of_lane[lane] * stride];
    return simd::load(x);
  }
  // Adds to what is there, or to zero.
  void put(float* to, int64_t stride, Wide x, bool adds) const {
    float part[LANES];
    simd::store(part, x.lanes);
    for (int lane = 0; lane < count; ++lane) {
      float& here = to[(first + lane) * stride];
      here = (adds ? here : 0.0f) + part[lane];
    }
  }
};

// LANES Gaussians from ``first`` on.
struct Batch : Rows {
  splat::Gaussian<Wide> gaussian;
  Wide sh[3 * splat::MAX_COEFFICIENTS];

  Batch(const Scene& scene, int64_t first_) : Rows(scene, first_) {
    for (int j = 0; j < 3; ++j) {
      gaussian.mean[j] = gather(scene.means + j, 3);
      gaussian.log_scale[j] = gather(scene.log_scales + j, 3);
    }
    for (int j = 0; j < 4; ++j) gaussian.quat[j] = gather(scene.quats + j, 4);
    gaussian.opacity_logit = gather(scene.opacity_logits, 1);
    const int64_t stride = 3 * scene.coefficients;
    for (int64_t j = 0; j < stride; ++j) sh[j] = gather(scene.sh + j, stride);
    gaussian.sh = sh;
    gaussian.coefficients = int(scene.coefficients);
  }
  Batch(const Batch&) = delete;  // ``gaussian`` points into this object
};

// Calls body(first) for the batches of a block.
template <class Body>
void each_batch(const Scene& scene, int64_t block, const Body& body) {
  const int64_t end = std::min((block + 1) * BLOCK, scene.gaussians);
  for (int64_t first = block * BLOCK; first < end; first += LANES) body(first);
}

// Calls body(first) for all batches; a thread processes one block of them at a time.
template <class Body>
void each_batch(Team& team, const Scene& scene, const Body& body) {
  team.run(ceil_div(scene.gaussians, BLOCK), [&](int64_t block) { each_batch(scene, block, body); });
}

splat::Camera<Wide> camera_of(const Scene& scene, int64_t v) {
  return splat::make_camera<Wide>(scene.world_to_camera + 16 * v, scene.intrinsics + 9 * v, int(scene.width),
                                  int(scene.height));
}

// ---------------------------------------------------------------------------------------------- project

// The tiles along one axis with pixel centres within ``reach`` of ``centre``, packed as in ``Box``.
Ints touched_tiles(Floats centre, Floats reach, int64_t tiles, Mask is_seen) {
  const Floats slack = 1e-3f + 1e-6f * (simd::absolute(centre) + reach);  // more than the rounding error
  const auto tile = [&](Floats pixel) {
    return simd::to_ints(simd::min(simd::max(pixel * (1.0f / TILE), Floats{}), spread(float(tiles))));
  };
  const Ints first = tile(centre - reach + 0.5f - slack);
  const Ints end = tile(centre + reach - 0.5f + slack + float(TILE));
  return simd::select(simd::both(is_seen, simd::less(first, end)), first | end << 16, Ints{});
}

// Projects LANES Gaussians into the views and adds them to the sums of their block, one per view.
void project_batch(const Scene& scene, Frame& frame, int64_t first, float* means2d, float* radii,
                   Block* sums) {
  const Batch batch(scene, first);
  splat::Shape<Wide> shape;
  const Truths is_sound = splat::make_shape(batch.gaussian, shape);
  for (int64_t v = 0; v < scene.views; ++v) {
    const splat::Camera<Wide>& camera = frame.views[size_t(v)].camera;
    splat::Footprint<Wide> footprint;
    const Mask is_seen = (is_sound & splat::project(batch.gaussian, shape, camera, footprint)).mask;
    Wide rgb[3];
    splat::colour(batch.gaussian, camera, rgb);
    const Wide &x = footprint.mean2d[0], &y = footprint.mean2d[1];
    const Floats reach[2] = {footprint.reach[0].lanes, footprint.reach[1].lanes};
    Ints columns = touched_tiles(x.lanes, reach[0], frame.tiles_x, is_seen);
    Ints rows = touched_tiles(y.lanes, reach[1], frame.tiles_y, is_seen);
    const Mask is_on_tiles = simd::both(simd::less(Ints{}, columns), simd::less(Ints{}, rows));
    columns = simd::select(is_on_tiles, columns, Ints{}), rows = simd::select(is_on_tiles, rows, Ints{});
    const Wide fields[SPLAT_FIELDS] = {
        x, y, footprint.l11, footprint.l12, footprint.l22, shape.log_cut, shape.opacity, footprint.centre[2],
        rgb[0], rgb[1], rgb[2]};
    float radius[LANES], centre[2][LANES];
    simd::store(radius, simd::keep(is_seen, simd::max(reach[0], reach[1])));
    for (int j = 0; j < 2; ++j) simd::store(centre[j], simd::keep(is_seen, fields[j].lanes));
    Block& sum = sums[v];
    const int64_t at = v * scene.gaussians + first;
    for (int lane = 0; lane < batch.count; ++lane) {
      char* out = reinterpret_cast<char*>(&frame.splats[at + lane]);
      for (int j = 0; j < SPLAT_FIELDS; ++j)
        std::memcpy(out + 4 * j, reinterpret_cast<const char*>(fields + j) + 4 * lane, 4);
      Box& box = frame.boxes[at + lane];
      box.columns = uint32_t(columns[lane]), box.rows = uint32_t(rows[lane]);
      std::memcpy(&box.key, &frame.splats[at + lane].depth, 4);
      if (box.rows != 0) {
        ++sum.visible;
        sum.low = std::min(sum.low, box.key), sum.high = std::max(sum.high, box.key);
        sum.slots += uint64_t(unpack(box.columns).size()) * unpack(box.rows).size();
      }
      radii[at + lane] = radius[lane];
      for (int j = 0; j < 2; ++j) means2d[2 * (at + lane) + j] = centre[j][lane];
    }
  }
}

// The sums are a thread's own until its block is done; two threads that add to one cache line slow each other
// down.
void project_block(const Scene& scene, Frame& frame, int64_t block, float* means2d, float* radii) {
  std::vector<Block> sums(size_t(scene.views));
  each_batch(scene, block,
             [&](int64_t first) { project_batch(scene, frame, first, means2d, radii, sums.data()); });
  for (int64_t v = 0; v < scene.views; ++v) frame.views[size_t(v)].blocks[block] = sums[size_t(v)];
}

// ---------------------------------------------------------------------------------------------- tile lists

constexpr int BITS = 12, BINS = 1 << BITS;  // a digit of the radix sort

// Data in depth order is scattered in memory, so an item is prefetched some places before it is needed. That
// is farther ahead where there is less to do per item.
constexpr int AHEAD = 6, BOXES_AHEAD = 24;
inline void prefetch(const void* address) {
  __builtin_prefetch(address);
  asm volatile("" : : "r"(address));  // GCC would remove a function that only prefetches
}

// Makes the lists of one view in pieces: each is a range of Gaussians, and later of the depth order. Pieces
// write to different places, so the result does not depend on their number.
class Lister {
 public:
  Lister(Team& team, int64_t pieces, const Scene& scene, Frame& frame, int64_t v, Scratch& scratch)
      : team_(team),
        pieces_(pieces),
        gaussians_(scene.gaussians),
        blocks_(ceil_div(scene.gaussians, BLOCK)),
        frame_(frame),
        view_(frame.views[size_t(v)]),
        boxes_(frame.boxes.data() + v * scene.gaussians),
        scratch_(scratch) {}

  void make() {
    {
      const Stopwatch watch(frame_, ORDER);
      sum_blocks();
      sort();
    }
    const Stopwatch watch(frame_, LISTS);
    count_entries();
    team_.run(pieces_, [&](int64_t piece) { fill_entries(piece); });
  }

 private:
  struct Span {
    int64_t begin, end;
  };
  Span blocks_of(int64_t piece) const { return {piece * blocks_ / pieces_, (piece + 1) * blocks_ / pieces_}; }
  // The part of the sorted items that belongs to a piece. It is as long as the piece's own visible Gaussians.
  Span items_of(int64_t piece) const {
    const Span blocks = blocks_of(piece);
    return {view_.blocks[blocks.begin].visible, view_.blocks[blocks.end].visible};
  }

  void sum_blocks() {
    Block sum;
    for (int64_t b = 0; b < blocks_; ++b) {
      Block& block = view_.blocks[b];
      sum.low = std::min(sum.low, block.low), sum.high = std::max(sum.high, block.high);
      std::swap(sum.slots, block.slots), std::swap(sum.visible, block.visible);
      sum.slots += block.slots, sum.visible += block.visible;
    }
    view_.blocks[blocks_] = sum;
    if (sum.slots > UINT32_MAX) throw Status(TOO_LARGE);
    view_.visible = sum.visible, view_.slots = uint32_t(sum.slots);
  }

  // Stable radix sort of the visible Gaussians by depth, least significant digit first, in as many passes as
  // the depths have differing digits. The memory of the lists, which are made later and are at least as long,
  // serves as the second array. The first pass reads from the array that makes the last one write to
  // ``order``.
  void sort() {
    const Block& all = view_.blocks[blocks_];
    const uint32_t low = all.low, differing = all.visible > 0 ? all.high - low : 0;
    scratch_.order.allocate(all.visible), view_.entries.allocate(int64_t(all.slots));
    scratch_.counts.allocate(pieces_ * BINS);
    const auto bin = [low](const Entry& item, int shift) { return (item.slot - low) >> shift & (BINS - 1); };
    const auto counts_of = [&](int64_t piece) { return scratch_.counts.data() + piece * BINS; };
    int passes = 0;
    while (passes * BITS < 32 && differing >> passes * BITS > 0) ++passes;
    Entry *from = scratch_.order.data(), *to = view_.entries.data();
    if (passes % 2 == 1) std::swap(from, to);
    team_.run(pieces_, [&](int64_t piece) {
      uint32_t* const counts = counts_of(piece);
      std::memset(counts, 0, BINS * sizeof(uint32_t));
      each_visible(piece, [&](int64_t at, Entry item) {
        from[at] = item;
        ++counts[bin(item, 0)];
      });
    });
    for (int pass = 0; pass < passes; ++pass, std::swap(from, to)) {
      const int shift = pass * BITS;
      if (pass > 0) {
        team_.run(pieces_, [&](int64_t piece) {
          uint32_t* const counts = counts_of(piece);
          std::memset(counts, 0, BINS * sizeof(uint32_t));
          const Span span = items_of(piece);
          for (int64_t i = span.begin; i < span.end; ++i) ++counts[bin(from[i], shift)];
        });
      }
      uint32_t sum = 0;
      for (int64_t b = 0; b < BINS; ++b) {
        for (int64_t piece = 0; piece < pieces_; ++piece) {
          uint32_t& count = counts_of(piece)[b];
          sum += std::exchange(count, sum);
        }
      }
      team_.run(pieces_, [&](int64_t piece) {
        uint32_t* const counts = counts_of(piece);
        const Span span = items_of(piece);
        for (int64_t i = span.begin; i < span.end; ++i) to[counts[bin(from[i], shift)]++] = from[i];
      });
    }
  }

  // Numbers the slots of a piece's Gaussians and calls visit(place, item) for those that are visible.
  template <class Visit>
  void each_visible(int64_t piece, const Visit& visit) {
    const Span blocks = blocks_of(piece);
    uint32_t slot = uint32_t(view_.blocks[blocks.begin].slots);
    int64_t at = view_.blocks[blocks.begin].visible;
    for (int64_t i = blocks.begin * BLOCK; i < std::min(blocks.end * BLOCK, gaussians_); ++i) {
      Box& box = boxes_[i];
      box.slot = slot;
      if (box.rows == 0) continue;
      slot += box.slots();
      visit(at++, Entry{uint32_t(i), box.key});
    }
  }

  // Calls visit(gaussian, box) for the items of a piece, near to far.
  template <class Visit>
  void each_sorted(int64_t piece, const Visit& visit) const {
    const Span span = items_of(piece);
    for (int64_t i = span.begin; i < span.end; ++i) {
      if (i + BOXES_AHEAD < span.end) prefetch(&boxes_[scratch_.order[i + BOXES_AHEAD].gaussian]);
      const uint32_t gaussian = scratch_.order[i].gaussian;
      visit(gaussian, boxes_[gaussian]);
    }
  }

  // Each piece has a table of tiles, with one more row and column.
  int64_t stride() const { return frame_.tiles_x + 1; }
  uint32_t* table_of(int64_t piece) { return scratch_.next.data() + piece * stride() * (frame_.tiles_y + 1); }

  // Computes the start of each tile's list, and in the tables the start of each piece's part of it.
  void count_entries() {
    scratch_.next.allocate(pieces_ * stride() * (frame_.tiles_y + 1));
    team_.run(pieces_, [&](int64_t piece) {
      // The change of the list length from one tile to the next, along x and y: each box makes four changes.
      // Unsigned numbers wrap around, and the sums come out right.
      uint32_t* const table = table_of(piece);
      std::memset(table, 0, size_t(stride() * (frame_.tiles_y + 1)) * sizeof(uint32_t));
      each_sorted(piece, [&](uint32_t, const Box& box) {
        const Range columns = unpack(box.columns), rows = unpack(box.rows);
        ++table[rows.first * stride() + columns.first];
        --table[rows.first * stride() + columns.end];
        --table[rows.end * stride() + columns.first];
        ++table[rows.end * stride() + columns.end];
      });
      for (int64_t row = 0; row < frame_.tiles_y; ++row) {
        uint32_t* const here = table + row * stride();
        for (int64_t column = 1; column < stride(); ++column) here[column] += here[column - 1];
        if (row > 0)
          for (int64_t column = 0; column < stride(); ++column) here[column] += here[column - stride()];
      }
    });
    view_.first_entry.allocate(frame_.tiles() + 1);
    uint32_t sum = 0;
    for (int64_t row = 0; row < frame_.tiles_y; ++row) {
      for (int64_t column = 0; column < frame_.tiles_x; ++column) {
        view_.first_entry[row * frame_.tiles_x + column] = sum;
        for (int64_t piece = 0; piece < pieces_; ++piece)
          sum += std::exchange(table_of(piece)[row * stride() + column], sum);
      }
    }
    view_.first_entry[frame_.tiles()] = sum;
  }

  void fill_entries(int64_t piece) {
    uint32_t* const next = table_of(piece);
    Entry* const entries = view_.entries.data();
    each_sorted(piece, [&](uint32_t gaussian, const Box& box) {
      const Range columns = unpack(box.columns), rows = unpack(box.rows);
      uint32_t slot = box.slot;
      for (uint32_t row = rows.first; row < rows.end; ++row) {
        uint32_t* const of_row = next + row * stride();
        for (uint32_t column = columns.first; column < columns.end; ++column)
          entries[of_row[column]++] = {gaussian, slot++};
      }
    });
  }

  Team& team_;
  const int64_t pieces_, gaussians_, blocks_;
  Frame& frame_;
  View& view_;
  Box* const boxes_;
  Scratch& scratch_;
};

// A large view is made by all threads together. Small views are made side by side, one by each thread.
void build_tile_lists(Team& team, const Scene& scene, Frame& frame) {
  const int64_t pieces = std::max<int64_t>(std::min(scene.gaussians / PIECE, scene.threads), 1);
  frame.scratch.resize(size_t(pieces > 1 ? 1 : scene.views));
  if (pieces > 1) {
    for (int64_t v = 0; v < scene.views; ++v) Lister(team, pieces, scene, frame, v, frame.scratch[0]).make();
  } else {
    team.run(scene.views, [&](int64_t v) {
      Team alone(1);
      Lister(alone, 1, scene, frame, v, frame.scratch[size_t(v)]).make();
    });
  }
}

// ---------------------------------------------------------------------------------------------- blend

// The position of a tile in its view, and the part of it that is inside the image.
struct Place {
  int64_t x, y;       // first pixel
  int columns, rows;  // pixels inside
};

Place place_of(const Scene& scene, const Frame& frame, int64_t tile) {
  const int64_t x = tile % frame.tiles_x * TILE, y = tile / frame.tiles_x * TILE;
  return {x, y, int(std::min<int64_t>(TILE, scene.width - x)),
          int(std::min<int64_t>(TILE, scene.height - y))};
}

// The offsets of the pixels of a cell from its middle, and of the middles of the cells from the tile's
// corner.
struct Grid {
  float offset_x[CELL * CELL], offset_y[CELL * CELL], middle_x[CELLS], middle_y[CELLS];
};
constexpr Grid make_grid() {
  Grid grid{};
  for (int i = 0; i < CELL * CELL; ++i) {
    grid.offset_x[i] = float(i % CELL) - 1.5f, grid.offset_y[i] = float(i / CELL) - 1.5f;
    grid.middle_x[i] = float(CELL * (i % CELL)) + 2.0f, grid.middle_y[i] = float(CELL * (i / CELL)) + 2.0f;
  }
  return grid;
}
constexpr Grid GRID = make_grid();

// y = L d of a splat: at the middle of each cell, and the difference for each pixel of a cell.
struct Aim {
  alignas(64) float u[CELLS], t[CELLS];
  Floats pixel_u[PARTS], pixel_t[PARTS];
};

// The forward and the backward pass both call this function and ``falloff``, so they agree to the last bit on
// which splats are skipped. ``x`` and ``y`` are the centre, relative to the tile.
inline void take_aim(const Splat& s, float x, float y, Aim& aim) {
  const Floats l11 = spread(s.l11), l12 = spread(s.l12), l22 = spread(s.l22);
  for (int part = 0; part < PARTS; ++part) {
    const int at = part * LANES;
    const Floats dx = simd::load(GRID.middle_x + at) - x, dy = simd::load(GRID.middle_y + at) - y;
    simd::store(aim.u + at, simd::fma(l11, dx, l12 * dy));
    simd::store(aim.t + at, l22 * dy);
    const Floats offset_y = simd::load(GRID.offset_y + at);
    aim.pixel_u[part] = simd::fma(l11, simd::load(GRID.offset_x + at), l12 * offset_y);
    aim.pixel_t[part] = l22 * offset_y;
  }
}

// Returns a bit for each cell that |L d|^2 <= cut can reach. Within a cell, u and t differ from their value
// in the middle by at most a known margin.
inline uint32_t reachable_cells(const Splat& s, const Aim& aim) {
  const Floats margin_u = spread(1.5f * (s.l11 + std::fabs(s.l12))), margin_t = spread(1.5f * s.l22);
  const Floats cut = spread(s.cut + 1e-3f);  // includes more than the rounding error
  uint32_t cells = 0;
  for (int part = 0; part < PARTS; ++part) {
    const Floats u = simd::max(simd::absolute(simd::load(aim.u + part * LANES)) - margin_u, Floats{});
    const Floats t = simd::max(simd::absolute(simd::load(aim.t + part * LANES)) - margin_t, Floats{});
    cells |= simd::bits(simd::less_equal(simd::fma(u, u, t * t), cut)) << (part * LANES);
  }
  return cells;
}

struct Falloff {
  Floats u, t, exponent;
};
inline Falloff falloff(const Aim& aim, int cell, int part) {
  const Floats u = aim.pixel_u[part] + aim.u[cell], t = aim.pixel_t[part] + aim.t[cell];
  return {u, t, simd::fma(u, u, t * t)};
}

// The pixels of one vector, stored field by field, so that the data that a splat touches is contiguous.
struct Pixels {
  Floats transmittance, red, green, blue, weight, depth;  // depth: sum w z, at the end the expected z
};
struct PixelsBackward {
  // red to far: gradients of the weighted sums.
  Floats transmittance, suffix, red, green, blue, far, depth;
  Ints last;
};

// Calls visit(vector, lane, pixel) for the pixels of a tile that are inside the image.
template <class Visit>
void each_pixel(const Scene& scene, const Place& place, const Visit& visit) {
  for (int row = 0; row < place.rows; ++row) {
    const int64_t first = (place.y + row) * scene.width + place.x;
    for (int column = 0; column < place.columns; ++column) {
      const int cell = row / CELL * (TILE / CELL) + column / CELL;
      const int at = cell * CELL * CELL + row % CELL * CELL + column % CELL;
      visit(at / LANES, at % LANES, first + column);
    }
  }
}

inline float* floats_of(Floats& vector) { return reinterpret_cast<float*>(&vector); }

constexpr int NEVER = INT32_MAX;

void blend_tile(const Scene& scene, const Frame& frame, View& view, const Splat* splats, int64_t tile,
                const float* background, float* rgb, float* alpha, float* depth, bool keeps) {
  Pixels pixels[CELLS * PARTS];
  Ints last[CELLS * PARTS];
  Mask open[CELLS * PARTS];
  uint32_t open_cells = 0;
  const Place place = place_of(scene, frame, tile);
  for (int cell = 0; cell < CELLS; ++cell) {
    for (int part = 0; part < PARTS; ++part) {
      const int at = cell * PARTS + part;
      pixels[at] = Pixels{};
      pixels[at].transmittance = spread(1.0f);
      const Floats x = simd::load(GRID.offset_x + part * LANES) + GRID.middle_x[cell];
      const Floats y = simd::load(GRID.offset_y + part * LANES) + GRID.middle_y[cell];
      open[at] = simd::both(simd::less_equal(x, spread(float(place.columns))),
                            simd::less_equal(y, spread(float(place.rows))));
      last[at] = simd::select(open[at], spread(NEVER), Ints{});
      open_cells |= uint32_t(simd::any(open[at])) << cell;
    }
  }

  const int64_t begin = view.first_entry[tile], end = view.first_entry[tile + 1];
  const Floats alpha_max = spread(float(SPLAT_ALPHA_MAX)), stop = spread(float(SPLAT_TRANSMITTANCE_MIN));
  int64_t entry = begin;
  for (; entry < end && open_cells != 0; ++entry) {
    if (entry + AHEAD < end) prefetch(splats + view.entries[entry + AHEAD].gaussian);
    const Splat& s = splats[view.entries[entry].gaussian];
    Aim aim;
    take_aim(s, s.x - float(place.x), s.y - float(place.y), aim);
    const Floats cut = spread(s.cut), opacity = spread(s.opacity);
    const Floats r = spread(s.rgb[0]), g = spread(s.rgb[1]), b = spread(s.rgb[2]), z = spread(s.depth);
    uint32_t reached = 0, closed = 0;
    for (uint32_t left = reachable_cells(s, aim) & open_cells; left != 0; left &= left - 1) {
      const int cell = __builtin_ctz(left);
      for (int part = 0; part < PARTS; ++part) {
        const int at = cell * PARTS + part;
        const Falloff fall = falloff(aim, cell, part);
        Mask hit = simd::both(simd::less_equal(fall.exponent, cut), open[at]);
        if (!simd::any(hit)) continue;
        reached |= 1u << cell;
        Pixels& p = pixels[at];
        Floats a = simd::keep(hit, simd::min(opacity * simd::exp_minus(fall.exponent), alpha_max));
        const Floats before = p.transmittance;
        Floats after = simd::fma(-a, before, before);
        const Mask stops = simd::both(hit, simd::less_equal(after, stop));
        if (simd::any(stops)) {
          open[at] = simd::first_only(open[at], stops);
          last[at] = simd::select(stops, spread(int(entry - begin)), last[at]);
          hit = simd::first_only(hit, stops);
          a = simd::keep(hit, a);
          after = simd::fma(-a, before, before);
          closed |= 1u << cell;
        }
        const Floats w = a * before;
        p.transmittance = after;
        p.red = simd::fma(w, r, p.red);
        p.green = simd::fma(w, g, p.green);
        p.blue = simd::fma(w, b, p.blue);
        p.depth = simd::fma(w, z, p.depth);
        p.weight += w;
      }
    }
    if (keeps) view.reached[entry] = uint16_t(reached);
    for (; closed != 0; closed &= closed - 1) {
      const int cell = __builtin_ctz(closed);
      bool is_open = false;
      for (int part = 0; part < PARTS; ++part) is_open = is_open || simd::any(open[cell * PARTS + part]);
      if (!is_open) open_cells &= ~(1u << cell);
    }
  }

  for (Pixels& p : pixels) {
    p.red = simd::fma(p.transmittance, spread(background[0]), p.red);
    p.green = simd::fma(p.transmittance, spread(background[1]), p.green);
    p.blue = simd::fma(p.transmittance, spread(background[2]), p.blue);
    const Mask is_touched = simd::greater(p.weight, Floats{});
    p.depth = simd::keep(is_touched, p.depth / simd::select(is_touched, p.weight, spread(1.0f)));
  }
  each_pixel(scene, place, [&](int vector, int lane, int64_t pixel) {
    Pixels& p = pixels[vector];
    rgb[3 * pixel] = floats_of(p.red)[lane];
    rgb[3 * pixel + 1] = floats_of(p.green)[lane];
    rgb[3 * pixel + 2] = floats_of(p.blue)[lane];
    alpha[pixel] = floats_of(p.weight)[lane];
    depth[pixel] = floats_of(p.depth)[lane];
  });
  if (!keeps) return;
  view.used[tile] = uint32_t(entry - begin);
  for (int at = 0; at < CELLS * PARTS; ++at) {
    simd::store(&view.transmittance[tile * AREA + at * LANES], pixels[at].transmittance);
    simd::store(&view.last[tile * AREA + at * LANES], last[at]);
  }
}

struct Images {
  const float *alpha, *depth;                       // results of the forward pass
  const float *grad_rgb, *grad_alpha, *grad_depth;  // each may be null, which means zero
};

void load_gradients(const Scene& scene, const View& view, int64_t tile, const Place& place,
                    const float* background, const Images& images, PixelsBackward (&pixels)[CELLS * PARTS]) {
  Floats through[CELLS * PARTS] = {}, weight[CELLS * PARTS] = {};
  for (PixelsBackward& p : pixels) p = PixelsBackward{};
  each_pixel(scene, place, [&](int vector, int lane, int64_t pixel) {
    PixelsBackward& p = pixels[vector];
    if (images.grad_rgb) {
      floats_of(p.red)[lane] = images.grad_rgb[3 * pixel];
      floats_of(p.green)[lane] = images.grad_rgb[3 * pixel + 1];
      floats_of(p.blue)[lane] = images.grad_rgb[3 * pixel + 2];
    }
    if (images.grad_alpha) floats_of(through[vector])[lane] = images.grad_alpha[pixel];
    if (images.grad_depth) floats_of(p.far)[lane] = images.grad_depth[pixel];
    floats_of(p.depth)[lane] = images.depth[pixel];
    floats_of(weight[vector])[lane] = images.alpha[pixel];
  });
  for (int at = 0; at < CELLS * PARTS; ++at) {
    PixelsBackward& p = pixels[at];
    p.transmittance = simd::load(&view.transmittance[tile * AREA + at * LANES]);
    p.last = simd::load(&view.last[tile * AREA + at * LANES]);
    const Mask is_touched = simd::greater(weight[at], Floats{});
    p.far = simd::keep(is_touched, p.far / simd::select(is_touched, weight[at], spread(1.0f)));
    const Floats behind = p.red * background[0] + p.green * background[1] + p.blue * background[2];
    p.suffix = p.transmittance * (behind - through[at]);
  }
}

// Goes back to front. With w = alpha T, the loss depends on a pixel through sum w v, where v = rgb . g_rgb +
// (z - D) g_depth / A, and through its final transmittance. ``suffix`` is the sum over everything behind a
// splat: dLoss/dalpha = T v - suffix / (1 - alpha).
template <bool ABSOLUTE>
void blend_tile_backward(const Scene& scene, const Frame& frame, const View& view, const Splat* splats,
                         int64_t tile, const float* background, const Images& images, Record* records) {
  const int64_t begin = view.first_entry[tile], end = view.first_entry[tile + 1];
  const int64_t used = view.used[tile];
  for (int64_t entry = begin + used; entry < end; ++entry) records[view.entries[entry].slot] = Record{};
  if (used == 0) return;
  PixelsBackward pixels[CELLS * PARTS];
  const Place place = place_of(scene, frame, tile);
  load_gradients(scene, view, tile, place, background, images, pixels);

  const Floats alpha_max = spread(float(SPLAT_ALPHA_MAX)), one = spread(1.0f);
  for (int64_t rank = used - 1; rank >= 0; --rank) {
    if (rank >= AHEAD) prefetch(splats + view.entries[begin + rank - AHEAD].gaussian);
    const Entry entry = view.entries[begin + rank];
    const uint32_t reached = view.reached[begin + rank];
    if (reached == 0) {
      records[entry.slot] = Record{};
      continue;
    }
    const Splat& s = splats[entry.gaussian];
    Aim aim;
    take_aim(s, s.x - float(place.x), s.y - float(place.y), aim);
    const Floats cut = spread(s.cut), opacity = spread(s.opacity);
    const Floats r = spread(s.rgb[0]), g = spread(s.rgb[1]), b = spread(s.rgb[2]), z = spread(s.depth);
    const Floats l12 = spread(s.l12), l22 = spread(s.l22);
    const Ints index = spread(int(rank));
    Floats sum_g{}, sum_gu{}, sum_gt{}, sum_guu{}, sum_gut{}, sum_gtt{};
    Floats sum_red{}, sum_green{}, sum_blue{}, sum_z{}, absolute_u{}, absolute_y{};
    for (uint32_t left = reached; left != 0; left &= left - 1) {
      const int cell = __builtin_ctz(left);
      for (int part = 0; part < PARTS; ++part) {
        PixelsBackward& p = pixels[cell * PARTS + part];
        const Falloff fall = falloff(aim, cell, part);
        const Mask hit = simd::both(simd::less_equal(fall.exponent, cut), simd::less(index, p.last));
        if (PARTS > 1 && !simd::any(hit)) continue;
        // Lanes that are not hit get alpha 0 here, so they change nothing and compute no slow denormals.
        const Floats free = simd::keep(hit, opacity * simd::exp_minus(fall.exponent));
        const Floats a = simd::min(free, alpha_max);
        const Floats after = p.transmittance, behind = p.suffix;
        const Floats inverse = simd::reciprocal(one - a), before = after * inverse;
        const Floats w = a * before;
        Floats value = (z - p.depth) * p.far;
        value = simd::fma(r, p.red, simd::fma(g, p.green, simd::fma(b, p.blue, value)));
        const Floats g_alpha = simd::fma(before, value, -(behind * inverse));
        const Mask flows = simd::less_equal(free, alpha_max);  // a capped alpha has no gradient
        const Floats g_exponent = simd::keep(flows, -a * g_alpha);
        const Floats gu = g_exponent * fall.u, gt = g_exponent * fall.t;
        p.transmittance = before;
        p.suffix = simd::fma(w, value, behind);
        sum_g += g_exponent;
        sum_gu += gu;
        sum_gt += gt;
        sum_guu = simd::fma(gu, fall.u, sum_guu);
        sum_gut = simd::fma(gu, fall.t, sum_gut);
        sum_gtt = simd::fma(gt, fall.t, sum_gtt);
        sum_red = simd::fma(w, p.red, sum_red);
        sum_green = simd::fma(w, p.green, sum_green);
        sum_blue = simd::fma(w, p.blue, sum_blue);
        sum_z = simd::fma(w, p.far, sum_z);
        if constexpr (ABSOLUTE) {
          absolute_u += simd::absolute(gu);
          absolute_y += simd::absolute(simd::fma(l12, gu, l22 * gt));
        }
      }
    }
    float* const sums = records[entry.slot].sums;
    if constexpr (ABSOLUTE) {
      simd::store_sums(sums, {sum_g, sum_gu, sum_gt, sum_guu, sum_gut, sum_gtt, sum_red, sum_green, sum_blue,
                              sum_z, absolute_u, absolute_y});
    } else {
      simd::store_sums(sums, {sum_g, sum_gu, sum_gt, sum_guu, sum_gut, sum_gtt, sum_red, sum_green, sum_blue,
                              sum_z});
    }
  }
}

// ---------------------------------------------------------------------------------------------- gather

struct ParameterGradients {
  float *means2d, *absgrad, *means, *log_scales, *quats, *opacity_logits, *sh;  // absgrad may be null
};

// Sums the records of one view over its tiles; returns false if no Gaussian of the batch is on the screen.
bool gather_moments(const Box* boxes, const Batch& batch, const Record* records,
                    splat::Moments<Wide>& moments, Wide (&absolutes)[ABSOLUTES]) {
  const Box& last = boxes[batch.first + batch.count - 1];
  if (boxes[batch.first].slot == last.slot + last.slots()) return false;
  float sums[RECORD][LANES] = {};
  for (int lane = 0; lane < batch.count; ++lane) {
    const Box& box = boxes[batch.first + lane];
    alignas(64) Record sum{};
    for (uint32_t slot = box.slot, end = slot + box.slots(); slot < end; ++slot)
      for (int j = 0; j < RECORD; j += LANES)
        simd::store(sum.sums + j, simd::load(sum.sums + j) + simd::load(records[slot].sums + j));
    for (int j = 0; j < MOMENTS + ABSOLUTES; ++j) sums[j][lane] = sum.sums[j];
  }
  Wide of[MOMENTS];
  for (int j = 0; j < MOMENTS; ++j) of[j] = simd::load(sums[j]);
  moments = {of[0], of[1], of[2], of[3], of[4], of[5], {of[6], of[7], of[8]}, of[9]};
  for (int j = 0; j < ABSOLUTES; ++j) absolutes[j] = simd::load(sums[MOMENTS + j]);
  return true;
}

void add_where(Truths condition, const splat::Gradient<Wide>& part, int64_t coefficients,
               splat::Gradient<Wide>& total) {
  for (int i = 0; i < 3; ++i) {
    total.mean[i] += select(condition, part.mean[i], 0);
    for (int j = 0; j < 3; ++j) total.axes[i][j] += select(condition, part.axes[i][j], 0);
  }
  total.opacity_logit += select(condition, part.opacity_logit, 0);
  for (int64_t j = 0; j < 3 * coefficients; ++j) total.sh[j] += select(condition, part.sh[j], 0);
}

// Computes the gradients of LANES Gaussians from the views [view_begin, view_end), and adds them to those of
// the views before.
void batch_backward(const Scene& scene, const Frame& frame, int64_t view_begin, int64_t view_end,
                    int64_t first, const Record* const* records, const ParameterGradients& out) {
  const Batch batch(scene, first);
  splat::Shape<Wide> shape;
  const Truths is_sound = splat::make_shape(batch.gaussian, shape);
  splat::Gradient<Wide> total, of_view;
  splat::clear(total, int(scene.coefficients));
  Truths has_any{simd::none()};
  for (int64_t v = view_begin; v < view_end; ++v) {
    const auto put_centres = [&](float* to, Truths is_seen, const Wide (&centre)[2]) {
      for (int j = 0; j < 2; ++j)
        batch.put(to + 2 * v * scene.gaussians + j, 2, select(is_seen, centre[j], 0), false);
    };
    splat::Moments<Wide> moments;
    Wide absolutes[ABSOLUTES], centre[2] = {0, 0};
    if (!gather_moments(frame.boxes.data() + v * scene.gaussians, batch, records[v], moments, absolutes)) {
      put_centres(out.means2d, is_sound, centre);
      if (out.absgrad) put_centres(out.absgrad, is_sound, centre);
      continue;
    }
    const splat::Camera<Wide>& camera = frame.views[size_t(v)].camera;
    splat::Footprint<Wide> footprint;
    const Truths is_seen = is_sound & splat::project(batch.gaussian, shape, camera, footprint);
    has_any = has_any | is_seen;
    splat::mean2d_gradient(footprint, moments, centre);
    put_centres(out.means2d, is_seen, centre);
    if (out.absgrad) {
      splat::mean2d_absolute(footprint.l11, absolutes, centre);
      put_centres(out.absgrad, is_seen, centre);
    }
    splat::clear(of_view, int(scene.coefficients));
    splat::project_backward(batch.gaussian, shape, camera, footprint, moments, of_view);
    add_where(is_seen, of_view, scene.coefficients, total);
  }
  const bool adds = view_begin > 0;
  Wide log_scale[3] = {0, 0, 0}, quat[4] = {0, 0, 0, 0};
  if (simd::any(has_any.mask)) {
    splat::shape_backward(shape, batch.gaussian, total, log_scale, quat);
  } else if (adds) {
    return;
  }
  for (int j = 0; j < 3; ++j) {
    batch.put(out.means + j, 3, total.mean[j], adds);
    batch.put(out.log_scales + j, 3, select(has_any, log_scale[j], 0), adds);
  }
  for (int j = 0; j < 4; ++j) batch.put(out.quats + j, 4, select(has_any, quat[j], 0), adds);
  batch.put(out.opacity_logits, 1, total.opacity_logit, adds);
  const int64_t stride = 3 * scene.coefficients;
  for (int64_t j = 0; j < stride; ++j) batch.put(out.sh + j, stride, total.sh[j], adds);
}

// Returns the end of a group of views with records that fit the budget. A group has at least one view.
int64_t group_end(const Scene& scene, const Frame& frame, int64_t begin, int64_t& records) {
  records = 0;
  int64_t v = begin;
  for (; v < scene.views; ++v) {
    const int64_t of_view = frame.views[size_t(v)].slots;
    if (v > begin && (records + of_view) * int64_t(sizeof(Record)) > SPLAT_RECORD_BUDGET) break;
    records += of_view;
  }
  return v;
}

template <class Body>
int guarded(const Body& body) {
  try {
    body();
    return OK;
  } catch (Status status) {
    return status;
  } catch (...) {
    return OUT_OF_MEMORY;
  }
}

}  // namespace

// ---------------------------------------------------------------------------------------------- C interface
// Every tensor is contiguous float32, with the shape that the Python code gives it. Functions return a
// Status.

EXPORT const char* cadam3d_instruction_set() { return SIMD_NAME; }

// Projects the Gaussians and creates the data that the other calls need. means2d [v n 2], radii [v n].
EXPORT int cadam3d_project(const Scene* scene, float* means2d, float* radii, void** out) {
  return guarded([&] {
    std::unique_ptr<Frame> frame(spare_frame.exchange(nullptr));
    if (!frame) frame = std::make_unique<Frame>();
    for (auto& nanoseconds : frame->nanoseconds) nanoseconds = 0;
    const Stopwatch watch(*frame, PROJECT);
    frame->tiles_x = ceil_div(scene->width, TILE), frame->tiles_y = ceil_div(scene->height, TILE);
    if (frame->tiles_x > INT16_MAX || frame->tiles_y > INT16_MAX || scene->gaussians >= UINT32_MAX)
      throw Status(TOO_LARGE);
    frame->splats.allocate(scene->views * scene->gaussians);
    frame->boxes.allocate(scene->views * scene->gaussians);
    frame->views.resize(size_t(scene->views));
    for (int64_t v = 0; v < scene->views; ++v) {
      View& view = frame->views[size_t(v)];
      view.camera = camera_of(*scene, v);
      view.blocks.allocate(ceil_div(scene->gaussians, BLOCK) + 1);
    }
    Team team(scene->threads);
    team.run(ceil_div(scene->gaussians, BLOCK),
             [&](int64_t block) { project_block(*scene, *frame, block, means2d, radii); });
    *out = frame.release();
  });
}

// Blends the images rgb [v h w 3], alpha [v h w] and depth [v h w]. With ``keeps``, stores the data that the
// backward pass needs.
EXPORT int cadam3d_blend(const Scene* scene, void* handle, float* rgb, float* alpha, float* depth,
                         int keeps) {
  return guarded([&] {
    Frame& frame = *static_cast<Frame*>(handle);
    Team team(scene->threads);
    build_tile_lists(team, *scene, frame);
    const Stopwatch watch(frame, BLEND);
    if (keeps) {
      for (View& view : frame.views) {
        view.used.allocate(frame.tiles()), view.reached.allocate(view.first_entry[frame.tiles()]);
        view.last.allocate(frame.tiles() * AREA), view.transmittance.allocate(frame.tiles() * AREA);
      }
    }
    const int64_t pixels = scene->height * scene->width;
    team.run(scene->views * frame.tiles(), [&](int64_t item) {
      const int64_t v = item / frame.tiles();
      blend_tile(*scene, frame, frame.views[size_t(v)], frame.splats.data() + v * scene->gaussians,
                 item % frame.tiles(), scene->background + 3 * v, rgb + 3 * v * pixels, alpha + v * pixels,
                 depth + v * pixels, keeps != 0);
    });
  });
}

// Writes all gradients. Each image gradient may be null, and so may absgrad: then no absolute values are
// summed. The path through means2d ends in grad_means2d; cadam3d_centre_backward
// continues it.
EXPORT int cadam3d_blend_backward(const Scene* scene, void* handle, const float* alpha, const float* depth,
                                  const float* grad_rgb, const float* grad_alpha, const float* grad_depth,
                                  float* grad_means2d, float* absgrad, float* grad_means,
                                  float* grad_log_scales, float* grad_quats, float* grad_opacity_logits,
                                  float* grad_sh) {
  return guarded([&] {
    Frame& frame = *static_cast<Frame*>(handle);
    const ParameterGradients out{grad_means2d, absgrad,             grad_means, grad_log_scales,
                                 grad_quats,   grad_opacity_logits, grad_sh};
    const auto blend_tile = absgrad ? blend_tile_backward<true> : blend_tile_backward<false>;
    const int64_t pixels = scene->height * scene->width, tiles = frame.tiles(), n = scene->gaussians;
    prefer_huge_pages(grad_means2d, 2 * scene->views * n), prefer_huge_pages(absgrad, 2 * scene->views * n);
    prefer_huge_pages(grad_means, 3 * n), prefer_huge_pages(grad_log_scales, 3 * n);
    prefer_huge_pages(grad_quats, 4 * n), prefer_huge_pages(grad_sh, 3 * scene->coefficients * n);
    std::vector<Record*> of_view(size_t(scene->views));
    Team team(scene->threads);
    int64_t begin = 0, end = 0;
    do {  // at least once, because gradients without any view are zero
      int64_t count = 0;
      end = group_end(*scene, frame, begin, count);
      {
        const Stopwatch watch(frame, BLEND_BACKWARD);
        frame.records.allocate(count);
        for (int64_t v = begin, first = 0; v < end; first += frame.views[size_t(v)].slots, ++v)
          of_view[size_t(v)] = frame.records.data() + first;
        team.run((end - begin) * tiles, [&](int64_t item) {
          const int64_t v = begin + item / tiles;
          const Images images{
              alpha + v * pixels, depth + v * pixels, grad_rgb ? grad_rgb + 3 * v * pixels : nullptr,
              grad_alpha ? grad_alpha + v * pixels : nullptr, grad_depth ? grad_depth + v * pixels : nullptr};
          blend_tile(*scene, frame, frame.views[size_t(v)], frame.splats.data() + v * scene->gaussians,
                     item % tiles, scene->background + 3 * v, images, of_view[size_t(v)]);
        });
      }
      const Stopwatch watch(frame, GATHER);
      each_batch(team, *scene, [&](int64_t first) {
        batch_backward(*scene, frame, begin, end, first, of_view.data(), out);
      });
      begin = end;
    } while (begin < scene->views);
    if (frame.bytes() > SPLAT_KEPT_BYTES) frame.records.release();
  });
}

// dLoss/dmeans [n 3] through the projected centres, from dLoss/dmeans2d [v n 2]. A culled Gaussian gets zero.
EXPORT int cadam3d_centre_backward(const Scene* scene, void* handle, const float* radii,
                                   const float* grad_means2d, float* grad_means) {
  return guarded([&] {
    const Stopwatch watch(*static_cast<Frame*>(handle), CENTRE);
    std::vector<splat::Camera<Wide>> cameras;
    for (int64_t v = 0; v < scene->views; ++v) cameras.push_back(camera_of(*scene, v));
    Team team(scene->threads);
    each_batch(team, *scene, [&](int64_t first) {
      const Rows rows(*scene, first);
      const Wide mean[3] = {rows.gather(scene->means, 3), rows.gather(scene->means + 1, 3),
                            rows.gather(scene->means + 2, 3)};
      Wide total[3] = {0, 0, 0};
      for (int64_t v = 0; v < scene->views; ++v) {
        const float* const of_view = grad_means2d + 2 * v * scene->gaussians;
        const Truths is_seen = rows.gather(radii + v * scene->gaussians, 1) > Wide(0);
        const Wide gradient[2] = {rows.gather(of_view, 2), rows.gather(of_view + 1, 2)};
        Wide part[3] = {0, 0, 0};
        splat::centre_backward(cameras[size_t(v)], mean, gradient, part);
        for (int j = 0; j < 3; ++j) total[j] += select(is_seen, part[j], 0);
      }
      for (int j = 0; j < 3; ++j) rows.put(grad_means + j, 3, total[j], false);
    });
  });
}

// Writes the seconds that a pass has spent in each ``Stage`` so far, and the numbers of its visible pairs of
// a Gaussian and a view, of its slots and of the bytes that it holds.
EXPORT void cadam3d_measure(const void* handle, double* seconds, int64_t* counts) {
  const Frame& frame = *static_cast<const Frame*>(handle);
  for (int stage = 0; stage < STAGES; ++stage)
    seconds[stage] = double(frame.nanoseconds[stage].load()) * 1e-9;
  counts[0] = counts[1] = 0, counts[2] = int64_t(frame.bytes());
  for (const View& view : frame.views) counts[0] += view.visible, counts[1] += view.slots;
}

// Ends a pass, and keeps its memory for the next one unless that is too much.
EXPORT void cadam3d_free(void* handle) {
  std::unique_ptr<Frame> frame(static_cast<Frame*>(handle));
  if (frame->bytes() > SPLAT_KEPT_BYTES) frame->records.release();
  if (frame->bytes() <= SPLAT_KEPT_BYTES) frame.reset(spare_frame.exchange(frame.release()));
}

// Returns 0 if this machine can run the compiled code: one splat passes every stage, forward and backward.
EXPORT int cadam3d_self_test() {
  const float means[3] = {0, 0, 2}, log_scales[3] = {-2, -2, -2}, quat[4] = {1, 0, 0, 0};
  const float logit = 2, sh[3] = {1, 1, 1};
  const float matrix[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  const float intrinsics[9] = {20, 0, 10, 0, 20, 10, 0, 0, 1};
  const float background[3] = {};
  const Scene scene{1, 1, 1, 20, 20, 2, means, log_scales, quat, &logit, sh, matrix, intrinsics, background};
  std::vector<float> rgb(1200), alpha(400), depth(400), ones(1200, 1.0f);
  float means2d[2], radius, gradients[16] = {};
  void* frame = nullptr;
  if (cadam3d_project(&scene, means2d, &radius, &frame) != OK) return 1;
  int status = cadam3d_blend(&scene, frame, rgb.data(), alpha.data(), depth.data(), 1);
  if (status == OK)
    status = cadam3d_blend_backward(&scene, frame, alpha.data(), depth.data(), ones.data(), nullptr, nullptr,
                                    gradients, nullptr, gradients + 2, gradients + 5, gradients + 8,
                                    gradients + 12, gradients + 13);
  cadam3d_free(frame);
  return status == OK && alpha[210] > 0.5f && std::fabs(depth[210] - 2) < 1e-3f && gradients[13] > 0 ? 0 : 1;
}
