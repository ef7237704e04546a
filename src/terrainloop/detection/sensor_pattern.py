"""Patterns fixed to the sensor: subtracted from submaps, and the loops that one explains refused.

What remains of a pattern, or cannot be told from ground yet, is looked for in every loop closure: a pose at
which submaps of other places agree too, or one that lays the same part of the sensor's view upon itself, is
that of a pattern.
"""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from terrainloop.config import Settings
from terrainloop.detection.flat_field import MIN_COVER, MIN_SUBMAPS, FlatField, SensorPattern, centred, is_far
from terrainloop.entry import MapEntry
from terrainloop.geometry import Array, inverse, se2, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.overlay import Agreement, agreement_at
from terrainloop.record import hull_overlap

logger = logging.getLogger(__name__)

SMOOTHEST = 0.25  # of the submaps, which weigh the same; rougher ones weigh less
PERIOD = 40  # submaps after which a pattern is measured anew
SAME_VIEW = 0.7  # intersection over union of two footprints that are one view of the sensor
MIN_SUPPORT = 0.4  # of the correlation of a loop, at which another submap agrees with both of its submaps too
MIN_SUPPORTERS = 2  # submaps that have to
EXPLAINED = 0.3  # share of the other submaps that agree as well, at which a pattern explains a loop
MAX_OTHERS = 20  # submaps that a loop is held against


