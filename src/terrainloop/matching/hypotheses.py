"""Hypotheses for the relative pose of two submaps: proposed by the search, refined, weighed."""

from dataclasses import dataclass

import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.field import Field
from terrainloop.geometry import Array, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.overlay import Agreement, agreement_at, participation_at
from terrainloop.matching.query import Query
from terrainloop.matching.refine import ROUGH, refine
from terrainloop.matching.search import SearchResult, same_place, search
from terrainloop.matching.significance import surprisal_of_field


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
    """

    T_target_source: Array
    agreement: Agreement
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

    @property
    def maps(self) -> tuple[GradientMap, GradientMap]:
        """Source and target."""
        return self.source.gradient_map, self.target.gradient_map

    @property
    def length_scale(self) -> float:
        """The larger length scale of the two maps, metres."""
        return max(self.source_field.length_scale, self.target_field.length_scale)

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
            return Hypothesis(T, agreement, 0.0)
        samples = agreement.area / null_area
        return Hypothesis(T, agreement, surprisal_of_field(agreement.correlation, samples, calibration))

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
