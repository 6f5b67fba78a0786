// SPDX-License-Identifier: Apache-2.0
// An array whose elements are not initialised: memory that is never written is never resident, and
// one that shrinks gives its pages back to the system.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>
#include <type_traits>
#include <utility>

namespace trk {

template <class T>
class RawArray {
    static_assert(std::is_trivially_copyable_v<T>);

  public:
    RawArray() = default;
    explicit RawArray(size_t size) { resize(size); }
    ~RawArray() { std::free(data_); }
    RawArray(RawArray&& o) noexcept
        : data_(std::exchange(o.data_, nullptr)), size_(std::exchange(o.size_, 0)) {}
    RawArray& operator=(RawArray&& o) noexcept {
        std::swap(data_, o.data_);
        std::swap(size_, o.size_);
        return *this;
    }

    /// Keeps what there is, as far as it fits; what is added is not initialised.
    void resize(size_t size) {
        if (size == 0) {
            std::free(std::exchange(data_, nullptr));
        } else if (size > static_cast<size_t>(-1) / 2 / sizeof(T)) {
            throw std::bad_alloc();
        } else if (void* data = std::realloc(static_cast<void*>(data_), size * sizeof(T))) {
            data_ = static_cast<T*>(data);
        } else {
            throw std::bad_alloc();
        }
        size_ = size;
    }

    size_t size() const { return size_; }
    bool empty() const { return size_ == 0; }
    size_t bytes() const { return size_ * sizeof(T); }
    T* data() { return data_; }
    const T* data() const { return data_; }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }

  private:
    T* data_ = nullptr;
    size_t size_ = 0;
};

}  // namespace trk
