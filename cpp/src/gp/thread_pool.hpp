#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace terrainloop::gp {

/// Threads that share loops. What a loop computes must not depend on which thread takes which index.
///
/// Threads are started when a loop first has work for them. Where the system refuses one, the loop runs on
/// those there are, and at least on the caller's.
class ThreadPool {
 public:
  /// At most `threads` in all, the caller's among them, and no more than the machine runs at once.
  explicit ThreadPool(int threads) : limit_(std::min(threads, most())) {}

  ~ThreadPool() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      stopping_ = true;
    }
    wake_.notify_all();
    for (std::thread& thread : threads_) thread.join();
  }
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  /// Calls body(0) ... body(count - 1), in any order; rethrows the first exception. Concurrent calls are
  /// serialised.
  void run(int count, const std::function<void(int)>& body) {
    const std::lock_guard<std::mutex> turn(running_);
    start_threads(count);
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      body_ = &body;
      count_ = count;
      next_ = 0;
      error_ = nullptr;
      busy_ = threads_.size();
      ++loop_;
    }
    wake_.notify_all();
    take(body, count);
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return busy_ == 0; });
    if (error_) std::rethrow_exception(error_);
  }

 private:
  /// More threads than processors only cost memory. A few are allowed everywhere, so that a test of
  /// concurrency is one on any machine.
  static int most() { return std::max(4, static_cast<int>(std::thread::hardware_concurrency())); }

  void start_threads(int count) {
    try {
      while (static_cast<int>(threads_.size()) + 1 < std::min(limit_, count))
        threads_.emplace_back([this, seen = loop_] { serve(seen); });
    } catch (const std::exception&) {  // std::system_error or std::bad_alloc: do not ask again
      limit_ = static_cast<int>(threads_.size()) + 1;
    }
  }

  void take(const std::function<void(int)>& body, int count) {
    try {
      for (int i = next_++; i < count; i = next_++) body(i);
    } catch (...) {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (!error_) error_ = std::current_exception();
      next_ = count;
    }
  }

  void serve(long seen) {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      wake_.wait(lock, [&] { return stopping_ || loop_ != seen; });
      if (stopping_) return;
      seen = loop_;
      const std::function<void(int)>& body = *body_;
      const int count = count_;
      lock.unlock();
      take(body, count);
      lock.lock();
      if (--busy_ == 0) done_.notify_one();
    }
  }

  int limit_;
  std::vector<std::thread> threads_;
  std::mutex running_, mutex_;
  std::condition_variable wake_, done_;
  const std::function<void(int)>* body_ = nullptr;
  std::exception_ptr error_;
  std::atomic<int> next_{0};
  std::size_t busy_ = 0;
  long loop_ = 0;
  int count_ = 0;
  bool stopping_ = false;
};

}  // namespace terrainloop::gp
