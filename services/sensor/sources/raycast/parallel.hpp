// Run a loop on several threads. Each index writes its own output only, so the result is the same for any count.
#pragma once

#include <atomic>
#include <thread>
#include <vector>

namespace raycast {

template <class Body>
void parallel_for(int count, int num_threads, const Body& body) {
  std::atomic<int> next{0};
  const auto work = [&] {
    for (int i = next++; i < count; i = next++) body(i);
  };
  std::vector<std::thread> threads;
  for (int k = 1; k < num_threads && k < count; ++k) threads.emplace_back(work);
  work();
  for (auto& thread : threads) thread.join();
}

}  // namespace raycast
