// Runs CUDA kernels on a CPU, one fiber per thread, so that tests can check the same source that a GPU runs.
//
// A thread runs until it reaches a barrier or a warp operation. Then another thread of its block continues,
// in an order shuffled by a seed. So a result that depends on the schedule changes with the seed. If a
// barrier is missing, a thread reads memory before it is written; shared memory starts with garbage in each
// block. A barrier that some threads do not reach is reported as a deadlock.
//
// The emulator cannot show the order in which a real memory system makes stores visible to other threads, nor
// the rounding of a real GPU's exponential. Compiled with -fsanitize=thread, each CUDA thread is a thread of
// ThreadSanitizer, and only __syncthreads, __syncwarp and the end of a launch order memory, so two threads that
// use a number without a barrier between them are reported however they were scheduled.
#pragma once

#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

struct Index {
  unsigned x;
};
inline Index threadIdx, blockIdx, blockDim, gridDim;  // of the running thread

// A GPU requires these alignments, and so do the sanitizers.
struct alignas(8) float2 {
  float x, y;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

// 1: blocks of one launch are unordered, as on a GPU. 0: they run one after another. All blocks have the same
// shared memory, so only 0 says something about races in it.
extern "C" int unordered_blocks;

#if defined(__SANITIZE_THREAD__)
extern "C" {
void* __tsan_get_current_fiber();
void* __tsan_create_fiber(unsigned);
void __tsan_switch_to_fiber(void*, unsigned);
void __tsan_acquire(void*);
void __tsan_release(void*);
void AnnotateIgnoreReadsBegin(const char*, int);
void AnnotateIgnoreReadsEnd(const char*, int);
void AnnotateIgnoreWritesBegin(const char*, int);
void AnnotateIgnoreWritesEnd(const char*, int);
}
#endif

namespace emulator {

// These functions tell ThreadSanitizer what is ordered. Otherwise they do nothing.
namespace order {
#if defined(__SANITIZE_THREAD__)
inline void before(void* point) { __tsan_release(point); }
inline void after(void* point) { __tsan_acquire(point); }
inline void* current() { return __tsan_get_current_fiber(); }
inline void* create() { return __tsan_create_fiber(0); }
// 1: the switch itself orders nothing.
inline void switch_to(void* fiber) { __tsan_switch_to_fiber(fiber, 1); }
// While an object of this class lives, the thread uses the variables of the emulator itself.
struct Unwatched {
  Unwatched() { AnnotateIgnoreReadsBegin(__FILE__, __LINE__), AnnotateIgnoreWritesBegin(__FILE__, __LINE__); }
  ~Unwatched() { AnnotateIgnoreWritesEnd(__FILE__, __LINE__), AnnotateIgnoreReadsEnd(__FILE__, __LINE__); }
};
#else
inline void before(void*) {}
inline void after(void*) {}
inline void* current() { return nullptr; }
inline void* create() { return nullptr; }
inline void switch_to(void*) {}
struct Unwatched {
  Unwatched() {}
};
#endif
}  // namespace order

constexpr int WARP = 32;
#if defined(__SANITIZE_THREAD__)
constexpr size_t STACK = 256 << 10;
#else
constexpr size_t STACK = 64 << 10;
#endif
// Fibers are used again, by every so many blocks. Unordered blocks with the same fibers would be ordered.
constexpr unsigned SETS = 4;
constexpr int MOST_THREADS = 1024;  // of a block, on every GPU

struct Failure : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// A point at which threads wait for one another. All members must arrive, and for the same reason.
struct Meeting {
  int members = 0, arrived = 0;
  unsigned generation = 0;
  const char* reason = nullptr;
  uint64_t values[2][WARP];  // of this generation and the previous one; a slow reader is at most one behind
};

struct Fiber {
  ucontext_t place;
  void* top = nullptr;  // of the stack, while another one runs
  void* identity = nullptr;  // the thread of ThreadSanitizer
  std::unique_ptr<char[]> stack;
  bool has_ended = true;
  const Meeting* waits_at = nullptr;
  unsigned waits_since = 0;
  bool can_run() const { return !has_ended && (!waits_at || waits_at->generation != waits_since); }
};

// A pseudo-random generator (xorshift, Marsaglia 2003) that compiles faster than <random>.
struct Random {
  uint64_t state = 1;
  void seed(uint64_t seed) { state = seed * 0x9e3779b97f4a7c15u | 1; }
  unsigned operator()() {
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return unsigned(state >> 32);
  }
  unsigned below(unsigned limit) { return unsigned(uint64_t((*this)()) * limit >> 32); }
};

struct Machine {
  Random random;
  bool is_shuffled = false;
  std::unique_ptr<Fiber[]> sets[SETS];
  Fiber* fibers = nullptr;  // of this block
  std::vector<Meeting> warps;
  Meeting block;
  int running = 0;
  ucontext_t outside;  // the scheduler
  void* top = nullptr;
  void* identity = nullptr;
  char launched, ended;  // what they order is known by their addresses
  std::string trouble;
  void (*body)(void*) = nullptr;
  void* argument = nullptr;
};
inline Machine machine;
inline Fiber& running_fiber() { return machine.fibers[machine.running]; }

inline void fiber_main();

#if defined(__x86_64__) && !defined(__SANITIZE_THREAD__)
// Saves the registers that a function must keep and the top of this stack, and continues on another stack.
// swapcontext calls the system, and AddressSanitizer does so before each longjmp.
extern "C" void emulator_switch(void** from, void* to);
asm(".text\n.globl emulator_switch\nemulator_switch:\n"
    "push %rbp\npush %rbx\npush %r12\npush %r13\npush %r14\npush %r15\n"
    "mov %rsp, (%rdi)\nmov %rsi, %rsp\n"
    "pop %r15\npop %r14\npop %r13\npop %r12\npop %rbx\npop %rbp\nret\n");
inline void yield() { emulator_switch(&running_fiber().top, machine.top); }
inline void enter(Fiber& fiber) { emulator_switch(&machine.top, fiber.top); }
inline void prepare(Fiber& fiber) {
  const uintptr_t end = reinterpret_cast<uintptr_t>(fiber.stack.get() + STACK) / 16 * 16;
  void** const slots = reinterpret_cast<void**>(end) - 8;  // six registers, the address to return to, a gap
  for (int i = 0; i < 8; ++i) slots[i] = nullptr;
  slots[6] = reinterpret_cast<void*>(fiber_main);
  fiber.top = slots;
}
#else
inline void yield() {
  order::switch_to(machine.identity);
  swapcontext(&running_fiber().place, &machine.outside);
}
inline void enter(Fiber& fiber) {
  order::switch_to(fiber.identity);
  swapcontext(&machine.outside, &fiber.place);
}
inline void prepare(Fiber& fiber) {
  getcontext(&fiber.place);
  fiber.place.uc_stack.ss_sp = fiber.stack.get();
  fiber.place.uc_stack.ss_size = STACK;
  fiber.place.uc_link = nullptr;
  makecontext(&fiber.place, fiber_main, 0);
}
#endif

inline void fail(const std::string& trouble) {
  if (machine.trouble.empty()) machine.trouble = trouble;
  for (;;) yield();
}

// Returns the generation of the meeting. Its values stay valid for one more generation.
inline unsigned meet(Meeting& meeting, const char* reason, int seat, uint64_t value) {
  const order::Unwatched unwatched;
  Fiber& self = running_fiber();
  const unsigned generation = meeting.generation;
  if (meeting.arrived > 0 && std::strcmp(meeting.reason, reason) != 0)
    fail(std::string("divergence: ") + reason + " in one thread, " + meeting.reason + " in another");
  meeting.reason = reason;
  meeting.values[generation % 2][seat] = value;
  if (++meeting.arrived == meeting.members) {
    meeting.arrived = 0;
    ++meeting.generation;
  }
  self.waits_at = &meeting;
  self.waits_since = generation;
  yield();
  self.waits_at = nullptr;
  return generation;
}

// A barrier that orders memory too. No thread is more than one generation behind, so two points are enough.
inline void synchronize(Meeting& meeting, const char* reason, int seat) {
  char* const points = reinterpret_cast<char*>(&meeting.values[0][0]);
  char* const point = points + 8 * (meeting.generation % 2);
  order::before(point);
  meet(meeting, reason, seat, 0);
  order::after(point);
}

inline void fiber_main() {
  for (;;) {
    order::after(&machine.launched);
    machine.body(machine.argument);
    order::before(&machine.ended);
    const order::Unwatched unwatched;
    running_fiber().has_ended = true;
    yield();
  }
}

inline void resume(int index) {
  machine.running = index;
  threadIdx.x = unsigned(index);
  enter(running_fiber());
}

// The fibers that stand somewhere in a kernel cannot be used again.
[[noreturn]] inline void give_up(const std::string& trouble) {
  for (auto& set : machine.sets)
    if (set.get() == machine.fibers) set.reset();
  throw Failure(trouble);
}

inline void run_block(int threads, unsigned set) {
  if (!machine.sets[set]) machine.sets[set].reset(new Fiber[MOST_THREADS]);
  Fiber* const fibers = machine.fibers = machine.sets[set].get();
  machine.warps.assign(size_t((threads + WARP - 1) / WARP), Meeting());
  machine.block = Meeting();
  machine.block.members = threads;
  int order[MOST_THREADS];
  for (int i = 0; i < threads; ++i) {
    if (!fibers[i].stack) {
      fibers[i].stack.reset(new char[STACK]);
      fibers[i].identity = order::create();
      prepare(fibers[i]);
    }
    fibers[i].has_ended = false;
    fibers[i].waits_at = nullptr;
    ++machine.warps[size_t(i / WARP)].members;
    order[i] = i;
  }
  // Now and then one warp stands still, in most cases until all others wait for it. Without that, all threads
  // would take about as many steps, and a fast warp could never overtake a slow one.
  int stalled = -1;
  for (int alive = threads; alive > 0;) {
    if (machine.is_shuffled && machine.random() % (stalled < 0 ? 16 : 256) == 0)
      stalled = stalled < 0 ? int(machine.random() % machine.warps.size()) : -1;
    if (machine.is_shuffled)
      for (int i = threads - 1; i > 0; --i) {
        const unsigned j = machine.random.below(unsigned(i) + 1);
        const int moved = order[i];
        order[i] = order[j], order[j] = moved;
      }
    bool has_run = false;
    for (int place = 0; place < threads; ++place) {
      const int i = order[place];
      if (i / WARP == stalled || !fibers[i].can_run()) continue;
      has_run = true;
      resume(i);
      alive -= fibers[i].has_ended;
      if (!machine.trouble.empty()) give_up(machine.trouble);
    }
    if (!has_run && stalled < 0) give_up("deadlock: some threads wait at a barrier that others never reach");
    if (!has_run) stalled = -1;
  }
}

extern "C" char __start_emulated_shared[], __stop_emulated_shared[];

template <class... Parameters, size_t... I>
void run_grid(void (*kernel)(Parameters...), unsigned blocks, int threads, uint64_t seed, const char* raw,
              size_t size, std::index_sequence<I...>) {
  static_assert(((sizeof(Parameters) == 8) && ...), "a launch is a list of eight-byte numbers");
  if (size != 8 * sizeof...(Parameters)) throw Failure("a launch with too many or too few arguments");
  const order::Unwatched unwatched;
  auto call = [&] {
    std::tuple<Parameters...> parameters;
    (std::memcpy(&std::get<I>(parameters), raw + 8 * I, 8), ...);
    kernel(std::get<I>(parameters)...);
  };
  machine.body = [](void* f) { (*static_cast<decltype(call)*>(f))(); };
  machine.argument = &call;
  machine.random.seed(seed);
  machine.is_shuffled = seed != 0;
  machine.trouble.clear();
  blockDim.x = unsigned(threads), gridDim.x = blocks;
  std::vector<unsigned> blocks_in_order(blocks);
  for (unsigned i = 0; i < blocks; ++i) blocks_in_order[i] = i;
  if (machine.is_shuffled)
    for (unsigned i = blocks; i > 1; --i)
      std::swap(blocks_in_order[i - 1], blocks_in_order[machine.random() % i]);
  machine.identity = order::current();
  order::before(&machine.launched);
  for (const unsigned block : blocks_in_order) {
    blockIdx.x = block;
    std::memset(__start_emulated_shared, 0xff, size_t(__stop_emulated_shared - __start_emulated_shared));
    run_block(threads, block % SETS);
    if (unordered_blocks) continue;
    order::after(&machine.ended);
    order::before(&machine.launched);
  }
  order::after(&machine.ended);
}

template <class... Parameters>
void launch(void (*kernel)(Parameters...), unsigned blocks, int threads, uint64_t seed, const char* raw,
            size_t size) {
  run_grid(kernel, blocks, threads, seed, raw, size, std::index_sequence_for<Parameters...>());
}

inline int lane() { return machine.running % WARP; }
inline Meeting& warp() { return machine.warps[size_t(machine.running / WARP)]; }

inline void require_all(unsigned mask) {
  if (mask != 0xffffffffu) fail("only operations of a whole warp are emulated");
}

template <class T>
T shuffle(const char* reason, unsigned mask, T value, int source) {
  static_assert(sizeof(T) <= 8);
  require_all(mask);
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof(T));
  const unsigned generation = meet(warp(), reason, lane(), bits);
  bits = warp().values[generation % 2][source % WARP];
  std::memcpy(&value, &bits, sizeof(T));
  return value;
}

inline unsigned ballot(const char* reason, unsigned mask, bool vote) {
  require_all(mask);
  const unsigned generation = meet(warp(), reason, lane(), vote);
  unsigned votes = 0;
  for (int i = 0; i < WARP; ++i) votes |= unsigned(warp().values[generation % 2][i]) << i;
  return votes;
}

}  // namespace emulator

