// One splat, from world to screen and back: the maths that all native backends share.
//
// This file includes no header, because a run-time CUDA compiler has none. It is templated on the scalar and
// has neither allocations nor branches, so that a scalar type may also hold many Gaussians (``simd::Wide``).
// The formulas are those of EWA splatting (Zwicker et al. 2002; Kerbl et al. 2023, sec. 4), in a form that
// costs nothing more and keeps long thin splats accurate in float32:
//
//   screen covariance  C = B B^T + blur I,  B = J W R diag(s): two rows of three
//   its determinant    |B0 x B1|^2 + blur (|B0|^2 + |B1|^2) + blur^2: a sum of squares, no cancellation
//   its whitening      L^T L = C^-1 / 2,  L = [[l11, l12], [0, l22]]: closed form in C and det C
//   falloff at d       exp(-|L d|^2): never above 1, by construction
//
// The blend gathers moments of y = L d, not of d. With Y = sum g y y^T and s = sum g y (g = dLoss/d|y|^2),
// the gradients are  dLoss/dC = -2 L^T Y L,  dLoss/dB = -4 L^T Y (L B),  dLoss/dmean2d = -2 L^T s.
//
// The build defines the constants of image formation (SPLAT_BLUR, SPLAT_ALPHA_MIN, SPLAT_NEAR, SPLAT_FAR,
// SPLAT_FRUSTUM_MARGIN) from cadam3d/rasterizer/base.py, which is the only place that contains their values.
#pragma once

#if defined(__CUDACC__)
#define SPLAT_FN __device__ __forceinline__
#define SPLAT_TABLE __device__ constexpr
#else
#define SPLAT_FN inline
#define SPLAT_TABLE constexpr
#endif

namespace splat {

constexpr int MAX_COEFFICIENTS = 16;       // spherical harmonics of degree 3
constexpr float TINY_QUATERNION = 1e-12f;  // squared length; a shorter one has no direction and is culled
constexpr float FLOAT_MAX = 3.402823466e+38f;

#if defined(__CUDACC__)
SPLAT_FN float root(float x) { return sqrtf(x); }
SPLAT_FN float power_e(float x) { return expf(x); }
SPLAT_FN float log_e(float x) { return logf(x); }
#else
SPLAT_FN float root(float x) { return __builtin_sqrtf(x); }
SPLAT_FN float power_e(float x) { return __builtin_expf(x); }
SPLAT_FN float log_e(float x) { return __builtin_logf(x); }
#endif
template <class Real>
SPLAT_FN Real select(bool condition, Real yes, Real no) {
  return condition ? yes : no;
}

// The type of a comparison, and the type in which coefficients are stored. simd::Wide specializes both.
template <class Real>
struct Kinds {
  typedef bool Truth;
  typedef float Stored;
};
template <class Real>
using Truth = typename Kinds<Real>::Truth;

template <class Real>
SPLAT_FN Truth<Real> is_finite(Real x) {
  return x - x == Real(0);
}
template <class Real>
SPLAT_FN Truth<Real> fits_float(Real x) {  // false for NaN too
  return (x <= Real(FLOAT_MAX)) & (x >= Real(-FLOAT_MAX));
}
template <class Real>
SPLAT_FN Real dot3(const Real* a, const Real* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// ---------------------------------------------------------------------------------------------- camera

template <class Real>
struct Camera {
  Real rotation[3][3], translation[3];  // world to camera; +x right, +y down, +z forward
  Real position[3];                     // in the world
  Real fx, fy, cx, cy, width, height;   // pixels; pixel centres at +0.5
  Real slope_low[2], slope_high[2];     // bounds of x/z and y/z in the Jacobian: the border and a margin
};

template <class Real>
SPLAT_FN Camera<Real> make_camera(const float* world_to_camera, const float* intrinsics, int width,
                                  int height) {
  Camera<Real> camera;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) camera.rotation[i][j] = world_to_camera[4 * i + j];
    camera.translation[i] = world_to_camera[4 * i + 3];
  }
  for (int j = 0; j < 3; ++j) {
    Real sum = 0;
    for (int i = 0; i < 3; ++i) sum += camera.rotation[i][j] * camera.translation[i];
    camera.position[j] = -sum;
  }
  camera.fx = intrinsics[0], camera.cx = intrinsics[2], camera.fy = intrinsics[4], camera.cy = intrinsics[5];
  camera.width = Real(width), camera.height = Real(height);
  const Real margin_x = Real(SPLAT_FRUSTUM_MARGIN) * camera.width,
             margin_y = Real(SPLAT_FRUSTUM_MARGIN) * camera.height;
  camera.slope_low[0] = (-margin_x - camera.cx) / camera.fx;
  camera.slope_low[1] = (-margin_y - camera.cy) / camera.fy;
  camera.slope_high[0] = (camera.width + margin_x - camera.cx) / camera.fx;
  camera.slope_high[1] = (camera.height + margin_y - camera.cy) / camera.fy;
  return camera;
}

