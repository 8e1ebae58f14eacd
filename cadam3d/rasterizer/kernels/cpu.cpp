// The CPU rasterizer: projection, tile lists, blending and their gradients, behind a C interface.
//
// The forward pass projects every Gaussian into every view, sorts the visible ones of each view by depth,
// lists for each 16x16 tile the Gaussians with boxes that touch it, front to back, and blends the tiles. The
// backward pass processes each tile back to front, writes one record per (Gaussian, tile), sums the records
// of each Gaussian in a fixed order and applies the chain rule. No two threads ever add to the same number,
// and the pieces of work do not depend on the number of threads. Therefore any number of threads gives the
// same bits.
//
// In the projection a vector holds LANES Gaussians. In the blending it holds LANES pixels of a cell of 4x4
// pixels: splats are small, and on a square they leave fewer lanes unused than on a row.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <thread>
#include <vector>

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
constexpr int64_t BLOCK = 256;              // Gaussians per piece of work; a whole number of vectors
constexpr int RECORD = 16;   // floats that the backward pass writes per (Gaussian, tile): one cache line
constexpr int MOMENTS = 10;  // the first floats of a record
constexpr int ABSOLUTES = 2;  // the next floats, used for absgrad
static_assert(CELLS == CELL * CELL && BLOCK % LANES == 0, "a vector of cells is as long as one of pixels");

// Bytes of the records that exist at the same time, unless a single view needs more. Tests set a small
// number.
#if !defined(SPLAT_RECORD_BUDGET)
#define SPLAT_RECORD_BUDGET (256 << 20)
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
  uint32_t columns, rows;  // tiles that its box touches: first | end << 16; 0 = none
  float spare[3];
};
constexpr int SPLAT_FIELDS = 13;  // four bytes each; ``project_batch`` lists them in this order

struct Range {
  uint32_t first, end;
  uint32_t size() const { return end - first; }
};
inline Range unpack(uint32_t range) { return {range & 0xffff, range >> 16}; }

// Uninitialized memory; std::vector would first write zeros.
template <class T>
class Buffer {
 public:
  void allocate(int64_t count) { memory_.reset(new T[size_t(std::max<int64_t>(count, 1))]); }
  T* data() { return memory_.get(); }
  const T* data() const { return memory_.get(); }
  T& operator[](int64_t i) { return memory_[size_t(i)]; }
  const T& operator[](int64_t i) const { return memory_[size_t(i)]; }

 private:
  std::unique_ptr<T[]> memory_;
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
  std::vector<uint32_t> order;   // Gaussians on the screen, near to far
  Buffer<uint32_t> first_slot;   // gaussians + 1; one slot per (Gaussian, tile), grouped by Gaussian
  Buffer<uint32_t> first_entry;  // tiles + 1
  Buffer<Entry> entries;         // tile by tile, near to far
  Buffer<uint16_t> reached;      // entries; one bit for each cell that the entry reached
  Buffer<uint32_t> used;         // tiles; entries processed before every pixel was opaque
  Buffer<float> transmittance;   // tiles x AREA; after the last splat
  Buffer<int32_t> last;          // tiles x AREA; rank of the splat at which the pixel was opaque
};

struct Frame {
  int64_t tiles_x = 0, tiles_y = 0;
  Buffer<Splat> splats;  // views x gaussians
  std::vector<View> views;
  int64_t tiles() const { return tiles_x * tiles_y; }
};

