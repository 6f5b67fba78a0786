// SPDX-License-Identifier: Apache-2.0
// Loops over TBB, in a task group of their own: one that the caller of the library cancels would
// otherwise end ours in the middle, without a word. They tell whoever listens to Progress.
#pragma once

#include "progress.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_reduce.h>
#include <tbb/task_group.h>

#include <cstddef>

namespace trk {

/// Calls body(), whose own loops, OpenVDB's among them, then belong to a group that nobody cancels.
/// Exceptions reach the caller.
template <class Body>
void inGroupOfItsOwn(const Body& body) {
    tbb::task_group_context context(tbb::task_group_context::isolated);
    tbb::parallel_for(
        0, 1, [&](int) { body(); }, context);
}

/// Calls body(begin, end) for parts of [0, count) of about `grain`. Exceptions reach the caller.
template <class Body>
void parallelRanges(size_t count, size_t grain, const Body& body) {
    tbb::task_group_context context(tbb::task_group_context::isolated);
    tbb::parallel_for(
        tbb::blocked_range<size_t>(0, count, grain),
        [&](const tbb::blocked_range<size_t>& range) {
            Progress::poll();
            body(range.begin(), range.end());
        },
        context);
}

/// Calls body(i) for every i in [0, count).
template <class Body>
void parallelFor(size_t count, size_t grain, const Body& body) {
    parallelRanges(count, grain, [&](size_t begin, size_t end) {
        for (size_t i = begin; i != end; ++i) {
            body(i);
        }
    });
}

/// The sum of body(i, part) over [0, count), which adds to a part; `part.join(other)` adds two.
template <class Part, class Body>
Part parallelSum(size_t count, size_t grain, const Body& body) {
    tbb::task_group_context context(tbb::task_group_context::isolated);
    return tbb::parallel_reduce(
        tbb::blocked_range<size_t>(0, count, grain), Part{},
        [&](const tbb::blocked_range<size_t>& range, Part part) {
            Progress::poll();
            for (size_t i = range.begin(); i != range.end(); ++i) {
                body(i, part);
            }
            return part;
        },
        [](Part a, const Part& b) {
            a.join(b);
            return a;
        },
        context);
}

}  // namespace trk
