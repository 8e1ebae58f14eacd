// The CPU rasterizer: projection, tile lists, blending and their gradients, behind a C interface.
//
// A frame goes through five stages: project every Gaussian into every view; sort each view's visible ones by
// depth; list for each 16x16 tile who touches it, front to back; blend the tiles. Backward walks each tile
// back to front, leaves one record per (splat, tile), sums the records of each Gaussian in a fixed order and
// applies the chain rule. No two threads ever add to the same number, and work is cut into pieces that do not
// depend on how many threads there are: the bits of every result are the same for any thread count.
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

namespace {

using simd::Floats;
using simd::Ints;
using simd::LANES;
using simd::Mask;
using simd::spread;

constexpr int TILE = 16;  // pixels; a row of a tile is a whole number of vectors on every machine
constexpr int AREA = TILE * TILE;
constexpr int GROUPS = TILE / LANES;  // vectors per row of a tile
constexpr int64_t BLOCK = 256;        // Gaussians per piece of work
constexpr int RECORD = 12;  // floats left by the backward per (splat, tile); the last two are padding

// Bytes of records in flight, unless one view needs more; tests set a small one.
#if !defined(SPLAT_RECORD_BUDGET)
#define SPLAT_RECORD_BUDGET (256 << 20)
#endif

enum Status : int { OK = 0, OUT_OF_MEMORY = 1, TOO_LARGE = 2 };

// Mirrored by ``Scene`` in cpu.py: same order, same types.
struct Scene {
  int64_t gaussians, views, coefficients, height, width, threads;
  const float *means, *log_scales, *quats, *opacity_logits, *sh, *world_to_camera, *intrinsics, *background;
};

// What the blend reads of a projected Gaussian: one cache line.
struct alignas(64) Splat {
  float x, y;                 // pixels
  float l11, l12, l22;        // whitening, see splat_math.h
  float cut, opacity, depth;  // alpha = opacity exp(-|y|^2) where |y|^2 <= cut
  float rgb[3];
  float reach_x, reach_y;  // half-sizes of its box; 0 = not seen
  float spare[3];
};

// Memory whose first content does not matter; std::vector would write zeros first.
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

struct Span {
  uint16_t first, end;  // tile columns [first, end) touched in one tile row
};

// What one view keeps between forward and backward.
struct View {
  splat::Camera<double> camera;
  std::vector<uint32_t> order;  // visible Gaussians, near to far
  Buffer<uint32_t> first_span;  // gaussians + 1; spans of Gaussian i: first_span[i] .. first_span[i + 1]
  Buffer<Span> spans;
  Buffer<uint32_t> first_slot;    // spans + 1; one slot per (Gaussian, tile), grouped by Gaussian
  Buffer<uint32_t> rank_of_slot;  // place of that Gaussian in the list of that tile
  Buffer<uint32_t> first_entry;   // tiles + 1
  Buffer<uint32_t> entries;       // Gaussian numbers, tile by tile, near to far
  Buffer<int32_t> used;           // tiles; entries that reached a pixel lie below
  Buffer<float> transmittance;    // tiles x AREA; after the last splat
  Buffer<int32_t> last;           // tiles x AREA; 1 + rank of the last splat that reached the pixel
  Buffer<int64_t> first_record;   // tiles; while the backward runs
};

struct Frame {
  int64_t tiles_x = 0, tiles_y = 0;
  Buffer<Splat> splats;  // views x gaussians
  std::vector<View> views;
  int64_t tiles() const { return tiles_x * tiles_y; }
};

// Runs body(0) .. body(items - 1), each once, on up to ``threads`` threads. Threads live for one call:
// nothing outlives a fork, and starting them costs microseconds.
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
    } catch (...) {  // the system refuses another thread: those at hand do the work
    }
  }
  work();
  for (std::thread& thread : team) thread.join();
}

int64_t ceil_div(int64_t a, int64_t b) { return (a + b - 1) / b; }

splat::Gaussian<double> load_gaussian(const Scene& scene, int64_t i) {
  splat::Gaussian<double> gaussian;
  for (int j = 0; j < 3; ++j) {
    gaussian.mean[j] = scene.means[3 * i + j];
    gaussian.log_scale[j] = scene.log_scales[3 * i + j];
  }
  for (int j = 0; j < 4; ++j) gaussian.quat[j] = scene.quats[4 * i + j];
  gaussian.opacity_logit = scene.opacity_logits[i];
  gaussian.sh = scene.sh + 3 * scene.coefficients * i;
  gaussian.coefficients = int(scene.coefficients);
  return gaussian;
}

// ---------------------------------------------------------------------------------------------- project

