"""Rover paths that revisit: back in the opposite direction, across, and the same way again."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]

SAMPLING = 0.1  # metres between the points of a route before it is cut into frames
SMOOTHING = 2.2  # metres; rounds a right-angled corner to a radius of about 3.5 m
START = 5.0  # metres; beyond where the smoothing feels the end of the route


@dataclass(frozen=True)
class Path:
    """Evenly spaced rover positions.

    Attributes
    ----------
    xy : array, (N, 2)
        World positions in metres, their bounding box centred on the origin.
    heading : array, (N,)
        Direction of travel in radians, counter-clockwise from x.
    legs : tuple of str, (N,)
        "first", "turn", "opposite" or "same": how each position relates to the first leg.
    """

    xy: Array
    heading: Array
    legs: tuple[str, ...]


def revisiting_path(rng: Generator, length: float, spacing: float) -> Path:
    """A drivable path of ``length`` metres with a position every ``spacing`` metres.

    The rover drives along a smooth curve, turns round and drives back over a part of it, turns again
    and repeats a part in the first direction, and so on, each time 0.3-1.5 m beside the curve. A turn
    swings out to one side and comes back across the curve at a right angle. The first leg takes 0.42
    of the length: an arc, which on long drives closes to a lap.
    """
    curve = _Curve.draw(rng, max(0.42 * length / (2 * np.pi), 18.0))
    corners, legs = _route(rng, curve, length)
    driven = _travelled(corners)
    even = np.arange(0.0, driven[-1], SAMPLING)
    route = ndimage.gaussian_filter1d(_along(corners, driven, even), SMOOTHING / SAMPLING, axis=0)
    travelled = _travelled(route)
    stops = START + spacing * np.arange(round(length / spacing), dtype=float)
    before, xy, after = (_along(route, travelled, stops + shift) for shift in (-0.25, 0.0, 0.25))
    dx, dy = (after - before).T
    leg = np.searchsorted(driven, np.interp(stops, travelled, even))
    centre = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
    return Path(xy - centre, np.arctan2(dy, dx), tuple(legs[i] for i in leg))


@dataclass(frozen=True)
class _Curve:
    """r(angle) = radius (1 + 0.10 cos(2 angle + a) + 0.06 cos(3 angle + b))."""

    radius: float
    phases: tuple[float, float]

    @classmethod
    def draw(cls, rng: Generator, radius: float) -> "_Curve":
        first, second = rng.uniform(0, 2 * np.pi, 2)
        return cls(radius, (float(first), float(second)))

    def at(self, angle: Array, outwards: Array | float = 0.0) -> Array:
        """Points (N, 2) at polar angles (N,), shifted outwards by some metres."""
        bulge = 0.12 * np.cos(2 * angle + self.phases[0]) + 0.08 * np.cos(3 * angle + self.phases[1])
        distance = self.radius * (1 + bulge) + outwards
        return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)


def _route(rng: Generator, curve: _Curve, length: float) -> tuple[Array, list[str]]:
    """Corners (N, 2) of a polyline and the leg of each, a little longer than ``length``."""
    angle, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
    end = angle + turn * max(0.42 * length, 36.0) / curve.radius
    pieces, legs = [_follow(curve, angle, end, (0.0, 0.0))], ["first"]
    repeats = itertools.cycle([("opposite", 0.17), ("same", 0.11)])
    while sum(_travelled(piece)[-1] for piece in pieces) < 1.1 * length + 20.0:
        leg, share = next(repeats)
        pieces.append(_turn_round(curve, end, turn, rng.choice([-1.0, 1.0])))
        turn = -turn
        angle = end + turn * 2.0 / curve.radius  # room to change over to the new offset
        end = angle + turn * max(share * length, 8.0) / curve.radius
        offsets = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.5, 2)
        pieces.append(_follow(curve, angle, end, (offsets[0], offsets[1])))
        legs += ["turn", leg]
    labels = [leg for leg, piece in zip(legs, pieces, strict=True) for _ in piece]
    return np.concatenate(pieces), labels


def _follow(curve: _Curve, start: float, end: float, offsets: tuple[float, float]) -> Array:
    """Along the curve between two angles, shifted outwards by one offset that runs into the other."""
    steps = int(np.ceil(abs(end - start) * curve.radius / SAMPLING)) + 1
    return curve.at(np.linspace(start, end, steps), np.linspace(*offsets, steps))


def _turn_round(curve: _Curve, angle: float, turn: float, side: float) -> Array:
    """Ahead to one side, straight across the curve, and back to it on the other side."""
    ahead = np.array([3.0, 7.0, 7.0, 3.0])
    return curve.at(angle + turn * ahead / curve.radius, side * np.array([3.0, 3.5, -3.5, -3.0]))


def _travelled(points: Array) -> Array:
    """Distance driven at each point (N, 2) of a polyline."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _along(points: Array, travelled: Array, distances: Array) -> Array:
    """Points (M, 2) at given distances along a polyline (N, 2)."""
    return np.stack([np.interp(distances, travelled, points[:, i]) for i in (0, 1)], axis=-1)
