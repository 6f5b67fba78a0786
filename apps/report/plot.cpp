// SPDX-License-Identifier: Apache-2.0
#include "plot.h"

#include "failure.h"

#include <fcntl.h>
#include <spawn.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <sstream>
#include <utility>

extern char** environ;

namespace apps {
namespace {

/// A file descriptor that closes itself.
class Descriptor {
  public:
    explicit Descriptor(int fd = -1) : fd_(fd) {}
    Descriptor(const Descriptor&) = delete;
    Descriptor& operator=(const Descriptor&) = delete;
    ~Descriptor() { close(); }
    void close() {
        if (fd_ >= 0) {
            ::close(std::exchange(fd_, -1));
        }
    }
    int get() const { return fd_; }

  private:
    int fd_;
};

[[noreturn]] void fail(const std::string& why) {
    throw trk::Error(TRK_ERROR_IO,
                     "gnuplot: " + why + "; it draws the report's plots (Debian: gnuplot-nox)");
}

/// What gnuplot prints for a script.
std::string runGnuplot(const std::string& script) {
    const Descriptor in(memfd_create("gnuplot", MFD_CLOEXEC));
    int ends[2];
    if (in.get() < 0 || pipe2(ends, O_CLOEXEC) != 0) {
        fail(std::strerror(errno));
    }
    const Descriptor out(ends[0]);
    Descriptor childOut(ends[1]);
    if (write(in.get(), script.data(), script.size()) != static_cast<ssize_t>(script.size()) ||
        lseek(in.get(), 0, SEEK_SET) != 0) {
        fail(std::strerror(errno));
    }
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, in.get(), STDIN_FILENO);
    posix_spawn_file_actions_adddup2(&actions, childOut.get(), STDOUT_FILENO);
    char name[] = "gnuplot";
    char* const arguments[] = {name, nullptr};
    pid_t child = 0;
    const int failed = posix_spawnp(&child, name, &actions, nullptr, arguments, environ);
    posix_spawn_file_actions_destroy(&actions);
    childOut.close();
    if (failed != 0) {
        fail(failed == ENOENT ? "not found" : std::strerror(failed));
    }
    std::string text;
    char buffer[1 << 14];
    for (ssize_t n = 0; (n = read(out.get(), buffer, sizeof(buffer))) != 0;) {
        if (n > 0) {
            text.append(buffer, static_cast<size_t>(n));
        } else if (errno != EINTR) {
            break;
        }
    }
    int status = 0;
    while (waitpid(child, &status, 0) < 0 && errno == EINTR) {
    }
    if (!WIFEXITED(status) || WEXITSTATUS(status) != 0) {
        fail("ended with status " + std::to_string(status));
    }
    return text;
}

std::string quoted(const std::string& text) {
    return "\"" + text + "\"";
}

/// Gnuplot's texts under the mouse need its script; as a <title> they need none.
std::string withTitles(const std::string& svg) {
    const std::string open = "<g onmousemove=\"gnuplot_svg.showHypertext(evt,'";
    const std::string close = "</title>";
    std::string result;
    size_t done = 0;
    for (size_t at = 0; (at = svg.find(open, done)) != std::string::npos;) {
        const size_t text = at + open.size();
        const size_t textEnd = svg.find('\'', text);
        const size_t end = svg.find(close, text);
        if (textEnd == std::string::npos || end == std::string::npos) {
            break;
        }
        result += svg.substr(done, at - done) + "<g><title>" + svg.substr(text, textEnd - text);
        done = end;
    }
    return result + svg.substr(done);
}

}  // namespace

void requireGnuplot() {
    runGnuplot("exit\n");
}

std::string drawSvg(const Plot& plot) {
    std::ostringstream script;
    script.precision(9);
    script << "set terminal svg size 600,440 dynamic noenhanced font 'sans-serif,12' name "
           << quoted(plot.name)
           << "\nset logscale xy\nset format xy '%g'\nset grid lc rgb '#e4e4e4'\nset border lc rgb "
              "'#888888'\n"
           << "set key outside top center horizontal maxcols 4 samplen 1 font ',11'\nset xlabel "
           << quoted(plot.xLabel) << "\nset ylabel " << quoted(plot.yLabel) << "\n";
    double lo[2] = {1e300, 1e300};
    double hi[2] = {0, 0};
    for (size_t i = 0; i < plot.series.size(); ++i) {
        script << "$d" << i << " << EOD\n";
        for (const PlotPoint& p : plot.series[i].points) {
            script << p.x << ' ' << p.y << ' ' << quoted(p.label) << '\n';
            lo[0] = std::min(lo[0], p.x);
            hi[0] = std::max(hi[0], p.x);
            lo[1] = std::min(lo[1], p.y);
            hi[1] = std::max(hi[1], p.y);
        }
        script << "EOD\n";
    }
    if (plot.verticalLine > 0) {
        lo[0] = std::min(lo[0], plot.verticalLine);
        hi[0] = std::max(hi[0], plot.verticalLine);
    }
    script << "set xrange [" << lo[0] / 1.2 << ':' << hi[0] * 1.2 << "]\nset yrange ["
           << lo[1] / 1.5 << ':' << hi[1] * 1.5 << "]\n";
    // Gnuplot itself labels powers of ten only, of which a plot may show one or none.
    script << "set xtics (";
    const char* comma = "";
    for (double decade = std::pow(10, std::floor(std::log10(lo[0] / 1.2))); decade < 1.2 * hi[0];
         decade *= 10) {
        for (const int digit : {1, 2, 5}) {
            script << comma << digit * decade;
            comma = ", ";
        }
    }
    script << ")\n";
    if (plot.verticalLine > 0) {
        script << "set arrow from " << plot.verticalLine << ", graph 0 to " << plot.verticalLine
               << ", graph 1 nohead dt 2 lc rgb '#444444'\nset label " << quoted(plot.lineLabel)
               << " at " << plot.verticalLine
               << ", graph 0.03 rotate right offset -0.7,6 tc rgb '#444444'\n";
    }
    const char* separator = "plot ";
    if (plot.tradeConstant > 0) {
        for (int k = -8; k <= 8; ++k) {
            script << separator << "sqrt(" << plot.tradeConstant << " * 10.0**(" << k
                   << ") / x) with lines lw 0.5 lc rgb '#d4d4e8' notitle";
            separator = ", ";
        }
    }
    for (size_t i = 0; i < plot.series.size(); ++i) {
        const PlotSeries& s = plot.series[i];
        const std::string color = "lc rgb " + quoted(s.color);
        script << separator << "$d" << i << " using 1:2";
        if (s.steps) {
            script << " with steps lw 1.5 " << color;
        } else {
            const std::string point = " pt " + std::to_string(s.marker) + " ps 0.6 " + color;
            script << ":3 with labels hypertext point" << point << " notitle, $d" << i
                   << " using (NaN):(NaN) with points" << point;
        }
        script << " title " << quoted(s.title);
        separator = ", ";
    }
    script << "\n";
    std::string svg = runGnuplot(script.str());
    const size_t begin = svg.find("<svg");
    if (begin == std::string::npos) {
        fail("drew nothing");
    }
    return withTitles(svg.substr(begin));
}

}  // namespace apps
