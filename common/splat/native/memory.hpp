// Large buffers that are used again. A fresh 20 MB block costs milliseconds of page faults at each rendering.
#pragma once

#include <cstddef>
#include <memory>
#include <utility>

namespace vtslam::native {

// Memory of at least `bytes`, 64-byte aligned, contents undefined; throws std::bad_alloc.
void* acquire_block(std::size_t bytes);
// Gives a block back; a bounded amount is kept for the next acquire_block.
void release_block(void* block) noexcept;

// An array in such a block.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(std::size_t count) : data_(static_cast<T*>(acquire_block(count * sizeof(T) + 64))), count_(count) {}
  Buffer(Buffer&& other) noexcept
      : data_(std::exchange(other.data_, nullptr)), count_(std::exchange(other.count_, 0)) {}
  Buffer& operator=(Buffer&& other) noexcept {
    std::swap(data_, other.data_);
    std::swap(count_, other.count_);
    return *this;
  }
  ~Buffer() { release_block(data_); }

  T* data() const { return data_; }
  std::size_t size() const { return count_; }
  T& operator[](std::size_t i) const { return data_[i]; }
  // Hands the memory over to who will call release_block.
  T* release() { return std::exchange(data_, nullptr); }

 private:
  T* data_ = nullptr;
  std::size_t count_ = 0;
};

}  // namespace vtslam::native
