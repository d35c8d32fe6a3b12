// The yardstick of the real-time benchmark: a C++ loop on an absolute grid, one mj_step a tick, nothing else.
//
//   twin MODEL OUT PERIOD_NS TICKS WARM_UP_TICKS PRIORITY
//
// OUT gets three int64 a tick, on CLOCK_MONOTONIC in nanoseconds: due, woke, ended. The standard output is one JSON
// object that says what the system granted. The policy on overrun is that of loops.py: keep the phase, skip the points
// of the grid that have passed.

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
#include <string>
#include <thread>
#include <vector>

#include <mujoco/mujoco.h>

// libstdc++'s steady_clock is CLOCK_MONOTONIC, the clock of Python's time.monotonic_ns().
using Clock = std::chrono::steady_clock;
using std::chrono::nanoseconds;

struct Record {
  std::int64_t due, woke, ended;
};

static std::int64_t now_ns() {
  return std::chrono::duration_cast<nanoseconds>(Clock::now().time_since_epoch()).count();
}

// Runs the grid; returns how many points of it were skipped, with those that passed during the last tick.
static std::int64_t run(const mjModel* model, mjData* data, std::int64_t period, std::int64_t points,
                        std::vector<Record>* records) {
  std::int64_t executed = 0;
  const std::int64_t start = now_ns() + period;
  std::int64_t point = 0;
  for (; point < points; ++executed) {
    const std::int64_t due = start + point * period;
    std::this_thread::sleep_until(Clock::time_point(nanoseconds(due)));
    const std::int64_t woke = now_ns();
    mj_step(model, data);
    const std::int64_t ended = now_ns();
    if (records != nullptr) records->push_back({due, woke, ended});
    point = std::max(point + 1, (ended - start) / period + 1);
  }
  return point - executed;
}

int main(int argc, char** argv) {
  if (argc != 7) {
    std::fprintf(stderr, "usage: twin MODEL OUT PERIOD_NS TICKS WARM_UP_TICKS PRIORITY\n");
    return 2;
  }
  const std::int64_t period = std::atoll(argv[3]), ticks = std::atoll(argv[4]), warm_up = std::atoll(argv[5]);
  const int priority = std::atoi(argv[6]);

  const std::string path = argv[1];
  char error[1000] = "cannot read it";
  const bool binary = path.size() > 4 && path.compare(path.size() - 4, 4, ".mjb") == 0;
  mjModel* model = binary ? mj_loadModel(argv[1], nullptr) : mj_loadXML(argv[1], nullptr, error, sizeof error);
  if (model == nullptr) {
    std::fprintf(stderr, "model %s: %s\n", argv[1], error);
    return 2;
  }
  mjData* data = mj_makeData(model);
  if (model->nkey > 0) mj_resetDataKeyframe(model, data, 0);
  mj_forward(model, data);

  std::vector<Record> records(ticks);  // touches every page before the memory is locked
  records.clear();                     // keeps the capacity

  const int lock_error = mlockall(MCL_CURRENT | MCL_FUTURE) == 0 ? 0 : errno;
  sched_param parameter{};
  parameter.sched_priority = priority;
  const int scheduler_error = sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &parameter) == 0 ? 0 : errno;
  if (scheduler_error != 0) prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);

  if (warm_up > 0) run(model, data, period, warm_up, nullptr);
  const std::int64_t skipped = run(model, data, period, ticks, &records);

  std::FILE* out = std::fopen(argv[2], "wb");
  if (out == nullptr || std::fwrite(records.data(), sizeof(Record), records.size(), out) != records.size() ||
      std::fclose(out) != 0) {
    std::fprintf(stderr, "cannot write %s: %s\n", argv[2], std::strerror(errno));
    return 2;
  }
  std::printf("{\"skipped\": %lld, \"scheduler\": \"%s\", \"locked\": %s, \"refused\": [", (long long)skipped,
              scheduler_error == 0 ? "SCHED_FIFO" : "SCHED_OTHER", lock_error == 0 ? "true" : "false");
  if (scheduler_error != 0) std::printf("\"SCHED_FIFO: %s\"%s", std::strerror(scheduler_error), lock_error ? ", " : "");
  if (lock_error != 0) std::printf("\"mlockall: %s\"", std::strerror(lock_error));
  std::printf("]}\n");
  mj_deleteData(data);
  mj_deleteModel(model);
  return 0;
}
