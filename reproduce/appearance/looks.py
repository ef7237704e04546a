"""Optical properties of the ground of each simulated world: tint, grain, stones and rocks."""

from dataclasses import dataclass

from terrainloop.simulation.names import WORLDS


@dataclass(frozen=True)
class Look:
    """Appearance of the ground of a world.

    Attributes
    ----------
    tint : (float, float, float)
        Mean albedo in red, green and blue.
    contrast : float
        Standard deviation of the albedo of each octave of noise, as a share of the mean.
    roughness : float
        Standard deviation of the slope that each octave of the grain adds.
    stones : tuple of (float, float)
        Cell size in metres and share of cells with a stone in it, whose radius is 0.08-0.2 cells.
    stone_tone, rock_tone : (float, float)
        Mean and standard deviation of the albedo of stones and rocks over that of the ground.
    sky_light : float
        Share of the light that comes from the sky and reaches shadows, too.
    """

    tint: tuple[float, float, float]
    contrast: float
    roughness: float
    stones: tuple[tuple[float, float], ...]
    stone_tone: tuple[float, float]
    rock_tone: tuple[float, float]
    sky_light: float


_ETNA = Look(
    tint=(0.15, 0.14, 0.135),
    contrast=0.035,
    roughness=0.12,
    stones=((0.035, 0.6), (0.08, 0.4), (0.18, 0.2)),
    stone_tone=(1.0, 0.08),
    rock_tone=(1.1, 0.08),
    sky_light=0.2,
)
_MOROCCO = Look(
    tint=(0.34, 0.27, 0.20),
    contrast=0.03,
    roughness=0.09,
    stones=((0.035, 0.7), (0.08, 0.6), (0.18, 0.4)),
    stone_tone=(0.8, 0.2),
    rock_tone=(0.75, 0.15),
    sky_light=0.15,
)
_MARS = Look(
    tint=(0.30, 0.20, 0.13),
    contrast=0.03,
    roughness=0.09,
    stones=((0.04, 0.15), (0.10, 0.12)),
    stone_tone=(0.85, 0.1),
    rock_tone=(0.8, 0.08),
    sky_light=0.3,
)
_SAND = Look(
    tint=(0.36, 0.30, 0.22),
    contrast=0.025,
    roughness=0.07,
    stones=(),
    stone_tone=(1.0, 0.0),
    rock_tone=(1.0, 0.0),
    sky_light=0.2,
)
LOOKS = dict.fromkeys(WORLDS, _SAND) | {"etna": _ETNA, "morocco": _MOROCCO, "mars": _MARS}
