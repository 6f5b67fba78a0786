// SPDX-License-Identifier: Apache-2.0
// What a long call tells its caller while it runs, and whether the caller wants it to end.
#pragma once

#include "failure.h"

#include <algorithm>
#include <chrono>
#include <functional>
#include <tuple>
#include <utility>

namespace trk {

/// While one lives, the loops of parallel.h that its thread starts, and whatever calls poll() in
/// that thread, tell its callback now and then how far the work is: always in that thread, ten
/// times a second at most. Others of the same thread hide it.
class Progress {
  public:
    /// `goOn(share)`: of the work done, 0 to 1, never less than before; false ends the work.
    explicit Progress(std::function<bool(double)> goOn)
        : goOn_(std::move(goOn)), outer_(std::exchange(current(), this)) {}
    ~Progress() { current() = outer_; }
    Progress(const Progress&) = delete;
    Progress& operator=(const Progress&) = delete;

    /// Throws Error (CANCELLED) where whoever asked for this thread's work wants it to end.
    /// `share`: of the stage, where it is known.
    static void poll(double share = 0) {
        if (current()) {
            current()->tell(share);
        }
    }

    /// A part of the work, from one share of all of it to another.
    class Stage {
      public:
        Stage(double from, double to) : progress_(current()) {
            if (progress_) {
                before_ = {progress_->from_, progress_->to_};
                const double width = progress_->to_ - progress_->from_;
                progress_->to_ = progress_->from_ + width * to;
                progress_->from_ += width * from;
                progress_->tell(0);
            }
        }
        ~Stage() {
            if (progress_) {
                std::tie(progress_->from_, progress_->to_) = before_;
            }
        }
        Stage(const Stage&) = delete;
        Stage& operator=(const Stage&) = delete;

      private:
        Progress* progress_;
        std::pair<double, double> before_;
    };

  private:
    using Clock = std::chrono::steady_clock;

    static Progress*& current() {
        thread_local Progress* current = nullptr;
        return current;
    }

    void tell(double share) {
        reached_ = std::max(reached_, from_ + (to_ - from_) * std::min(share, 1.0));
        const Clock::time_point now = Clock::now();
        if (now - told_ < std::chrono::milliseconds(100)) {
            return;
        }
        told_ = now;
        // What the callback itself asks of the library is not this work.
        Progress* const self = std::exchange(current(), nullptr);
        const bool goesOn = goOn_(reached_);
        current() = self;
        if (!goesOn) {
            throw Error(TRK_ERROR_CANCELLED, "cancelled by the caller's progress function");
        }
    }

    std::function<bool(double)> goOn_;
    Progress* outer_;
    double from_ = 0;
    double to_ = 1;
    double reached_ = 0;
    Clock::time_point told_{};  // so that the first time is at once
};

}  // namespace trk