// ---------------------------------------------------------------------------------------------- colour

// The real basis of cadam3d/core/sh.py (Y_lm with the Condon-Shortley phase, l = 0..3, m = -l..l).
constexpr double SH_C0 = 0.28209479177387814, SH_C1 = 0.4886025119029199;
SPLAT_TABLE double SH_C2[5] = {1.0925484305920792, -1.0925484305920792, 0.31539156525252005,
                               -1.0925484305920792, 0.5462742152960396};
SPLAT_TABLE double SH_C3[7] = {-0.5900435899266435, 2.890611442640554,   -0.4570457994644658,
                               0.3731763325901154,  -0.4570457994644658, 1.445305721320277,
                               -0.5900435899266435};

template <class Real>
SPLAT_FN void sh_basis(int coefficients, const Real* unit, Real* basis) {
  const Real x = unit[0], y = unit[1], z = unit[2];
  basis[0] = Real(SH_C0);
  if (coefficients < 4) return;
  const Real c1 = Real(SH_C1);
  basis[1] = -c1 * y, basis[2] = c1 * z, basis[3] = -c1 * x;
  if (coefficients < 9) return;
  const Real xx = x * x, yy = y * y, zz = z * z;
  basis[4] = Real(SH_C2[0]) * x * y;
  basis[5] = Real(SH_C2[1]) * y * z;
  basis[6] = Real(SH_C2[2]) * (2 * zz - xx - yy);
  basis[7] = Real(SH_C2[3]) * x * z;
  basis[8] = Real(SH_C2[4]) * (xx - yy);
  if (coefficients < 16) return;
  basis[9] = Real(SH_C3[0]) * y * (3 * xx - yy);
  basis[10] = Real(SH_C3[1]) * x * y * z;
  basis[11] = Real(SH_C3[2]) * y * (4 * zz - xx - yy);
  basis[12] = Real(SH_C3[3]) * z * (2 * zz - 3 * xx - 3 * yy);
  basis[13] = Real(SH_C3[4]) * x * (4 * zz - xx - yy);
  basis[14] = Real(SH_C3[5]) * z * (xx - yy);
  basis[15] = Real(SH_C3[6]) * x * (xx - 3 * yy);
}

// Gradient of sum_k weight[k] * basis[k] with respect to x, y and z as free variables.
template <class Real>
SPLAT_FN void sh_basis_backward(int coefficients, const Real* unit, const Real* weight, Real* gradient) {
  const Real x = unit[0], y = unit[1], z = unit[2];
  gradient[0] = gradient[1] = gradient[2] = 0;
  if (coefficients < 4) return;
  const Real c1 = Real(SH_C1);
  gradient[0] = -c1 * weight[3], gradient[1] = -c1 * weight[1], gradient[2] = c1 * weight[2];
  if (coefficients < 9) return;
  const Real a = Real(SH_C2[0]) * weight[4], b = Real(SH_C2[1]) * weight[5], c = Real(SH_C2[2]) * weight[6];
  const Real d = Real(SH_C2[3]) * weight[7], e = Real(SH_C2[4]) * weight[8];
  gradient[0] += a * y - 2 * c * x + d * z + 2 * e * x;
  gradient[1] += a * x + b * z - 2 * c * y - 2 * e * y;
  gradient[2] += b * y + 4 * c * z + d * x;
  if (coefficients < 16) return;
  const Real xx = x * x, yy = y * y, zz = z * z;
  const Real p = Real(SH_C3[0]) * weight[9], q = Real(SH_C3[1]) * weight[10], r = Real(SH_C3[2]) * weight[11];
  const Real s = Real(SH_C3[3]) * weight[12], t = Real(SH_C3[4]) * weight[13],
             u = Real(SH_C3[5]) * weight[14];
  const Real w = Real(SH_C3[6]) * weight[15];
  gradient[0] += 6 * p * x * y + q * y * z - 2 * r * x * y - 6 * s * x * z + t * (4 * zz - 3 * xx - yy) +
                 2 * u * x * z + 3 * w * (xx - yy);
  gradient[1] += 3 * p * (xx - yy) + q * x * z + r * (4 * zz - xx - 3 * yy) - 6 * s * y * z - 2 * t * x * y -
                 2 * u * y * z - 6 * w * x * y;
  gradient[2] += q * x * y + 8 * r * y * z + s * (6 * zz - 3 * xx - 3 * yy) + 8 * t * x * z + u * (xx - yy);
}

