// SPDX-License-Identifier: Apache-2.0
#include "ray_file.h"

#include "failure.h"

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <iterator>
#include <limits>
#include <sstream>

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

const std::vector<std::string> kColumns{"ox", "oy", "oz", "dx", "dy", "dz", "tmin", "tmax"};
constexpr size_t kLeastColumns = 6;

/// Where each of kColumns stands in a line; those not there beyond all.
using Order = std::array<size_t, 8>;

[[noreturn]] void refuse(const std::string& where, const std::string& expected,
                         const std::string& found) {
    throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                     where + ": expected " + expected + ", found " + found);
}

std::string inQuotes(const std::string& line) {
    return "\"" + line.substr(0, 60) + (line.size() > 60 ? "…\"" : "\"");
}

/// The columns that a header names.
Order parseHeader(const std::string& line, const std::string& where, size_t& count) {
    Order order;
    order.fill(kColumns.size());
    count = 0;
    std::istringstream names(line);
    for (std::string name; std::getline(names, name, ','); ++count) {
        const size_t first = name.find_first_not_of(" \t");
        name = first == std::string::npos
                   ? ""
                   : name.substr(first, name.find_last_not_of(" \t") + 1 - first);
        const auto known = std::find(kColumns.begin(), kColumns.end(), name);
        if (known == kColumns.end()) {
            refuse(where, "numbers, or a header of the columns ox,oy,oz,dx,dy,dz[,tmin,tmax]",
                   inQuotes(name) + " in " + inQuotes(line));
        }
        size_t& place = order[static_cast<size_t>(known - kColumns.begin())];
        if (place != kColumns.size()) {
            refuse(where, "every column once", name + " twice");
        }
        place = count;
    }
    for (size_t i = 0; i < kColumns.size(); ++i) {
        const bool needed = i < kLeastColumns || count > kLeastColumns;
        if (needed && order[i] == kColumns.size()) {
            refuse(where, "the columns ox,oy,oz,dx,dy,dz[,tmin,tmax]", "none named " + kColumns[i]);
        }
    }
    return order;
}

std::string readAll(const std::string& path) {
    std::ifstream file;
    if (path != "-") {
        std::error_code ignored;
        if (std::filesystem::is_directory(path, ignored)) {
            throw trk::Error(TRK_ERROR_IO, path + ": is a directory; expected a CSV file");
        }
        file.open(path, std::ios::binary);
        if (!file) {
            throw trk::Error(TRK_ERROR_IO, path + ": cannot be opened: " + std::strerror(errno));
        }
    }
    std::istream& stream = path == "-" ? std::cin : file;
    std::string text((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
    if (stream.bad()) {
        throw trk::Error(TRK_ERROR_IO, path + ": cannot be read");
    }
    return text;
}

TrkRay toRay(const std::vector<double>& fields, const Order& order, const std::string& where) {
    const auto field = [&](size_t column, float missing) {
        return order[column] < fields.size() ? static_cast<float>(fields[order[column]]) : missing;
    };
    TrkRay ray{{field(0, 0), field(1, 0), field(2, 0)},
               field(6, 0),
               {field(3, 0), field(4, 0), field(5, 0)},
               field(7, std::numeric_limits<float>::infinity())};
    bool finite = !std::isnan(ray.tMin) && !std::isnan(ray.tMax);
    bool zero = true;
    for (int a = 0; a < 3; ++a) {
        finite = finite && std::isfinite(ray.origin[a]) && std::isfinite(ray.direction[a]);
        zero = zero && ray.direction[a] == 0;
    }
    if (!finite || zero) {
        throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                         where +
                             ": expected a finite origin, a finite direction that is not zero (as "
                             "floats), and limits that are not NaN");
    }
    if (ray.tMin > ray.tMax) {
        std::ostringstream found;
        found << "tmin " << ray.tMin << " and tmax " << ray.tMax;
        refuse(where, "tmin <= tmax", found.str());
    }
    return ray;
}

}  // namespace

std::vector<TrkRay> readRays(const std::string& path) {
    const std::string text = readAll(path);
    const std::string name = path == "-" ? "standard input" : path;
    std::vector<TrkRay> rays;
    Order order{{0, 1, 2, 3, 4, 5, 6, 7}};
    size_t columns = 0;  // of a header
    bool first = true;   // line that is no comment
    const std::string mark = "\xef\xbb\xbf";
    size_t at = text.compare(0, mark.size(), mark) == 0 ? mark.size() : 0;
    for (size_t number = 1; at < text.size(); ++number) {
        const size_t end = std::min(text.find_first_of("\r\n", at), text.size());
        const std::string line = text.substr(at, end - at);
        at = end + (text.compare(end, 2, "\r\n") == 0 ? 2 : 1);
        const size_t start = line.find_first_not_of(" \t");
        if (start == std::string::npos || line[start] == '#') {
            continue;
        }
        const std::string where = name + ": line " + std::to_string(number);
        const std::vector<double> fields = parseFields(line);
        if (fields.empty() && first) {
            order = parseHeader(line, where, columns);
            first = false;
            continue;
        }
        first = false;
        const bool fits = columns > 0
                              ? fields.size() == columns
                              : fields.size() == kLeastColumns || fields.size() == kColumns.size();
        if (!fits) {
            refuse(where,
                   columns > 0 ? std::to_string(columns) + " numbers, as the header names"
                               : "ox,oy,oz,dx,dy,dz[,tmin,tmax]",
                   fields.empty() ? inQuotes(line) : std::to_string(fields.size()) + " numbers");
        }
        rays.push_back(toRay(fields, order, where));
    }
    return rays;
}

}  // namespace apps