// Runs body(0) .. body(items - 1), each once, on up to ``threads`` threads. The threads end with the call, so
// that none exists when the process forks; starting them costs microseconds.
template <class Body>
void parallel_for(int64_t items, int64_t threads, const Body& body) {
  std::atomic<int64_t> next{0};
  const auto work = [&] {
    for (int64_t i = next.fetch_add(1); i < items; i = next.fetch_add(1)) body(i);
  };
  std::vector<std::thread> team;
  const int64_t helpers = std::min(threads, items) - 1;
  if (helpers > 0) {
    team.reserve(size_t(helpers));
    try {
      for (int64_t i = 0; i < helpers; ++i) team.emplace_back(work);
    } catch (...) {  // the system refuses another thread, so the existing ones do the work
    }
  }
  work();
  for (std::thread& thread : team) thread.join();
}

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
  void add(float* to, int64_t stride, Wide x) const {
    float part[LANES];
    simd::store(part, x.lanes);
    for (int lane = 0; lane < count; ++lane) to[(first + lane) * stride] += part[lane];
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

// Calls body(first) for all batches; a thread processes one block of them at a time.
template <class Body>
void each_batch(const Scene& scene, const Body& body) {
  parallel_for(ceil_div(scene.gaussians, BLOCK), scene.threads, [&](int64_t block) {
    const int64_t end = std::min((block + 1) * BLOCK, scene.gaussians);
    for (int64_t first = block * BLOCK; first < end; first += LANES) body(first);
  });
}

splat::Camera<Wide> camera_of(const Scene& scene, int64_t v) {
  return splat::make_camera<Wide>(scene.world_to_camera + 16 * v, scene.intrinsics + 9 * v, int(scene.width),
                                  int(scene.height));
}

// ---------------------------------------------------------------------------------------------- project

// The tiles along one axis with pixel centres within ``reach`` of ``centre``, packed as in ``Splat``.
Ints touched_tiles(Floats centre, Floats reach, int64_t tiles, Mask is_seen) {
  const Floats slack = 1e-3f + 1e-6f * (simd::absolute(centre) + reach);  // more than the rounding error
  const auto tile = [&](Floats pixel) {
    return simd::to_ints(simd::min(simd::max(pixel * (1.0f / TILE), Floats{}), spread(float(tiles))));
  };
  const Ints first = tile(centre - reach + 0.5f - slack);
  const Ints end = tile(centre + reach - 0.5f + slack + float(TILE));
  return simd::select(simd::both(is_seen, simd::less(first, end)), first | end << 16, Ints{});
}

void project_batch(const Scene& scene, Frame& frame, int64_t first, float* means2d, float* radii) {
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
    // clang-format off
    const Wide fields[SPLAT_FIELDS] = {
        x, y, footprint.l11, footprint.l12, footprint.l22, shape.log_cut, shape.opacity, footprint.centre[2],
        rgb[0], rgb[1], rgb[2], simd::as_floats(columns), simd::as_floats(rows)};
    // clang-format on
    float radius[LANES], centre[2][LANES];
    simd::store(radius, simd::keep(is_seen, simd::max(reach[0], reach[1])));
    for (int j = 0; j < 2; ++j) simd::store(centre[j], simd::keep(is_seen, fields[j].lanes));
    const int64_t at = v * scene.gaussians + first;
    for (int lane = 0; lane < batch.count; ++lane) {
      char* out = reinterpret_cast<char*>(&frame.splats[at + lane]);
      for (int j = 0; j < SPLAT_FIELDS; ++j)
        std::memcpy(out + 4 * j, reinterpret_cast<const char*>(fields + j) + 4 * lane, 4);
      radii[at + lane] = radius[lane];
      for (int j = 0; j < 2; ++j) means2d[2 * (at + lane) + j] = centre[j][lane];
    }
  }
}

// ---------------------------------------------------------------------------------------------- tile lists

// Stable radix sort of ``order`` by positive depth, least significant digit first. It makes as many passes as
// the depths have differing digits.
void sort_by_depth(std::vector<uint32_t>& order, const Splat* splats) {
  constexpr int BITS = 12, BINS = 1 << BITS;
  struct Item {
    uint32_t key, gaussian;
  };
  const size_t n = order.size();
  if (n == 0) return;
  Buffer<Item> items, swap;
  items.allocate(int64_t(n)), swap.allocate(int64_t(n));
  uint32_t low = UINT32_MAX, high = 0;
  for (size_t i = 0; i < n; ++i) {
    uint32_t key;
    std::memcpy(&key, &splats[order[i]].depth, 4);
    items[int64_t(i)] = {key, order[i]};
    low = std::min(low, key), high = std::max(high, key);
  }
  for (int shift = 0; shift < 32 && (high - low) >> shift > 0; shift += BITS) {
    uint32_t counts[BINS] = {}, sum = 0;
    const auto bin = [&](const Item& item) { return (item.key - low) >> shift & (BINS - 1); };
    for (size_t i = 0; i < n; ++i) ++counts[bin(items[int64_t(i)])];
    for (uint32_t& count : counts) {
      const uint32_t here = count;
      count = sum;
      sum += here;
    }
    for (size_t i = 0; i < n; ++i) swap[counts[bin(items[int64_t(i)])]++] = items[int64_t(i)];
    std::swap(items, swap);
  }
  for (size_t i = 0; i < n; ++i) order[i] = items[int64_t(i)].gaussian;
}

