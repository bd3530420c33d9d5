#include "thread_pool.hpp"

#include <pthread.h>
#include <sched.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace vtslam::native {
namespace {

constexpr int kMostThreads = 256, kMostByDefault = 16;

using Body = std::function<void(std::size_t, int)>;

class Pool {
 public:
  void run(int threads, std::size_t items, const Body& body) {
    const std::lock_guard one_job(job_mutex_);
    {
      const std::lock_guard lock(mutex_);
      while (int(workers_.size()) < threads - 1)
        workers_.emplace_back([this, worker = int(workers_.size()) + 1] { serve(worker); });
      body_ = &body;
      items_ = items;
      next_.store(0, std::memory_order_relaxed);
      wanted_ = threads - 1;
      open_ = true;
      error_ = nullptr;
      ++generation_;
    }
    wake_.notify_all();
    work(0);
    std::unique_lock lock(mutex_);
    open_ = false;  // a worker that wakes only now is not waited for
    done_.wait(lock, [this] { return active_ == 0; });
    if (error_) std::rethrow_exception(error_);
  }

 private:
  void serve(int worker) {
    std::size_t seen = 0;
    std::unique_lock lock(mutex_);
    for (;;) {
      wake_.wait(lock, [&] { return open_ && generation_ != seen; });
      seen = generation_;
      if (worker > wanted_) continue;
      ++active_;
      lock.unlock();
      work(worker);
      lock.lock();
      if (--active_ == 0) done_.notify_one();
    }
  }

  void work(int worker) {
    try {
      for (;;) {
        const std::size_t item = next_.fetch_add(1, std::memory_order_relaxed);
        if (item >= items_) return;
        (*body_)(item, worker);
      }
    } catch (...) {
      next_.store(items_, std::memory_order_relaxed);
      const std::lock_guard lock(mutex_);
      if (!error_) error_ = std::current_exception();
    }
  }

  std::mutex job_mutex_, mutex_;
  std::condition_variable wake_, done_;
  std::vector<std::thread> workers_;
  const Body* body_ = nullptr;
  std::size_t items_ = 0, generation_ = 0;
  std::atomic<std::size_t> next_{0};
  int wanted_ = 0, active_ = 0;
  bool open_ = false;
  std::exception_ptr error_;
};

// Never destroyed: its threads may sleep until the process ends. A forked child has none of them and starts anew.
Pool* pool = nullptr;
std::once_flag once;

Pool& the_pool() {
  std::call_once(once, [] {
    pool = new Pool;
    pthread_atfork(nullptr, nullptr, [] { pool = new Pool; });
  });
  return *pool;
}

std::atomic<int> chosen_threads{0};

int allowed_processors() {
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof set, &set) == 0) return std::max(1, CPU_COUNT(&set));
  return std::max(1, int(std::thread::hardware_concurrency()));
}

int threads_of_environment() {
  const char* text = std::getenv("VTSLAM_THREADS");
  if (text == nullptr || *text == '\0') return 0;
  char* end = nullptr;
  const long value = std::strtol(text, &end, 10);
  if (*end != '\0' || value < 1 || value > kMostThreads)
    throw std::invalid_argument("VTSLAM_THREADS must be a whole number from 1 to 256, got '" + std::string(text) + "'");
  return int(value);
}

}  // namespace

int default_threads() {
  const int chosen = chosen_threads.load();
  if (chosen > 0) return chosen;
  const int named = threads_of_environment();
  return named > 0 ? named : std::min(allowed_processors(), kMostByDefault);
}

void set_default_threads(int threads) {
  if (threads < 0 || threads > kMostThreads) throw std::invalid_argument("threads must be 0 (default) to 256");
  chosen_threads.store(threads);
}

int worker_count(int threads) { return threads > 0 ? std::min(threads, kMostThreads) : default_threads(); }

void parallel_for(int threads, std::size_t items, const Body& body) {
  const int workers = int(std::min<std::size_t>(worker_count(threads), items));
  if (workers > 1) return the_pool().run(workers, items, body);
  for (std::size_t item = 0; item < items; ++item) body(item, 0);
}

}  // namespace vtslam::native
