// SPDX-License-Identifier: Apache-2.0
#include "ray_file.h"

#include "failure.h"

#include <cctype>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstring>
#include <fstream>
#include <limits>

namespace apps {
namespace {

/// The numbers of one line, or none where a field is not a number.
std::vector<double> parseFields(const std::string& line) {
    std::vector<double> values;
    const char* at = line.data();
    const char* const end = at + line.size();
    const auto skipSpace = [&] {
        while (at != end && (*at == ' ' || *at == '\t')) {
            ++at;
        }
    };
    for (;;) {
        skipSpace();
        if (at != end && *at == '+') {
            ++at;
        }
        double value = 0;
        const auto [next, error] = std::from_chars(at, end, value);
        if (error != std::errc()) {
            return {};
        }
        values.push_back(value);
        at = next;
        skipSpace();
        if (at == end) {
            return values;
        }
        if (*at++ != ',') {
            return {};
        }
    }
}

}  // namespace

std::vector<TrkRay> readRays(const std::string& path) {
    std::ifstream stream(path);
    if (!stream) {
        throw trk::Error(TRK_ERROR_IO, path + ": cannot be opened: " + std::strerror(errno));
    }
    std::vector<TrkRay> rays;
    std::string line;
    bool first = true;  // a header may stand before the first ray
    for (size_t number = 1; std::getline(stream, line); ++number) {
        if (number == 1 && line.compare(0, 3, "\xef\xbb\xbf") == 0) {
            line.erase(0, 3);  // a byte order mark, as spreadsheets write
        }
        if (!line.empty() && line.back() == '\r') {
            line.pop_back();
        }
        if (line.find_first_not_of(" \t") == std::string::npos || line[0] == '#') {
            continue;
        }
        const std::vector<double> v = parseFields(line);
        const bool letters = std::isalpha(static_cast<unsigned char>(line[0])) != 0 &&
                             line.find("inf") != 0 && line.find("nan") != 0;
        if (v.empty() && first && letters) {
            first = false;
            continue;
        }
        first = false;
        if (v.size() != 6 && v.size() != 8) {
            throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                             path + ": line " + std::to_string(number) +
                                 ": expected ox,oy,oz,dx,dy,dz[,tmin,tmax], found " +
                                 (v.empty() ? "\"" + line.substr(0, 60) + "\""
                                            : std::to_string(v.size()) + " numbers"));
        }
        const auto narrow = [](double x) { return static_cast<float>(x); };
        const TrkRay ray{{narrow(v[0]), narrow(v[1]), narrow(v[2])},
                         v.size() == 8 ? narrow(v[6]) : 0,
                         {narrow(v[3]), narrow(v[4]), narrow(v[5])},
                         v.size() == 8 ? narrow(v[7]) : std::numeric_limits<float>::infinity()};
        bool finite = !std::isnan(ray.tMin) && !std::isnan(ray.tMax);
        bool zero = true;
        for (int a = 0; a < 3; ++a) {
            finite = finite && std::isfinite(ray.origin[a]) && std::isfinite(ray.direction[a]);
            zero = zero && ray.direction[a] == 0;
        }
        if (!finite || zero) {
            throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                             path + ": line " + std::to_string(number) +
                                 ": expected a finite origin, a finite direction that is not zero "
                                 "as a float, and limits that are not NaN");
        }
        rays.push_back(ray);
    }
    if (stream.bad()) {
        throw trk::Error(TRK_ERROR_IO, path + ": cannot be read");
    }
    return rays;
}

}  // namespace apps
