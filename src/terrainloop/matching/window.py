"""A search in a window: where two submaps must lie, if they share ground at all, is known already."""

from dataclasses import dataclass

import numpy as np

from terrainloop.config import Calibration
from terrainloop.field import Field
from terrainloop.geometry import Array, rotation_about, se2, transform, yaw_of
from terrainloop.matching.overlay import agreement_at
from terrainloop.matching.search import SearchResult, same_place
from terrainloop.matching.significance import surprisal_of_correlation

STEP = 0.5  # length scales, by which poses of a window are apart


@dataclass(frozen=True, eq=False)
class Window:
    """Poses near a predicted one.

    Attributes
    ----------
    T_target_source : array, (3, 3)
        The prediction, SE(2).
    shift, rotation : float
        How far the centre of the source, metres, and its yaw, radians, may be from it on either side.
    """

    T_target_source: Array
    shift: float
    rotation: float

    def poses(self, source: Field) -> list[Array]:
        """Poses that fill the window: a source moves by half a length scale at most from one to the next."""
        step = STEP * source.length_scale
        centre = transform(self.T_target_source, source.centre)
        shifts = _spread(self.shift, step)
        rotations = _spread(self.rotation, step / source.radius)
        return [
            se2(x, y, 0.0) @ rotation_about(centre, yaw) @ self.T_target_source
            for yaw in rotations
            for x in shifts
            for y in shifts
        ]

    def tried(self, source: Field, calibration: Calibration) -> float:
        """Number of poses in the units of `SearchResult.tried`, as many as make each of them count.

        Neighbours among all poses are alike, which `independent_tests` allows for; in a window of few of
        them the best is refined, and each counts as a test (docs/slam.md).
        """
        arc = 2 * self.rotation * source.radius / source.spacing
        area = (2 * self.shift / source.length_scale) ** 2
        return max(arc / calibration.rotation_step, 1.0) * max(area, 1.0) / calibration.independent_tests


def search_window(
    found: SearchResult, source: Field, target: Field, window: Window, calibration: Calibration
) -> SearchResult:
    """The places at which two fields agree best within a window.

    Parameters
    ----------
    found : SearchResult
        Of all poses: the null that was measured on the pair is that of the window, too.
    source, target : Field
    window : Window
    calibration : Calibration
    """
    least = calibration.min_shared_area * max(source.length_scale, target.length_scale) ** 2
    scored = []
    for T in window.poses(source):
        agreement, null_area = agreement_at(source, target, T), found.null_area_at(yaw_of(T))
        if agreement.area >= least and agreement.correlation > 0 and not np.isnan(null_area):
            squared, samples = agreement.correlation**2, agreement.area / null_area
            scored.append((float(surprisal_of_correlation(squared, samples, calibration)), T))
    places: list[tuple[float, Array]] = []
    for surprisal, T in sorted(scored, key=lambda item: -item[0]):
        if len(places) == calibration.candidates:
            break
        if not any(same_place(T, other, source, calibration) for _, other in places):
            places.append((surprisal, T))
    surprisals = np.array([surprisal for surprisal, _ in places])
    tried = window.tried(source, calibration) if places else 0.0
    return SearchResult([T for _, T in places], surprisals, found.null_area, tried)


def _spread(half: float, step: float) -> Array:
    """Numbers from -half to half, evenly spaced, at most `step` apart, zero among them."""
    count = int(np.ceil(half / step))
    return np.linspace(-half, half, 2 * count + 1) if count else np.zeros(1)
