// SPDX-License-Identifier: Apache-2.0
#include "image.h"

#include "failure.h"

#include <ImathMatrix.h>
#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfOutputFile.h>
#include <ImfStandardAttributes.h>
#include <ImfStringAttribute.h>
#include <png.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <iterator>
#include <memory>

namespace apps {
namespace {

[[noreturn]] void cannotWrite(const trk::OutputFile& file, const std::string& why) {
    throw trk::Error(TRK_ERROR_IO, file.target() + ": cannot be written: " + why);
}

/// Linear up to 0.6, then rolled off so that 1.4 still keeps a shade below white.
float toneMap(float x) {
    constexpr float kShoulder = 0.6f;
    if (x > kShoulder) {
        const float room = 1 - kShoulder;
        x = kShoulder + room * (1 - std::exp(-(x - kShoulder) / room));
    }
    return x;
}

float encodeSrgb(float linear) {
    const float x = std::fmin(std::fmax(linear, 0.0f), 1.0f);
    return x <= 0.0031308f ? 12.92f * x : 1.055f * std::pow(x, 1 / 2.4f) - 0.055f;
}

/// A number in [0, 1) for a pixel, evenly spread over any neighbourhood [Jimenez 2014].
float dither(size_t x, size_t y) {
    const double t = 0.06711056 * static_cast<double>(x) + 0.00583715 * static_cast<double>(y);
    const double scaled = 52.9829189 * (t - std::floor(t));
    return static_cast<float>(scaled - std::floor(scaled));
}

std::vector<uint8_t> encodePixels(const Image& image, Tone tone, bool alpha) {
    const size_t count = alpha ? 4 : 3;
    std::vector<uint8_t> bytes(image.pixelCount() * count);
    const char* const names[] = {"R", "G", "B", "A"};
    const auto width = static_cast<size_t>(image.width);
    for (size_t c = 0; c < count; ++c) {
        const std::vector<float>& channel = image.channels.at(names[c]);
        for (size_t i = 0; i < channel.size(); ++i) {
            const float value =
                tone == Tone::kRolledOff && c < 3 ? toneMap(channel[i]) : channel[i];
            const float encoded =
                c < 3 ? encodeSrgb(value) : std::fmin(std::fmax(value, 0.0f), 1.0f);
            bytes[count * i + c] =
                static_cast<uint8_t>(std::fmin(255 * encoded + dither(i % width, i / width), 255));
        }
    }
    return bytes;
}

png_image pngOf(const Image& image, bool alpha) {
    png_image png;
    std::memset(&png, 0, sizeof(png));
    png.version = PNG_IMAGE_VERSION;
    png.width = static_cast<png_uint_32>(image.width);
    png.height = static_cast<png_uint_32>(image.height);
    png.format = alpha ? PNG_FORMAT_RGBA : PNG_FORMAT_RGB;
    return png;
}

}  // namespace

void writeExr(const Image& image, bool half, const std::map<std::string, std::string>& attributes,
              const CameraMatrices& matrices, const trk::OutputFile& file) {
    errno = 0;
    try {
        Imf::Header header(image.width, image.height);
        Imf::FrameBuffer frame;
        header.screenWindowWidth() = matrices.screenWindowWidth;
        Imf::addWorldToCamera(header, Imath::M44f(matrices.worldToCamera));
        Imf::addWorldToNDC(header, Imath::M44f(matrices.worldToNdc));
        std::map<std::string, std::vector<Imath::half>> halfs;
        for (const auto& [name, values] : image.channels) {
            if (half && name.back() != 'Z') {
                std::vector<Imath::half>& rounded = halfs[name];
                rounded.assign(values.begin(), values.end());
                header.channels().insert(name, Imf::Channel(Imf::HALF));
                frame.insert(name,
                             Imf::Slice(Imf::HALF, reinterpret_cast<char*>(rounded.data()),
                                        sizeof(Imath::half),
                                        sizeof(Imath::half) * static_cast<size_t>(image.width)));
                continue;
            }
            header.channels().insert(name, Imf::Channel(Imf::FLOAT));
            // OpenEXR's slices are for reading too, hence not const; writing leaves them alone.
            char* base = const_cast<char*>(reinterpret_cast<const char*>(values.data()));
            frame.insert(name, Imf::Slice(Imf::FLOAT, base, sizeof(float),
                                          sizeof(float) * static_cast<size_t>(image.width)));
        }
        for (const auto& [name, text] : attributes) {
            header.insert(name, Imf::StringAttribute(text));
        }
        Imf::OutputFile out(file.path().c_str(), header);
        out.setFrameBuffer(frame);
        out.writePixels(image.height);
    } catch (const std::exception& e) {
        // OpenEXR names the path it was given, which is not the user's.
        cannotWrite(file, errno ? std::strerror(errno) : trk::firstLine(e));
    }
}

void writePng(const Image& image, Tone tone, const trk::OutputFile& file, bool alpha) {
    const std::vector<uint8_t> bytes = encodePixels(image, tone, alpha);
    png_image png = pngOf(image, alpha);
    errno = 0;
    if (!png_image_write_to_file(&png, file.path().c_str(), 0, bytes.data(), 0, nullptr)) {
        cannotWrite(file, errno ? std::strerror(errno) : png.message);
    }
}

std::string pngUri(const Image& image, Tone tone) {
    const std::vector<uint8_t> pixels = encodePixels(image, tone, false);
    png_image png = pngOf(image, false);
    png_alloc_size_t size = PNG_IMAGE_PNG_SIZE_MAX(png);
    std::vector<uint8_t> bytes(size);
    if (!png_image_write_to_memory(&png, bytes.data(), &size, 0, pixels.data(), 0, nullptr)) {
        throw trk::Error(TRK_ERROR_UNKNOWN,
                         std::string("a picture cannot be made: ") + png.message);
    }
    bytes.resize(size);
    static const char kDigits[] =
        "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    std::string text = "data:image/png;base64,";
    for (size_t i = 0; i < size; i += 3) {
        const size_t left = size - i;
        const uint32_t three = static_cast<uint32_t>(bytes[i]) << 16 |
                               (left > 1 ? static_cast<uint32_t>(bytes[i + 1]) << 8 : 0u) |
                               (left > 2 ? static_cast<uint32_t>(bytes[i + 2]) : 0u);
        for (size_t k = 0; k < 4; ++k) {
            text += k <= left ? kDigits[three >> (18 - 6 * k) & 63] : '=';
        }
    }
    return text;
}

std::array<float, 3> falseColor(float value) {
    if (!std::isfinite(value)) {
        return {{0.1f, 0.5f, 0.1f}};
    }
    // Linear light, about equally spaced in lightness.
    static const float kAnchors[][3] = {{0.000f, 0.000f, 0.003f}, {0.017f, 0.003f, 0.083f},
                                        {0.107f, 0.006f, 0.156f}, {0.333f, 0.020f, 0.105f},
                                        {0.680f, 0.078f, 0.030f}, {0.930f, 0.270f, 0.006f},
                                        {0.970f, 0.620f, 0.080f}, {0.975f, 1.000f, 0.370f}};
    constexpr size_t kLast = std::size(kAnchors) - 1;
    const float x = std::fmin(std::fmax(value, 0.0f), 1.0f) * static_cast<float>(kLast);
    const size_t i = std::min(static_cast<size_t>(x), kLast - 1);
    const float f = x - static_cast<float>(i);
    std::array<float, 3> color{};
    for (size_t c = 0; c < 3; ++c) {
        color[c] = kAnchors[i][c] + f * (kAnchors[i + 1][c] - kAnchors[i][c]);
    }
    return color;
}

}  // namespace apps
