// Projection of Gaussians to splats, and its gradient from records: one thread per Gaussian loops over the
// views.
#pragma once

#include "tiles.cuh"

typedef splat::Camera<float> Camera;
static_assert(sizeof(Camera) == 25 * sizeof(float), "mirrored in ../cuda.py");

// One thread per view. Later kernels read the cameras.
KERNEL(BLOCK)
prepare_cameras(const float* world_to_camera, const float* intrinsics, i64 views, i64 height, i64 width,
                Camera* cameras) {
  const i64 v = thread_index();
  if (v >= views) return;
  cameras[v] =
      splat::make_camera<float>(world_to_camera + 16 * v, intrinsics + 9 * v, int(width), int(height));
}

template <int COEFFICIENTS>
using Gaussian = splat::Gaussian<float, splat::Fixed<COEFFICIENTS>>;

template <int COEFFICIENTS>
SPLAT_FN Gaussian<COEFFICIENTS> load_gaussian(const float* means, const float* log_scales, const float* quats,
                                              const float* opacity_logits, const float* sh, i64 i) {
  Gaussian<COEFFICIENTS> gaussian;
  for (int j = 0; j < 3; ++j) {
    gaussian.mean[j] = means[3 * i + j];
    gaussian.log_scale[j] = log_scales[3 * i + j];
  }
  for (int j = 0; j < 4; ++j) gaussian.quat[j] = quats[4 * i + j];
  gaussian.opacity_logit = opacity_logits[i];
  gaussian.sh = sh + 3 * COEFFICIENTS * i;
  return gaussian;
}

// splats [v n 3 float4], means2d [v n 2], radii [v n], depth_keys [v n], and the numbers of tiles: counts [v
// n]
template <int COEFFICIENTS>
SPLAT_FN void project_gaussian(const float* means, const float* log_scales, const float* quats,
                               const float* opacity_logits, const float* sh, const Camera* cameras, i64 n,
                               i64 views, const Grid& grid, float4* splats, float* means2d, float* radii,
                               u32* depth_keys, u32* counts) {
  const i64 i = thread_index();
  if (i >= n) return;
  const Gaussian<COEFFICIENTS> gaussian =
      load_gaussian<COEFFICIENTS>(means, log_scales, quats, opacity_logits, sh, i);
  splat::Shape<float> shape;
  const bool is_sound = splat::make_shape(gaussian, shape);
  for (i64 v = 0; v < views; ++v) {
    const i64 pair = v * n + i;
    splat::Footprint<float> footprint;
    if (!is_sound || !splat::project(gaussian, shape, cameras[v], footprint)) {
      means2d[2 * pair] = means2d[2 * pair + 1] = radii[pair] = 0;
      depth_keys[pair] = CULLED, counts[pair] = 0;
      continue;
    }
    float rgb[3];
    splat::colour(gaussian, cameras[v], rgb);
    const float *at = footprint.mean2d, *reach = footprint.reach, depth = footprint.centre[2];
    const float unit = SQRT_LOG2_E, cut = LOG2_E * shape.log_cut;
    const float l11 = unit * footprint.l11, l12 = unit * footprint.l12, l22 = unit * footprint.l22;
    const Splat s = {at[0],    at[1],  l11,    l12,    l22,  cut + LOG2_ALPHA_MIN, cut,
                     reach[0], rgb[0], rgb[1], rgb[2], depth};
    store_splat(splats + 3 * pair, s);
    counts[pair] = count_tiles(s, grid);
    means2d[2 * pair] = at[0], means2d[2 * pair + 1] = at[1];
    radii[pair] = reach[0] > reach[1] ? reach[0] : reach[1];
    depth_keys[pair] = __float_as_uint(depth);  // positive floats sort like their bits
  }
}

constexpr u32 LONG_RUN = 64;  // records; a longer run is summed by the whole warp

template <int WIDTH>
SPLAT_FN void add_record(const float2* records, u32 slot, float* sum) {
#pragma unroll
  for (int j = 0; j < WIDTH / 2; ++j) {
    const float2 two = records[WIDTH / 2 * i64(slot) + j];
    sum[2 * j] += two.x, sum[2 * j + 1] += two.y;
  }
}