// Computes the depth order of the visible Gaussians, the slots of each, and the start of each tile's list.
void order_view(const Scene& scene, const Frame& frame, View& view, const Splat* splats) {
  const int64_t stride = frame.tiles_x + 1;
  // The change of the list length from one tile to the next, along x and y: each box makes four changes.
  std::vector<int64_t> change(size_t(stride * (frame.tiles_y + 1)), 0);
  view.first_slot.allocate(scene.gaussians + 1);
  view.order.resize(size_t(scene.gaussians));
  uint64_t slots = 0;
  size_t visible = 0;
  for (int64_t i = 0; i < scene.gaussians; ++i) {
    const Range columns = unpack(splats[i].columns), rows = unpack(splats[i].rows);
    view.first_slot[i] = uint32_t(slots);
    view.order[visible] = uint32_t(i);
    visible += rows.size() > 0;
    slots += uint64_t(columns.size()) * rows.size();
    if (slots > UINT32_MAX) throw Status(TOO_LARGE);
    ++change[size_t(rows.first * stride + columns.first)];
    --change[size_t(rows.first * stride + columns.end)];
    --change[size_t(rows.end * stride + columns.first)];
    ++change[size_t(rows.end * stride + columns.end)];
  }
  view.first_slot[scene.gaussians] = uint32_t(slots);
  view.order.resize(visible);
  sort_by_depth(view.order, splats);

  view.first_entry.allocate(frame.tiles() + 1);
  uint32_t entries = 0;
  for (int64_t row = 0; row < frame.tiles_y; ++row) {
    int64_t here = 0;
    for (int64_t column = 0; column < frame.tiles_x; ++column) {
      view.first_entry[row * frame.tiles_x + column] = entries;
      int64_t& along_y = change[size_t(row * stride + column)];
      if (row > 0) along_y += change[size_t((row - 1) * stride + column)];
      here += along_y;
      entries += uint32_t(here);
    }
  }
  view.first_entry[frame.tiles()] = entries;
  view.entries.allocate(entries);
}

// Lists refer to scattered memory, so an item is prefetched ``AHEAD`` places before it is needed.
constexpr int AHEAD = 6;
inline void prefetch(const void* address) {
  __builtin_prefetch(address);
  asm volatile("" : : "r"(address));  // GCC would remove a function that only prefetches
}

// Writes the lists of the tile rows [row_begin, row_end). Near splats come first, so lists are in depth
// order.
void fill_entries(const Frame& frame, View& view, const Splat* splats, int64_t row_begin, int64_t row_end) {
  std::vector<uint32_t> next(size_t((row_end - row_begin) * frame.tiles_x));
  const int64_t first_tile = row_begin * frame.tiles_x;
  for (size_t tile = 0; tile < next.size(); ++tile) next[tile] = view.first_entry[first_tile + int64_t(tile)];
  const size_t n = view.order.size();
  for (size_t nth = 0; nth < n; ++nth) {
    if (nth + AHEAD < n) prefetch(&splats[view.order[nth + AHEAD]].columns);
    const uint32_t i = view.order[nth];
    const Range columns = unpack(splats[i].columns), rows = unpack(splats[i].rows);
    const int64_t from = std::max<int64_t>(rows.first, row_begin), to = std::min<int64_t>(rows.end, row_end);
    for (int64_t row = from; row < to; ++row) {
      uint32_t slot = view.first_slot[i] + uint32_t(row - rows.first) * columns.size();
      uint32_t* const of_row = next.data() + (row - row_begin) * frame.tiles_x;
      for (uint32_t column = columns.first; column < columns.end; ++column)
        view.entries[of_row[column]++] = {i, slot++};
    }
  }
}

