"""The C++ core: the variant for this machine's level of x86-64, or the single one that was built."""

from importlib import import_module

try:
    _core = import_module("terrainloop._core.single")
except ModuleNotFoundError:
    _level = import_module("terrainloop._core.cpu").level()
    if _level < 2:
        raise ImportError("this CPU is older than x86-64-v2: build terrainloop from source") from None
    _core = import_module(f"terrainloop._core.x86_64_v{_level}")

globals().update({name: getattr(_core, name) for name in dir(_core) if not name.startswith("_")})
