"""Patterns fixed to the sensor: found as what submaps of different places have in common, and removed.

Ground does not recur at one place of a submap's own frame; a disparity bias of a camera, the range errors of
a LiDAR's rings or parts of the rover do. As a flat field is in photography, the mean gradient of the other
submaps, each in its own frame, is what the sensor adds; it is subtracted from the maps where it is
significant. What remains of it is looked for in every loop closure: a pose at which submaps of other places
agree too is that of a pattern.
"""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice

import cv2
import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import Array, inverse, se2, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.overlay import Agreement, agreement_at

logger = logging.getLogger(__name__)

MIN_SUBMAPS = 4  # that a mean is taken of
MIN_COVER = 0.67  # of the submaps that see a pixel: fewer, and the frame is that of the ground
MIN_SHARE = 0.05  # of the gradients' energy: less does no harm (docs/matching.md, section 3)
SIGNIFICANT = 5.0  # standard deviations of the mean squared significance
WINDOW = 2.0  # length scales over which the significance of the mean is averaged
MAX_PIXELS = 4  # times the largest map, that frames laid over each other may take
SMOOTHEST = 0.25  # of the submaps, which weigh the same; rougher ones weigh less
TYPICAL = 0.5  # of the share, that the median pair has in common: less, and it is ground that some share
PRESENT = 0.5  # of the pattern, that a submap must have: with less it is of another sensor
PERIOD = 40  # submaps after which a pattern is measured anew
MIN_SUPPORT = 0.4  # of the correlation of a loop, at which another submap agrees with both of its submaps too
MIN_SUPPORTERS = 2  # submaps that have to
EXPLAINED = 0.3  # share of the other submaps that agree with both, at which a pattern explains a loop
MAX_OTHERS = 20  # submaps that a loop is held against
MAX_PAIRS = 300  # that the median is taken of


