// SPDX-License-Identifier: Apache-2.0
// What core_table measures with.
#pragma once

#include <linux/perf_event.h>
#include <sys/ioctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <ctime>
#include <limits>
#include <vector>

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

inline double threadSeconds() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

inline double wallSeconds() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch())
        .count();
}

/// Cache misses of this thread, where the system tells them.
class CacheMisses {
  public:
    CacheMisses() {
        perf_event_attr wanted{};
        wanted.size = sizeof(wanted);
        wanted.type = PERF_TYPE_HARDWARE;
        wanted.config = PERF_COUNT_HW_CACHE_MISSES;
        wanted.exclude_kernel = 1;
        wanted.exclude_hv = 1;
        counter_ = static_cast<int>(syscall(SYS_perf_event_open, &wanted, 0, -1, -1, 0));
    }
    ~CacheMisses() {
        if (counter_ >= 0) {
            close(counter_);
        }
    }
    CacheMisses(const CacheMisses&) = delete;
    CacheMisses& operator=(const CacheMisses&) = delete;

    double sofar() const {
        uint64_t count = 0;
        return counter_ >= 0 && read(counter_, &count, sizeof(count)) == sizeof(count)
                   ? static_cast<double>(count)
                   : kNaN;
    }

  private:
    int counter_ = -1;
};

inline double median(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    return values.empty() ? kNaN : values[values.size() / 2];
}
