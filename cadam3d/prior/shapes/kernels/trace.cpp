// The ray tracer of the embedded prior: from rays to the light and the coverage of every pixel, in one pass.
//
// This is ``tracer.py`` for vectors of rays. A vector holds LANES neighbouring samples, which mostly hit the
// same parts after the same number of steps. Everything that decides where a ray hits, and how much light is
// there, uses the same IEEE operations in the same order as ``tracer.py`` and ``solids.py``, so both find the
// same bits. Only atan2, asin and the matrix product with the spots, which place the borders of patterns, may
// differ in their last bits.
//
// A piece of work is a band of rows of pixels of one view. The bands do not depend on the number of threads,
// and no two of them write to the same pixel. Therefore any number of threads gives the same bits.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <limits>
#include <new>
#include <thread>
#include <vector>

#include "simd.h"

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

namespace {

using simd::absolute;
using simd::any;
using simd::bits;
using simd::both;
using simd::either;
using simd::first_only;
using simd::Floats;
using simd::greater;
using simd::Ints;
using simd::LANES;
using simd::less_equal;
using simd::Mask;
using simd::max;
using simd::min;
using simd::select;
using simd::spread;

constexpr float INF = std::numeric_limits<float>::infinity();
constexpr double PI = 3.14159265358979323846;
// A vector holds a block of samples with these sides.
constexpr int BLOCK_ROWS = LANES == 4 ? 2 : LANES == 8 ? 2 : 4, BLOCK_COLUMNS = LANES / BLOCK_ROWS;
// Rows of pixels in a piece of work. Blocks of samples never cross the border between two pieces.
constexpr int BAND = 4;
static_assert(BAND % BLOCK_ROWS == 0, "a band is a whole number of blocks");
// A part that a ray enters this far behind the nearest hit cannot be nearer: rounding moves a ray by less.
constexpr float BEHIND = 1e-2f;  // world units

enum Status : int { OK = 0, OUT_OF_MEMORY = 1 };

// Mirrored by ``_Job`` in native_tracer.py: same order, same types.
struct Job {
  int64_t views, height, width, samples, parts, paints, threads;
  const float *origins, *to_world;                  // views x 3, views x 3 x 3
  const float *starts, *centres;                    // views x parts x 3: origins and balls, as seen from each
  const float* least;                               // views x parts
  const float *to_local, *sizes, *low, *high;       // parts x 3 x 3, x 4, x 3, x 3
  const int64_t *kinds, *patterns, *part_paints;    // parts, parts, parts x 2
  const float *light, *spots;                       // 3, SPOTS x 3; unit vectors
  float *alpha, *layers;                            // views x height x width (x paints), zero at first
};

// ------------------------------------------------------------------------------------- vectors

struct Vec {
  Floats x, y, z;
};

inline Floats dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Floats dot(const float* a, Vec b) { return a[0] * b.x + a[1] * b.y + a[2] * b.z; }
inline Floats inverse_root(Floats x) { return 1.0f / simd::root(x); }
// ``root`` of solids.py.
inline Floats root(Floats x) { return x * inverse_root(max(x, spread(1e-30f))); }
inline Floats length(Floats x, Floats y) { return root(x * x + y * y); }
inline Vec unit(Vec a) {
  const Floats scale = inverse_root(max(dot(a, a), spread(1e-30f)));
  return {a.x * scale, a.y * scale, a.z * scale};
}
// The matrix has rows of three.
inline Vec product(const float* m, Vec a) { return {dot(m, a), dot(m + 3, a), dot(m + 6, a)}; }
inline Vec transposed_product(const float* m, Vec a) {
  return {m[0] * a.x + m[3] * a.y + m[6] * a.z, m[1] * a.x + m[4] * a.y + m[7] * a.z,
          m[2] * a.x + m[5] * a.y + m[8] * a.z};
}
inline Floats floor(Floats x) {
  const Floats whole = simd::to_floats(simd::to_ints(x));
  return select(greater(whole, x), whole - 1.0f, whole);
}

// The angle of (x, y) in radians, with an error of a few units in the last place; 0 for (0, 0). The
// polynomial is the minimax approximation of atan(a) / a in a^2 for a up to tan(pi / 8) (Lawson).
inline Floats atan2(Floats y, Floats x) {
  const Floats wide = absolute(x), high = absolute(y), largest = max(wide, high);
  const Floats ratio = min(wide, high) / select(greater(largest, Floats{}), largest, spread(1.0f));
  const Mask is_steep = greater(ratio, spread(0.414213562f));
  const Floats a = select(is_steep, (ratio - 1.0f) / (ratio + 1.0f), ratio), square = a * a;
  Floats p = spread(-0.0603479046f);
  p = simd::fma(p, square, spread(0.105734798f));
  p = simd::fma(p, square, spread(-0.14240083f));
  p = simd::fma(p, square, spread(0.199982169f));
  p = simd::fma(p, square, spread(-0.333333076f));
  Floats angle = simd::fma(p * square, a, a);
  angle = select(is_steep, angle + float(PI / 4), angle);
  angle = select(greater(high, wide), float(PI / 2) - angle, angle);
  angle = select(greater(Floats{}, x), float(PI) - angle, angle);
  return select(greater(Floats{}, y), -angle, angle);
}
inline Floats asin(Floats x) { return atan2(x, simd::root((1.0f - x) * (1.0f + x))); }

// ------------------------------------------------------------------------------------- solids
// See solids.py. A constructor computes what depends on the sizes alone.

struct Ball {
  float radius;
  explicit Ball(const float* size) : radius(size[0]) {}
  Floats operator()(Vec p) const { return root(dot(p, p)) - radius; }
};

struct Box {
  const float* half;
  explicit Box(const float* size) : half(size) {}
  Floats operator()(Vec p) const {
    return max(max(absolute(p.x) - half[0], absolute(p.y) - half[1]), absolute(p.z) - half[2]);
  }
};

struct Frustum {
  float middle, half, slope, scale;
  explicit Frustum(const float* size)
      : middle((size[0] + size[1]) / 2), half(size[2]), slope((size[0] - size[1]) / (2 * half)),
        scale(1.0f / std::sqrt(1.0f + slope * slope)) {}
  Floats operator()(Vec p) const {
    const Floats side = (length(p.x, p.y) - middle + slope * p.z) * scale;
    return max(side, absolute(p.z) - half);
  }
};

struct Tube {
  float middle, thickness, half;
  explicit Tube(const float* size)
      : middle((size[0] + size[1]) / 2), thickness((size[0] - size[1]) / 2), half(size[2]) {}
  Floats operator()(Vec p) const {
    return max(absolute(length(p.x, p.y) - middle) - thickness, absolute(p.z) - half);
  }
};

struct Torus {
  float ring, pipe;
  explicit Torus(const float* size) : ring(size[0]), pipe(size[1]) {}
  Floats operator()(Vec p) const { return length(length(p.x, p.y) - ring, p.z) - pipe; }
};

struct Arc {
  float ring, pipe, sine, cosine;
  explicit Arc(const float* size) : ring(size[0]), pipe(size[1]), sine(size[2]), cosine(size[3]) {}
  Floats operator()(Vec p) const {
    const Floats x = absolute(p.x), away = length(x, p.y) - ring;
    const Floats dx = x - ring * sine, dy = p.y - ring * cosine;
    const Mask is_beyond = greater(x * cosine, p.y * sine);
    return root(select(is_beyond, dx * dx + dy * dy, away * away) + p.z * p.z) - pipe;
  }
};

struct Capsule {
  float radius, half;
  explicit Capsule(const float* size) : radius(size[0]), half(size[1]) {}
  Floats operator()(Vec p) const {
    const Floats beyond = max(absolute(p.z) - half, Floats{});
    return root(p.x * p.x + p.y * p.y + beyond * beyond) - radius;
  }
};

struct Star {
  float outer, half, edge_x, edge_y, scale, cosines[2], sines[2];
  explicit Star(const float* size) : outer(size[0]), half(size[2]) {
    constexpr double sector = PI / TRACE_STAR_POINTS;
    edge_x = size[1] * float(std::cos(sector)) - size[0];
    edge_y = size[1] * float(std::sin(sector));
    scale = 1.0f / std::sqrt(edge_x * edge_x + edge_y * edge_y);
    for (int i = 0; i < 2; ++i) {
      const double angle = i == 0 ? 3 * sector : sector;
      cosines[i] = float(std::cos(angle));
      sines[i] = float(std::sin(angle));
    }
  }
  Floats operator()(Vec p) const {
    Floats across = absolute(p.y), along = p.z;
    for (int i = 0; i < 2; ++i) {
      const Floats beyond = 2.0f * max(across * cosines[i] - along * sines[i], Floats{});
      across = across - beyond * cosines[i];
      along = along + beyond * sines[i];
    }
    const Floats side = edge_y * (along - outer) - edge_x * absolute(across);
    return max(side * scale, absolute(p.x) - half);
  }
};

struct Pyramid {
  explicit Pyramid(const float*) {}
  Floats operator()(Vec p) const {
    const Floats side = (2.0f * max(absolute(p.x), absolute(p.y)) + p.z - 1.0f) * float(1 / std::sqrt(5.0));
    return max(side, -1.0f - p.z);
  }
};

struct Gable {
  explicit Gable(const float*) {}
  Floats operator()(Vec p) const {
    const Floats slope = (2.0f * absolute(p.y) + p.z - 1.0f) * float(1 / std::sqrt(5.0));
    return max(max(slope, absolute(p.x) - 1.0f), -1.0f - p.z);
  }
};

struct Tetrahedron {
  explicit Tetrahedron(const float*) {}
  Floats operator()(Vec p) const {
    const Floats rise = p.z * float(1.0 / 3);
    const Floats sides = p.x * float(std::sqrt(2.0) / 3) +
                         absolute(p.y) * float(std::sqrt(2.0) / std::sqrt(3.0)) + rise;
    return max(max(sides, rise - p.x * float(2 * std::sqrt(2.0) / 3)), -p.z) - float(1.0 / 3);
  }
};

struct Octahedron {
  explicit Octahedron(const float*) {}
  Floats operator()(Vec p) const {
    return (absolute(p.x) + absolute(p.y) + absolute(p.z) - 1.0f) * float(1 / std::sqrt(3.0));
  }
};

// Calls ``body`` with the distance function of a part.
template <class Body>
inline void with_solid(const Job& job, int64_t part, const Body& body) {
  const float* size = job.sizes + 4 * part;
  switch (job.kinds[part]) {
    case TRACE_KIND_BALL: return body(Ball(size));
    case TRACE_KIND_BOX: return body(Box(size));
    case TRACE_KIND_FRUSTUM: return body(Frustum(size));
    case TRACE_KIND_TUBE: return body(Tube(size));
    case TRACE_KIND_TORUS: return body(Torus(size));
    case TRACE_KIND_ARC: return body(Arc(size));
    case TRACE_KIND_CAPSULE: return body(Capsule(size));
    case TRACE_KIND_STAR: return body(Star(size));
    case TRACE_KIND_PYRAMID: return body(Pyramid(size));
    case TRACE_KIND_GABLE: return body(Gable(size));
    case TRACE_KIND_TETRAHEDRON: return body(Tetrahedron(size));
    case TRACE_KIND_OCTAHEDRON: return body(Octahedron(size));
  }
}

// ------------------------------------------------------------------------------------- hits

// The nearest hit of each lane so far; part -1 means none.
struct Nearest {
  Floats reached = spread(INF);
  Ints part = spread(-1);

