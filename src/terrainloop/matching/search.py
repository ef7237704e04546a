"""Exhaustive search of SE(2) for the poses at which two gradient fields agree, by FFT."""

from dataclasses import dataclass

import numpy as np

from terrainloop import _core
from terrainloop.config import Calibration
from terrainloop.field import Field
from terrainloop.geometry import Array, inverse, se2, transform, yaw_of
from terrainloop.matching.query import Query, stored_spectra
from terrainloop.matching.significance import surprisal_of_correlation


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The result of a search.

    Attributes
    ----------
    poses : list of arrays, (3, 3)
        T_target_source, SE(2), one for each distinct place, best first.
    surprisals : array, (P,)
        Surprisals of these poses (see `terrainloop.matching.significance.surprisal_of_correlation`).
    null_area : array, (K,)
        For each of K rotations, evenly spaced from 0 to 2 pi, the area that counts as one independent
        sample, m^2; NaN where no shift shares enough ground.
    tried : float
        Number of poses tried: rotations, in units of `rotation_step`, times shifts, in units of a squared
        length scale.
    """

    poses: list[Array]
    surprisals: Array
    null_area: Array
    tried: float

    def null_area_at(self, yaw: float) -> float:
        """`null_area` of the rotation nearest to a yaw in radians."""
        return float(self.null_area[round(yaw / (2 * np.pi) * len(self.null_area)) % len(self.null_area)])


def search(query: Query, target: Field, calibration: Calibration) -> SearchResult:
    """Compare a query with a target at every rotation and at every shift that shares enough ground.

    With f the field of the target and g the rotated field of the source, the correlation at a shift t is

        r(t) = sum_x f(x) . g(x - t) / sqrt(sum_x |f(x)|^2 m_g(x - t)  sum_x m_f(x) |g(x - t)|^2)

    with m the valid areas: four correlations of images, each by FFT. If n independent samples of unrelated
    ground agree by chance, the mean of r^2 is 1 / n; so the mean of r^2 times the shared area, over all
    shifts of a rotation, is the area of one sample. All poses but one are wrong, so this measures the null on
    the very pair: ripples that repeat or slopes that run through make the area large.

    Parameters
    ----------
    query : Query
    target : Field
        The target's field at the spacing of the query's grid.
    calibration : Calibration
    """
    grid, source = query.grid, query.rotated.field
    pixels = (max(source.length_scale, target.length_scale) / grid.spacing) ** 2  # of a squared length scale
    peaks, sample, admissible = _core.search_correlate(
        query.vectors,
        query.area,
        *stored_spectra(target, grid.size),
        least_shared=calibration.min_shared_area * pixels,
        evident=calibration.peak_threshold,
    )
    rotation, row, column, r_squared, samples = peaks.T
    rows, columns = target.valid.shape
    row, column = row - grid.size * (row >= rows), column - grid.size * (column >= columns)  # negative shifts
    surprisals = surprisal_of_correlation(r_squared, samples, calibration)
    rotations = len(query.rotated.poses)
    arc = 2 * np.pi * source.radius / grid.spacing / max(rotations, 1)
    tried = admissible.sum() * arc / calibration.rotation_step / pixels
    best = _distinct_peaks(
        np.stack([surprisals, rotation, row, column]),
        separation=calibration.min_separation * np.sqrt(pixels),
        rotations=rotations,
        arc=arc,
        count=calibration.candidates,
    )
    metres = target.metres_from_pixels
    poses = [
        metres @ se2(column, row, 0.0) @ query.rotated.poses[int(k)] for _, k, row, column in best.T.tolist()
    ]
    return SearchResult(poses, best[0], sample * grid.spacing**2, float(tried))


def same_place(T: Array, other: Array, source: Field, calibration: Calibration) -> bool:
    """Whether two poses of a source are closer to each other than the places that a search distinguishes."""
    shift = np.hypot(*(transform(T, source.centre) - transform(other, source.centre)))
    rotation = abs(yaw_of(inverse(T) @ other)) * source.radius
    return bool(max(shift, rotation) < calibration.min_separation * source.length_scale)


def _distinct_peaks(peaks: Array, *, separation: float, rotations: int, arc: float, count: int) -> Array:
    """The peaks (4, C) with the highest surprisal, each at least `separation` pixels from those before.

    Peaks (4, N) are surprisal, rotation out of `rotations`, row and column. Sources are rotated about their
    centroid, so that a shift is its displacement; from one rotation to the next ground moves by `arc` pixels.
    """
    surprisals, rotation, row, column = peaks
    chosen: list[int] = []
    while len(chosen) < count and surprisals.max(initial=0.0) > 0:
        best = int(surprisals.argmax())
        chosen.append(best)
        rotated = np.abs(rotation - rotation[best])
        rotated = np.minimum(rotated, rotations - rotated) * arc
        shifted = np.hypot(row - row[best], column - column[best])
        surprisals = np.where(np.maximum(shifted, rotated) < separation, 0.0, surprisals)
    return peaks[:, chosen]