// Sums ``count`` records of WIDTH floats from ``first`` on; each lane has its own run. All lanes of a warp
// must call this function.
template <int WIDTH>
SPLAT_FN void sum_records(const float2* records, u32 first, u32 count, float* sum) {
  for (int j = 0; j < WIDTH; ++j) sum[j] = 0;
  if (count <= LONG_RUN)
    for (u32 slot = first; slot < first + count; ++slot) add_record<WIDTH>(records, slot, sum);
  const int lane = lane_index();
  u32 waiting = __ballot_sync(ALL, count > LONG_RUN);
  while (waiting) {
    const int owner = __ffs(int(waiting)) - 1;
    waiting &= waiting - 1;
    const u32 from = __shfl_sync(ALL, first, owner), many = __shfl_sync(ALL, count, owner);
    float part[WIDTH] = {};
    for (u32 slot = from + u32(lane); slot < from + many; slot += WARP) add_record<WIDTH>(records, slot, part);
#pragma unroll
    for (int j = 0; j < WIDTH; ++j) {
#pragma unroll
      for (int reach = WARP / 2; reach > 0; reach /= 2) part[j] += __shfl_xor_sync(ALL, part[j], reach);
      if (lane == owner) sum[j] = part[j];
    }
  }
}

// The totals over the views. A launch processes some consecutive views and the next launch continues, so
// numbers are added in the same order as in a single launch. ``axes`` [n 9] may be null if one launch
// processes all views.
template <int COEFFICIENTS>
struct Totals {
  float *means, *axes, *opacity_logits, *sh;

  SPLAT_FN void load(i64 i, splat::Gradient<float>& total) const {
    for (int j = 0; j < 3; ++j) total.mean[j] = means[3 * i + j];
    for (int j = 0; j < 9; ++j) total.axes[j / 3][j % 3] = axes[9 * i + j];
    total.opacity_logit = opacity_logits[i];
#pragma unroll
    for (int j = 0; j < 3 * COEFFICIENTS; ++j) total.sh[j] = sh[3 * COEFFICIENTS * i + j];
  }
  SPLAT_FN void store(i64 i, const splat::Gradient<float>& total) const {
    for (int j = 0; j < 3; ++j) means[3 * i + j] = total.mean[j];
    if (axes)
      for (int j = 0; j < 9; ++j) axes[9 * i + j] = total.axes[j / 3][j % 3];
    opacity_logits[i] = total.opacity_logit;
#pragma unroll
    for (int j = 0; j < 3 * COEFFICIENTS; ++j) sh[3 * COEFFICIENTS * i + j] = total.sh[j];
  }
};

// All gradients of one Gaussian except the path through means2d, which ends in grad_means2d [v n 2]. They are
// zero if the slots did not fit into the memory that was reserved for them, because then there are no records.
// Processes the views first_view .. end_view - 1, for which there are records. The launch with the last view
// also computes the gradients of log-scales and quaternions.
template <int COEFFICIENTS>
SPLAT_FN void gaussian_backward(const float* means, const float* log_scales, const float* quats,
                                const float* opacity_logits, const float* sh, const Camera* cameras, i64 n,
                                i64 views, i64 first_view, i64 end_view, const u32* first_slot,
                                const u32* slot_count, const u32* total_slots, i64 capacity,
                                const float2* records, float* grad_means2d,
                                const Totals<COEFFICIENTS>& totals, float* grad_log_scales,
                                float* grad_quats) {
  const i64 i = thread_index();
  const bool is_mine = i < n;  // threads without a Gaussian help with long runs
  bool is_seen = false;  // in any view, with records
  if (is_mine && i64(*total_slots) <= capacity)
    for (i64 v = 0; v < views; ++v) is_seen = is_seen || slot_count[v * n + i] > 0;
  // A thread without a Gaussian loads the first one and does not use it. This needs no branch, so the loops
  // unroll.
  const Gaussian<COEFFICIENTS> gaussian =
      load_gaussian<COEFFICIENTS>(means, log_scales, quats, opacity_logits, sh, is_mine ? i : 0);
  splat::Shape<float> shape;
  if (is_seen) splat::make_shape(gaussian, shape);
  splat::Gradient<float> total;
  splat::clear(total, COEFFICIENTS);
  if (is_mine && first_view > 0) totals.load(i, total);
  for (i64 v = first_view; v < end_view; ++v) {
    const i64 pair = v * n + i;
    const bool is_visible = is_seen && slot_count[pair] > 0;
    float sum[RECORD];
    sum_records<RECORD>(records, is_visible ? first_slot[pair] : 0, is_visible ? slot_count[pair] : 0, sum);
    float centre[2] = {0, 0};
    if (is_visible) {
      splat::Footprint<float> footprint;
      splat::project(gaussian, shape, cameras[v], footprint);
      // The blend writes moments of y times sqrt(log2 e).
      const float once = SQRT_LN_2, twice = LN_2;
      const splat::Moments<float> moments = {
          sum[0],         once * sum[1],  once * sum[2],  twice * sum[3],
          twice * sum[4], twice * sum[5], {sum[6], sum[7], sum[8]}, sum[9]};
      splat::mean2d_gradient(footprint, moments, centre);
      splat::project_backward(gaussian, shape, cameras[v], footprint, moments, total);
    }
    if (is_mine) grad_means2d[2 * pair] = centre[0], grad_means2d[2 * pair + 1] = centre[1];
  }
  if (!is_mine) return;
  totals.store(i, total);
  if (end_view < views) return;
  float log_scale[3] = {0, 0, 0}, quat[4] = {0, 0, 0, 0};
  if (is_seen) splat::shape_backward(shape, gaussian, total, log_scale, quat);
  for (int j = 0; j < 3; ++j) grad_log_scales[3 * i + j] = log_scale[j];
  for (int j = 0; j < 4; ++j) grad_quats[4 * i + j] = quat[j];
}