  // Beyond this, no hit can be nearer. A ray that begins inside solids, at NEAR, moves back to their surface.
  Floats limit() const { return max(reached, spread(float(TRACE_NEAR))) + BEHIND; }
};

struct Interval {
  Floats begin, end;
};

inline Interval box_interval(const float* low, const float* high, Vec origin, Vec direction) {
  const Floats tiny = spread(1e-12f);
  const auto inverse = [&](Floats d) { return 1.0f / select(greater(tiny, absolute(d)), tiny, d); };
  const Vec by{inverse(direction.x), inverse(direction.y), inverse(direction.z)};
  const Vec first{(low[0] - origin.x) * by.x, (low[1] - origin.y) * by.y, (low[2] - origin.z) * by.z};
  const Vec second{(high[0] - origin.x) * by.x, (high[1] - origin.y) * by.y, (high[2] - origin.z) * by.z};
  const Floats begin = max(max(min(first.x, second.x), min(first.y, second.y)), min(first.z, second.z));
  const Floats end = min(min(max(first.x, second.x), max(first.y, second.y)), max(first.z, second.z));
  return {max(begin, spread(float(TRACE_NEAR))), end + float(TRACE_HIT_DISTANCE)};
}

// Moves the lanes in ``alive`` to the surface of a part, and updates the nearest hits.
template <class Solid>
inline void march(const Solid& distance, int64_t part, Vec origin, Vec direction, Interval inside, Mask alive,
                  Nearest& nearest) {
  const Floats speed = inverse_root(dot(direction, direction)), limit = nearest.limit();
  Floats t = inside.begin;
  for (int step = 0; step < TRACE_MARCH_STEPS; step += TRACE_COMPACT_EVERY) {
    Floats advance;
    for (int i = 0; i < TRACE_COMPACT_EVERY; ++i) {
      const Vec p{origin.x + t * direction.x, origin.y + t * direction.y, origin.z + t * direction.z};
      advance = distance(p) * speed;
      t = t + advance;
    }
    const bool is_last = step + TRACE_COMPACT_EVERY == TRACE_MARCH_STEPS;
    const Floats close = spread(float(is_last ? TRACE_GRAZE_DISTANCE : TRACE_HIT_DISTANCE));
    const Mask is_hit = both(both(greater(close, advance), less_equal(t, inside.end)), alive);
    // If a ray hits two parts at the same point, the later part is chosen.
    const Mask is_nearest = both(is_hit, less_equal(t, nearest.reached));
    nearest.reached = select(is_nearest, t, nearest.reached);
    nearest.part = select(is_nearest, spread(int(part)), nearest.part);
    alive = first_only(both(alive, both(greater(inside.end, t), less_equal(t, limit))), is_hit);
    if (!any(alive)) return;
  }
}

inline Nearest first_hits(const Job& job, int64_t view, Vec direction, Mask is_inside) {
  Nearest nearest;
  for (int64_t part = 0; part < job.parts; ++part) {
    const int64_t pair = view * job.parts + part;
    const Floats towards = dot(job.centres + 3 * pair, direction);
    Mask alive = both(is_inside, less_equal(spread(job.least[pair]), towards));
    if (!any(alive)) continue;
    const float* start = job.starts + 3 * pair;
    const Vec origin{spread(start[0]), spread(start[1]), spread(start[2])};
    const Vec local = product(job.to_local + 9 * part, direction);
    const Interval inside = box_interval(job.low + 3 * part, job.high + 3 * part, origin, local);
    alive = both(alive, greater(inside.end, inside.begin));
    alive = both(alive, less_equal(inside.begin, nearest.limit()));
    if (!any(alive)) continue;
    with_solid(job, part, [&](const auto& distance) {
      march(distance, part, origin, local, inside, alive, nearest);
    });
  }
  return nearest;
}

// ------------------------------------------------------------------------------------- light and paint

inline Mask is_odd(Ints x) { return simd::less(Ints{}, x & 1); }
inline Mask is_odd(Floats x) { return is_odd(simd::to_ints(floor(x))); }
inline Mask is_odd_sum(Floats x, Floats y) { return is_odd(simd::to_ints(floor(x) + floor(y))); }

template <class Solid>
inline Vec gradient(const Solid& distance, Vec p) {
  constexpr float step = float(TRACE_NORMAL_STEP);
  const Floats a = distance({p.x + step, p.y + step, p.z + step});
  const Floats b = distance({p.x + step, p.y - step, p.z - step});
  const Floats c = distance({p.x - step, p.y + step, p.z - step});
  const Floats d = distance({p.x - step, p.y - step, p.z + step});
  return {a + b - c - d, a - b + c - d, a - b - c + d};
}

// Both angles are in half turns, in [-1, 1].
inline Mask ring_pattern(int64_t pattern, Floats turn, Floats roll) {
  if (pattern == TRACE_PATTERN_STRIPED) return is_odd((turn + 1.0f) * 8.0f);
  if (pattern == TRACE_PATTERN_CHECKERED) return is_odd_sum((turn + 1.0f) * 7.0f, (roll + 1.0f) * 4.0f);
  const Floats along = (turn + 1.0f) * 6.0f, column = floor(along);
  Floats around = (roll + 1.0f) * 2.0f;
  around = around + 0.5f * select(is_odd(column), spread(1.0f), Floats{});
  const Floats x = along - column - 0.5f, y = around - floor(around) - 0.5f;
  return greater(spread(0.09f), x * x + y * y);
}

// Returns whether each point has the second colour of its pattern.
inline Mask paint_second(const Job& job, int64_t part, Vec p) {
  const int64_t pattern = job.patterns[part], kind = job.kinds[part];
  if (pattern == TRACE_PATTERN_PLAIN) return simd::none();
  if (kind == TRACE_KIND_TORUS || kind == TRACE_KIND_ARC) {
    const Floats across = length(p.x, p.y) - job.sizes[4 * part];
    return ring_pattern(pattern, atan2(p.y, p.x) / float(PI), atan2(p.z, across) / float(PI));
  }
  const float *low = job.low + 3 * part, *high = job.high + 3 * part;
  const auto scaled = [&](Floats x, int axis) {
    return (x - (high[axis] + low[axis]) / 2) / ((high[axis] - low[axis]) / 2);
  };
  const Vec in_box{scaled(p.x, 0), scaled(p.y, 1), scaled(p.z, 2)};  // in [-1, 1]
  if (pattern == TRACE_PATTERN_SPOTTED) {
    const Vec towards = unit(in_box);
    Floats nearest = spread(-1.0f);
    for (int spot = 0; spot < TRACE_SPOTS; ++spot) nearest = max(nearest, dot(job.spots + 3 * spot, towards));
    return greater(nearest, spread(float(TRACE_SPOT_COSINE)));
  }
  const bool is_round = kind == TRACE_KIND_BALL || kind == TRACE_KIND_FRUSTUM || kind == TRACE_KIND_TUBE ||
                        kind == TRACE_KIND_CAPSULE;
  if (!is_round) {
    const Vec inner{0.999f * in_box.x, 0.999f * in_box.y, 0.999f * in_box.z};
    if (pattern == TRACE_PATTERN_STRIPED) return is_odd((inner.z + 1.0f) * 3.0f);
    const auto cell = [](Floats x) { return floor((x + 1.0f) * 2.0f); };
    return is_odd(simd::to_ints(cell(inner.x) + cell(inner.y) + cell(inner.z)));
  }
  Floats band;
  if (kind == TRACE_KIND_BALL) {
    band = 3.0f * asin(min(max(in_box.z, spread(-1.0f)), spread(1.0f))) / float(PI / 2);
  } else {
    const Floats across = min(length(in_box.x, in_box.y), spread(1.0f));
    const float rise = (high[2] - low[2]) / 2;
    const float reach = std::fmax((high[0] - low[0]) / 2, (high[1] - low[1]) / 2);
    band = 4.0f * (in_box.z * rise + (1.0f - across) * reach) / (reach + rise);
  }
  if (pattern == TRACE_PATTERN_STRIPED) return is_odd(band);
  return is_odd_sum(band, 4.0f * (atan2(p.y, p.x) / float(PI)) + 4.0f);
}

// The light, and the column of the paint, of the visible point of each lane that hits something.
struct Shade {
  Floats light;
  Ints paint;
};

inline Shade shade(const Job& job, int64_t view, Vec direction, const Nearest& nearest, unsigned hits) {
  Shade result{Floats{}, Ints{}};
  int parts[LANES];
  simd::store(parts, nearest.part);
  for (unsigned left = hits; left;) {
    const int64_t part = parts[__builtin_ctz(left)];
    const Ints number = spread(int(part));
    // Neither is less than the other.
    const Mask others = either(simd::less(nearest.part, number), simd::less(number, nearest.part));
    left &= bits(others);
    const float *start = job.starts + 3 * (view * job.parts + part), *to_local = job.to_local + 9 * part;
    const Vec local = product(to_local, direction);
    const Vec p{start[0] + nearest.reached * local.x, start[1] + nearest.reached * local.y,
                start[2] + nearest.reached * local.z};
    Vec normal{};
    with_solid(job, part, [&](const auto& distance) { normal = gradient(distance, p); });
    // A normal is mapped to the world by the transposed inverse of the matrix that maps points.
    normal = unit(transposed_product(to_local, normal));
    const Floats towards_light = (dot(job.light, normal) + float(TRACE_WRAP)) / float(1 + TRACE_WRAP);
    const Floats light = float(TRACE_AMBIENT) + float(TRACE_SKY) * (0.5f + 0.5f * normal.z) +
                         float(TRACE_DIFFUSE) * max(towards_light, Floats{});
    const int64_t* paints = job.part_paints + 2 * part;
    const Ints paint = select(paint_second(job, part, p), spread(int(paints[1])), spread(int(paints[0])));
    result.light = select(others, result.light, light);
    result.paint = select(others, result.paint, paint);
  }
  return result;
}

// ------------------------------------------------------------------------------------- pixels

// The places of the lanes within a block of samples.
struct Block {
  Floats rows, columns;
  Block() {
    for (int lane = 0; lane < LANES; ++lane) {
      rows[lane] = float(lane / BLOCK_COLUMNS);
      columns[lane] = float(lane % BLOCK_COLUMNS);
    }
  }
};

void trace_band(const Job& job, int64_t view, int64_t first_row) {
  const Block block;
  const int64_t samples = job.samples, columns = job.width * samples;
  const int64_t begin = first_row * samples, end = std::min(first_row + BAND, job.height) * samples;
  const float* m = job.to_world + 9 * view;
  const float* o = job.origins + 3 * view;
  const Vec origin{spread(o[0]), spread(o[1]), spread(o[2])};
  const Floats square = dot(origin, origin);
  const float share = float(1.0 / double(samples * samples));
  for (int64_t row = begin; row < end; row += BLOCK_ROWS) {
    const Floats rows = block.rows + float(row), y = rows + 0.5f;
    for (int64_t column = 0; column < columns; column += BLOCK_COLUMNS) {
      const Floats of_lane = block.columns + float(column), x = of_lane + 0.5f;
      const Vec direction = unit(
          {m[0] * x + m[1] * y + m[2], m[3] * x + m[4] * y + m[5], m[6] * x + m[7] * y + m[8]});
      const Floats along = min(dot(o, direction), Floats{}), apart = square - along * along;
      Mask is_inside = less_equal(apart, spread(float(TRACE_BALL_RADIUS * TRACE_BALL_RADIUS)));
      is_inside = both(is_inside, greater(spread(float(end)), rows));
      is_inside = both(is_inside, greater(spread(float(columns)), of_lane));
      if (!any(is_inside)) continue;
      const Nearest nearest = first_hits(job, view, direction, is_inside);
      const unsigned hits = bits(simd::less(spread(-1), nearest.part));
      if (!hits) continue;
      const Shade shaded = shade(job, view, direction, nearest, hits);
      float sent[LANES];
      int paint[LANES];
      simd::store(sent, shaded.light * share);
      simd::store(paint, shaded.paint);
      for (unsigned left = hits; left; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        const int64_t at = (view * job.height + (row + lane / BLOCK_COLUMNS) / samples) * job.width +
                           (column + lane % BLOCK_COLUMNS) / samples;
        job.alpha[at] += share;
        job.layers[at * job.paints + paint[lane]] += sent[lane];
      }
    }
  }
  // The rounded shares of a pixel may add up to slightly more than one.
  const int64_t count = std::min<int64_t>(BAND, job.height - first_row);
  const int64_t first = view * job.height + first_row;
  for (int64_t at = first * job.width; at < (first + count) * job.width; ++at) {
    job.alpha[at] = std::fmin(job.alpha[at], 1.0f);
  }
}

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

}  // namespace

