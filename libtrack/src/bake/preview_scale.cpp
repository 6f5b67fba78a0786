// SPDX-License-Identifier: Apache-2.0
#include "preview_scale.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <numeric>
#include <tuple>
#include <type_traits>
#include <vector>

namespace trk {
namespace {

/// The line of an axis through a place, from side to side of a field's box.
LocalRay lineThrough(const IntBox& box, const Vec3d& place, int axis) {
    LocalRay ray;
    ray.origin = place;
    for (int a = 0; a < 3; ++a) {
        ray.direction[a] = a == axis ? 1 : 0;
        ray.inverse[a] = a == axis ? 1 : 1e300;
    }
    ray.origin[axis] = static_cast<double>(box.lo[static_cast<size_t>(axis)]);
    ray.tEnd = static_cast<double>(box.hi[static_cast<size_t>(axis)]) - ray.origin[axis];
    return ray;
}

/// What of a line lies in a region of one entry.
struct Piece {
    SparseTable::Entry entry;
    uint32_t line;
    Int3 lo;
    double t0;
    double t1;
};

/// The integral of the density over it (the mean over channels), in voxel lengths.
double depthOf(const BrickPages& pages, const Piece& piece, const LocalRay& line) {
    const auto depth = [&](auto channels) {
        double sum = 0;
        for (const double d :
             pages.integrate<channels>(piece.entry, piece.lo, line, piece.t0, piece.t1)) {
            sum += d / static_cast<double>(channels);
        }
        return sum;
    };
    return pages.field().channels() == 1 ? depth(std::integral_constant<size_t, 1>{})
                                         : depth(std::integral_constant<size_t, 3>{});
}

/// Integrals along whole lines. With pages, piece after piece in the order of their bricks; they
/// are summed in the order of the lines either way.
std::vector<double> depthsAlong(BrickPages& pages, const std::vector<LocalRay>& lines) {
    const auto forEachPiece = [&](size_t i, const auto& body) {
        pages.field().table().walk(
            lines[i], 0, lines[i].tEnd,
            [&](SparseTable::Entry entry, const Int3& lo, int, double t0, double t1) {
                body(Piece{entry, static_cast<uint32_t>(i), lo, t0, t1});
                return true;
            });
    };
    std::vector<double> depths(lines.size(), 0);
    if (pages.resident()) {
        parallelFor(lines.size(), 16, [&](size_t i) {
            forEachPiece(i,
                         [&](const Piece& piece) { depths[i] += depthOf(pages, piece, lines[i]); });
        });
        return depths;
    }
    std::vector<Piece> pieces;
    for (size_t i = 0; i < lines.size(); ++i) {
        forEachPiece(i, [&](const Piece& piece) { pieces.push_back(piece); });
    }
    std::vector<uint32_t> order(pieces.size());
    std::iota(order.begin(), order.end(), 0u);
    std::sort(order.begin(), order.end(), [&](uint32_t a, uint32_t b) {
        return std::tie(pieces[a].entry, a) < std::tie(pieces[b].entry, b);
    });
    std::vector<double> parts(pieces.size());
    const auto bricksOf = [&](size_t i, const auto& f) { f(pieces[order[i]].entry); };
    pages.forEach(pieces.size(), 64, bricksOf, [&](size_t i) {
        const Piece& piece = pieces[order[i]];
        parts[order[i]] = depthOf(pages, piece, lines[piece.line]);
    });
    for (size_t i = 0; i < pieces.size(); ++i) {
        depths[pieces[i].line] += parts[i];
    }
    return depths;
}

/// The nearest number of two digits, as it is written.
double twoDigits(double value) {
    char text[32];
    std::snprintf(text, sizeof(text), "%.1e", value);
    double result = value;
    std::from_chars(text, text + std::strlen(text), result);
    return result;
}

}  // namespace

double previewScale(BrickPages pages, const AffineMap& indexToWorld) {
    const DensityField& field = pages.field();
    constexpr size_t kPlaces = 256;
    size_t count = 0;
    field.table().forEach([&](const Int3&, int, SparseTable::Entry) { ++count; });
    const size_t step = std::max<size_t>(1, count / kPlaces);
    std::vector<Vec3d> centres;
    size_t i = 0;
    field.table().forEach([&](const Int3& lo, int shift, SparseTable::Entry) {
        if (i++ % step != step / 2) {
            return;
        }
        Vec3d centre;
        for (int a = 0; a < 3; ++a) {
            centre[a] = static_cast<double>(lo[static_cast<size_t>(a)]) + std::ldexp(0.5, shift);
        }
        centres.push_back(centre);
    });
    std::vector<LocalRay> lines;
    for (const Vec3d& centre : centres) {
        for (int axis = 0; axis < 3; ++axis) {
            lines.push_back(lineThrough(field.box(), centre, axis));
        }
    }
    std::vector<double> depths = depthsAlong(pages, lines);
    for (size_t k = 0; k < depths.size(); ++k) {
        depths[k] *= length(indexToWorld.column(static_cast<int>(k % 3)));
    }
    depths.erase(std::remove_if(depths.begin(), depths.end(), [](double d) { return !(d > 0); }),
                 depths.end());
    if (depths.empty()) {
        return 1;
    }
    const auto middle = depths.begin() + static_cast<std::ptrdiff_t>(depths.size() / 2);
    std::nth_element(depths.begin(), middle, depths.end());
    constexpr double kShown = 4.6;  // -log(0.01)
    // From a veil to a solid body, the volume's own scale is what its maker meant.
    constexpr double kThinnest = 3;
    constexpr double kThickest = 12;
    if (*middle >= kThinnest && *middle <= kThickest) {
        return 1;
    }
    return std::min(twoDigits(kShown / *middle), 1e37);  // it becomes a float
}

}  // namespace trk
