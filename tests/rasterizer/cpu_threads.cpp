// Calls the C interface of the CPU kernels with several numbers of threads, for sanitizers to watch. The exit
// code is 0 if every number of threads gives the same bits.
#include <cstdio>
#include <initializer_list>
#include <random>

#include "cpu.cpp"

typedef std::vector<float> Numbers;

constexpr int WIDTH = 70, HEIGHT = 50, COEFFICIENTS = 4;

struct Input {
  Numbers means, log_scales, quats, logits, sh, matrices, intrinsics, background;

  Input(int count, int views) {
    std::mt19937 generator(0);
    const auto numbers = [&](int each, float middle) {
      std::normal_distribution<float> normal(middle, 0.5f);
      Numbers all(size_t(each * count));
      for (float& x : all) x = normal(generator);
      return all;
    };
    means = numbers(3, 0), log_scales = numbers(3, -3.5f), quats = numbers(4, 0), logits = numbers(1, 0);
    sh = numbers(3 * COEFFICIENTS, 0);
    // The last third is behind the cameras, so that whole blocks are not on the screen.
    for (int i = 2 * count / 3; i < count; ++i) means[size_t(3 * i + 2)] = -10;
    for (int v = 0; v < views; ++v) {
      const float side = 0.1f * float(v);
      for (float x : {1.f, 0.f, 0.f, side, 0.f, 1.f, 0.f, 0.f, 0.f, 0.f, 1.f, 2.f, 0.f, 0.f, 0.f, 1.f})
        matrices.push_back(x);
      for (float x : {60.f, 0.f, 35.f, 0.f, 60.f, 25.f, 0.f, 0.f, 1.f}) intrinsics.push_back(x);
      for (int channel = 0; channel < 3; ++channel) background.push_back(0.3f);
    }
  }
};

// Returns all images and gradients, or nothing if a call fails or leaves a number out.
Numbers render(const Input& in, int count, int views, int threads) {
  const Scene scene{count, views, COEFFICIENTS, HEIGHT, WIDTH, threads, in.means.data(),
                    in.log_scales.data(), in.quats.data(), in.logits.data(), in.sh.data(),
                    in.matrices.data(), in.intrinsics.data(), in.background.data()};
  const size_t n = size_t(count), pairs = size_t(count * views), pixels = size_t(views * WIDTH * HEIGHT);
  Numbers means2d(2 * pairs), radii(pairs);
  Numbers rgb(3 * pixels), alpha(pixels), depth(pixels), ones(3 * pixels, 1.f);
  // Of means2d, absgrad, means, log-scales, quaternions, opacities, colours and again means. The kernels must
  // write every number.
  Numbers grads[8];
  const size_t sizes[8] = {2 * pairs, 2 * pairs, 3 * n, 3 * n, 4 * n, n, 3 * COEFFICIENTS * n, 3 * n};
  for (int i = 0; i < 8; ++i) grads[i].assign(sizes[i], NAN);
  void* frame = nullptr;
  if (cadam3d_project(&scene, means2d.data(), radii.data(), &frame) != OK) return {};
  int status = cadam3d_blend(&scene, frame, rgb.data(), alpha.data(), depth.data(), 1);
  if (status == OK)
    status = cadam3d_blend_backward(&scene, frame, alpha.data(), depth.data(), ones.data(), nullptr,
                                    ones.data(), grads[0].data(), grads[1].data(), grads[2].data(),
                                    grads[3].data(), grads[4].data(), grads[5].data(), grads[6].data());
  if (status == OK)
    status = cadam3d_centre_backward(&scene, frame, radii.data(), grads[0].data(), grads[7].data());
  cadam3d_free(frame);
  if (status != OK) return {};
  Numbers all = rgb;
  for (const Numbers* part : {&alpha, &depth}) all.insert(all.end(), part->begin(), part->end());
  for (const Numbers& part : grads) all.insert(all.end(), part.begin(), part.end());
  for (float x : all)
    if (!std::isfinite(x)) return {};
  return all;
}

int main() {
  bool is_same = true;
  for (int count : {0, 1, 700, 3 * int(PIECE)}) {
    for (int views : {1, 2}) {
      const Input input(count, views);
      const Numbers first = render(input, count, views, 1);
      for (int threads : {2, 3}) {
        const Numbers other = render(input, count, views, threads);
        const bool is_equal = !first.empty() && first.size() == other.size() &&
                              std::memcmp(first.data(), other.data(), 4 * first.size()) == 0;
        if (!is_equal) std::printf("%d Gaussians, %d views, %d threads differ\n", count, views, threads);
        is_same = is_same && is_equal;
      }
    }
  }
  delete spare_frame.exchange(nullptr);
  return is_same ? 0 : 1;
}