EXPORT int cadam3d_trace(const Job* job) {
  const int64_t bands = (job->height + BAND - 1) / BAND;
  try {
    parallel_for(job->views * bands, job->threads,
                 [&](int64_t item) { trace_band(*job, item / bands, item % bands * BAND); });
  } catch (const std::bad_alloc&) {
    return OUT_OF_MEMORY;
  }
  return OK;
}

EXPORT const char* cadam3d_trace_instructions() { return SIMD_NAME; }

// Returns 0 if this machine can run the compiled code: a ball covers a pixel in front of it and no corner.
EXPORT int cadam3d_trace_self_test() {
  const float origin[3] = {0, 0, -2}, to_world[9] = {0.25f, 0, -0.5f, 0, 0.25f, -0.5f, 0, 0, 1};
  const float centre[3] = {0, 0, 2}, least = 1.9f, to_local[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  const float sizes[4] = {0.5f, 0, 0, 0}, low[3] = {-0.5f, -0.5f, -0.5f}, high[3] = {0.5f, 0.5f, 0.5f};
  const int64_t kind = TRACE_KIND_BALL, pattern = TRACE_PATTERN_CHECKERED, paints[2] = {0, 0};
  const float light[3] = {0, 0, 1};
  std::vector<float> spots(3 * TRACE_SPOTS), alpha(16), layers(16);
  const Job job{1, 4, 4, 1, 1, 1, 2, origin, to_world, origin, centre, &least, to_local, sizes, low, high,
                &kind, &pattern, paints, light, spots.data(), alpha.data(), layers.data()};
  if (cadam3d_trace(&job) != OK) return 1;
  return alpha[5] == 1 && layers[5] > 0 && alpha[0] == 0 ? 0 : 2;
}
