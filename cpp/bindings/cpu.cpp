#include <nanobind/nanobind.h>

#include <cstdint>

#ifdef _MSC_VER
#include <immintrin.h>
#include <intrin.h>
#else
#include <cpuid.h>
#endif

namespace {

struct Registers {
  std::uint32_t a, b, c, d;
};

Registers cpuid(std::uint32_t leaf) {
  Registers r{};
#ifdef _MSC_VER
  int values[4];
  __cpuid(values, leaf & 0x80000000u);
  if (static_cast<std::uint32_t>(values[0]) < leaf) return r;
  __cpuidex(values, leaf, 0);
  r = {std::uint32_t(values[0]), std::uint32_t(values[1]), std::uint32_t(values[2]),
       std::uint32_t(values[3])};
#else
  __get_cpuid_count(leaf, 0, &r.a, &r.b, &r.c, &r.d);  // leaves r as it is where there is no such leaf
#endif
  return r;
}

/// Registers that the operating system saves.
std::uint64_t saved_state() {
#ifdef _MSC_VER
  return _xgetbv(0);
#else
  std::uint32_t low, high;
  __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  return std::uint64_t{high} << 32 | low;
#endif
}

template <typename... Bits>
constexpr std::uint64_t bits(Bits... bit) {
  return (... | (std::uint64_t{1} << bit));
}

bool all(std::uint64_t flags, std::uint64_t wanted) { return (flags & wanted) == wanted; }

/// Level of x86-64 that this CPU has, at most 3, by the table of the x86-64 psABI, section 3.1.1.
int level() {
  const Registers basic = cpuid(1), structured = cpuid(7), extended = cpuid(0x80000001);
  // SSE3, SSSE3, CMPXCHG16B, SSE4.1, SSE4.2, POPCNT; LAHF
  if (!all(basic.c, bits(0, 9, 13, 19, 20, 23)) || !all(extended.c, bits(0))) return 1;
  // FMA, MOVBE, OSXSAVE, AVX, F16C; BMI1, AVX2, BMI2; LZCNT; SSE and AVX registers
  if (!all(basic.c, bits(12, 22, 27, 28, 29)) || !all(structured.b, bits(3, 5, 8)) ||
      !all(extended.c, bits(5)) || !all(saved_state(), bits(1, 2)))
    return 2;
  return 3;
}

}  // namespace

// A module of its own, since it must run on any x86-64 CPU: the variants must not.
NB_MODULE(cpu, module) { module.def("level", &level); }
