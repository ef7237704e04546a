#pragma once

namespace terrainloop {

/// Level of x86-64 whose instructions the library was compiled for; 0 for less than 2, or another
/// architecture.
int instruction_level();

}  // namespace terrainloop
