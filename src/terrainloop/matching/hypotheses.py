"""Hypotheses for the relative pose of two submaps: proposed by the search, refined, weighed."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.field import Field
from terrainloop.geometry import Array, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.overlay import Agreement, agreement_at, participation_at
from terrainloop.matching.query import Query
from terrainloop.matching.ransac import get_inliers, inlier_radius_of
from terrainloop.matching.refine import ROUGH, refine
from terrainloop.matching.search import SearchResult, same_place, search
from terrainloop.matching.significance import combined_surprisal, surprisal_of_field, surprisal_of_inliers
from terrainloop.matching.window import Window, search_window


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A relative pose and the evidence for it.

    Attributes
    ----------
    T_target_source : array, (3, 3)
        SE(2).
    agreement : Agreement
        How well the two fields agree at this pose.
    of_field : float
        -ln P(agreement at least this good | unrelated ground) in one test, nats.
    surprisal : float
        The same of field and keypoints together.
    """

    T_target_source: Array
    agreement: Agreement
    of_field: float
    surprisal: float


@dataclass(frozen=True, eq=False)
class Pair:
    """Two submaps under comparison, with everything needed to weigh hypotheses about their relative pose."""

    source: MapEntry
    target: MapEntry
    source_field: Field
    target_field: Field
    found: SearchResult
    settings: Settings

    @classmethod
    def of(cls, query: Query, target: MapEntry, settings: Settings) -> "Pair":
        """Search all poses of a query in a target."""
        field = target.field_at(query.grid.spacing, settings)
        return cls(
            source=query.entry,
            target=target,
            source_field=query.rotated.field,
            target_field=field,
            found=search(query, field, settings.calibration),
            settings=settings,
        )

    def within(self, window: Window) -> "Pair":
        """The pair, searched only in a window."""
        fields = self.source_field, self.target_field
        return replace(self, found=search_window(self.found, *fields, window, self.settings.calibration))

    @property
    def maps(self) -> tuple[GradientMap, GradientMap]:
        """Source and target."""
        return self.source.gradient_map, self.target.gradient_map

    @property
    def length_scale(self) -> float:
        """The larger length scale of the two maps, metres."""
        return max(self.source_field.length_scale, self.target_field.length_scale)

    @cached_property
    def associations(self) -> Associations:
        """Keypoints of the two that may be the same."""
        return associate(self.source.features, self.target.features)

    def inliers_of(self, T: Array) -> Array:
        """Keypoints (n, 2) of the target, metres, whose associations agree with a pose."""
        radius = inlier_radius_of(self.settings, self.target.gradient_map)
        return self.associations.target[get_inliers(self.associations, T[None], radius)[0]]

    def same_place(self, T: Array, other: Array) -> bool:
        """Whether two poses are closer than the places that a search distinguishes."""
        return same_place(T, other, self.source_field, self.settings.calibration)

    def weigh(self, T: Array) -> Hypothesis:
        """The evidence for a pose; none where the overlap is too small or the fields disagree."""
        calibration = self.settings.calibration
        agreement = agreement_at(self.source_field, self.target_field, T)
        null_area = self.found.null_area_at(yaw_of(T))
        enough = agreement.area >= calibration.min_shared_area * self.length_scale**2
        if not enough or agreement.correlation <= 0 or np.isnan(null_area):
            return Hypothesis(T, agreement, 0.0, 0.0)
        of_field = surprisal_of_field(agreement.correlation, agreement.area / null_area, calibration)
        if not len(self.associations):
            return Hypothesis(T, agreement, of_field, of_field)
        return Hypothesis(T, agreement, of_field, combined_surprisal(of_field, self._of_inliers(T)))

    def _of_inliers(self, T: Array) -> float:
        """Surprisal of the inliers in distinct l x l cells."""
        cells = np.unique(np.floor(self.inliers_of(T) / self.target_field.length_scale), axis=0)
        observed = self.target.gradient_map.mask.sum() * self.target.gradient_map.resolution**2
        radius = inlier_radius_of(self.settings, self.target.gradient_map)
        probability = min(np.pi * radius**2 / observed, 1.0)
        return surprisal_of_inliers(len(cells), len(self.associations), probability)

    def participation(self, T: Array) -> float:
        """Share of the shared ground that the agreement at a pose rests on."""
        block = self.settings.calibration.block * self.length_scale
        return participation_at(self.source_field, self.target_field, T, block)

    def refined(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis at the pose where the gradients agree best, if that has more evidence."""
        refinement = refine(*self.maps, hypothesis.T_target_source, self.settings.calibration, ROUGH)
        if refinement is None:
            return hypothesis
        better = self.weigh(refinement.T_target_source)
        return better if better.surprisal > hypothesis.surprisal else hypothesis


def propose_hypotheses(pair: Pair, places: slice) -> list[Hypothesis]:
    """Some of the places that the search found, best first, refined."""
    return [pair.refined(pair.weigh(T)) for T in pair.found.poses[places]]
