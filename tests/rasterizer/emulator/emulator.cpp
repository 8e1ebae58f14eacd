// The part of the CUDA driver that the rasterizer calls, on top of the emulator: same functions, same
// arguments. A module contains every kernel below. The handle of a stream is the seed of the schedule; seed
// 0 runs blocks and threads in order.
#include "cuda_emulator.h"

// The number of the planted mistake that is switched on. Only altered copies of the kernels read it.
extern "C" {
int active_mutant = 0;
int unordered_blocks = 0;
}

// The emulator must come first, because it defines __global__ and the like for the kernels.
#include "cuda.cu"

typedef void (*Launcher)(unsigned blocks, int threads, uint64_t seed, const char* arguments, size_t size);

template <auto kernel>
static void launch(unsigned blocks, int threads, uint64_t seed, const char* arguments, size_t size) {
  emulator::launch(kernel, blocks, threads, seed, arguments, size);
}

#define ENTRY(kernel) {#kernel, launch<kernel>}
static const struct {
  const char* name;
  Launcher launcher;
} KERNELS[] = {
    ENTRY(prepare_cameras),     ENTRY(project_forward_1),  ENTRY(project_backward_1),
#if !defined(EMULATOR_ONLY_DEGREE_0)
    ENTRY(project_forward_4),   ENTRY(project_forward_9),  ENTRY(project_forward_16),
    ENTRY(project_backward_4),  ENTRY(project_backward_9), ENTRY(project_backward_16),
#endif
    ENTRY(centre_backward),     ENTRY(scan_reduce),        ENTRY(scan_apply),
    ENTRY(sort_count),          ENTRY(sort_columns),       ENTRY(sort_scatter),
    ENTRY(tile_list),           ENTRY(tile_ranges),        ENTRY(sum_absolutes),
    ENTRY(blend_forward_8x4),   ENTRY(blend_backward_8x4), ENTRY(blend_backward_absolute_8x4),
    ENTRY(blend_forward_8x8),   ENTRY(blend_backward_8x8), ENTRY(blend_backward_absolute_8x8),
};

enum Status : int { OK = 0, NOT_FOUND = 500, LAUNCH_FAILED = 719 };
static std::string trouble = "no such kernel";
static int contexts = 0;  // pushed and not yet popped

extern "C" {

int cuInit(unsigned) { return OK; }
int cuDeviceGet(int* device, int ordinal) {
  *device = ordinal;
  return OK;
}
int cuDevicePrimaryCtxRetain(void** context, int) {
  *context = &contexts;
  return OK;
}
int cuCtxPushCurrent_v2(void* context) {
  if (context == &contexts) ++contexts;
  return OK;
}
int cuCtxPopCurrent_v2(void**) {
  --contexts;
  return OK;
}
int cuModuleLoadData(void** module, const void*) {
  *module = &trouble;
  return contexts > 0 ? OK : LAUNCH_FAILED;
}
int cuModuleGetFunction(Launcher* function, void*, const char* name) {
  for (const auto& each : KERNELS) {
    if (std::strcmp(each.name, name) != 0) continue;
    *function = each.launcher;
    return OK;
  }
  return NOT_FOUND;
}
int cuLaunchKernel(Launcher function, unsigned blocks, unsigned, unsigned, unsigned threads, unsigned,
                   unsigned, unsigned, uint64_t stream, void** arguments, void** extra) {
  try {
    if (contexts < 1 || blocks == 0) throw emulator::Failure("no context, or no block");
    // The arguments are in one buffer: its address and the address of its size, each after its label.
    if (arguments || extra[0] != (void*)1 || extra[2] != (void*)2 || extra[4])
      throw emulator::Failure("the arguments are not packed");
    function(blocks, int(threads), stream, (const char*)extra[1], *(size_t*)extra[3]);
    return OK;
  } catch (const std::exception& error) {
    trouble = error.what();
    return LAUNCH_FAILED;
  }
}
int cuGetErrorString(int, const char** message) {
  *message = trouble.c_str();
  return OK;
}
}