@dataclass(frozen=True)
class SensorPattern:
    """What submaps have in common in their own frames.

    Attributes
    ----------
    share : float
        Of the energy of the gradients, 0 to 1.
    submaps : int
        Number of submaps it was measured on.
    """

    share: float
    submaps: int

    @property
    def _size(self) -> str:
        return f"{self.share:.0%} of the slopes of {self.submaps} submaps"

    @property
    def subtracted(self) -> str:
        """What the reason of a pair says."""
        return f"a pattern fixed to the sensor ({self._size}) was subtracted"

    def __str__(self) -> str:
        return (
            f"a pattern fixed to the sensor makes up {self._size}; it was subtracted before matching: "
            "calibrate the sensor, or mask what it sees of the vehicle; loops of a vehicle that stood still "
            "need its odometry"
        )


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
        """What was found, in words: for each session the strongest pattern."""
        return tuple(
            f"{name}: {session.strongest}" if name else str(session.strongest)
            for name, session in self._sessions.items()
            if session.strongest is not None
        )

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

    def judge(self, candidate: LoopCandidate, source: MapEntry, target: MapEntry) -> LoopCandidate:
        """A candidate, rejected if a pattern explains it; its reason names what was subtracted."""
        pair = [self._submaps[entry.id] for entry in (source, target)]
        if candidate and (objection := self._objection(candidate, *pair)):
            candidate = candidate.rejected(f"{objection}: {candidate.reason}")
        removed = [submap.removed for submap in pair if submap.removed is not None]
        if removed:
            strongest = max(removed, key=lambda pattern: pattern.share)
            candidate = replace(candidate, reason=f"{candidate.reason}; {strongest.subtracted}")
        return candidate

    def _session_of(self, entry: MapEntry) -> "_Session":
        return self._sessions.setdefault(entry.record.session, _Session([]))

    def _store(self, entry: MapEntry) -> str:
        self._submaps[entry.id] = _Submap(entry, entry, _energy(entry.gradient_map), None)
        return entry.id

    def _measure(self, session: "_Session", ids: Sequence[str], cleaned: Sequence[str]) -> None:
        """Measure the pattern of a session on some of its submaps, and clean some."""
        submaps = [self._submaps[name] for name in ids]
        members = _distinct([submap.entry for submap in submaps])
        energies = np.array([self._submaps[entry.id].energy for entry in members])
        session.stack, session.pattern = None, None
        if len(members) > MIN_SUBMAPS:
            least = max(float(np.quantile(energies, SMOOTHEST)), 1e-30)
            stack = _Stack.of(members, 1.0 / np.maximum(energies, least))
            session.pattern = None if stack is None else stack.pattern()
        if session.pattern is not None:
            session.stack = stack
            session.strongest = max(filter(None, [session.strongest, session.pattern]), key=lambda p: p.share)
        self._clean(session, cleaned)

    def _clean(self, session: "_Session", ids: Sequence[str]) -> None:
        for name in ids:
            submap, stack = self._submaps[name], session.stack
            entry = submap.entry if stack is None else stack.clean(submap.entry, self.settings)
            removed = session.pattern if entry is not submap.entry else None
            self._submaps[name] = replace(submap, cleaned=entry, removed=removed)

    def _objection(self, candidate: LoopCandidate, source: "_Submap", target: "_Submap") -> str:
        """Why a loop is none, in words: submaps of other places agree with both at its pose as well."""
        T = candidate.T_target_source
        near = self.settings.calibration.min_separation * source.entry.field.length_scale
        if _same_cloud(source.entry, target.entry) or _as_by_odometry(T, source.entry, target.entry, near):
            return ""
        pose = se2(T[0, 3], T[1, 3], yaw_of(T))
        agreement = agreement_at(source.entry.field, target.entry.field, pose)
        energy = max(source.energy, target.energy)
        total, supporting, count = 0.0, 0.0, 0
        for other in self._others(source.entry, target.entry):
            # On rough ground a pattern disappears: such submaps can neither show nor refute it.
            weight = min(1.0, energy / max(other.energy, 1e-30))
            total += weight
            if _supports(pose, source.entry, other.entry, target.entry, agreement):
                supporting, count = supporting + weight, count + 1
        if count >= MIN_SUPPORTERS and supporting >= EXPLAINED * total:
            return f"a pattern fixed to the sensor explains it, {count} other submaps agree at this pose too"
        at_identity = candidate.overlap >= MIN_COVER and np.hypot(*T[:2, 3]) <= near
        if not at_identity or _is_far(source.entry.gradient_map):
            return ""
        if any(session.strongest is not None for session in self._sessions.values()):
            return "a pattern fixed to the sensor explains it, the two agree in the frame of the sensor"
        if total - supporting < MIN_SUBMAPS:
            return "a pattern fixed to the sensor may explain it, too few other submaps tell"
        return ""

    def _others(self, source: MapEntry, target: MapEntry) -> "list[_Submap]":
        """Up to `MAX_OTHERS` submaps that, as far as odometry says, show neither place."""
        submaps = list(self._submaps.values())
        shuffled = np.random.default_rng(self.settings.seed).permutation(len(submaps))
        elsewhere = (
            submaps[index]
            for index in shuffled
            if not any(
                submaps[index].entry.id == e.id or _near(submaps[index].entry, e) for e in (source, target)
            )
        )
        return list(islice(elsewhere, MAX_OTHERS))


@dataclass(frozen=True, eq=False)
class _Submap:
    """A submap, the same without the pattern of its sensor, its energy, and the pattern that was removed."""

    entry: MapEntry
    cleaned: MapEntry
    energy: float
    removed: SensorPattern | None


@dataclass(eq=False)
class _Session:
    """Submaps of one sensor: their ids, what they have in common now, and the most that they ever had."""

    ids: list[str]
    stack: "_Stack | None" = None
    pattern: SensorPattern | None = None
    strongest: SensorPattern | None = None


