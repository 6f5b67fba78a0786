// SPDX-License-Identifier: Apache-2.0
// The types of grid that can be a density, and their values as floats a channel.
#pragma once

#include "openvdb_grids.h"

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>

namespace trk {

/// Grids of one channel, and of three. The statistics of a sidecar have the type of its source.
using DensityGrids = openvdb::TypeList<openvdb::FloatGrid, openvdb::DoubleGrid, openvdb::Vec3SGrid,
                                       openvdb::Vec3DGrid>;

/// How a type of value is made of channels.
template <class Value>
struct ValueTraits {
    static constexpr size_t kChannels = 1;
    using Component = Value;
    using Vector = openvdb::math::Vec3<Value>;
    static const Component* components(const Value* values) { return values; }
    static Component* components(Value* values) { return values; }
};
template <class T>
struct ValueTraits<openvdb::math::Vec3<T>> {
    static constexpr size_t kChannels = 3;
    using Component = T;
    using Vector = openvdb::math::Vec3<T>;
    static const Component* components(const Vector* values) { return values->asPointer(); }
    static Component* components(Vector* values) { return values->asPointer(); }
};

/// A value of the field: floats that are finite and not negative.
template <class Value>
using Sample = std::array<float, ValueTraits<Value>::kChannels>;

/// The value as floats.
template <class Value>
Sample<Value> toFloats(const Value& value) {
    Sample<Value> floats;
    for (size_t c = 0; c < floats.size(); ++c) {
        floats[c] = static_cast<float>(ValueTraits<Value>::components(&value)[c]);
    }
    return floats;
}

/// The value as the field holds it: repaired, float, without negative zero.
template <class Value>
Sample<Value> fieldValue(const Value& value) {
    Sample<Value> sample = toFloats(value);
    for (float& v : sample) {
        v = v > 0 && std::isfinite(v) ? v : 0.0f;
    }
    return sample;
}

template <class Value>
Value fromFloats(const float* floats) {
    using Component = typename ValueTraits<Value>::Component;
    if constexpr (ValueTraits<Value>::kChannels == 1) {
        return static_cast<Component>(floats[0]);
    } else {
        return Value(static_cast<Component>(floats[0]), static_cast<Component>(floats[1]),
                     static_cast<Component>(floats[2]));
    }
}

/// Value type of a tree, from its type's name: "Tree_vec3s_5_4_3" -> "vec3s".
inline std::string valueTypeName(const std::string& treeType) {
    const size_t first = treeType.find('_');
    const size_t last = treeType.find('_', first + 1);
    return first == std::string::npos ? treeType : treeType.substr(first + 1, last - first - 1);
}
inline std::string treeTypeName(const std::string& valueType) {
    return "Tree_" + valueType + "_5_4_3";
}

/// Channels of a grid of values of that type; 0 for types that cannot be a density.
inline int channelCount(const std::string& valueType) {
    return valueType == "float" || valueType == "double"  ? 1
           : valueType == "vec3s" || valueType == "vec3d" ? 3
                                                          : 0;
}
/// Bytes of a value of a density's type, in memory.
inline uint64_t valueBytes(const std::string& valueType) {
    const uint64_t component = valueType == "double" || valueType == "vec3d" ? 8 : 4;
    return component * static_cast<uint64_t>(channelCount(valueType));
}

/// Calls f(a zero of the type) for the type of value of that name, a density's, and answers what it
/// does.
template <class F>
auto withValueType(const std::string& valueType, const F& f) {
    if (valueType == "double") {
        return f(double{});
    }
    if (valueType == "vec3s") {
        return f(openvdb::Vec3f(0));
    }
    return valueType == "vec3d" ? f(openvdb::Vec3d(0)) : f(0.0f);
}

/// Throws UNSUPPORTED_GRID where a grid's type or class, as its header says, cannot be a density's.
/// `where` begins the message.
void checkKind(const std::string& treeType, const std::string& gridClass, const std::string& where);

}  // namespace trk
