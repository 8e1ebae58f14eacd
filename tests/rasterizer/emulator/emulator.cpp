// Every kernel of the CUDA rasterizer by name, behind a C interface.
#include "cuda_emulator.h"
//
#include "cuda.cu"

#define TRY(kernel) \
  if (wanted == #kernel) return emulator::launch(kernel, blocks, threads, seed, arguments)

static void find_and_launch(const std::string& wanted, unsigned blocks, int threads, uint64_t seed,
                            const uint64_t* arguments) {
  TRY(prepare_cameras);
  TRY(project_forward_1);
  TRY(project_forward_4);
  TRY(project_forward_9);
  TRY(project_forward_16);
  TRY(project_backward_1);
  TRY(project_backward_4);
  TRY(project_backward_9);
  TRY(project_backward_16);
  TRY(centre_backward);
  TRY(scan_short);
  TRY(scan_reduce);
  TRY(scan_sums);
  TRY(scan_apply);
  TRY(sort_count);
  TRY(sort_scatter);
  TRY(tile_count);
  TRY(tile_list);
  TRY(tile_ranges);
  TRY(blend_forward);
  TRY(blend_backward);
  throw emulator::Failure("no kernel called " + wanted);
}

// Null, or what went wrong. Seed 0 keeps threads and blocks in order.
extern "C" const char* emulate(const char* kernel, int64_t blocks, int64_t threads, uint64_t seed,
                               const uint64_t* arguments) {
  static std::string trouble;
  try {
    find_and_launch(kernel, unsigned(blocks), int(threads), seed, arguments);
    return nullptr;
  } catch (const std::exception& error) {
    trouble = error.what();
    return trouble.c_str();
  }
}