// absgrad [pairs 2]: the sum over the pixels of the absolute value of what each adds to the gradient of a
// centre.
KERNEL(BLOCK)
sum_absolutes(i64 pairs, const u32* total, i64 capacity, const float2* absolutes, const float4* splats,
              const u32* first_slot, const u32* slot_count, float* absgrad) {
  const i64 pair = thread_index();
  const bool has_records = i64(*total) <= capacity;
  // Other threads help with long runs.
  const bool is_visible = pair < pairs && has_records && slot_count[pair] > 0;
  float sum[ABSOLUTES], absolute[2] = {0, 0};
  sum_records<ABSOLUTES>(absolutes, is_visible ? first_slot[pair] : 0, is_visible ? slot_count[pair] : 0, sum);
  // Both sums, and l11 (z), are in units of the scaled whitening.
  sum[0] *= SQRT_LN_2, sum[1] *= LN_2;
  if (is_visible) splat::mean2d_absolute(SQRT_LN_2 * splats[3 * pair].z, sum, absolute);
  if (pair >= pairs) return;
  for (int j = 0; j < 2; ++j) absgrad[2 * pair + j] = absolute[j];
}

// dLoss/dmeans [n 3] through the projected centres, from dLoss/dmeans2d [v n 2]. A culled Gaussian gets zero.
KERNEL(BLOCK)
centre_backward(const float* means, const Camera* cameras, i64 n, i64 views, const float* radii,
                const float* grad_means2d, float* grad_means) {
  const i64 i = thread_index();
  if (i >= n) return;
  const float mean[3] = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
  float total[3] = {0, 0, 0};
  for (i64 v = 0; v < views; ++v) {
    const i64 pair = v * n + i;
    if (!(radii[pair] > 0)) continue;
    const float gradient[2] = {grad_means2d[2 * pair], grad_means2d[2 * pair + 1]};
    splat::centre_backward(cameras[v], mean, gradient, total);
  }
  for (int j = 0; j < 3; ++j) grad_means[3 * i + j] = total[j];
}

// Fewer threads than in other kernels, because each needs many registers. Mirrored in ../cuda.py.
constexpr int PROJECT_BLOCK = 128;

#define KERNELS_FOR(COEFFICIENTS)                                                                            \
  KERNEL(PROJECT_BLOCK)                                                                                      \
  project_forward_##COEFFICIENTS(const float* means, const float* log_scales, const float* quats,            \
                                 const float* opacity_logits, const float* sh, const Camera* cameras, i64 n, \
                                 i64 views, i64 height, i64 width, i64 tile_height, float4* splats,          \
                                 float* means2d, float* radii, u32* depth_keys, u32* counts) {               \
    project_gaussian<COEFFICIENTS>(means, log_scales, quats, opacity_logits, sh, cameras, n, views,          \
                                   make_grid(height, width, tile_height), splats, means2d, radii,            \
                                   depth_keys, counts);                                                      \
  }                                                                                                          \
  KERNEL(PROJECT_BLOCK)                                                                                      \
  project_backward_##COEFFICIENTS(                                                                           \
      const float* means, const float* log_scales, const float* quats, const float* opacity_logits,          \
      const float* sh, const Camera* cameras, i64 n, i64 views, i64 first_view, i64 end_view,                \
      const u32* first_slot, const u32* slot_count, const u32* total, i64 capacity, const float2* records,   \
      float* grad_axes, float* grad_means2d, float* grad_means, float* grad_log_scales, float* grad_quats,   \
      float* grad_opacity_logits, float* grad_sh) {                                                          \
    gaussian_backward<COEFFICIENTS>(means, log_scales, quats, opacity_logits, sh, cameras, n, views,         \
                                    first_view, end_view, first_slot, slot_count, total, capacity, records,  \
                                    grad_means2d, {grad_means, grad_axes, grad_opacity_logits, grad_sh},     \
                                    grad_log_scales, grad_quats);                                            \
  }

KERNELS_FOR(1)
KERNELS_FOR(4)
KERNELS_FOR(9)
KERNELS_FOR(16)