void project_gaussian(const Scene& scene, Frame& frame, int64_t i, float* means2d, float* radii) {
  const splat::Gaussian<double> gaussian = load_gaussian(scene, i);
  splat::Shape<double> shape;
  const bool is_sound = splat::make_shape(gaussian, shape);
  for (int64_t v = 0; v < scene.views; ++v) {
    const splat::Camera<double>& camera = frame.views[size_t(v)].camera;
    const int64_t at = v * scene.gaussians + i;
    Splat& out = frame.splats[at];
    splat::Footprint<double> footprint;
    if (!is_sound || !splat::project(gaussian, shape, camera, footprint)) {
      out.reach_x = out.reach_y = radii[at] = means2d[2 * at] = means2d[2 * at + 1] = 0;
      continue;
    }
    double rgb[3];
    splat::colour(gaussian, camera, rgb);
    out.x = float(footprint.mean2d[0]), out.y = float(footprint.mean2d[1]);
    out.l11 = float(footprint.l11), out.l12 = float(footprint.l12), out.l22 = float(footprint.l22);
    out.cut = float(shape.log_cut), out.opacity = float(shape.opacity),
    out.depth = float(footprint.centre[2]);
    for (int c = 0; c < 3; ++c) out.rgb[c] = float(rgb[c]);
    out.reach_x = float(footprint.reach[0]), out.reach_y = float(footprint.reach[1]);
    radii[at] = std::max(out.reach_x, out.reach_y);
    means2d[2 * at] = out.x, means2d[2 * at + 1] = out.y;
  }
}

// ---------------------------------------------------------------------------------------------- tile lists

struct Range {
  int first, last;  // both included; empty if last < first
};

// Pixels whose centres lie in [low, high], widened by more than the rounding of either bound.
Range pixels_between(double low, double high, int64_t size) {
  const double slack = 1e-3 + 1e-6 * (std::fabs(low) + std::fabs(high));
  const double first = std::ceil(low - slack - 0.5), last = std::floor(high + slack - 0.5);
  return {int(std::min(std::max(first, 0.0), double(size))),
          int(std::max(std::min(last, double(size - 1)), -1.0))};
}

Range pixel_rows(const Splat& s, int64_t height) {
  return pixels_between(double(s.y) - s.reach_y, double(s.y) + s.reach_y, height);
}

// The tile columns where the ellipse |L d|^2 <= cut meets the pixel rows [first, last].
Span touched_columns(const Splat& s, Range rows, int64_t width) {
  const double low = rows.first + 0.5 - s.y - 1e-3, high = rows.last + 0.5 - s.y + 1e-3;
  const double slope = -double(s.l12) / s.l11;  // the middle of a row at height d lies at slope * d
  const double extreme = slope * s.reach_y * (double(s.reach_y) / s.reach_x);  // of the rightmost point
  const auto half_width = [&](double d) {
    return std::sqrt(std::max(s.cut - s.l22 * d * s.l22 * d, 0.0)) / s.l11;
  };
  const double right = std::min(std::max(extreme, low), high), left = std::min(std::max(-extreme, low), high);
  const Range columns =
      pixels_between(std::max(slope * left - half_width(left), -double(s.reach_x)) + s.x,
                     std::min(slope * right + half_width(right), double(s.reach_x)) + s.x, width);
  if (columns.last < columns.first) return {0, 0};
  return {uint16_t(columns.first / TILE), uint16_t(columns.last / TILE + 1)};
}

// Stable least-significant-digit radix sort of ``order`` by positive depth.
void sort_by_depth(std::vector<uint32_t>& order, const Splat* splats) {
  constexpr int BITS = 11, BINS = 1 << BITS;
  struct Item {
    uint32_t key, gaussian;
  };
  const size_t n = order.size();
  std::vector<Item> items(n), swap(n);
  std::vector<uint32_t> counts(3 * BINS, 0);
  for (size_t i = 0; i < n; ++i) {
    uint32_t key;
    std::memcpy(&key, &splats[order[i]].depth, 4);
    items[i] = {key, order[i]};
    for (int pass = 0; pass < 3; ++pass)
      ++counts[size_t(pass * BINS) + ((key >> (BITS * pass)) & (BINS - 1))];
  }
  for (int pass = 0; pass < 3; ++pass) {
    uint32_t* count = counts.data() + pass * BINS;
    uint32_t sum = 0;
    for (int bin = 0; bin < BINS; ++bin) {
      const uint32_t here = count[bin];
      count[bin] = sum;
      sum += here;
    }
    for (const Item& item : items) swap[count[(item.key >> (BITS * pass)) & (BINS - 1)]++] = item;
    items.swap(swap);
  }
  for (size_t i = 0; i < n; ++i) order[i] = items[i].gaussian;
}

Range tile_rows(const Splat& s, int64_t height) {
  const Range rows = pixel_rows(s, height);
  return rows.last < rows.first ? Range{0, -1} : Range{rows.first / TILE, rows.last / TILE};
}

// Visible Gaussians in depth order, and room for the spans of each.
void order_view(const Scene& scene, const Frame& frame, View& view, const Splat* splats) {
  view.first_span.allocate(scene.gaussians + 1);
  uint32_t spans = 0;
  for (int64_t i = 0; i < scene.gaussians; ++i) {
    view.first_span[i] = spans;
    if (splats[i].reach_x <= 0) continue;
    const Range rows = tile_rows(splats[i], scene.height);
    if (rows.last < rows.first) continue;
    const uint32_t count = uint32_t(rows.last - rows.first + 1);
    if (spans > UINT32_MAX - count) throw Status(TOO_LARGE);
    spans += count;
    view.order.push_back(uint32_t(i));
  }
  view.first_span[scene.gaussians] = spans;
  view.spans.allocate(spans);
  view.first_slot.allocate(int64_t(spans) + 1);
  view.first_entry.allocate(frame.tiles() + 1);
  sort_by_depth(view.order, splats);
}

