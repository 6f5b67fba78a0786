// SPDX-License-Identifier: Apache-2.0
#include "command_line.h"

#include "io/density.h"

#include "failure.h"

#include <tbb/global_control.h>
#include <unistd.h>

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <iostream>
#include <mutex>
#include <new>
#include <utility>

namespace apps {
namespace po = boost::program_options;

namespace {

// Room for one that is never destroyed.
alignas(tbb::global_control) unsigned char threadLimit[sizeof(tbb::global_control)];

std::mutex progressMutex;

}  // namespace

Arguments::Arguments(const Command& command, const std::vector<std::string>& arguments,
                     po::options_description options, const std::vector<std::string>& positional,
                     size_t required) {
    options.add_options()("quiet,q", po::bool_switch(), "only errors on stderr")(
        "threads", po::value<int>()->default_value(0), "threads to use; 0: all")(
        "help,h", po::bool_switch(), "this text");
    po::options_description all = options;
    po::positional_options_description positions;
    for (const std::string& name : positional) {
        all.add_options()(name.c_str(), po::value<std::string>());
        positions.add(name.c_str(), 1);
    }
    try {
        namespace style = po::command_line_style;
        po::store(po::command_line_parser(arguments)
                      .options(all)
                      .positional(positions)
                      .style(style::unix_style & ~style::allow_guessing)
                      .run(),
                  values_);
        po::notify(values_);
    } catch (const po::too_many_positional_options_error&) {
        throw UsageError("too many arguments");
    } catch (const po::error& e) {
        throw UsageError(e.what());
    }
    if (flag("help")) {
        std::cout << "usage: " << command.synopsis << "\n\n"
                  << command.summary << "\n\n"
                  << options << "\n";
        throw HelpShown{};
    }
    for (size_t i = 0; i < required; ++i) {
        if (!has(positional[i]) || text(positional[i]).empty()) {
            throw UsageError("missing argument " + positional[i]);
        }
    }
    const int threads = integer("threads", 0, 4096);
    if (threads > 0) {
        // TBB obeys this for as long as it lives, and where it dies starts the threads it was kept
        // from starting: it never does.
        new (threadLimit) tbb::global_control(tbb::global_control::max_allowed_parallelism,
                                              static_cast<size_t>(threads));
    }
}

int Arguments::integer(const std::string& name, int lo, int hi) const {
    const int value = get<int>(name);
    if (value < lo || value > hi) {
        throw UsageError("--" + name + " " + std::to_string(value) + ": expected " +
                         std::to_string(lo) + " to " + std::to_string(hi));
    }
    return value;
}

void refuseInput(const std::string& output, const std::vector<std::string>& inputs) {
    for (const std::string& input : inputs) {
        std::error_code ignored;
        if (!output.empty() && !input.empty() &&
            std::filesystem::equivalent(input, output, ignored)) {
            throw trk::Error(TRK_ERROR_IO, output + ": is an input; expected another output");
        }
    }
}

void addGridOptions(po::options_description& options) {
    options.add_options()("grid", po::value<std::string>(),
                          "grid to read, NAME or NAME[i]; default: the only one that can be a "
                          "density, else density")("drop-nonfinite", po::bool_switch(),
                                                   "read NaN and infinite densities as 0")(
        "clamp-negative", po::bool_switch(), "read negative densities as 0")(
        "max-memory", po::value<std::string>(),
        "fail rather than hold more for the volume: bytes, or 512M, 4G (powers of 1024)");
}

uint64_t memoryLimit(const Arguments& arguments) {
    if (!arguments.has("max-memory")) {
        return 0;
    }
    const std::string text = arguments.text("max-memory");
    const char* last = text.data() + text.size();
    uint64_t bytes = 0;
    const auto [end, error] = std::from_chars(text.data(), last, bytes);
    const std::string units = "KMGT";
    const size_t unit = end == last ? std::string::npos : units.find(*end);
    const int shift = unit == std::string::npos ? 0 : 10 * (static_cast<int>(unit) + 1);
    if (error != std::errc() || end + (shift > 0 ? 1 : 0) != last || bytes == 0 ||
        bytes > UINT64_MAX >> shift) {
        throw UsageError("--max-memory " + text + ": expected bytes above 0, as 512M or 4G, say");
    }
    return bytes << shift;
}

trk::DensityOptions densityOptionsOf(const Arguments& arguments) {
    trk::DensityOptions options;
    options.gridNamed = arguments.has("grid");
    options.gridName = arguments.text("grid");
    options.repair = repairBits(arguments);
    options.maxMemory = memoryLimit(arguments);
    return options;
}

uint32_t repairBits(const Arguments& arguments) {
    uint32_t bits = 0;
    if (arguments.flag("drop-nonfinite")) {
        bits |= TRK_REPAIR_DROP_NONFINITE;
    }
    if (arguments.flag("clamp-negative")) {
        bits |= TRK_REPAIR_CLAMP_NEGATIVE;
    }
    return bits;
}

void addColorOption(po::options_description& options) {
    options.add_options()("color", po::value<std::string>()->default_value("1,1,1"),
                          "r,g,b: extinction of channel k = scale x color_k x density; three that "
                          "differ tint a density of one channel");
}

std::array<float, 3> colorOf(const Arguments& arguments) {
    const std::string text = arguments.text("color");
    const std::vector<double> numbers = numberList("color", text, 3);
    std::array<float, 3> color{};
    for (size_t c = 0; c < 3; ++c) {
        color[c] = static_cast<float>(numbers[c]);
        if (!(color[c] >= 0) || !std::isfinite(color[c])) {
            throw UsageError("--color " + text + ": expected three finite numbers >= 0");
        }
    }
    return color;
}

void checkLevel(const std::string& sidecar, uint32_t level, const trk::SidecarHeader& header) {
    if (level > static_cast<uint32_t>(header.levels)) {
        throw UsageError("--level " + std::to_string(level) + ": expected 0 to " +
                         std::to_string(header.levels) + ", the levels of " + sidecar);
    }
}

float nonNegative(const Arguments& arguments, const std::string& option) {
    const float value = arguments.get<float>(option);
    if (!(value >= 0) || !std::isfinite(value)) {
        throw UsageError("--" + option + ": expected a finite number >= 0");
    }
    return value;
}

int choiceIndex(const std::string& option, const std::string& name,
                const std::vector<std::string>& names) {
    std::string list;
    for (size_t i = 0; i < names.size(); ++i) {
        if (names[i] == name) {
            return static_cast<int>(i);
        }
        list += (i == 0 ? "" : ", ") + names[i];
    }
    throw UsageError("--" + option + " " + name + ": expected one of " + list);
}

std::vector<double> numberList(const std::string& option, const std::string& text, size_t count) {
    std::vector<double> numbers;
    size_t begin = 0;
    bool good = true;
    while (good && begin <= text.size()) {
        const size_t end = std::min(text.find(',', begin), text.size());
        const std::string part = text.substr(begin, end - begin);
        char* parsed = nullptr;
        numbers.push_back(std::strtod(part.c_str(), &parsed));
        good = !part.empty() && *parsed == '\0' && std::isfinite(numbers.back());
        begin = end + 1;
    }
    if (!good || numbers.size() != count) {
        throw UsageError("--" + option + " " + text + ": expected " + std::to_string(count) +
                         " numbers separated by commas");
    }
    return numbers;
}

Progress::Progress(const Arguments& arguments, std::string label)
    : label_(std::move(label)), shown_(!arguments.quiet() && isatty(STDERR_FILENO) == 1) {
    if (shown_) {
        std::fprintf(stderr, "%s …", label_.c_str());
        std::fflush(stderr);
    }
}

Progress::~Progress() {
    if (shown_) {
        std::fputs("\r\033[K", stderr);
    }
}

void Progress::update(double fraction) const {
    if (!shown_) {
        return;
    }
    const std::lock_guard<std::mutex> lock(progressMutex);
    const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start_;
    const double seconds = elapsed.count();
    if (seconds < last_ + 0.2) {
        return;
    }
    last_ = seconds;
    std::fprintf(stderr, "\r\033[K%s … %d %%", label_.c_str(), static_cast<int>(100 * fraction));
    constexpr double kLong = 5;
    const double left = fraction > 0 ? seconds / fraction - seconds : 0;
    if (left > kLong) {
        std::fprintf(stderr, ", %d:%02d left", static_cast<int>(left) / 60,
                     static_cast<int>(left) % 60);
    }
    std::fflush(stderr);
}

std::string shellWord(const std::string& text) {
    const bool plain = !text.empty() && std::all_of(text.begin(), text.end(), [](char c) {
        return std::isalnum(static_cast<unsigned char>(c)) ||
               std::string("-_./,:=+%@").find(c) != std::string::npos;
    });
    if (plain) {
        return text;
    }
    std::string quoted = "'";
    for (const char c : text) {
        quoted += c == '\'' ? std::string("'\\''") : std::string(1, c);
    }
    return quoted + "'";
}

std::string byteCount(uint64_t bytes) {
    const char* const units[] = {"bytes", "kB", "MB", "GB", "TB"};
    auto value = static_cast<double>(bytes);
    size_t unit = 0;
    while (value >= 999.5 && unit + 1 < std::size(units)) {
        value /= 1000;
        ++unit;
    }
    char text[32];
    std::snprintf(text, sizeof(text), unit == 0 ? "%.0f %s" : "%.3g %s", value, units[unit]);
    return text;
}

}  // namespace apps
