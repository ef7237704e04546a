"""The query of a search: a submap's gradient field at every rotation, as spectra."""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from terrainloop import _core
from terrainloop.config import Calibration, Settings
from terrainloop.entry import MapEntry
from terrainloop.field import Field, Image, rotate_field
from terrainloop.geometry import Array, inverse, se2, transform

FFT_SIZES = tuple(sorted(n * 2**k for n in (32, 40, 48, 60) for k in range(4)))
"""Canonical sizes: multiples of 4 without prime factors beyond 5, at most a quarter apart."""


@dataclass(frozen=True)
class SearchGrid:
    """What two fields are correlated on: metres per pixel, and pixels a side of the FFT."""

    spacing: float
    size: int


@dataclass(frozen=True, eq=False)
class RotatedField:
    """A field at K evenly spaced rotations about the centroid of its observed area.

    Attributes
    ----------
    field : Field
    poses : array, (K, 3, 3)
        Affine maps from metres of the map to pixels of each image.
    vectors : array, (K, 2, n, n)
        x and y.
    area : array, (K, 2, n / 2, n / 2)
        Valid area and energy, summed over 2 x 2 pixels.
    """

    field: Field
    poses: Array
    vectors: Image
    area: Image


@dataclass(frozen=True, eq=False)
class Query:
    """A submap and the spectra of its field at every rotation, made for the targets of one search grid.

    Attributes
    ----------
    entry : MapEntry
    grid : SearchGrid
    rotated : RotatedField
    vectors, area : array
        Conjugate half spectra of `rotated`, in the layout of the core.
    """

    entry: MapEntry
    grid: SearchGrid
    rotated: RotatedField
    vectors: Image
    area: Image

    @classmethod
    def of(cls, entry: MapEntry, grid: SearchGrid, rotated: RotatedField) -> "Query":
        """The spectra of a rotated field, zero-padded to the size of the grid."""
        vectors = _core.search_spectra(rotated.vectors, grid.size)
        return cls(entry, grid, rotated, vectors, _core.search_spectra(rotated.area, grid.size // 2))


def search_grid(source: MapEntry, target: MapEntry, settings: Settings) -> SearchGrid:
    """The grid on which two submaps are searched: the coarser spacing of the two, and a size that holds both.

    Shifts at which only the rims of the maps overlap wrap around and are added to those of the opposite rim;
    the only cost is that such overlaps are not searched correctly, and the FFT is a fifth smaller.
    """
    spacing = max(source.field.spacing, target.field.spacing)
    diameter = source.field_at(spacing, settings).diameter
    extent = max(target.field_at(spacing, settings).valid.shape)
    padded = int(settings.calibration.wraparound * (diameter + extent))
    least = max(padded, diameter, extent) + 1
    return SearchGrid(spacing, next(size for size in FFT_SIZES if size >= least))


def rotate(field: Field, calibration: Calibration) -> RotatedField:
    """The field at evenly spaced rotations, between which ground moves by `rotation_step` pixels (RMS)."""
    side = field.diameter + 1
    arc = 2 * np.pi * field.radius / (calibration.rotation_step * field.spacing)
    count = int(np.ceil(arc / _core.LANES)) * _core.LANES
    poses = np.empty((count, 3, 3))
    images = np.empty((count, 4, side, side), np.float32)
    pixels_from_metres = np.asarray(np.linalg.inv(field.metres_from_pixels), dtype=float)
    centre = transform(pixels_from_metres, field.centre)
    for k in range(count):
        rotation = se2(0.0, 0.0, 2 * np.pi * k / count)
        rotation[:2, 2] = (side - 1) / 2 - rotation[:2, :2] @ centre
        poses[k] = rotation @ pixels_from_metres
        if k < count // 2:
            x, y, valid = rotate_field(field, inverse(rotation), (side, side))
            images[k] = x, y, valid, x**2 + y**2
    # Half a turn later every image is upside down and every vector reversed.
    opposite = images[: count // 2, :, ::-1, ::-1]
    images[count // 2 :, :2], images[count // 2 :, 2:] = -opposite[:, :2], opposite[:, 2:]
    return RotatedField(field, poses, np.ascontiguousarray(images[:, :2]), _halved(images[:, 2:]))


def stored_spectra(field: Field, size: int) -> tuple[Image, Image]:
    """Half spectra (2, n, n / 2 + 1, 2) of a target: of x and y, and of area and energy on half the grid."""
    area = _halved(np.stack([field.valid, field.x**2 + field.y**2]))
    return _spectra(np.stack([field.x, field.y]), size), _spectra(area, size // 2)


def _halved(images: Image) -> Image:
    """Images (..., n, m) summed over 2 x 2 pixels."""
    even = np.pad(images, [(0, 0)] * (images.ndim - 2) + [(0, n % 2) for n in images.shape[-2:]])
    return np.ascontiguousarray(
        even[..., ::2, ::2] + even[..., 1::2, ::2] + even[..., ::2, 1::2] + even[..., 1::2, 1::2]
    )


def _spectra(images: Image, size: int) -> Image:
    """Half spectra (K, size, size / 2 + 1, 2), real and imaginary, of images (K, rows, columns)."""
    spectra = np.asarray(fft.rfft2(images, s=(size, size)), dtype=np.complex64)
    return spectra.view(np.float32).reshape(*spectra.shape, 2)