void fill_spans(const Scene& scene, View& view, const Splat* splats, int64_t i) {
  const uint32_t begin = view.first_span[i], end = view.first_span[i + 1];
  if (begin == end) return;
  const Range pixels = pixel_rows(splats[i], scene.height);
  for (uint32_t span = begin; span < end; ++span) {
    const int top = (pixels.first / TILE + int(span - begin)) * TILE;
    view.spans[span] = touched_columns(
        splats[i], {std::max(pixels.first, top), std::min(pixels.last, top + TILE - 1)}, scene.width);
  }
}

// How many slots each span needs and where each tile's list starts.
void count_entries(const Scene& scene, const Frame& frame, View& view, const Splat* splats) {
  // By how many the lists grow from one tile to the next in its row.
  std::vector<int64_t> change(size_t(frame.tiles_y * (frame.tiles_x + 1)), 0);
  uint64_t slots = 0;
  for (int64_t i = 0; i < scene.gaussians; ++i) {
    const uint32_t begin = view.first_span[i], end = view.first_span[i + 1];
    if (begin == end) continue;
    int64_t row = tile_rows(splats[i], scene.height).first;
    for (uint32_t span = begin; span < end; ++span, ++row) {
      view.first_slot[span] = uint32_t(slots);
      const Span columns = view.spans[span];
      slots += uint64_t(columns.end - columns.first);
      ++change[size_t(row * (frame.tiles_x + 1) + columns.first)];
      --change[size_t(row * (frame.tiles_x + 1) + columns.end)];
    }
    if (slots > UINT32_MAX) throw Status(TOO_LARGE);
  }
  view.first_slot[view.first_span[scene.gaussians]] = uint32_t(slots);
  uint32_t entries = 0;
  for (int64_t row = 0; row < frame.tiles_y; ++row) {
    int64_t here = 0;
    for (int64_t column = 0; column < frame.tiles_x; ++column) {
      view.first_entry[row * frame.tiles_x + column] = entries;
      here += change[size_t(row * (frame.tiles_x + 1) + column)];
      entries += uint32_t(here);
    }
  }
  view.first_entry[frame.tiles()] = entries;
  view.entries.allocate(int64_t(slots));
  view.rank_of_slot.allocate(int64_t(slots));
}

// Writes the lists of the tile rows [row_begin, row_end): near splats first, so every list is in depth order.
void fill_entries(const Scene& scene, const Frame& frame, View& view, const Splat* splats, int64_t row_begin,
                  int64_t row_end) {
  std::vector<uint32_t> filled(size_t((row_end - row_begin) * frame.tiles_x), 0);
  for (const uint32_t i : view.order) {
    const int64_t first_row = tile_rows(splats[i], scene.height).first;
    const int64_t begin = view.first_span[i], end = view.first_span[i + 1];
    const int64_t from = std::max(first_row, row_begin), to = std::min(first_row + (end - begin), row_end);
    for (int64_t row = from; row < to; ++row) {
      const int64_t span = begin + (row - first_row);
      const Span columns = view.spans[span];
      uint32_t slot = view.first_slot[span];
      for (int64_t column = columns.first; column < columns.end; ++column, ++slot) {
        const uint32_t rank = filled[size_t((row - row_begin) * frame.tiles_x + column)]++;
        view.entries[view.first_entry[row * frame.tiles_x + column] + rank] = i;
        view.rank_of_slot[slot] = rank;
      }
    }
  }
}

void build_tile_lists(const Scene& scene, Frame& frame) {
  const int64_t blocks = ceil_div(scene.gaussians, BLOCK);
  const auto splats = [&](int64_t v) { return frame.splats.data() + v * scene.gaussians; };
  std::atomic<int> trouble{OK};  // an exception must not leave a thread
  const auto each_view = [&](auto&& stage) {
    parallel_for(scene.views, scene.threads, [&](int64_t v) {
      try {
        stage(frame.views[size_t(v)], splats(v));
      } catch (Status status) {
        trouble = status;
      } catch (...) {
        trouble = OUT_OF_MEMORY;
      }
    });
    if (trouble != OK) throw Status(trouble.load());
  };
  each_view([&](View& view, const Splat* of_view) { order_view(scene, frame, view, of_view); });
  parallel_for(scene.views * blocks, scene.threads, [&](int64_t item) {
    const int64_t v = item / blocks, begin = item % blocks * BLOCK;
    for (int64_t i = begin; i < std::min(begin + BLOCK, scene.gaussians); ++i)
      fill_spans(scene, frame.views[size_t(v)], splats(v), i);
  });
  each_view([&](View& view, const Splat* of_view) { count_entries(scene, frame, view, of_view); });
  const int64_t bands = std::min(
      frame.tiles_y, std::max<int64_t>(ceil_div(scene.threads, std::max<int64_t>(scene.views, 1)), 1));
  parallel_for(scene.views * bands, scene.threads, [&](int64_t item) {
    const int64_t v = item / bands, band = item % bands;
    try {
      fill_entries(scene, frame, frame.views[size_t(v)], splats(v), band * frame.tiles_y / bands,
                   (band + 1) * frame.tiles_y / bands);
    } catch (...) {
      trouble = OUT_OF_MEMORY;
    }
  });
  if (trouble != OK) throw Status(trouble.load());
}