// ---------------------------------------------------------------------------------------------- one Gaussian

// A number known at compile time. Loops with this count unroll, and their data stays in registers.
template <int N>
struct Fixed {
  SPLAT_FN constexpr operator int() const { return N; }
};

// The raw parameters of one Gaussian, as the optimizer stores them. Count is int or Fixed.
template <class Real, class Count = int>
struct Gaussian {
  Real mean[3], log_scale[3], quat[4], opacity_logit;
  const typename Kinds<Real>::Stored* sh;  // coefficients x 3
  Count coefficients;
};

// The quantities that do not depend on the view, computed once per batch.
template <class Real>
struct Shape {
  Real axes[3][3];      // columns: the axes of the Gaussian in the world, times their standard deviations
  Real rotation[3][3];  // columns: the axes of the Gaussian in the world
  Real unit_quat[4], inverse_length;
  Real opacity, transparency;  // transparency = 1 - opacity, computed without cancellation
  Real log_cut;                // ln(opacity / alpha_min): the falloff exponent at which alpha is alpha_min
};

// The quantities of one view, which the chain rule needs again.
template <class Real>
struct Footprint {
  Real centre[3];   // in the camera
  Real axes[3][3];  // Shape::axes in the camera
  Real inverse_z, slope[2];
  Truth<Real> is_held[2];  // whether the slope in the Jacobian is clamped, and therefore constant
  Real rows[2][3];         // B
  Real mean2d[2];
  Real cov_xx, cov_xy, cov_yy, l11, l12, l22;
  Real reach[2];  // half-sizes of the box outside which alpha < alpha_min
};

// Returns false if the Gaussian is not visible in any view.
template <class Real, class Count>
SPLAT_FN Truth<Real> make_shape(const Gaussian<Real, Count>& gaussian, Shape<Real>& shape) {
  Real poison = gaussian.opacity_logit - gaussian.opacity_logit;  // 0, or NaN if a parameter is not finite
  for (int i = 0; i < 3; ++i)
    poison += (gaussian.mean[i] - gaussian.mean[i]) + (gaussian.log_scale[i] - gaussian.log_scale[i]);
  for (int i = 0; i < 3 * gaussian.coefficients; ++i) poison += Real(gaussian.sh[i] - gaussian.sh[i]);
  Real squared = 0;
  for (int i = 0; i < 4; ++i) squared += gaussian.quat[i] * gaussian.quat[i];

  const Real odds_against = power_e(-gaussian.opacity_logit);
  shape.opacity = 1 / (1 + odds_against);
  shape.transparency = odds_against * shape.opacity;
  shape.log_cut = log_e(shape.opacity / Real(SPLAT_ALPHA_MIN));

  shape.inverse_length = 1 / root(squared);
  for (int i = 0; i < 4; ++i) shape.unit_quat[i] = gaussian.quat[i] * shape.inverse_length;
  const Real w = shape.unit_quat[0], x = shape.unit_quat[1], y = shape.unit_quat[2], z = shape.unit_quat[3];
  Real(&r)[3][3] = shape.rotation;
  r[0][0] = 1 - 2 * (y * y + z * z), r[0][1] = 2 * (x * y - w * z), r[0][2] = 2 * (x * z + w * y);
  r[1][0] = 2 * (x * y + w * z), r[1][1] = 1 - 2 * (x * x + z * z), r[1][2] = 2 * (y * z - w * x);
  r[2][0] = 2 * (x * z - w * y), r[2][1] = 2 * (y * z + w * x), r[2][2] = 1 - 2 * (x * x + y * y);
  for (int j = 0; j < 3; ++j) {
    const Real scale = power_e(gaussian.log_scale[j]);
    for (int i = 0; i < 3; ++i) shape.axes[i][j] = r[i][j] * scale;
  }
  return (poison == Real(0)) & (squared >= Real(TINY_QUATERNION)) & is_finite(squared) &
         (shape.opacity > Real(SPLAT_ALPHA_MIN));
}