void build_tile_lists(const Scene& scene, Frame& frame) {
  std::atomic<int> trouble{OK};  // collects failures, because an exception must not leave a thread
  const auto each = [&](int64_t items, auto&& stage) {
    parallel_for(items, scene.threads, [&](int64_t item) {
      try {
        stage(item);
      } catch (Status status) {
        trouble = status;
      } catch (...) {
        trouble = OUT_OF_MEMORY;
      }
    });
    if (trouble != OK) throw Status(trouble.load());
  };
  const auto splats = [&](int64_t v) { return frame.splats.data() + v * scene.gaussians; };
  each(scene.views, [&](int64_t v) { order_view(scene, frame, frame.views[size_t(v)], splats(v)); });
  const int64_t bands = std::min(
      frame.tiles_y, std::max<int64_t>(ceil_div(scene.threads, std::max<int64_t>(scene.views, 1)), 1));
  each(scene.views * bands, [&](int64_t item) {
    const int64_t v = item / bands, band = item % bands;
    fill_entries(frame, frame.views[size_t(v)], splats(v), band * frame.tiles_y / bands,
                 (band + 1) * frame.tiles_y / bands);
  });
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
bool gather_moments(const View& view, const Batch& batch, const Record* records,
                    splat::Moments<Wide>& moments, Wide (&absolutes)[ABSOLUTES]) {
  if (view.first_slot[batch.first] == view.first_slot[batch.first + batch.count]) return false;
  float sums[RECORD][LANES] = {};
  for (int lane = 0; lane < batch.count; ++lane) {
    const int64_t i = batch.first + lane;
    alignas(64) Record sum{};
    for (uint32_t slot = view.first_slot[i]; slot < view.first_slot[i + 1]; ++slot)
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

// Adds the gradients of LANES Gaussians from the views [view_begin, view_end).
void batch_backward(const Scene& scene, const Frame& frame, int64_t view_begin, int64_t view_end,
                    int64_t first, const Record* const* records, const ParameterGradients& out) {
  const Batch batch(scene, first);
  splat::Shape<Wide> shape;
  const Truths is_sound = splat::make_shape(batch.gaussian, shape);
  splat::Gradient<Wide> total, of_view;
  splat::clear(total, int(scene.coefficients));
  Truths has_any{simd::none()};
  for (int64_t v = view_begin; v < view_end; ++v) {
    const View& view = frame.views[size_t(v)];
    splat::Moments<Wide> moments;
    Wide absolutes[ABSOLUTES];
    if (!gather_moments(view, batch, records[v], moments, absolutes)) continue;
    splat::Footprint<Wide> footprint;
    const Truths is_seen = is_sound & splat::project(batch.gaussian, shape, view.camera, footprint);
    has_any = has_any | is_seen;
    Wide centre[2];
    splat::mean2d_gradient(footprint, moments, centre);
    float* const means2d = out.means2d + 2 * v * scene.gaussians;
    for (int j = 0; j < 2; ++j) batch.add(means2d + j, 2, select(is_seen, centre[j], 0));
    if (out.absgrad) {
      splat::mean2d_absolute(footprint.l11, absolutes, centre);
      float* const absgrad = out.absgrad + 2 * v * scene.gaussians;
      for (int j = 0; j < 2; ++j) batch.add(absgrad + j, 2, select(is_seen, centre[j], 0));
    }
    splat::clear(of_view, int(scene.coefficients));
    splat::project_backward(batch.gaussian, shape, view.camera, footprint, moments, of_view);
    add_where(is_seen, of_view, scene.coefficients, total);
  }
  if (!simd::any(has_any.mask)) return;
  Wide log_scale[3], quat[4];
  splat::shape_backward(shape, batch.gaussian, total, log_scale, quat);
  for (int j = 0; j < 3; ++j) {
    batch.add(out.means + j, 3, total.mean[j]);
    batch.add(out.log_scales + j, 3, select(has_any, log_scale[j], 0));
  }
  for (int j = 0; j < 4; ++j) batch.add(out.quats + j, 4, select(has_any, quat[j], 0));
  batch.add(out.opacity_logits, 1, total.opacity_logit);
  const int64_t stride = 3 * scene.coefficients;
  for (int64_t j = 0; j < stride; ++j) batch.add(out.sh + j, stride, total.sh[j]);
}

// Returns the end of a group of views with records that fit the budget. A group has at least one view.
int64_t group_end(const Scene& scene, const Frame& frame, int64_t begin, int64_t& records) {
  records = 0;
  int64_t v = begin;
  for (; v < scene.views; ++v) {
    const int64_t of_view = frame.views[size_t(v)].first_slot[scene.gaussians];
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
    auto frame = std::make_unique<Frame>();
    frame->tiles_x = ceil_div(scene->width, TILE), frame->tiles_y = ceil_div(scene->height, TILE);
    if (frame->tiles_x > INT16_MAX || frame->tiles_y > INT16_MAX || scene->gaussians >= UINT32_MAX)
      throw Status(TOO_LARGE);
    frame->splats.allocate(scene->views * scene->gaussians);
    frame->views.resize(size_t(scene->views));
    for (int64_t v = 0; v < scene->views; ++v) frame->views[size_t(v)].camera = camera_of(*scene, v);
    each_batch(*scene, [&](int64_t first) { project_batch(*scene, *frame, first, means2d, radii); });
    *out = frame.release();
  });
}

// Blends the images rgb [v h w 3], alpha [v h w] and depth [v h w]. With ``keeps``, stores the data that the
// backward pass needs.
EXPORT int cadam3d_blend(const Scene* scene, void* handle, float* rgb, float* alpha, float* depth,
                         int keeps) {
  return guarded([&] {
    Frame& frame = *static_cast<Frame*>(handle);
    build_tile_lists(*scene, frame);
    if (keeps) {
      for (View& view : frame.views) {
        view.used.allocate(frame.tiles()), view.reached.allocate(view.first_entry[frame.tiles()]);
        view.last.allocate(frame.tiles() * AREA), view.transmittance.allocate(frame.tiles() * AREA);
      }
    }
    const int64_t pixels = scene->height * scene->width;
    parallel_for(scene->views * frame.tiles(), scene->threads, [&](int64_t item) {
      const int64_t v = item / frame.tiles();
      blend_tile(*scene, frame, frame.views[size_t(v)], frame.splats.data() + v * scene->gaussians,
                 item % frame.tiles(), scene->background + 3 * v, rgb + 3 * v * pixels, alpha + v * pixels,
                 depth + v * pixels, keeps != 0);
    });
  });
}

// Adds to gradients that the caller has set to zero. Each image gradient may be null, and so may absgrad:
// then no absolute values are summed. The path through means2d ends in grad_means2d; cadam3d_centre_backward
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
    const int64_t pixels = scene->height * scene->width, tiles = frame.tiles();
    Buffer<Record> records;
    std::vector<Record*> of_view(size_t(scene->views));
    for (int64_t begin = 0, end = 0; begin < scene->views; begin = end) {
      int64_t count = 0;
      end = group_end(*scene, frame, begin, count);
      records.allocate(count);
      for (int64_t v = begin, first = 0; v < end; ++v) {
        of_view[size_t(v)] = records.data() + first;
        first += frame.views[size_t(v)].first_slot[scene->gaussians];
      }
      parallel_for((end - begin) * tiles, scene->threads, [&](int64_t item) {
        const int64_t v = begin + item / tiles;
        const Images images{
            alpha + v * pixels, depth + v * pixels, grad_rgb ? grad_rgb + 3 * v * pixels : nullptr,
            grad_alpha ? grad_alpha + v * pixels : nullptr, grad_depth ? grad_depth + v * pixels : nullptr};
        blend_tile(*scene, frame, frame.views[size_t(v)], frame.splats.data() + v * scene->gaussians,
                   item % tiles, scene->background + 3 * v, images, of_view[size_t(v)]);
      });
      each_batch(*scene, [&](int64_t first) {
        batch_backward(*scene, frame, begin, end, first, of_view.data(), out);
      });
    }
  });
}

// dLoss/dmeans [n 3] through the projected centres, from dLoss/dmeans2d [v n 2]. A culled Gaussian gets zero.
EXPORT int cadam3d_centre_backward(const Scene* scene, const float* radii, const float* grad_means2d,
                                   float* grad_means) {
  return guarded([&] {
    std::vector<splat::Camera<Wide>> cameras;
    for (int64_t v = 0; v < scene->views; ++v) cameras.push_back(camera_of(*scene, v));
    each_batch(*scene, [&](int64_t first) {
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
      for (int j = 0; j < 3; ++j) rows.add(grad_means + j, 3, total[j]);
    });
  });
}

EXPORT void cadam3d_free(void* handle) { delete static_cast<Frame*>(handle); }

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