// ---------------------------------------------------------------------------------------------- blend

// Where a tile lies in its view and which part of it is inside the image.
struct Place {
  int64_t x, y;       // first pixel
  int columns, rows;  // pixels inside
};

Place place_of(const Scene& scene, const Frame& frame, int64_t tile) {
  const int64_t x = tile % frame.tiles_x * TILE, y = tile / frame.tiles_x * TILE;
  return {x, y, int(std::min<int64_t>(TILE, scene.width - x)),
          int(std::min<int64_t>(TILE, scene.height - y))};
}

// Rows and vectors of a tile inside the box of a splat.
struct Window {
  int row_begin, row_end, group_begin, group_end;
};

inline int clamp_to_tile(float pixel) { return int(std::min(std::max(pixel, 0.0f), float(TILE))); }

inline Window window_of(const Splat& s, float x, float y) {  // centre relative to the tile
  const float slack_x = 1e-3f + 1e-6f * (std::fabs(s.x) + s.reach_x);
  const float slack_y = 1e-3f + 1e-6f * (std::fabs(s.y) + s.reach_y);
  const int top = clamp_to_tile(std::floor(y - s.reach_y - slack_y + 0.5f));
  const int bottom = clamp_to_tile(std::floor(y + s.reach_y + slack_y + 0.5f));
  const int left = clamp_to_tile(std::floor(x - s.reach_x - slack_x + 0.5f));
  const int right = clamp_to_tile(std::floor(x + s.reach_x + slack_x + 0.5f));
  return {top, bottom, left / LANES, (right + LANES - 1) / LANES};
}

struct Columns {
  float x[TILE];
};
constexpr Columns pixel_centres() {
  Columns columns{};
  for (int i = 0; i < TILE; ++i) columns.x[i] = float(i) + 0.5f;
  return columns;
}
constexpr Columns CENTRES = pixel_centres();

// |L d|^2 of a row of pixels. Forward and backward both call it and agree to the last bit on who is skipped.
struct Falloff {
  Floats u, exponent;
};
inline Falloff falloff(Floats dx, Floats l11, Floats u_of_row, Floats t_squared) {
  const Floats u = simd::fma(l11, dx, u_of_row);
  return {u, simd::fma(u, u, t_squared)};
}

// The pixels of one vector, field by field. What a splat touches lies together, and no two fields sit a
// multiple of 4096 bytes apart, which the processor would take for the same address.
struct Cell {
  Floats transmittance, red, green, blue, weight, depth;  // depth: sum w z, in the end the expected z
  Ints last;
};
struct CellBackward {
  Floats transmittance, suffix, red, green, blue, far, depth;  // red .. far: gradients of what a weight adds
  Ints last;
};

// What is needed ``AHEAD`` places later is asked for now: lists point all over memory.
constexpr int AHEAD = 6;
inline void prefetch(const void* address) {
  __builtin_prefetch(address);
  asm volatile("" : : "r"(address));  // GCC takes a function that only prefetches for one that does nothing
}

