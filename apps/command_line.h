// SPDX-License-Identifier: Apache-2.0
// What the commands share: options, usage errors, progress, names of choices.
#pragma once

#include "io/sidecar.h"
#include "track/track.h"

#include <boost/program_options.hpp>

#include <array>
#include <chrono>
#include <stdexcept>
#include <string>
#include <vector>

namespace trk {
struct DensityOptions;
}

namespace apps {

/// A mistake in the command line: exit code 2.
class UsageError : public std::runtime_error {
  public:
    using std::runtime_error::runtime_error;
};

/// One command of vdbtrack.
struct Command {
    const char* name;
    const char* synopsis;  ///< "vdbtrack bake IN.vdb [-o …]"
    const char* summary;   ///< one sentence
    void (*run)(const Command& command, const std::vector<std::string>& arguments);
};

extern const Command kMakeCommand;
extern const Command kBakeCommand;
extern const Command kInfoCommand;
extern const Command kVerifyCommand;
extern const Command kQueryCommand;
extern const Command kPreviewCommand;
extern const Command kMeasureCommand;

/// Thrown after --help was printed.
struct HelpShown {};

/// Parsed arguments of one command. Positional arguments come first in `positional`, in order;
/// those from `required` on are optional. --help, --quiet and --threads are added to `options`.
class Arguments {
  public:
    Arguments(const Command& command, const std::vector<std::string>& arguments,
              boost::program_options::options_description options,
              const std::vector<std::string>& positional, size_t required);

    bool has(const std::string& name) const { return values_.count(name) > 0; }
    template <class T>
    const T& get(const std::string& name) const {
        return values_[name].as<T>();
    }
    /// Whether the option was given, not only defaulted.
    bool given(const std::string& name) const { return has(name) && !values_[name].defaulted(); }
    bool flag(const std::string& name) const { return has(name) && get<bool>(name); }
    std::string text(const std::string& name) const {
        return has(name) ? get<std::string>(name) : std::string();
    }
    bool quiet() const { return flag("quiet"); }

    /// The integer value of an option that must lie in [lo, hi].
    int integer(const std::string& name, int lo, int hi) const;

  private:
    boost::program_options::variables_map values_;
};

/// Throws where an output file is one of the inputs; empty names are none.
void refuseInput(const std::string& output, const std::vector<std::string>& inputs);

/// Options of opening a volume that several commands share: --grid, --drop-nonfinite,
/// --clamp-negative, --max-memory.
void addGridOptions(boost::program_options::options_description& options);
uint32_t repairBits(const Arguments& arguments);
/// Bytes of --max-memory; 0: no limit. Throws UsageError.
uint64_t memoryLimit(const Arguments& arguments);
/// What those options say of the density to load.
trk::DensityOptions densityOptionsOf(const Arguments& arguments);

/// --color r,g,b: what each channel's extinction is multiplied by.
void addColorOption(boost::program_options::options_description& options);
std::array<float, 3> colorOf(const Arguments& arguments);

/// A UsageError where a sidecar has no such --level.
void checkLevel(const std::string& sidecar, uint32_t level, const trk::SidecarHeader& header);

/// A finite number >= 0, or a UsageError that names the option.
float nonNegative(const Arguments& arguments, const std::string& option);

/// The value of `name` among `names`, or a UsageError that lists them.
int choiceIndex(const std::string& option, const std::string& name,
                const std::vector<std::string>& names);

/// Numbers separated by commas, or a UsageError: `count` of them.
std::vector<double> numberList(const std::string& option, const std::string& text, size_t count);

/// A line on stderr, overwritten as work goes on, with the time left where that is long: only on a
/// terminal, and not with --quiet.
class Progress {
  public:
    Progress(const Arguments& arguments, std::string label);
    ~Progress();
    Progress(const Progress&) = delete;
    Progress& operator=(const Progress&) = delete;

    /// Safe from any thread.
    void update(double fraction) const;

  private:
    std::string label_;
    bool shown_;
    std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
    mutable double last_ = 0;  // shown, in seconds since the start
};

/// A word as a shell takes it: in quotes where it needs them.
std::string shellWord(const std::string& text);

/// "1.5 MB".
std::string byteCount(uint64_t bytes);

}  // namespace apps
