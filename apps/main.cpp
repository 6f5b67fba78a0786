// SPDX-License-Identifier: Apache-2.0
// vdbtrack: dispatches to one file per command, and turns what they throw into exit codes.
#include "command_line.h"

#include "failure.h"
#include "io/output_file.h"

#include <unistd.h>

#include <csignal>
#include <cstring>
#include <exception>
#include <iostream>
#include <new>
#include <string>
#include <utility>
#include <vector>

namespace {

const apps::Command* const kCommands[] = {
    &apps::kMakeCommand,  &apps::kBakeCommand,    &apps::kInfoCommand,   &apps::kVerifyCommand,
    &apps::kQueryCommand, &apps::kPreviewCommand, &apps::kMeasureCommand};

void printUsage(std::ostream& out) {
    out << "vdbtrack " TRACK_VERSION ": transmittance through OpenVDB volumes\n\n";
    for (const apps::Command* command : kCommands) {
        out << "  " << command->synopsis << "\n      " << command->summary << "\n";
    }
    out << "\nEvery command: --help (options with defaults), --quiet, --threads N.\n"
           "Data goes to stdout, messages to stderr. Exit code: 0 success, 1 failure, 2 usage,\n"
           "128 + n on signal n.\n";
}

extern "C" void endOnSignal(int signal) {
    trk::cleanUpOutputFiles();
    _exit(128 + signal);
}

/// The library speaks of its own constants; who runs the program knows its options.
std::string inOptions(std::string message) {
    const std::pair<const char*, const char*> words[] = {
        {"TRK_REPAIR_DROP_NONFINITE", "--drop-nonfinite"},
        {"TRK_REPAIR_CLAMP_NEGATIVE", "--clamp-negative"},
        {"maxMemory", "--max-memory"},
        {"TRK_METHOD_EXACT", "--method exact"},
        {"TRK_METHOD_CONTROL", "--method control"},
        {", and replacing it was not asked for", "; --force replaces it"}};
    for (const auto& [library, program] : words) {
        const size_t at = message.find(library);
        if (at != std::string::npos) {
            message.replace(at, std::strlen(library), program);
        }
    }
    return message;
}

int fail(const std::string& message) {
    std::cerr << "vdbtrack: error: " << inOptions(message) << "\n";
    return 1;
}

int run(const apps::Command& command, const std::vector<std::string>& arguments) {
    try {
        command.run(command, arguments);
        std::cout.flush();
        return std::cout ? 0 : fail("standard output cannot be written");
    } catch (const apps::HelpShown&) {
        return 0;
    } catch (const apps::UsageError& e) {
        std::cerr << "vdbtrack " << command.name << ": " << e.what()
                  << "\nusage: " << command.synopsis << "\n";
        return 2;
    } catch (const std::bad_alloc&) {
        return fail("the machine has no memory left for this");
    } catch (const std::exception& e) {
        return fail(e.what());
    }
}

}  // namespace

int main(int argc, char** argv) {
    for (const int signal : {SIGINT, SIGTERM, SIGHUP}) {
        if (std::signal(signal, endOnSignal) == SIG_IGN) {
            std::signal(signal, SIG_IGN);  // as nohup asked
        }
    }
    std::signal(SIGXFSZ, SIG_IGN);  // a file size limit is an error of writing, with its message
    const std::vector<std::string> arguments(argv + 1, argv + argc);
    const std::string name = arguments.empty() ? "" : arguments[0];
    if (name == "--help" || name == "-h" || name == "help") {
        printUsage(std::cout);
        return 0;
    }
    if (name == "--version") {
        std::cout << "vdbtrack " TRACK_VERSION "\n";
        return 0;
    }
    for (const apps::Command* command : kCommands) {
        if (name == command->name) {
            return run(*command, {arguments.begin() + 1, arguments.end()});
        }
    }
    std::cerr << (name.empty() ? "vdbtrack: no command"
                               : "vdbtrack: unknown command \"" + name + "\"")
              << "\n\n";
    printUsage(std::cerr);
    return 2;
}