void blend_tile(const Scene& scene, const Frame& frame, View& view, const Splat* splats, int64_t tile,
                const float* background, float* rgb, float* alpha, float* depth, bool keeps) {
  Cell cells[TILE][GROUPS];
  Mask open[TILE][GROUPS];
  bool row_is_open[TILE];
  const Place place = place_of(scene, frame, tile);
  int open_rows = place.rows;
  for (int row = 0; row < TILE; ++row) {
    row_is_open[row] = row < place.rows;
    for (int group = 0; group < GROUPS; ++group) {
      const Floats x = simd::load(CENTRES.x + group * LANES);
      open[row][group] = row_is_open[row] ? simd::less_equal(x, spread(float(place.columns))) : simd::none();
      cells[row][group] = Cell{};
      cells[row][group].transmittance = spread(1.0f);
    }
  }

  const int64_t begin = view.first_entry[tile], end = view.first_entry[tile + 1];
  const Floats alpha_max = spread(float(SPLAT_ALPHA_MAX)), stop = spread(float(SPLAT_TRANSMITTANCE_MIN));
  for (int64_t entry = begin; entry < end && open_rows > 0; ++entry) {
    if (entry + AHEAD < end) prefetch(splats + view.entries[entry + AHEAD]);
    const Splat& s = splats[view.entries[entry]];
    const float x = s.x - float(place.x), y = s.y - float(place.y);
    const Window window = window_of(s, x, y);
    const Floats centre = spread(x), l11 = spread(s.l11), cut = spread(s.cut), opacity = spread(s.opacity);
    const Floats r = spread(s.rgb[0]), g = spread(s.rgb[1]), b = spread(s.rgb[2]), z = spread(s.depth);
    const Ints mark = spread(int(entry - begin) + 1);
    for (int row = window.row_begin; row < window.row_end; ++row) {
      if (!row_is_open[row]) continue;
      const float dy = (float(row) + 0.5f) - y, t = s.l22 * dy;
      const Floats u_of_row = spread(s.l12 * dy), t_squared = spread(t * t);
      bool has_stopped = false;
      for (int group = window.group_begin; group < window.group_end; ++group) {
        Cell& cell = cells[row][group];
        const Falloff fall =
            falloff(simd::load(CENTRES.x + group * LANES) - centre, l11, u_of_row, t_squared);
        Mask hit = simd::both(simd::less_equal(fall.exponent, cut), open[row][group]);
        if (!simd::any(hit)) continue;
        Floats a = simd::keep(hit, simd::min(opacity * simd::exp_minus(fall.exponent), alpha_max));
        const Floats before = cell.transmittance;
        Floats after = simd::fma(-a, before, before);
        const Mask stops = simd::both(hit, simd::less_equal(after, stop));
        if (simd::any(stops)) {
          open[row][group] = simd::first_only(open[row][group], stops);
          hit = simd::first_only(hit, stops);
          a = simd::keep(hit, a);
          after = simd::fma(-a, before, before);
          has_stopped = true;
        }
        const Floats w = a * before;
        cell.transmittance = after;
        cell.last = simd::select(hit, mark, cell.last);
        cell.red = simd::fma(w, r, cell.red);
        cell.green = simd::fma(w, g, cell.green);
        cell.blue = simd::fma(w, b, cell.blue);
        cell.depth = simd::fma(w, z, cell.depth);
        cell.weight += w;
      }
      if (has_stopped) {
        bool is_open = false;
        for (int group = 0; group < GROUPS; ++group) is_open = is_open || simd::any(open[row][group]);
        row_is_open[row] = is_open;
        open_rows -= !is_open;
      }
    }
  }

  int used = 0;
  for (int row = 0; row < place.rows; ++row) {
    for (int column = 0; column < place.columns; ++column) {
      Cell& cell = cells[row][column / LANES];
      const int lane = column % LANES;
      const int64_t pixel = (place.y + row) * scene.width + place.x + column;
      const float through = cell.transmittance[lane], weight = cell.weight[lane];
      rgb[3 * pixel] = cell.red[lane] + through * background[0];
      rgb[3 * pixel + 1] = cell.green[lane] + through * background[1];
      rgb[3 * pixel + 2] = cell.blue[lane] + through * background[2];
      alpha[pixel] = weight;
      depth[pixel] = weight > 0 ? cell.depth[lane] / weight : 0.0f;
      used = std::max(used, int(cell.last[lane]));
    }
  }
  if (!keeps) return;
  view.used[tile] = used;
  for (int row = 0; row < TILE; ++row) {
    for (int group = 0; group < GROUPS; ++group) {
      const int64_t at = tile * AREA + row * TILE + group * LANES;
      simd::store(&view.transmittance[at], cells[row][group].transmittance);
      simd::store(&view.last[at], cells[row][group].last);
    }
  }
}

struct Images {
  const float *alpha, *depth;                       // what the forward gave
  const float *grad_rgb, *grad_alpha, *grad_depth;  // any may be null, which means zero
};

// Fills the cells; returns how many rows can hold a gradient, and the last rank of each row.
void load_gradients(const Scene& scene, const View& view, int64_t tile, const Place& place,
                    const float* background, const Images& images, CellBackward (&cells)[TILE][GROUPS],
                    int (&row_last)[TILE]) {
  for (int row = 0; row < TILE; ++row) {
    row_last[row] = 0;
    for (int group = 0; group < GROUPS; ++group) {
      const int64_t at = tile * AREA + row * TILE + group * LANES;
      cells[row][group] = CellBackward{};
      cells[row][group].transmittance = simd::load(&view.transmittance[at]);
      cells[row][group].last = simd::load(&view.last[at]);
      for (int lane = 0; lane < LANES; ++lane) row_last[row] = std::max(row_last[row], view.last[at + lane]);
    }
  }
  for (int row = 0; row < place.rows; ++row) {
    for (int column = 0; column < place.columns; ++column) {
      CellBackward& cell = cells[row][column / LANES];
      const int lane = column % LANES;
      const int64_t pixel = (place.y + row) * scene.width + place.x + column;
      float through = images.grad_alpha ? images.grad_alpha[pixel] : 0.0f;
      if (images.grad_rgb) {
        const float* grad = images.grad_rgb + 3 * pixel;
        cell.red[lane] = grad[0], cell.green[lane] = grad[1], cell.blue[lane] = grad[2];
        through -= grad[0] * background[0] + grad[1] * background[1] + grad[2] * background[2];
      }
      const float weight = images.alpha[pixel];
      if (images.grad_depth && weight > 0) cell.far[lane] = images.grad_depth[pixel] / weight;
      cell.depth[lane] = images.depth[pixel];
      cell.suffix[lane] = -cell.transmittance[lane] * through;
    }
  }
}

