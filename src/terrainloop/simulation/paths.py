"""Rover paths that revisit: a lap, the same way again, across, back in the opposite direction."""

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
        "lap", "same", "across" or "opposite": how each position relates to the first lap.
    """

    xy: Array
    heading: Array
    legs: tuple[str, ...]


def revisiting_path(rng: Generator, length: float, spacing: float) -> Path:
    """A drivable path of ``length`` metres with a position every ``spacing`` metres.

    The rover drives once around a smooth closed curve and some way on (same direction, 0.3-1.5 m
    beside its track), cuts across to the far side, crosses the first lap there, follows it backwards
    (opposite direction), cuts across again, and so on. The lap takes 0.45 of the length.
    """
    curve = _ClosedCurve.draw(rng, max(0.45 * length, 36.0))
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
class _ClosedCurve:
    """r(angle) = radius (1 + 0.12 cos(2 angle + a) + 0.08 cos(3 angle + b))."""

    radius: float
    phases: tuple[float, float]

    @classmethod
    def draw(cls, rng: Generator, circumference: float) -> "_ClosedCurve":
        first, second = rng.uniform(0, 2 * np.pi, 2)
        return cls(circumference / (2 * np.pi), (float(first), float(second)))

    def at(self, angle: Array, outwards: Array | float = 0.0) -> Array:
        """Points (N, 2) at polar angles (N,), shifted outwards by some metres."""
        bulge = 0.12 * np.cos(2 * angle + self.phases[0]) + 0.08 * np.cos(3 * angle + self.phases[1])
        distance = self.radius * (1 + bulge) + outwards
        return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)


def _route(rng: Generator, curve: _ClosedCurve, length: float) -> tuple[Array, list[str]]:
    """Corners (N, 2) of a polyline and the leg of each, a little longer than ``length``."""
    angle, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
    forwards = turn
    end = angle + 2 * np.pi * turn
    pieces, legs = [_follow(curve, angle, end, (0.0, 0.0))], ["lap"]
    while sum(_travelled(piece)[-1] for piece in pieces) < 1.1 * length + 20.0:
        angle, end = end, end + turn * max(0.12 * length, 12.0) / curve.radius
        offsets = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.5, 2)
        pieces.append(_follow(curve, angle, end, (offsets[0], offsets[1])))
        legs.append("same" if turn == forwards else "opposite")
        crossing, turn = _cross(curve, end, turn), -turn
        end += np.pi + turn * 9.0 / curve.radius
        pieces.append(crossing)
        legs.append("across")
    labels = [leg for leg, piece in zip(legs, pieces, strict=True) for _ in piece]
    return np.concatenate(pieces), labels


def _follow(curve: _ClosedCurve, start: float, end: float, offsets: tuple[float, float]) -> Array:
    """Along the curve between two angles, shifted outwards by one offset that runs into the other."""
    steps = int(np.ceil(abs(end - start) * curve.radius / SAMPLING)) + 1
    return curve.at(np.linspace(start, end, steps), np.linspace(*offsets, steps))


def _cross(curve: _ClosedCurve, angle: float, turn: float) -> Array:
    """From the curve through the middle, over its far side and around to join it the other way."""
    inner = curve.at(np.array([angle]), -2.0)
    along = -turn / curve.radius * np.array([0.0, 4.0, 9.0])
    outer = curve.at(angle + np.pi + along, np.array([4.0, 4.0, 0.0]))
    return np.concatenate([inner, outer])


def _travelled(points: Array) -> Array:
    """Distance driven at each point (N, 2) of a polyline."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _along(points: Array, travelled: Array, distances: Array) -> Array:
    """Points (M, 2) at given distances along a polyline (N, 2)."""
    return np.stack([np.interp(distances, travelled, points[:, i]) for i in (0, 1)], axis=-1)
