#include "memory.hpp"

#include <pthread.h>
#include <sys/mman.h>

#include <bit>
#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <new>
#include <vector>

namespace vtslam::native {
namespace {

constexpr std::size_t kHugePage = std::size_t(2) << 20;
constexpr std::size_t kHeader = 64;  // holds the block's capacity, keeps the alignment
constexpr std::size_t kKeptBytes = std::size_t(192) << 20;
constexpr std::size_t kLargest = 8;     // a block of so many times the size wanted still does
constexpr std::uint64_t kStale = 1024;  // blocks taken since, some eighty renderings: the scene has other sizes now

struct Kept {
  void* block;
  std::uint64_t since;  // blocks taken before it was given back
};

struct Cache {
  std::mutex mutex;
  std::vector<Kept> blocks;  // oldest first
  std::size_t bytes = 0;
  std::uint64_t taken = 0;
};

Cache* cache = nullptr;
std::once_flag once;

Cache& the_cache() {
  std::call_once(once, [] {
    cache = new Cache;
    // A forked child may inherit the mutex in any state: it starts anew and leaves the parent's blocks alone.
    pthread_atfork(nullptr, nullptr, [] { cache = new Cache; });
  });
  return *cache;
}

std::size_t& capacity_of(void* block) { return *reinterpret_cast<std::size_t*>(static_cast<char*>(block) - kHeader); }

// Large blocks lie in huge pages where the system grants them: tiles read and write all over them, and a miss in the
// page tables costs as much as the work on a splat.
void* new_block(std::size_t capacity) {
  const bool huge = capacity >= kHugePage;
  const std::size_t alignment = huge ? kHugePage : kHeader;
  const std::size_t bytes = (capacity + kHeader + alignment - 1) / alignment * alignment;
  void* memory = std::aligned_alloc(alignment, bytes);
  if (memory == nullptr) throw std::bad_alloc();
  if (huge) madvise(memory, bytes, MADV_HUGEPAGE);  // a wish; refused is fine
  return static_cast<char*>(memory) + kHeader;
}

void free_block(void* block) { std::free(static_cast<char*>(block) - kHeader); }

// Rounded up to an eighth of a power of two, so that sizes that vary a little share blocks.
std::size_t size_class(std::size_t bytes) {
  const std::size_t step = std::max<std::size_t>(4096, std::bit_floor(bytes) / 8);
  return (bytes + step - 1) / step * step;
}

}  // namespace

void* acquire_block(std::size_t bytes) {
  const std::size_t capacity = size_class(bytes);
  Cache& kept = the_cache();
  {
    const std::lock_guard lock(kept.mutex);
    ++kept.taken;
    // A block too large does: a section's arrays grow until it ends, and the next one's start small again.
    std::size_t best = kept.blocks.size();
    for (std::size_t i = 0; i < kept.blocks.size(); ++i) {
      const std::size_t has = capacity_of(kept.blocks[i].block);
      if (has >= capacity && has / kLargest <= capacity &&
          (best == kept.blocks.size() || has <= capacity_of(kept.blocks[best].block)))
        best = i;
    }
    if (best < kept.blocks.size()) {
      void* block = kept.blocks[best].block;
      kept.blocks.erase(kept.blocks.begin() + static_cast<std::ptrdiff_t>(best));
      kept.bytes -= capacity_of(block);
      return block;
    }
  }
  void* block = new_block(capacity);
  capacity_of(block) = capacity;
  return block;
}

void release_block(void* block) noexcept {
  if (block == nullptr) return;
  Cache& kept = the_cache();
  const std::lock_guard lock(kept.mutex);
  const std::size_t capacity = capacity_of(block);
  if (capacity > kKeptBytes / 4) {
    free_block(block);
    return;
  }
  try {
    kept.blocks.push_back({block, kept.taken});
  } catch (const std::bad_alloc&) {
    free_block(block);
    return;
  }
  kept.bytes += capacity;
  while (kept.bytes > kKeptBytes || kept.blocks.front().since + kStale < kept.taken) {
    void* oldest = kept.blocks.front().block;
    kept.bytes -= capacity_of(oldest);
    free_block(oldest);
    kept.blocks.erase(kept.blocks.begin());
  }
}

}  // namespace vtslam::native