// Back to front. With w = alpha T the loss sees a pixel through sum w v, where v = rgb . g_rgb +
// (z - D) g_depth / A, and through its final transmittance. ``suffix`` is what lies behind a splat:
// dLoss/dalpha = T v - suffix / (1 - alpha).
void blend_tile_backward(const Scene& scene, const Frame& frame, const View& view, const Splat* splats,
                         int64_t tile, const float* background, const Images& images, float* records) {
  const int used = view.used[tile];
  if (used == 0) return;
  CellBackward cells[TILE][GROUPS];
  int row_last[TILE];
  const Place place = place_of(scene, frame, tile);
  load_gradients(scene, view, tile, place, background, images, cells, row_last);

  const int64_t begin = view.first_entry[tile];
  const Floats alpha_max = spread(float(SPLAT_ALPHA_MAX)), one = spread(1.0f);
  for (int rank = used - 1; rank >= 0; --rank) {
    if (rank >= AHEAD) prefetch(splats + view.entries[begin + rank - AHEAD]);
    const Splat& s = splats[view.entries[begin + rank]];
    const float x = s.x - float(place.x), y = s.y - float(place.y);
    const Window window = window_of(s, x, y);
    const Floats centre = spread(x), l11 = spread(s.l11), cut = spread(s.cut), opacity = spread(s.opacity);
    const Floats r = spread(s.rgb[0]), g = spread(s.rgb[1]), b = spread(s.rgb[2]), z = spread(s.depth);
    const Ints index = spread(rank);
    Floats sum_g{}, sum_gu{}, sum_gt{}, sum_guu{}, sum_gut{}, sum_gtt{};
    Floats sum_red{}, sum_green{}, sum_blue{}, sum_z{};
    for (int row = window.row_begin; row < window.row_end; ++row) {
      if (rank >= row_last[row]) continue;
      const float dy = (float(row) + 0.5f) - y, t = s.l22 * dy;
      const Floats u_of_row = spread(s.l12 * dy), t_squared = spread(t * t), t_of_row = spread(t);
      Floats row_g{}, row_gu{};
      for (int group = window.group_begin; group < window.group_end; ++group) {
        CellBackward& cell = cells[row][group];
        const Falloff fall =
            falloff(simd::load(CENTRES.x + group * LANES) - centre, l11, u_of_row, t_squared);
        const Mask hit = simd::both(simd::less_equal(fall.exponent, cut), simd::less(index, cell.last));
        if (!simd::any(hit)) continue;
        // Lanes that are not hit have alpha 0 from here on: they change nothing, and meet no slow denormals.
        const Floats free = simd::keep(hit, opacity * simd::exp_minus(fall.exponent));
        const Floats a = simd::min(free, alpha_max);
        const Floats after = cell.transmittance, behind = cell.suffix;
        const Floats inverse = one / (one - a), before = after * inverse;
        const Floats w = a * before;
        Floats value = (z - cell.depth) * cell.far;
        value = simd::fma(r, cell.red, simd::fma(g, cell.green, simd::fma(b, cell.blue, value)));
        const Floats g_alpha = simd::fma(before, value, -(behind * inverse));
        const Mask flows = simd::less_equal(free, alpha_max);  // a capped alpha has no gradient
        const Floats g_exponent = simd::keep(flows, -a * g_alpha), gu = g_exponent * fall.u;
        cell.transmittance = before;
        cell.suffix = simd::fma(w, value, behind);
        row_g += g_exponent;
        row_gu += gu;
        sum_guu = simd::fma(gu, fall.u, sum_guu);
        sum_red = simd::fma(w, cell.red, sum_red);
        sum_green = simd::fma(w, cell.green, sum_green);
        sum_blue = simd::fma(w, cell.blue, sum_blue);
        sum_z = simd::fma(w, cell.far, sum_z);
      }
      sum_g += row_g;
      sum_gu += row_gu;
      sum_gt = simd::fma(row_g, t_of_row, sum_gt);
      sum_gut = simd::fma(row_gu, t_of_row, sum_gut);
      sum_gtt = simd::fma(row_g, t_squared, sum_gtt);
    }
    const simd::Quad record[3] = {simd::sums(sum_g, sum_gu, sum_gt, sum_guu),
                                  simd::sums(sum_gut, sum_gtt, sum_red, sum_green),
                                  simd::sums(sum_blue, sum_z, sum_z, sum_z)};
    std::memcpy(records + int64_t(rank) * RECORD, record, sizeof record);
  }
}

// ---------------------------------------------------------------------------------------------- gather

struct ParameterGradients {
  float *means2d, *means, *log_scales, *quats, *opacity_logits, *sh;
};