// Returns false if the Gaussian is not visible in the view. The comparisons are written such that NaN culls.
template <class Real, class Count>
SPLAT_FN Truth<Real> project(const Gaussian<Real, Count>& gaussian, const Shape<Real>& shape,
                             const Camera<Real>& camera, Footprint<Real>& out) {
  for (int i = 0; i < 3; ++i) out.centre[i] = dot3(camera.rotation[i], gaussian.mean) + camera.translation[i];
  const Real z = out.centre[2];
  out.inverse_z = 1 / z;

  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out.axes[i][j] = camera.rotation[i][0] * shape.axes[0][j] + camera.rotation[i][1] * shape.axes[1][j] +
                       camera.rotation[i][2] * shape.axes[2][j];
  const Real focal[2] = {camera.fx, camera.fy}, principal[2] = {camera.cx, camera.cy};
  for (int i = 0; i < 2; ++i) {
    const Real slope = out.centre[i] * out.inverse_z;
    out.mean2d[i] = focal[i] * slope + principal[i];
    const Truth<Real> is_low = slope<camera.slope_low[i], is_high = slope> camera.slope_high[i];
    const Real held = select(is_low, camera.slope_low[i], select(is_high, camera.slope_high[i], slope));
    out.slope[i] = held;
    out.is_held[i] = is_low | is_high;
    for (int j = 0; j < 3; ++j)
      out.rows[i][j] = focal[i] * out.inverse_z * (out.axes[i][j] - held * out.axes[2][j]);
  }

  const Real blur = Real(SPLAT_BLUR);
  const Real *b0 = out.rows[0], *b1 = out.rows[1];
  const Real b00 = dot3(b0, b0), b11 = dot3(b1, b1);
  const Real cross[3] = {b0[1] * b1[2] - b0[2] * b1[1], b0[2] * b1[0] - b0[0] * b1[2],
                         b0[0] * b1[1] - b0[1] * b1[0]};
  const Real determinant = dot3(cross, cross) + blur * (b00 + b11) + blur * blur;
  out.cov_xx = b00 + blur, out.cov_xy = dot3(b0, b1), out.cov_yy = b11 + blur;
  out.l11 = root(Real(0.5) * out.cov_yy / determinant);
  out.l12 = -out.l11 * out.cov_xy / out.cov_yy;
  out.l22 = root(Real(0.5) / out.cov_yy);

  out.reach[0] = root(2 * shape.log_cut * out.cov_xx);
  out.reach[1] = root(2 * shape.log_cut * out.cov_yy);
  return (z > Real(SPLAT_NEAR)) & (z < Real(SPLAT_FAR)) & fits_float(out.cov_xx) & fits_float(out.cov_yy) &
         is_finite(determinant) & fits_float(out.reach[0]) & fits_float(out.reach[1]) &
         (out.mean2d[0] + out.reach[0] > Real(0)) & (out.mean2d[0] - out.reach[0] < camera.width) &
         (out.mean2d[1] + out.reach[1] > Real(0)) & (out.mean2d[1] - out.reach[1] < camera.height);
}

// Writes the unit vector from camera to Gaussian and returns one over their distance.
template <class Real, class Count>
SPLAT_FN Real direction(const Gaussian<Real, Count>& gaussian, const Camera<Real>& camera, Real* unit) {
  for (int i = 0; i < 3; ++i) unit[i] = gaussian.mean[i] - camera.position[i];
  const Real inverse = 1 / root(dot3(unit, unit));
  for (int i = 0; i < 3; ++i) unit[i] *= inverse;
  return inverse;
}

