#include <gtest/gtest.h>

#include <atomic>
#include <numeric>
#include <stdexcept>
#include <thread>
#include <vector>

#include "gp/thread_pool.hpp"

namespace terrainloop::gp {
namespace {

TEST(ThreadPool, CallsEveryIndexOnce) {
  for (const int threads : {1, 2, 4, 1000000}) {
    ThreadPool pool(threads);
    for (const int count : {0, 1, 3, 1000}) {
      std::vector<std::atomic<int>> calls(count);
      pool.run(count, [&](int i) { ++calls[i]; });
      for (const std::atomic<int>& number : calls) EXPECT_EQ(number, 1) << threads << " threads";
    }
  }
}

TEST(ThreadPool, PassesAnErrorOnAndGoesOnWorking) {
  ThreadPool pool(4);
  for (int round = 0; round < 100; ++round) {
    const auto fail = [](int i) {
      if (i == 7) throw std::runtime_error("seven");
    };
    EXPECT_THROW(pool.run(50, fail), std::runtime_error);
    std::atomic<int> sum{0};
    pool.run(50, [&](int i) { sum += i; });
    EXPECT_EQ(sum, 49 * 50 / 2);
  }
}

TEST(ThreadPool, ServesSeveralCallers) {
  ThreadPool pool(4);
  std::vector<int> sums(8, 0);
  std::vector<std::thread> callers;
  for (int& sum : sums)
    callers.emplace_back([&] {
      for (int round = 0; round < 50; ++round) {
        std::vector<int> values(30);
        pool.run(30, [&](int i) { values[i] = i; });
        sum += std::accumulate(values.begin(), values.end(), 0);
      }
    });
  for (std::thread& caller : callers) caller.join();
  EXPECT_EQ(sums, std::vector<int>(8, 50 * 29 * 30 / 2));
}

}  // namespace
}  // namespace terrainloop::gp