@dataclass(frozen=True, eq=False)
class _Stack:
    """Centred gradients of submaps, weighted, summed in one frame.

    Attributes
    ----------
    members : dict of str to (MapEntry, float)
        The submaps and their weights, by id.
    origin, resolution : array (2,), float
        Of the common frame, metres.
    sums : array, (9, rows, columns)
        For each pixel the sums over the submaps that see it, of: 1, w, w^2, w g (2), w^2 g (2), w |g|^2 and
        w^2 |g|^2, with the gradient g of a submap and its weight w.
    """

    members: dict[str, tuple[MapEntry, float]]
    origin: Array
    resolution: float
    sums: Array

    @classmethod
    def of(cls, entries: Sequence[MapEntry], weights: Array) -> "_Stack | None":
        """The stack, or nothing where the submaps have no common frame or resolution."""
        maps = [entry.gradient_map for entry in entries]
        resolution, origin = maps[0].resolution, np.min([m.origin for m in maps], axis=0)
        ends = np.array([_corner(m, origin, resolution) + m.mask.shape for m in maps])
        extent = ends.max(axis=0)
        most = MAX_PIXELS * max(m.mask.size for m in maps)
        if any(_is_far(m) or m.resolution != resolution for m in maps) or extent.astype(float).prod() > most:
            return None
        sums = np.zeros((9, *extent))
        for m, weight in zip(maps, weights, strict=True):
            row, column = _corner(m, origin, resolution)
            rows, columns = m.mask.shape
            sums[:, row : row + rows, column : column + columns] += _summands(m, weight)
        members = {entry.id: (entry, float(w)) for entry, w in zip(entries, weights, strict=True)}
        return cls(members, origin, resolution, sums)

    def pattern(self) -> SensorPattern | None:
        """What the submaps have in common, if it is more than chance, not negligible, and common to most."""
        seen = self.sums[0] >= max(MIN_SUBMAPS, MIN_COVER * len(self.members))
        if not seen.any():
            return None
        _, mean, by_chance = _mean(self.sums[:, seen])
        energy = float((self.sums[7, seen] / self.sums[1, seen]).mean())
        excess = float(((mean**2).sum(axis=0) - by_chance).mean())
        window = WINDOW * self._length_scale / self.resolution
        least = SIGNIFICANT * float(by_chance.mean()) / np.sqrt(max(seen.sum() / window**2, 1.0))
        if not excess > max(least, MIN_SHARE * energy) or not self._is_typical():
            return None
        return SensorPattern(excess / energy, len(self.members))

    def clean(self, entry: MapEntry, settings: Settings) -> MapEntry:
        """The entry less the mean of the others, shrunk by how much of it chance explains nearby.

        As it is where it has no such pattern: a mission may have several sensors.
        """
        g = entry.gradient_map
        if g.resolution != self.resolution or _is_far(g):
            return entry
        _, weight_of_entry = self.members.get(entry.id, (None, 0.0))
        sums = self._at(g)
        if weight_of_entry:
            sums -= _summands(g, weight_of_entry)
        count, mean, by_chance = _mean(sums)
        sigma = WINDOW * self._length_scale / g.resolution / 2
        valid = (count >= max(MIN_SUBMAPS - 1, MIN_COVER * (len(self.members) - 1))).astype(float)
        square, chance = (
            cv2.GaussianBlur(image * valid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
            for image in ((mean**2).sum(axis=0), by_chance)
        )
        weight = valid * np.clip(1.0 - chance / np.maximum(square, 1e-30), 0.0, 1.0)
        of_sensor = weight * mean * g.mask
        if (_centred(g) * of_sensor).sum() <= PRESENT * (of_sensor**2).sum():
            return entry
        x, y = (
            (image - part).astype(np.float32)
            for image, part in zip((g.gradient_x, g.gradient_y), weight * mean, strict=True)
        )
        return MapEntry.of(entry.record, replace(g, gradient_x=x, gradient_y=y), settings)

    @property
    def _length_scale(self) -> float:
        return next(iter(self.members.values()))[0].field.length_scale

    def _at(self, g: GradientMap) -> Array:
        """The sums on the pixels of a map; zero beyond the common frame."""
        row, column = _corner(g, self.origin, self.resolution)
        rows, columns = g.mask.shape
        sums = np.zeros((9, rows, columns))
        ends = np.minimum((row + rows, column + columns), self.sums.shape[1:])
        low = np.maximum((row, column), 0)
        if (ends > low).all():
            inside = tuple(slice(a - at, b - at) for a, b, at in zip(low, ends, (row, column), strict=True))
            sums[:, *inside] = self.sums[:, low[0] : ends[0], low[1] : ends[1]]
        return sums

    def _is_typical(self) -> bool:
        """Whether most pairs of submaps have it in common, rather than a few much (ground seen again)."""
        pairs = list(combinations(self.members.values(), 2))
        pairs = pairs[:: -(-len(pairs) // MAX_PAIRS)]
        common = np.array([agreement_at(a.field, b.field, np.eye(3)).correlation for (a, _), (b, _) in pairs])
        weights = np.array([v * w for (_, v), (_, w) in pairs])
        order = common.argsort()
        below = weights[order].cumsum()
        median = common[order[np.searchsorted(below, 0.5 * below[-1])]]
        return bool(median > TYPICAL * np.average(common, weights=weights))


def _corner(g: GradientMap, origin: Array, resolution: float) -> Array:
    """Row and column of the first pixel of a map in a frame."""
    return np.asarray(np.round((np.array(g.origin) - origin) / resolution).astype(int)[::-1])


def _summands(g: GradientMap, weight: float) -> Array:
    """What a map adds to the sums of a `_Stack`."""
    gradient, seen = _centred(g), g.mask.astype(float)
    energy = (gradient**2).sum(axis=0)
    w, v = weight, weight**2
    return np.stack([seen, w * seen, v * seen, *(w * gradient), *(v * gradient), w * energy, v * energy])


def _mean(sums: Array) -> tuple[Array, Array, Array]:
    """Number of submaps, weighted mean gradient (2, ...) and variance of that mean, from the sums."""
    count, w, v, energy = sums[0], np.maximum(sums[1], 1e-30), sums[2], sums[8]
    mean = sums[3:5] / w
    squares = energy - 2 * (mean * sums[5:7]).sum(axis=0) + (mean**2).sum(axis=0) * v
    effective = w**2 / np.maximum(v, 1e-30)
    return count, mean, np.maximum(squares, 0.0) / w**2 / np.maximum(1.0 - 1.0 / effective, 1e-3)


def _centred(g: GradientMap) -> Array:
    """Gradient (2, rows, columns) less its mean, zero where the ground was not observed."""
    gradient = np.stack([g.gradient_x, g.gradient_y]).astype(float)
    return (gradient - gradient[:, g.mask].mean(axis=1)[:, None, None] if g.mask.any() else gradient) * g.mask


def _energy(g: GradientMap) -> float:
    """Mean square of the gradient about its mean."""
    return float((_centred(g) ** 2).sum() / max(g.mask.sum(), 1))


def _distinct(entries: Iterable[MapEntry]) -> list[MapEntry]:
    """The submaps that may show different places: no copies, and none near another by odometry."""
    distinct: list[MapEntry] = []
    for entry in entries:
        if not any(_same_cloud(entry, other) or _near(entry, other) for other in distinct):
            distinct.append(entry)
    return distinct


def _same_cloud(a: MapEntry, b: MapEntry) -> bool:
    """Whether two maps are equal to the last bit: no sensor sees the same noise twice."""
    return np.array_equal(a.gradient_map.gradient_x, b.gradient_map.gradient_x)


def _near(a: MapEntry, b: MapEntry) -> bool:
    """Whether odometry says that two submaps show one place."""
    if a.record.odometry is None or b.record.odometry is None:
        return False
    return bool(np.hypot(*(a.record.odometry - b.record.odometry)[:2, 3]) < a.field.radius)


def _is_far(g: GradientMap) -> bool:
    """Whether the frame of a map cannot be that of a sensor, which is near what it sees."""
    return bool(g.local_origin.any())


def _as_by_odometry(T: Array, source: MapEntry, target: MapEntry, tolerance: float) -> bool:
    """Whether odometry puts the source where T does, to a tolerance in metres."""
    to_world, from_source = target.record.odometry, source.record.odometry
    if to_world is None or from_source is None:
        return False
    return bool(np.hypot(*(inverse(to_world) @ from_source - T)[:2, 3]) < tolerance)


def _supports(T: Array, source: MapEntry, other: MapEntry, target: MapEntry, pair: Agreement) -> bool:
    """Whether another submap agrees with both of a pair at its pose, nearly as well as these agree."""

    def agrees(a: MapEntry, b: MapEntry) -> bool:
        found = agreement_at(a.field, b.field, T)
        return found.area >= 0.5 * pair.area and found.correlation > MIN_SUPPORT * pair.correlation

    return agrees(source, other) and agrees(other, target)