// Calls visit(record) for the records of one Gaussian in one view, tile row by tile row.
template <class Visit>
void each_record(const Scene& scene, const Frame& frame, const View& view, const Splat& s, int64_t i,
                 const float* records, const Visit& visit) {
  const uint32_t begin = view.first_span[i], end = view.first_span[i + 1];
  if (begin == end) return;
  int64_t row = tile_rows(s, scene.height).first;
  for (uint32_t span = begin; span < end; ++span, ++row) {
    const Span columns = view.spans[span];
    uint32_t slot = view.first_slot[span];
    for (int64_t column = columns.first; column < columns.end; ++column, ++slot) {
      const int64_t tile = row * frame.tiles_x + column, rank = view.rank_of_slot[slot];
      if (rank < view.used[tile]) visit(records + (view.first_record[tile] + rank) * RECORD);
    }
  }
}

// The sum of those records. False if there are none: it reached no pixel.
bool gather(const Scene& scene, const Frame& frame, const View& view, const Splat* splats, int64_t i,
            const float* records, splat::Moments<double>& moments) {
  if (i + AHEAD < scene.gaussians)  // records lie in the order of the tiles: ask for them early
    each_record(scene, frame, view, splats[i + AHEAD], i + AHEAD, records, [](const float* record) {
      prefetch(record);
      prefetch(record + RECORD - 1);
    });
  double sum[RECORD] = {};
  bool has_any = false;
  each_record(scene, frame, view, splats[i], i, records, [&](const float* record) {
    for (int j = 0; j < RECORD; ++j) sum[j] += record[j];
    has_any = true;
  });
  moments = {sum[0], sum[1], sum[2], sum[3], sum[4], sum[5], {sum[6], sum[7], sum[8]}, sum[9]};
  return has_any;
}

// Adds the gradients that the views [view_begin, view_end) give to one Gaussian.
void gaussian_backward(const Scene& scene, const Frame& frame, int64_t view_begin, int64_t view_end,
                       int64_t i, const float* records, const ParameterGradients& out) {
  splat::Gaussian<double> gaussian;
  splat::Shape<double> shape;
  splat::Gradient<double> total;
  bool is_loaded = false;
  for (int64_t v = view_begin; v < view_end; ++v) {
    const View& view = frame.views[size_t(v)];
    splat::Moments<double> moments;
    if (!gather(scene, frame, view, frame.splats.data() + v * scene.gaussians, i, records, moments)) continue;
    if (!is_loaded) {
      gaussian = load_gaussian(scene, i);
      if (!splat::make_shape(gaussian, shape)) return;  // never: the same numbers were sound in the forward
      splat::clear(total, gaussian.coefficients);
      is_loaded = true;
    }
    splat::Footprint<double> footprint;
    if (!splat::project(gaussian, shape, view.camera, footprint)) continue;  // never, likewise
    double centre[2];
    splat::mean2d_gradient(footprint, moments, centre);
    for (int j = 0; j < 2; ++j) out.means2d[2 * (v * scene.gaussians + i) + j] = float(centre[j]);
    splat::project_backward(gaussian, shape, view.camera, footprint, moments, total);
  }
  if (!is_loaded) return;
  double log_scale[3], quat[4];
  splat::shape_backward(shape, gaussian, total, log_scale, quat);
  for (int j = 0; j < 3; ++j) {
    out.means[3 * i + j] += float(total.mean[j]);
    out.log_scales[3 * i + j] += float(log_scale[j]);
  }
  for (int j = 0; j < 4; ++j) out.quats[4 * i + j] += float(quat[j]);
  out.opacity_logits[i] += float(total.opacity_logit);
  float* sh = out.sh + 3 * scene.coefficients * i;
  for (int64_t j = 0; j < 3 * scene.coefficients; ++j) sh[j] += float(total.sh[j]);
}

