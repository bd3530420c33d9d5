// Atomic 64-bit words in memory that processes share (docs/protocol-shm.md, section 3).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <atomic>
#include <cstdint>

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<uint64_t, nb::numpy, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

static_assert(std::atomic_ref<uint64_t>::is_always_lock_free, "a lock would be private to one process");

class Words {
 public:
  explicit Words(Array words) : words_(std::move(words)) {
    if (reinterpret_cast<uintptr_t>(words_.data()) % std::atomic_ref<uint64_t>::required_alignment != 0) {
      throw nb::value_error("words must be aligned to 8 bytes");
    }
  }

  size_t size() const { return words_.shape(0); }
  uint64_t load(size_t index) const { return at(index).load(std::memory_order_seq_cst); }
  void store(size_t index, uint64_t value) { at(index).store(value, std::memory_order_seq_cst); }
  uint64_t fetch_add(size_t index, uint64_t value) { return at(index).fetch_add(value, std::memory_order_seq_cst); }
  bool compare_exchange(size_t index, uint64_t expected, uint64_t desired) {
    return at(index).compare_exchange_strong(expected, desired, std::memory_order_seq_cst);
  }

 private:
  std::atomic_ref<uint64_t> at(size_t index) const {
    if (index >= size()) throw nb::index_error("word outside of the block");
    return std::atomic_ref<uint64_t>(words_.data()[index]);
  }

  Array words_;  // keeps the mapping alive
};

}  // namespace

NB_MODULE(_atomics, m) {
  m.doc() = "Atomic 64-bit words in shared memory.";
  nb::class_<Words>(m, "Words", "Atomic access, sequentially consistent, to a writable uint64 [n] array.")
      .def(nb::init<Array>(), "words"_a)
      .def("__len__", &Words::size)
      .def("load", &Words::load, "index"_a)
      .def("store", &Words::store, "index"_a, "value"_a)
      .def("fetch_add", &Words::fetch_add, "index"_a, "value"_a, "Adds, wrapping; returns the former value.")
      .def("compare_exchange", &Words::compare_exchange, "index"_a, "expected"_a, "desired"_a,
           "Stores ``desired`` if the word is ``expected``; whether it did.");
  m.def(
      "fence", [] { std::atomic_thread_fence(std::memory_order_seq_cst); },
      "Orders plain reads and writes before it against those after it.");
}