// The colour before negative values are clamped to 0.
template <class Real, class Count>
SPLAT_FN void raw_colour(const Gaussian<Real, Count>& gaussian, const Real* basis, Real* rgb) {
  for (int c = 0; c < 3; ++c) {
    Real sum = Real(0.5);
    for (int k = 0; k < gaussian.coefficients; ++k) sum += basis[k] * Real(gaussian.sh[3 * k + c]);
    rgb[c] = sum;
  }
}

template <class Real, class Count>
SPLAT_FN void colour(const Gaussian<Real, Count>& gaussian, const Camera<Real>& camera, Real* rgb) {
  Real unit[3] = {0, 0, 1}, basis[MAX_COEFFICIENTS];
  if (gaussian.coefficients > 1) direction(gaussian, camera, unit);
  sh_basis(gaussian.coefficients, unit, basis);
  raw_colour(gaussian, basis, rgb);
  for (int c = 0; c < 3; ++c) rgb[c] = select(rgb[c] > Real(0), rgb[c], Real(0));
}

// ---------------------------------------------------------------------------------------------- backward

// Sums over the pixels of one view; g is dLoss/d|y|^2 and y = L (pixel - mean2d).
template <class Real>
struct Moments {
  Real g, gu, gt, guu, gut, gtt;  // sum g, sum g y, sum g y y^T
  Real rgb[3], depth;             // dLoss/d colour after the clamp, dLoss/d camera z
};

// Gradients of one Gaussian. Gradients of the shape are sums over the views with respect to the axes;
// shape_backward converts them at the end.
template <class Real>
struct Gradient {
  Real mean[3], axes[3][3], opacity_logit, sh[3 * MAX_COEFFICIENTS];
};

template <class Real>
SPLAT_FN void clear(Gradient<Real>& gradient, int coefficients) {
  for (int i = 0; i < 3; ++i)
    gradient.mean[i] = gradient.axes[i][0] = gradient.axes[i][1] = gradient.axes[i][2] = 0;
  gradient.opacity_logit = 0;
  for (int i = 0; i < 3 * coefficients; ++i) gradient.sh[i] = 0;
}

template <class Real>
SPLAT_FN void mean2d_gradient(const Footprint<Real>& footprint, const Moments<Real>& moments,
                              Real* gradient) {
  gradient[0] = -2 * footprint.l11 * moments.gu;
  gradient[1] = -2 * (footprint.l12 * moments.gu + footprint.l22 * moments.gt);
}

// The sums of absolute contributions to mean2d_gradient, from the sums of |g u| and of |g (l12 u + l22 t)|.
template <class Real>
SPLAT_FN void mean2d_absolute(const Real& l11, const Real* sums, Real* absolute) {
  absolute[0] = 2 * l11 * sums[0];
  absolute[1] = 2 * sums[1];
}

