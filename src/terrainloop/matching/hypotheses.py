"""Hypotheses for the relative pose of two submaps: proposed by search and keypoints, refined, weighed."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.field import Field
from terrainloop.geometry import Array, fit_se2, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.overlay import Agreement, agreement_at
from terrainloop.matching.query import Query
from terrainloop.matching.ransac import get_inliers, inlier_radius_of, propose, rng_for_pair
from terrainloop.matching.refine import ROUGH, refine
from terrainloop.matching.search import SearchResult, same_place, search
from terrainloop.matching.significance import combined_surprisal, surprisal_of_field, surprisal_of_inliers

FoundBy = Literal["dense", "sparse"]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A relative pose and the evidence for it.

    Attributes
    ----------
    T_target_source : array, (3, 3)
        SE(2).
    agreement : Agreement
        How well the two fields agree at this pose.
    surprisal : float
        -ln P(agreement at least this good | unrelated ground) in one test, nats.
    found_by : {"dense", "sparse"}
        What proposed the pose: the search of all poses, or the keypoints.
    """

    T_target_source: Array
    agreement: Agreement
    surprisal: float
    found_by: FoundBy


@dataclass(frozen=True, eq=False)
class Pair:
    """Two submaps under comparison, with everything needed to weigh hypotheses about their relative pose."""

    source: MapEntry
    target: MapEntry
    source_field: Field
    target_field: Field
    found: SearchResult
    associations: Associations
    settings: Settings

    @classmethod
    def of(cls, query: Query, target: MapEntry, settings: Settings) -> "Pair":
        """Search all poses of a query in a target, and associate their keypoints."""
        field = target.field_at(query.grid.spacing, settings)
        return cls(
            source=query.entry,
            target=target,
            source_field=query.rotated.field,
            target_field=field,
            found=search(query, field, settings.calibration),
            associations=associate(query.entry.features, target.features),
            settings=settings,
        )

    @property
    def maps(self) -> tuple[GradientMap, GradientMap]:
        """Source and target."""
        return self.source.gradient_map, self.target.gradient_map

    @property
    def length_scale(self) -> float:
        """The larger length scale of the two maps, metres."""
        return max(self.source_field.length_scale, self.target_field.length_scale)

    @property
    def inlier_radius(self) -> float:
        """Largest distance of an inlier, metres."""
        return inlier_radius_of(self.settings, self.target.gradient_map)

    def inliers_of(self, T: Array) -> Array:
        """Keypoints (n, 2) of the target, metres, whose associations agree with a pose."""
        return self.associations.target[get_inliers(self.associations, T[None], self.inlier_radius)[0]]

    def same_place(self, T: Array, other: Array) -> bool:
        """Whether two poses are closer than the places that a search distinguishes."""
        return same_place(T, other, self.source_field, self.settings.calibration)

    def weigh(self, T: Array, found_by: FoundBy) -> Hypothesis:
        """The evidence for a pose; none where the overlap is too small or the fields disagree."""
        calibration = self.settings.calibration
        agreement = agreement_at(self.source_field, self.target_field, T)
        null_area = self.found.null_area_at(yaw_of(T))
        enough = agreement.area >= calibration.min_shared_area * self.length_scale**2
        if not enough or agreement.correlation <= 0 or np.isnan(null_area):
            return Hypothesis(T, agreement, 0.0, found_by)
        by_field = surprisal_of_field(agreement.correlation, agreement.area / null_area, calibration)
        surprisal = combined_surprisal(by_field, self._surprisal_of_inliers(T, found_by))
        return Hypothesis(T, agreement, surprisal, found_by)

    def refined(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis at the pose where the gradients agree best, if that has more evidence."""
        refinement = refine(*self.maps, hypothesis.T_target_source, self.settings.calibration, ROUGH)
        if refinement is None:
            return hypothesis
        better = self.weigh(refinement.T_target_source, hypothesis.found_by)
        return better if better.surprisal > hypothesis.surprisal else hypothesis

    def _surprisal_of_inliers(self, T: Array, found_by: FoundBy) -> float:
        """Surprisal of the inliers in distinct l x l cells, without the two that proposed a sparse pose."""
        cells = np.floor(self.inliers_of(T) / self.target_field.length_scale)
        independent = len(np.unique(cells, axis=0)) - 2 * (found_by == "sparse")
        observed = self.target.gradient_map.mask.sum() * self.target.gradient_map.resolution**2
        probability = min(np.pi * self.inlier_radius**2 / observed, 1.0)
        return surprisal_of_inliers(independent, len(self.associations), probability)


def propose_hypotheses(pair: Pair) -> list[Hypothesis]:
    """The best places of the search, and the best place of the keypoints if it is another, refined."""
    calibration = pair.settings.calibration
    hypotheses = [pair.weigh(T, "dense") for T in pair.found.poses[: calibration.dense_hypotheses]]
    sparse = sorted(
        (pair.weigh(T, "sparse") for T in _poses_of_keypoints(pair)), key=_surprisal, reverse=True
    )
    for proposed in sparse[: calibration.sparse_hypotheses][::-1]:
        if not any(pair.same_place(proposed.T_target_source, h.T_target_source) for h in hypotheses):
            hypotheses.append(proposed)
    return [pair.refined(hypothesis) for hypothesis in hypotheses]


def _poses_of_keypoints(pair: Pair) -> Iterator[Array]:
    """The poses with the most inliers among the keypoint associations."""
    proposed = propose(
        pair.associations,
        iterations=pair.settings.match.iterations,
        inlier_radius=pair.inlier_radius,
        rng=rng_for_pair(pair.settings, pair.source.name, pair.target.name),
    )
    for inliers in islice(proposed, pair.settings.calibration.ransac_hypotheses):
        yield fit_se2(pair.associations.source[inliers], pair.associations.target[inliers])


def _surprisal(hypothesis: Hypothesis) -> float:
    return hypothesis.surprisal
