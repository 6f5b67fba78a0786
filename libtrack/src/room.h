// SPDX-License-Identifier: Apache-2.0
// Room for objects that are made when they are needed.
#pragma once

#include <new>
#include <type_traits>
#include <utility>

namespace trk {

/// Room for an object that may never be made: in arrays of which a single ray fills little.
template <class T>
union Room {
    static_assert(std::is_trivially_destructible_v<T>);

    Room() {}
    template <class... Arguments>
    void emplace(Arguments&&... arguments) {
        new (static_cast<void*>(&object)) T(std::forward<Arguments>(arguments)...);
    }

    T object;
};

}  // namespace trk