// Adds the gradient of one view to ``total``, except the path through mean2d: see centre_backward.
template <class Real, class Count>
SPLAT_FN void project_backward(const Gaussian<Real, Count>& gaussian, const Shape<Real>& shape,
                               const Camera<Real>& camera, const Footprint<Real>& f,
                               const Moments<Real>& moments, Gradient<Real>& total) {
  total.opacity_logit -= moments.g * shape.transparency;  // alpha = opacity exp(-|y|^2)

  Real centre[3] = {0, 0, moments.depth}, axes[3][3];
  Real rows[2][3];
  for (int j = 0; j < 3; ++j) {  // -4 L^T Y (L B)
    const Real u = f.l11 * f.rows[0][j] + f.l12 * f.rows[1][j], t = f.l22 * f.rows[1][j];
    const Real yu = -4 * (moments.guu * u + moments.gut * t), yt = -4 * (moments.gut * u + moments.gtt * t);
    rows[0][j] = f.l11 * yu;
    rows[1][j] = f.l12 * yu + f.l22 * yt;
  }
  const Real focal[2] = {camera.fx, camera.fy};
  for (int j = 0; j < 3; ++j) axes[2][j] = 0;
  for (int i = 0; i < 2; ++i) {
    const Real scale = focal[i] * f.inverse_z;
    for (int j = 0; j < 3; ++j) {
      axes[i][j] = scale * rows[i][j];
      axes[2][j] -= scale * f.slope[i] * rows[i][j];
    }
    centre[2] -= dot3(f.rows[i], rows[i]) * f.inverse_z;
    const Real slope = select(f.is_held[i], Real(0), -scale * dot3(f.axes[2], rows[i]));
    centre[i] += slope * f.inverse_z;
    centre[2] -= slope * f.slope[i] * f.inverse_z;
  }
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) {
      total.mean[i] += camera.rotation[k][i] * centre[k];
      for (int j = 0; j < 3; ++j) total.axes[i][j] += camera.rotation[k][i] * axes[k][j];
    }
  }

  Real unit[3] = {0, 0, 1}, basis[MAX_COEFFICIENTS], rgb[3], inverse = 0;
  const int coefficients = gaussian.coefficients;
  if (coefficients > 1) inverse = direction(gaussian, camera, unit);
  sh_basis(coefficients, unit, basis);
  raw_colour(gaussian, basis, rgb);
  for (int c = 0; c < 3; ++c) rgb[c] = select(rgb[c] >= Real(0), moments.rgb[c], Real(0));
  for (int k = 0; k < coefficients; ++k)
    for (int c = 0; c < 3; ++c) total.sh[3 * k + c] += basis[k] * rgb[c];
  if (coefficients > 1) {
    Real weight[MAX_COEFFICIENTS], towards[3];
    for (int k = 0; k < coefficients; ++k) {
      const auto* sh = gaussian.sh + 3 * k;
      weight[k] = Real(sh[0]) * rgb[0] + Real(sh[1]) * rgb[1] + Real(sh[2]) * rgb[2];
    }
    sh_basis_backward(coefficients, unit, weight, towards);
    const Real radial = dot3(towards, unit);
    for (int i = 0; i < 3; ++i) total.mean[i] += (towards[i] - radial * unit[i]) * inverse;
  }
}

// Adds dLoss/dmean of the pinhole projection alone: the path through mean2d.
template <class Real>
SPLAT_FN void centre_backward(const Camera<Real>& camera, const Real* mean, const Real* mean2d_gradient,
                              Real* total) {
  Real centre[3];
  for (int i = 0; i < 3; ++i) centre[i] = dot3(camera.rotation[i], mean) + camera.translation[i];
  const Real inverse_z = 1 / centre[2];
  const Real x = camera.fx * inverse_z * mean2d_gradient[0], y = camera.fy * inverse_z * mean2d_gradient[1];
  const Real z = -(x * centre[0] + y * centre[1]) * inverse_z;
  for (int i = 0; i < 3; ++i)
    total[i] += camera.rotation[0][i] * x + camera.rotation[1][i] * y + camera.rotation[2][i] * z;
}

// Converts the gradient of the axes, summed over the views, to that of log-scales and raw quaternion.
template <class Real, class Count>
SPLAT_FN void shape_backward(const Shape<Real>& shape, const Gaussian<Real, Count>& gaussian,
                             const Gradient<Real>& total, Real* log_scale, Real* quat) {
  Real g[3][3];
  for (int j = 0; j < 3; ++j) {
    const Real scale = power_e(gaussian.log_scale[j]);
    log_scale[j] = 0;
    for (int i = 0; i < 3; ++i) {
      log_scale[j] += shape.axes[i][j] * total.axes[i][j];
      g[i][j] = scale * total.axes[i][j];
    }
  }
  const Real w = shape.unit_quat[0], x = shape.unit_quat[1], y = shape.unit_quat[2], z = shape.unit_quat[3];
  const Real unit[4] = {
      2 * (x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1])),
      2 * (y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) + w * (g[2][1] - g[1][2]) -
           2 * x * (g[1][1] + g[2][2])),
      2 * (x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) + w * (g[0][2] - g[2][0]) -
           2 * y * (g[0][0] + g[2][2])),
      2 * (x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) + w * (g[1][0] - g[0][1]) -
           2 * z * (g[0][0] + g[1][1])),
  };
  Real along = 0;
  for (int i = 0; i < 4; ++i) along += unit[i] * shape.unit_quat[i];
  for (int i = 0; i < 4; ++i) quat[i] = (unit[i] - along * shape.unit_quat[i]) * shape.inverse_length;
}

}  // namespace splat
