#include "level.hpp"

namespace terrainloop {

int instruction_level() {
#if defined(__AVX512VL__)
  return 4;
#elif defined(__AVX2__)
  return 3;
#elif defined(__SSE4_2__)
  return 2;
#else
  return 0;
#endif
}

}  // namespace terrainloop