#define __global__
#define __device__ static
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static __attribute__((section("emulated_shared")))
#define __fmaf_rn(a, b, c) std::fmaf(a, b, c)
#define __popc(x) __builtin_popcount(x)
#define __ffs(x) __builtin_ffs(x)

inline unsigned __float_as_uint(float x) {
  unsigned bits;
  std::memcpy(&bits, &x, 4);
  return bits;
}
inline float __uint_as_float(unsigned bits) {
  float x;
  std::memcpy(&x, &bits, 4);
  return x;
}

// The approximations of the hardware, for which device.cuh has the instructions. The hardware returns zero
// instead of a denormal number. With EMULATOR_ROUGH a result is also off by up to ``ulps``, as a function of
// its bits, which is as far as the hardware may be off.
inline float approximately(float x, int ulps) {
  if (!(std::fabs(x) >= 1.17549435e-38f) || std::isinf(x)) return std::isinf(x) ? x : 0.0f;
#if defined(EMULATOR_ROUGH)
  const unsigned bits = __float_as_uint(x);
  return __uint_as_float(bits + (bits * 2654435769u >> 16) % unsigned(2 * ulps + 1) - unsigned(ulps));
#else
  (void)ulps;
  return x;
#endif
}
inline float exp2_approx(float x) { return approximately(std::exp2(x), 2); }
inline float reciprocal_approx(float x) { return approximately(1 / x, 1); }
template <class T>
T keep_in_register(T x) {
  return x;
}
inline void __syncthreads() { emulator::synchronize(emulator::machine.block, "__syncthreads", 0); }
inline void __syncwarp() { emulator::synchronize(emulator::warp(), "__syncwarp", emulator::lane()); }
inline unsigned __ballot_sync(unsigned mask, bool vote) {
  return emulator::ballot("__ballot_sync", mask, vote);
}
inline bool __any_sync(unsigned mask, bool vote) { return emulator::ballot("__any_sync", mask, vote) != 0; }
template <class T>
T __shfl_sync(unsigned mask, T value, int source) {
  return emulator::shuffle("__shfl_sync", mask, value, source);
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int reach) {
  return emulator::shuffle("__shfl_xor_sync", mask, value, emulator::lane() ^ reach);
}
inline unsigned atomicAdd(unsigned* to, unsigned value) { return __atomic_fetch_add(to, value, __ATOMIC_RELAXED); }
