// The yardstick of benchmarks/realtime.py: a C++ loop on an absolute grid, some steps of MuJoCo a tick, nothing else.
//
//   twin MODEL STATE OUT PERIOD_NS STEPS POINTS PRIORITY
//
// OUT gets three int64 a tick, on CLOCK_MONOTONIC in nanoseconds: due, started, ended. What the system refused is
// printed, one line each. On overrun the phase stays, and the points of the grid that have passed are skipped.

#include <sched.h>
#include <sys/mman.h>
#include <sys/prctl.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <thread>
#include <vector>

#include <mujoco/mujoco.h>

using Clock = std::chrono::steady_clock;  // CLOCK_MONOTONIC, as Python's time.monotonic_ns()
using std::chrono::nanoseconds;

static std::int64_t now_ns() { return std::chrono::duration_cast<nanoseconds>(Clock::now().time_since_epoch()).count(); }

static int fail(const char* what) {
  std::fprintf(stderr, "%s: %s\n", what, std::strerror(errno));
  return 2;
}

int main(int argc, char** argv) {
  if (argc != 8) {
    std::fprintf(stderr, "usage: twin MODEL STATE OUT PERIOD_NS STEPS POINTS PRIORITY\n");
    return 2;
  }
  const std::int64_t period = std::atoll(argv[4]), points = std::atoll(argv[6]);
  const int steps = std::atoi(argv[5]);

  mjModel* model = mj_loadModel(argv[1], nullptr);
  if (model == nullptr) return fail(argv[1]);
  mjData* data = mj_makeData(model);
  std::vector<mjtNum> state(mj_stateSize(model, mjSTATE_INTEGRATION));
  std::FILE* in = std::fopen(argv[2], "rb");
  if (in == nullptr || std::fread(state.data(), sizeof(mjtNum), state.size(), in) != state.size()) return fail(argv[2]);
  mj_setState(model, data, state.data(), mjSTATE_INTEGRATION);

  std::vector<std::int64_t> records(3 * points);  // touches every page before the memory is locked
  if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) std::printf("memory lock: %s\n", std::strerror(errno));
  sched_param parameter{};
  parameter.sched_priority = std::atoi(argv[7]);
  if (sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &parameter) != 0) {
    std::printf("scheduler: %s\n", std::strerror(errno));
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
  }

  std::size_t used = 0;
  const std::int64_t start = now_ns() + period;
  for (std::int64_t point = 0; point < points;) {
    const std::int64_t due = start + point * period;
    std::this_thread::sleep_until(Clock::time_point(nanoseconds(due)));
    const std::int64_t started = now_ns();
    for (int step = 0; step < steps; ++step) mj_step(model, data);
    const std::int64_t ended = now_ns();
    for (const std::int64_t time : {due, started, ended}) records[used++] = time;
    point = std::max(point + 1, (ended - start) / period + 1);
  }

  std::FILE* out = std::fopen(argv[3], "wb");
  if (out == nullptr || std::fwrite(records.data(), sizeof(records[0]), used, out) != used || std::fclose(out) != 0) {
    return fail(argv[3]);
  }
  mj_deleteData(data);
  mj_deleteModel(model);
  return 0;
}
