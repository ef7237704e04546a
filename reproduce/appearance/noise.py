"""Aperiodic noise: uniform numbers hashed from the cells of lattices, each rotated and shifted at random."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import Array

Image = NDArray[np.float32]


def value_noise(xy: Array, cell: float, salt: int) -> Image:
    """Value noise at points (N, 2): its value and its slopes along x and y (3, N), each of unit variance.

    Uniform numbers hashed from the corners of the cells, joined by w(t) = 3 t^2 - 2 t^3. With E[w^2] =
    13/35 and E[w'^2] = 6/5 the variance is (26/35)^2 / 12, that of a slope 2 (6/5) (26/35) / 12.
    """
    lattice = Lattice.of(xy, cell, salt)
    a, b = lattice.hashed(salt), lattice.hashed(salt, 1, 0)
    c, d = lattice.hashed(salt, 0, 1), lattice.hashed(salt, 1, 1)
    u, v = lattice.u, lattice.v
    wu, wv = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    b, c, d = b - a, c - a, a - b - c + d
    value = (a - 0.5 + b * wu + c * wv + d * wu * wv) * np.float32(np.sqrt(12) * 35 / 26)
    scale = np.float32(np.sqrt(12 / (2 * 6 / 5 * 26 / 35)))
    slopes = lattice.to_world(scale * 6 * u * (1 - u) * (b + d * wv), scale * 6 * v * (1 - v) * (c + d * wu))
    return np.stack([value, *slopes])


@dataclass(frozen=True, eq=False)
class Lattice:
    """Points on a lattice of square cells, which is rotated and shifted by its salt.

    Attributes
    ----------
    rotation : array, (2,)
        Cosine and sine of the angle from the world's axes to the lattice's.
    i, j : array, (N,) uint32
        Cell of each point.
    u, v : array, (N,) float32
        Position of each point within its cell, 0-1.
    """

    rotation: Array
    i: NDArray[np.uint32]
    j: NDArray[np.uint32]
    u: Image
    v: Image

    @classmethod
    def of(cls, xy: Array, cell: float, salt: int) -> "Lattice":
        angle, *shift = 2 * np.pi * np.random.default_rng(salt).random(3)
        c, s = np.cos(angle), np.sin(angle)
        x = (c * xy[:, 0] + s * xy[:, 1]) / cell + shift[0]
        y = (c * xy[:, 1] - s * xy[:, 0]) / cell + shift[1]
        i, j = np.floor(x), np.floor(y)
        u, v = (x - i).astype(np.float32), (y - j).astype(np.float32)
        return cls(
            np.array([c, s]), i.astype(np.int32).view(np.uint32), j.astype(np.int32).view(np.uint32), u, v
        )

    def only(self, kept: NDArray[np.bool_]) -> "Lattice":
        return Lattice(self.rotation, self.i[kept], self.j[kept], self.u[kept], self.v[kept])

    def hashed(self, salt: int, right: int = 0, up: int = 0) -> Image:
        """A uniform number in [0, 1) for each cell, or for the cell ``right`` and ``up`` of it."""
        h = (self.i + np.uint32(right)) * np.uint32(0x9E3779B1)
        h ^= (self.j + np.uint32(up)) * np.uint32(0x85EBCA77) + np.uint32(salt % 2**32)
        for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39)):  # mixers of lowbias32-type hashes
            h ^= h >> np.uint32(shift)
            h *= np.uint32(factor)
        h ^= h >> np.uint32(15)
        return np.asarray((h >> np.uint32(8)).astype(np.float32) * np.float32(2**-24))

    def from_world(self, vector: Array) -> Array:
        """Rotate a vector (2,) from the world into the lattice."""
        c, s = self.rotation
        return np.array([c * vector[0] + s * vector[1], c * vector[1] - s * vector[0]])

    def to_world(self, x: Image, y: Image) -> tuple[Image, Image]:
        """Rotate vectors, given by their components (N,), from the lattice into the world."""
        c, s = self.rotation.astype(np.float32)
        return c * x - s * y, s * x + c * y
