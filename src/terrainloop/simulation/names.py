"""Names that commands accept, kept apart so that ``--help`` loads nothing heavy."""

WORLDS = (
    *("etna", "morocco", "mars", "flat", "ripples"),
    *("craters", "sparse_rocks", "boulders", "equal_rocks"),
    *("lattice", "ruts", "polygons", "terraces", "built", "symmetric"),
)
"""Worlds of `make_terrain`."""

SENSORS = ("stereo", "lidar", "survey", "biased_stereo", "biased_lidar")
"""Sensors of `simulate_mission`, by their setups in `missions.SETUPS`."""
