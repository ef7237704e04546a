"""Exhaustive search of SE(2) for the poses at which two gradient fields agree, by FFT."""

from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

import numpy as np
from scipy import fft

from terrainloop import _core
from terrainloop.geometry import Array, inverse, se2, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.evidence import surprise
from terrainloop.matching.field import Field, Image, field_of, turn_field

PIXELS_PER_LENGTH_SCALE = 2  # a finer field tells no more: the spectrum of the process ends there
MAX_PIXELS = 96  # across; larger maps are searched at twice the spacing, and so on
TURN = 1.0  # pixels that ground moves between two rotations, about; root mean square over the map
MIN_AREA = 20.0  # of shared ground, in squared length scales
EVIDENT = 6.0  # r^2 in units of its mean, above which a pose is looked at: one in seventy
WRAPPED = 0.8  # of the size at which nothing wraps around
APART = 1.5  # length scales by which two places differ

_turning = Lock()  # threads that compare one source wait for its spectra, instead of making them again


@dataclass(frozen=True, eq=False)
class Search:
    """What was found.

    Attributes
    ----------
    places : list of arrays, (3, 3)
        T_target_source, SE(2), of places that differ from one another, best first.
    surprises : array, (P,)
        Of the places (see `terrainloop.matching.evidence.surprise`).
    null_area : array, (K,)
        For each of K rotations, evenly spaced from 0 to 2 pi, the ground that counts as one
        independent sample, m^2; NaN where no shift shares enough ground.
    tried : float
        Poses tried: rotations, in units of `TURN`, times shifts, in units of a squared length scale.
    """

    places: list[Array]
    surprises: Array
    null_area: Array
    tried: float

    def null_area_at(self, yaw: float) -> float:
        """`null_area` of the rotation nearest to a yaw in radians."""
        return float(self.null_area[round(yaw / (2 * np.pi) * len(self.null_area)) % len(self.null_area)])


