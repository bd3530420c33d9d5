// Worker threads that take numbered items until none is left, and sleep in between.
#pragma once

#include <cstddef>
#include <functional>

namespace vtslam::native {

// Threads used where a call does not say: VTSLAM_THREADS, or the processors this process may use, at most 16.
int default_threads();
// Overrides default_threads(); 0 returns to the default. Throws std::invalid_argument outside 0..256.
void set_default_threads(int threads);

// Calls body(item, worker) once for each item below `items`, worker below `threads` (0: the default), and returns
// when all are done. The caller works too. Which worker gets which item is left open. The first exception of a body is
// thrown here. One call at a time uses the workers; others wait.
void parallel_for(int threads, std::size_t items, const std::function<void(std::size_t item, int worker)>& body);

// Number of workers that parallel_for will use.
int worker_count(int threads);

}  // namespace vtslam::native
