#include "dispatch.hpp"

#include <atomic>
#include <cstdlib>
#include <stdexcept>

namespace vtslam::native {

extern const Kernels kPortableKernels;
#if defined(__x86_64__)
extern const Kernels kAvx2Kernels, kAvx512Kernels;
#endif

namespace {

std::vector<const Kernels*> runnable() {
  std::vector<const Kernels*> tables;
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool fma = __builtin_cpu_supports("fma");
  if (fma && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
    tables.push_back(&kAvx512Kernels);
  if (fma && __builtin_cpu_supports("avx2")) tables.push_back(&kAvx2Kernels);
#endif
  tables.push_back(&kPortableKernels);
  return tables;
}

const Kernels* find(const std::string& name) {
  std::string known;
  for (const Kernels* table : runnable()) {
    if (name == table->name) return table;
    known += (known.empty() ? "" : ", ") + std::string(table->name);
  }
  throw std::invalid_argument("instruction set '" + name +
                              "' is unknown or missing here; VTSLAM_SIMD can be one of: " + known);
}

std::atomic<const Kernels*> chosen{nullptr};

}  // namespace

const Kernels& kernels() {
  const Kernels* table = chosen.load(std::memory_order_acquire);
  if (table == nullptr) {
    const char* name = std::getenv("VTSLAM_SIMD");
    table = name != nullptr && *name != '\0' ? find(name) : runnable().front();
    chosen.store(table, std::memory_order_release);
  }
  return *table;
}

std::vector<std::string> available_simd() {
  std::vector<std::string> names;
  for (const Kernels* table : runnable()) names.emplace_back(table->name);
  return names;
}

void select_simd(const std::string& name) { chosen.store(find(name), std::memory_order_release); }

}  // namespace vtslam::native