class SearchMap:
    """A gradient map with its fields and their spectra, each computed once.

    Attributes
    ----------
    length_scale, spacing : float
        Of the process, and of the pixels that are searched unless the other map is larger; metres.
    middle : array, (2,)
        Of the known ground, metres.
    radius : float
        Root mean square distance of the known ground from its middle, metres.
    """

    def __init__(self, gradient_map: GradientMap) -> None:
        self._map = gradient_map
        self._fields: dict[float, Field] = {}
        self._spectra: dict[tuple[float, int], tuple[Image, Image]] = {}
        self.length_scale = gradient_map.parameters.length_scale
        self.spacing = self.length_scale / PIXELS_PER_LENGTH_SCALE
        while max(gradient_map.mask.shape) * gradient_map.resolution > MAX_PIXELS * self.spacing:
            self.spacing *= 2
        ground = self.field(self.spacing).ground
        self.middle = ground.mean(axis=0) if len(ground) else np.array(gradient_map.origin)
        self.radius = float(np.sqrt(((ground - self.middle) ** 2).sum() / max(len(ground), 1)))

    def field(self, spacing: float) -> Field:
        """The field at `spacing` metres per pixel."""
        if spacing not in self._fields:
            self._fields[spacing] = field_of(self._map, spacing)
        return self._fields[spacing]

    def spectra(self, spacing: float, size: int) -> tuple[Image, Image]:
        """Half spectra (2, n, n / 2 + 1, 2) of x and y, and of known ground and energy on half the grid."""
        if (spacing, size) not in self._spectra:
            field = self.field(spacing)
            ground = _coarser(np.stack([field.known, field.x**2 + field.y**2]))
            self._spectra[spacing, size] = (
                _spectra_of(np.stack([field.x, field.y]), size),
                _spectra_of(ground, size // 2),
            )
        return self._spectra[spacing, size]


def search(source: SearchMap, target: SearchMap, count: int) -> Search:
    """Compare two maps at every rotation and at every shift that shares enough ground.

    With f the field of the target and g that of the source, turned, the correlation at a shift t is

        r(t) = sum_x f(x) . g(x - t) / sqrt(sum_x |f(x)|^2 m_g(x - t)  sum_x m_f(x) |g(x - t)|^2)

    with m the known ground: four correlations of images, each by FFT. If n independent samples of
    unrelated ground agree by chance, the mean of r^2 is 1 / n; so the mean of r^2 times the shared
    area, over all shifts of a rotation, is the area of one sample. All but one of the poses are wrong,
    so this is the null of the very pair, measured: ripples that repeat or slopes that run through
    make it large.

    Parameters
    ----------
    source, target : SearchMap
    count : int
        Places wanted.
    """
    spacing = max(source.spacing, target.spacing)
    field = target.field(spacing)
    size = _size(source.field(spacing), field)
    with _turning:
        turned = _turned_spectra(source, spacing, size)
    pixels = (max(source.length_scale, target.length_scale) / spacing) ** 2  # of a squared length scale
    evident, sample, admissible = _core.search_correlate(
        turned.fields,
        turned.ground,
        *target.spectra(spacing, size),
        least_shared=MIN_AREA * pixels,
        evident=EVIDENT,
    )
    rotation, row, column, r_squared, samples = evident.T
    rows, columns = field.known.shape
    row, column = row - size * (row >= rows), column - size * (column >= columns)  # shifts back are last
    poses = np.stack([surprise(r_squared, samples), rotation, row, column])
    turns = len(turned.poses)
    arc = 2 * np.pi * source.radius / spacing / max(turns, 1)
    tried = admissible.sum() * arc / TURN / pixels
    peaks = _distinct_peaks(poses, APART * np.sqrt(pixels), turns, arc, count)
    metres = field.metres_from_pixels
    places = [metres @ se2(column, row, 0.0) @ turned.poses[int(k)] for _, k, row, column in peaks.T.tolist()]
    return Search(places, peaks[0], sample * spacing**2, float(tried))


def same_place(T: Array, other: Array, source: SearchMap) -> bool:
    """Whether two poses of a source are nearer to each other than the search tells places apart."""
    apart = np.hypot(*(transform(T, source.middle) - transform(other, source.middle)))
    turned = abs(yaw_of(inverse(T) @ other)) * source.radius
    return bool(max(apart, turned) < APART * source.length_scale)


def _distinct_peaks(poses: Array, apart: float, turns: int, arc: float, count: int) -> Array:
    """The most surprising poses (4, C), each `apart` pixels from those before.

    Poses (4, N) are surprise, rotation out of `turns`, and shift. Sources are turned about their middle,
    so that a shift is its way; from one rotation to the next ground moves by `arc` pixels.
    """
    surprises, rotation, row, column = poses
    peaks: list[int] = []
    while len(peaks) < count and surprises.max(initial=0.0) > 0:
        best = int(surprises.argmax())
        peaks.append(best)
        turned = np.abs(rotation - rotation[best])
        turned = np.minimum(turned, turns - turned) * arc
        shifted = np.hypot(row - row[best], column - column[best])
        surprises = np.where(np.maximum(shifted, turned) < apart, 0.0, surprises)
    return poses[:, peaks]


@dataclass(frozen=True, eq=False)
class _Turned:
    """A field at K rotations, about the middle of its ground: images, or their spectra for the core."""

    poses: Array  # (K, 3, 3), from metres of the map to pixels
    fields: Image  # x and y
    ground: Image  # known ground and energy, on half the grid


@lru_cache(maxsize=6)  # maps of like extent take few sizes
def _turned_spectra(source: SearchMap, spacing: float, size: int) -> _Turned:
    turned = _turned(source, spacing)
    fields, ground = _core.search_spectra(turned.fields, size), _core.search_spectra(turned.ground, size // 2)
    return _Turned(turned.poses, fields, ground)


@lru_cache(maxsize=1)
def _turned(source: SearchMap, spacing: float) -> _Turned:
    field = source.field(spacing)
    extent = field.across + 1
    blocks = int(np.ceil(2 * np.pi * source.radius / (TURN * _core.LANES * spacing)))
    turns = blocks * _core.LANES
    poses = np.empty((turns, 3, 3))
    images = np.empty((turns, 4, extent, extent), np.float32)
    pixels_from_metres = np.asarray(np.linalg.inv(field.metres_from_pixels), dtype=float)
    middle = transform(pixels_from_metres, source.middle)
    centre = np.array([extent - 1, extent - 1]) / 2
    for k in range(turns):
        turn = se2(0.0, 0.0, 2 * np.pi * k / turns)
        turn[:2, 2] = centre - turn[:2, :2] @ middle
        poses[k] = turn @ pixels_from_metres
        if k < turns // 2:
            x, y, known = turn_field(field, inverse(turn), (extent, extent))
            images[k] = x, y, known, x**2 + y**2
    half_a_turn = images[: turns // 2, :, ::-1, ::-1]
    images[turns // 2 :, :2], images[turns // 2 :, 2:] = -half_a_turn[:, :2], half_a_turn[:, 2:]
    return _Turned(poses, np.ascontiguousarray(images[:, :2]), _coarser(images[:, 2:]))


def _coarser(images: Image) -> Image:
    """Images (..., n, m) summed over 2 x 2 pixels."""
    even = np.pad(images, [(0, 0)] * (images.ndim - 2) + [(0, n % 2) for n in images.shape[-2:]])
    return np.ascontiguousarray(
        even[..., ::2, ::2] + even[..., 1::2, ::2] + even[..., ::2, 1::2] + even[..., 1::2, 1::2]
    )


def _spectra_of(images: Image, size: int) -> Image:
    """Half spectra (K, size, size / 2 + 1, 2), real and imaginary, of images (K, rows, columns)."""
    spectra = np.asarray(fft.rfft2(images, s=(size, size)), dtype=np.complex64)
    return spectra.view(np.float32).reshape(*spectra.shape, 2)


def _size(source: Field, target: Field) -> int:
    """Pixels a side of the FFT.

    Shifts at which maps share only a rim wrap around and add to those at the other side: that costs
    nothing but the sight of such rims, and saves a third of the time.
    """
    across, extent = source.across, max(target.known.shape)
    least = max(int(WRAPPED * (across + extent)), across, extent) + 1
    return 4 * int(fft.next_fast_len(-(-least // 4), real=True))  # as the core wants it