class SensorPatterns:
    """The submaps of a mission without the patterns of their sensors, and loops that a pattern explains.

    Parameters
    ----------
    settings : Settings
    entries : sequence of MapEntry, optional
        The submaps of the mission, where all are known in advance. Else they are added one by one; a pattern
        is then measured on the 5, 10, 20 and 40 first submaps of a session, which are cleaned anew each time,
        and on each further 40, for those that follow.
    """

    def __init__(self, settings: Settings, entries: Sequence[MapEntry] = ()) -> None:
        self.settings = settings
        self.refused = 0  # loops that a pattern explains, or may explain
        self._seen_in_view = False  # whether other submaps agreed with a loop as a pattern makes them
        self._submaps: dict[str, _Submap] = {}
        self._sessions: dict[str, _Session] = {}
        for entry in entries:
            self._session_of(entry).ids.append(self._store(entry))
        for session in self._sessions.values():
            runs = np.array_split(np.arange(len(session.ids)), max(1, len(session.ids) // PERIOD))
            for run in runs:
                ids = [session.ids[index] for index in run]
                self._measure(session, ids, cleaned=ids)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was found, in words: for each session the strongest pattern; how many loops were refused."""
        found = [
            f"{name}: {session.strongest}" if name else str(session.strongest)
            for name, session in self._sessions.items()
            if session.strongest is not None
        ]
        refused = (
            f"{self.refused} would-be loops were refused: they lie where a pattern of the sensor would be; "
            "if the vehicle stood still or came back to the same spot, give its odometry"
        )
        return (*found, refused) if self.refused else tuple(found)

    def add(self, entry: MapEntry) -> None:
        """Another submap; nothing happens if it is known."""
        if entry.id in self._submaps:
            return
        session = self._session_of(entry)
        session.ids.append(self._store(entry))
        count, found_before = len(session.ids), session.strongest is not None
        if count in (PERIOD // 8, PERIOD // 4, PERIOD // 2, PERIOD):
            self._measure(session, session.ids, cleaned=session.ids)
        else:
            self._clean(session, session.ids[-1:])
            if count % PERIOD == 0:
                self._measure(session, session.ids[-PERIOD:], cleaned=[])
        if session.strongest is not None and not found_before:
            logger.warning("%s", session.strongest)

    def cleaned(self, entry: MapEntry) -> MapEntry:
        """A submap that was added, without the pattern of its sensor; as it is if there is none."""
        return self._submaps[entry.id].cleaned

    def judge(
        self, candidates: Sequence[LoopCandidate], query: MapEntry, stored: Sequence[MapEntry]
    ) -> list[LoopCandidate]:
        """Candidates of a query, rejected where a pattern explains them; reasons name what was subtracted."""
        source = self._submaps[query.id]
        pairs = [
            _Pair.of(candidate, source, self._submaps[entry.id])
            for candidate, entry in zip(candidates, stored, strict=True)
        ]
        return [self._judged(pair, pairs) for pair in pairs]

    def _session_of(self, entry: MapEntry) -> "_Session":
        return self._sessions.setdefault(entry.record.session, _Session([]))

    def _store(self, entry: MapEntry) -> str:
        session = self._session_of(entry)
        if session.ids and not session.left:
            first = self._submaps[session.ids[0]].entry
            session.left = entry.field.radius < _distance(first, entry) < np.inf
        self._submaps[entry.id] = _Submap(entry, entry, _energy(entry.gradient_map), None)
        return entry.id

    def _measure(self, session: "_Session", ids: Sequence[str], cleaned: Sequence[str]) -> None:
        """Measure the pattern of a session on some of its submaps, and clean some."""
        submaps = [self._submaps[name] for name in ids]
        members = self._distinct([submap.entry for submap in submaps])
        energies = np.array([self._submaps[entry.id].energy for entry in members])
        session.flat_field, session.pattern = None, None
        if len(members) > MIN_SUBMAPS:
            least = max(float(np.quantile(energies, SMOOTHEST)), 1e-30)
            flat_field = FlatField.of(members, 1.0 / np.maximum(energies, least))
            session.pattern = None if flat_field is None else flat_field.pattern()
        if session.pattern is not None:
            session.flat_field = flat_field
            session.strongest = max(filter(None, [session.strongest, session.pattern]), key=lambda p: p.share)
        self._clean(session, cleaned)

    def _distinct(self, entries: Iterable[MapEntry]) -> list[MapEntry]:
        """The submaps that may show different places: no copies, and none near another by odometry."""
        distinct: list[MapEntry] = []
        for entry in entries:
            if not any(_same_cloud(entry, other) or self._near(entry, other) for other in distinct):
                distinct.append(entry)
        return distinct

    def _clean(self, session: "_Session", ids: Sequence[str]) -> None:
        for name in ids:
            submap, flat_field = self._submaps[name], session.flat_field
            entry = submap.entry if flat_field is None else flat_field.clean(submap.entry, self.settings)
            removed = session.pattern if entry is not submap.entry else None
            self._submaps[name] = replace(submap, cleaned=entry, removed=removed)

    def _judged(self, pair: "_Pair", of_query: "Sequence[_Pair]") -> LoopCandidate:
        candidate = pair.candidate
        if candidate and (objection := self._objection(pair, of_query)):
            self.refused += 1
            candidate = candidate.rejected(f"{objection}: {candidate.reason}")
        removed = [submap.removed for submap in (pair.source, pair.target) if submap.removed is not None]
        if not removed:
            return candidate
        strongest = max(removed, key=lambda pattern: pattern.share)
        return replace(candidate, reason=f"{candidate.reason}; {strongest.subtracted}")

    def _objection(self, pair: "_Pair", of_query: "Sequence[_Pair]") -> str:
        """Why a loop is none, in words: other submaps agree with it as a pattern would."""
        if _same_cloud(pair.source.entry, pair.target.entry):
            return ""
        others = self._elsewhere(pair, of_query)
        agree = self._agree(pair, others)
        weight = np.array([pair.weight_of(other.target) for other in others])
        if agree.sum() >= MIN_SUPPORTERS and weight @ agree >= EXPLAINED * weight.sum():
            self._seen_in_view = True
            return f"a pattern fixed to the sensor explains it, {agree.sum()} other submaps agree there too"
        at_identity = pair.is_at_identity(self._near_by(pair.source))
        if not (at_identity or pair.same_view) or self._as_by_odometry(pair):
            return ""
        if (at_identity and self._found_any) or (pair.same_view and self._seen_in_view):
            return "a pattern fixed to the sensor explains it, the two agree in the same part of its view"
        if weight @ ~agree < MIN_SUBMAPS:
            return "a pattern fixed to the sensor may explain it, too few other submaps tell"
        return ""

    @property
    def _found_any(self) -> bool:
        return any(session.strongest is not None for session in self._sessions.values())

    def _elsewhere(self, pair: "_Pair", of_query: "Sequence[_Pair]") -> "list[_Pair]":
        """Up to `MAX_OTHERS` pairs of the query with submaps that show neither place, by odometry if any."""
        shuffled = np.random.default_rng(self.settings.seed).permutation(len(of_query))
        elsewhere = (
            other
            for other in (of_query[index] for index in shuffled)
            if other is not pair
            and not any(self._near(other.target.entry, e.entry) for e in (pair.source, pair.target))
        )
        return list(islice(elsewhere, MAX_OTHERS))

    def _agree(self, pair: "_Pair", others: "Sequence[_Pair]") -> NDArray[np.bool_]:
        """Which of other submaps agree with both of a pair at its pose, or with the query in its view."""
        least = -np.log10(self.settings.calibration.ambiguity_chance)
        agreement = pair.source.agreement_with(pair.target, pair.pose)
        return np.array(
            [
                (pair.same_view and other.candidate.score >= least and other.same_view)
                or pair.is_supported_by(other.target, agreement)
                for other in others
            ],
            dtype=bool,
        )

    def _as_by_odometry(self, pair: "_Pair") -> bool:
        """Whether odometry puts the middle of the source where the pose of a pair does."""
        source, target = pair.source.entry, pair.target.entry
        to_world, from_source = target.record.odometry, source.record.odometry
        if to_world is None or from_source is None or not self._odometry_tells(source, target):
            return False
        expected = _middle(source, inverse(to_world) @ from_source)
        away = np.hypot(*(expected - transform(pair.pose, source.field.centre)))
        return bool(away < self._near_by(pair.source))

    def _near(self, a: MapEntry, b: MapEntry) -> bool:
        """Whether odometry says that two submaps show one place."""
        return self._odometry_tells(a, b) and _distance(a, b) < a.field.radius

    def _odometry_tells(self, a: MapEntry, b: MapEntry) -> bool:
        """Whether two submaps have odometry in one frame by which their session left its first place.

        If it did not, as with zeros or degrees in the file, it says nothing against a pattern.
        """
        return a.record.session == b.record.session and self._sessions[a.record.session].left

    def _near_by(self, submap: "_Submap") -> float:
        """Distance within which two poses are one, metres."""
        return self.settings.calibration.min_separation * submap.entry.field.length_scale


@dataclass(frozen=True, eq=False)
class _Submap:
    """A submap, the same without the pattern of its sensor, its energy, and the pattern that was removed."""

    entry: MapEntry
    cleaned: MapEntry
    energy: float
    removed: SensorPattern | None

    def agreement_with(self, target: "_Submap", T_target_source: Array) -> Agreement:
        return agreement_at(self.cleaned.field, target.cleaned.field, T_target_source)


@dataclass(frozen=True, eq=False)
class _Pair:
    """A query and a stored submap, and the pose (3, 3) at which they were found to agree best."""

    candidate: LoopCandidate
    source: _Submap
    target: _Submap
    pose: Array

    @classmethod
    def of(cls, candidate: LoopCandidate, source: _Submap, target: _Submap) -> "_Pair":
        T = candidate.T_local
        pose = se2(T[0, 3], T[1, 3], yaw_of(T))
        pose[:2, 2] += candidate.target_origin[:2] - pose[:2, :2] @ candidate.source_origin[:2]
        return cls(candidate, source, target, pose)

    @cached_property
    def same_view(self) -> bool:
        """Whether the pose lays one observed area upon the other, wherever their frames are."""
        source, target = self.source.entry.record.hull, self.target.entry.record.hull
        return hull_overlap(transform(self.pose, source), target) >= SAME_VIEW

    def is_at_identity(self, tolerance: float) -> bool:
        """Whether the pose lays one frame upon the other, and the frames can be those of a sensor."""
        g = self.source.entry.gradient_map
        near = np.hypot(*self.pose[:2, 2]) <= tolerance
        return bool(near and self.candidate.overlap >= MIN_COVER and not is_far(g))

    def is_supported_by(self, other: _Submap, agreement: Agreement) -> bool:
        """Whether another submap agrees with both at the pose, nearly as well as the two agree."""

        def agrees(a: _Submap, b: _Submap) -> bool:
            found = a.agreement_with(b, self.pose)
            enough = found.area >= 0.5 * agreement.area
            return enough and found.correlation > MIN_SUPPORT * agreement.correlation

        return agrees(self.source, other) and agrees(other, self.target)

    def weight_of(self, other: _Submap) -> float:
        """What another submap counts: on rough ground it can neither show a pattern nor refute it."""
        return min(1.0, max(self.source.energy, self.target.energy) / max(other.energy, 1e-30))


@dataclass(eq=False)
class _Session:
    """Submaps of one sensor: their ids, what they have in common now, and the most that they ever had.

    `left` tells whether odometry says that the vehicle left its first place.
    """

    ids: list[str]
    left: bool = False
    flat_field: FlatField | None = None
    pattern: SensorPattern | None = None
    strongest: SensorPattern | None = None


def _energy(g: GradientMap) -> float:
    """Mean square of the gradient about its mean."""
    return float((centred(g) ** 2).sum() / max(g.mask.sum(), 1))


def _same_cloud(a: MapEntry, b: MapEntry) -> bool:
    """Whether two maps are equal to the last bit: no sensor sees the same noise twice."""
    return np.array_equal(a.gradient_map.gradient_x, b.gradient_map.gradient_x)


def _middle(entry: MapEntry, T: Array) -> Array:
    """Where SE(3) transform takes the middle of a submap, (2,); its height is not known and taken as zero."""
    return transform(T, np.append(entry.field.centre, 0.0))[:2]


def _distance(a: MapEntry, b: MapEntry) -> float:
    """Between the middles of two submaps by odometry, metres; infinite where it is not known."""
    if a.record.odometry is None or b.record.odometry is None:
        return np.inf
    return float(np.hypot(*(_middle(a, a.record.odometry) - _middle(b, b.record.odometry))))