// Views are taken in groups whose records fit the budget, at least one at a time.
int64_t group_end(Frame& frame, int64_t begin, int64_t& records) {
  records = 0;
  int64_t v = begin;
  for (; v < int64_t(frame.views.size()); ++v) {
    View& view = frame.views[size_t(v)];
    int64_t of_view = 0;
    for (int64_t tile = 0; tile < frame.tiles(); ++tile) of_view += view.used[tile];
    if (v > begin && (records + of_view) * RECORD * int64_t(sizeof(float)) > SPLAT_RECORD_BUDGET) break;
    for (int64_t tile = 0; tile < frame.tiles(); ++tile) {
      view.first_record[tile] = records;
      records += view.used[tile];
    }
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
// Every tensor is contiguous float32 in the shape the Python side gives it. Functions return a Status.

EXPORT const char* cadam3d_instruction_set() { return SIMD_NAME; }

// Projects, and creates the frame that the other calls need. means2d [v n 2], radii [v n].
EXPORT int cadam3d_project(const Scene* scene, float* means2d, float* radii, void** out) {
  return guarded([&] {
    auto frame = std::make_unique<Frame>();
    frame->tiles_x = ceil_div(scene->width, TILE), frame->tiles_y = ceil_div(scene->height, TILE);
    if (frame->tiles_x > UINT16_MAX || frame->tiles_y > UINT16_MAX || scene->gaussians >= UINT32_MAX)
      throw Status(TOO_LARGE);
    frame->splats.allocate(scene->views * scene->gaussians);
    frame->views.resize(size_t(scene->views));
    for (int64_t v = 0; v < scene->views; ++v)
      frame->views[size_t(v)].camera = splat::make_camera<double>(
          scene->world_to_camera + 16 * v, scene->intrinsics + 9 * v, int(scene->width), int(scene->height));
    parallel_for(ceil_div(scene->gaussians, BLOCK), scene->threads, [&](int64_t block) {
      for (int64_t i = block * BLOCK; i < std::min((block + 1) * BLOCK, scene->gaussians); ++i)
        project_gaussian(*scene, *frame, i, means2d, radii);
    });
    *out = frame.release();
  });
}

// Blends. rgb [v h w 3], alpha [v h w], depth [v h w]; ``keeps`` stores what the backward needs.
EXPORT int cadam3d_blend(const Scene* scene, void* handle, float* rgb, float* alpha, float* depth,
                         int keeps) {
  return guarded([&] {
    Frame& frame = *static_cast<Frame*>(handle);
    build_tile_lists(*scene, frame);
    if (keeps) {
      for (View& view : frame.views) {
        view.used.allocate(frame.tiles()), view.first_record.allocate(frame.tiles());
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

// Adds to gradients that come zeroed; each image gradient may be null. The path through means2d is left to
// cadam3d_centre_backward: here it only arrives in grad_means2d.
EXPORT int cadam3d_blend_backward(const Scene* scene, void* handle, const float* alpha, const float* depth,
                                  const float* grad_rgb, const float* grad_alpha, const float* grad_depth,
                                  float* grad_means2d, float* grad_means, float* grad_log_scales,
                                  float* grad_quats, float* grad_opacity_logits, float* grad_sh) {
  return guarded([&] {
    Frame& frame = *static_cast<Frame*>(handle);
    const ParameterGradients out{grad_means2d, grad_means,          grad_log_scales,
                                 grad_quats,   grad_opacity_logits, grad_sh};
    const int64_t pixels = scene->height * scene->width, tiles = frame.tiles();
    Buffer<float> records;
    for (int64_t begin = 0, end = 0; begin < scene->views; begin = end) {
      int64_t count = 0;
      end = group_end(frame, begin, count);
      records.allocate(count * RECORD);
      parallel_for((end - begin) * tiles, scene->threads, [&](int64_t item) {
        const int64_t v = begin + item / tiles, tile = item % tiles;
        const View& view = frame.views[size_t(v)];
        const Images images{
            alpha + v * pixels, depth + v * pixels, grad_rgb ? grad_rgb + 3 * v * pixels : nullptr,
            grad_alpha ? grad_alpha + v * pixels : nullptr, grad_depth ? grad_depth + v * pixels : nullptr};
        blend_tile_backward(*scene, frame, view, frame.splats.data() + v * scene->gaussians, tile,
                            scene->background + 3 * v, images,
                            records.data() + view.first_record[tile] * RECORD);
      });
      parallel_for(ceil_div(scene->gaussians, BLOCK), scene->threads, [&](int64_t block) {
        for (int64_t i = block * BLOCK; i < std::min((block + 1) * BLOCK, scene->gaussians); ++i)
          gaussian_backward(*scene, frame, begin, end, i, records.data(), out);
      });
    }
  });
}

// dLoss/dmeans [n 3] through the projected centres, from dLoss/dmeans2d [v n 2]; a culled Gaussian gets none.
EXPORT int cadam3d_centre_backward(const Scene* scene, const float* radii, const float* grad_means2d,
                                   float* grad_means) {
  return guarded([&] {
    std::vector<splat::Camera<double>> cameras;
    for (int64_t v = 0; v < scene->views; ++v)
      cameras.push_back(splat::make_camera<double>(scene->world_to_camera + 16 * v, scene->intrinsics + 9 * v,
                                                   int(scene->width), int(scene->height)));
    parallel_for(ceil_div(scene->gaussians, BLOCK), scene->threads, [&](int64_t block) {
      for (int64_t i = block * BLOCK; i < std::min((block + 1) * BLOCK, scene->gaussians); ++i) {
        const double mean[3] = {scene->means[3 * i], scene->means[3 * i + 1], scene->means[3 * i + 2]};
        double total[3] = {};
        for (int64_t v = 0; v < scene->views; ++v) {
          const int64_t at = v * scene->gaussians + i;
          if (!(radii[at] > 0)) continue;
          const double gradient[2] = {grad_means2d[2 * at], grad_means2d[2 * at + 1]};
          splat::centre_backward(cameras[size_t(v)], mean, gradient, total);
        }
        for (int j = 0; j < 3; ++j) grad_means[3 * i + j] = float(total[j]);
      }
    });
  });
}

EXPORT void cadam3d_free(void* handle) { delete static_cast<Frame*>(handle); }

// 0 if this machine can run the compiled code: one splat through every stage, forward and backward.
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
                                    gradients, gradients + 2, gradients + 5, gradients + 8, gradients + 12,
                                    gradients + 13);
  cadam3d_free(frame);
  return status == OK && alpha[210] > 0.5f && std::fabs(depth[210] - 2) < 1e-3f && gradients[13] > 0 ? 0 : 1;
}
