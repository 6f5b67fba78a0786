// SPDX-License-Identifier: Apache-2.0
// Scatter plots as SVG, drawn by gnuplot.
#pragma once

#include <string>
#include <vector>

namespace apps {

struct PlotPoint {
    double x = 0;
    double y = 0;
    std::string label;  ///< shown under the mouse
};

struct PlotSeries {
    std::string title;
    std::string color;   ///< "#rrggbb"
    int marker = 7;      ///< gnuplot's point type
    bool steps = false;  ///< a line in steps, without points
    std::vector<PlotPoint> points;
};

/// A plot with two logarithmic axes.
struct Plot {
    std::string name;  ///< unique in its page
    std::string xLabel;
    std::string yLabel;
    std::vector<PlotSeries> series;
    double verticalLine = 0;  ///< at this x, where > 0
    std::string lineLabel;
    double tradeConstant = 0;  ///< guide lines y = sqrt(k tradeConstant / x), where > 0
};

/// Throws trk::Error where gnuplot cannot be started: for the beginning of long work.
void requireGnuplot();

/// The <svg> element. Throws trk::Error.
std::string drawSvg(const Plot& plot);

}  // namespace apps
