"""LoopDetector: submaps go in one by one, loop closures come out."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Real
from threading import Lock

import numpy as np

from terrainloop.config import Settings
from terrainloop.detection.allowance import pairs_equivalent, plausible_by_odometry, share_of_query
from terrainloop.detection.sensor_pattern import SensorPatterns
from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array, is_rigid
from terrainloop.gp.hyperparameters import FitOptions, fit_hyperparameters, fit_noise
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.training import TrainingData, detrend
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mission_null import MissionNull, by_mission_null, mirrored, without_loops
from terrainloop.matching.mission_warp import with_mission_warp
from terrainloop.matching.register import compare_many
from terrainloop.record import SubmapRecord
from terrainloop.resources import check_memory, memory_errors
from terrainloop.submap import UNNAMED, Submap

logger = logging.getLogger(__name__)

FEATURE_BYTES_PER_PIXEL = 250  # of SIFT, at the peak (docs/solver.md)

NULL_PAIRS_PER_QUERY = 12  # mirror images compared for one submap, at most
NEVER_SIGNIFICANT = 1e100  # pairs; mirror images need no thorough refinement

PairSink = Callable[[LoopCandidate], object]


class LoopDetector:
    """Finds the earlier submaps that show the same place as a new one.

    Parameters
    ----------
    settings : Settings, optional
    max_false_loops : float, optional
        Expected number of false loop closures per mission; overrides the settings.
    parameters : Hyperparameters, optional
        Hyperparameters of the Gaussian process, if known; otherwise fitted according to ``settings.map.fit``,
        with "database" to the first submap. Each map has a noise of its own (see `map_submap`).
    expected_pairs : int, optional
        Number of pairs that the mission will compare, if known: `max_false_loops` is shared among them.
        Otherwise later queries are given less of it, so that it holds for any number (see `allowance`).
    null_scores : sequence of float, optional
        Scores of mirror images, where they are known (see `sample_null`); else measured on the way.
    sensor_patterns : SensorPatterns, optional
        Of the submaps that will be added, where these are known; else patterns fixed to the sensor are
        measured on the way.
    on_pair : callable, optional
        Called with every LoopCandidate as it is decided, rejected ones too; the detector keeps the loops
        only.
    workers : int
        Threads; the result does not depend on their number.

    Attributes
    ----------
    entries : dict of str to MapEntry
        The submaps stored so far, by id, in the order of arrival.
    loops : list of LoopCandidate
        The accepted loops so far.
    null_scores : list of float
        Scores of mirror images, from which the null of the mission is estimated.

    Examples
    --------
    >>> detector = LoopDetector()
    >>> for submap in load_mission("mission/"):  # doctest: +SKIP
    ...     for loop in detector.add(submap):
    ...         print(loop.target, loop.source, loop.T_target_source)
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        max_false_loops: float | None = None,
        parameters: Hyperparameters | None = None,
        expected_pairs: int | None = None,
        null_scores: Sequence[float] | None = None,
        sensor_patterns: SensorPatterns | None = None,
        on_pair: PairSink = lambda candidate: None,
        workers: int = 1,
    ) -> None:
        self.settings = Settings.or_default(settings).with_max_false_loops(max_false_loops)
        known = () if null_scores is None else null_scores
        _require(isinstance(parameters, Hyperparameters | None), "Hyperparameters or None", parameters)
        _require(
            expected_pairs is None or _is_count(expected_pairs), "expected_pairs of 0 or more", expected_pairs
        )
        _require(all(map(_is_finite, known)), "finite null_scores", known)
        _require(
            isinstance(sensor_patterns, SensorPatterns | None), "SensorPatterns or None", sensor_patterns
        )
        _require(callable(on_pair), "a function on_pair", on_pair)
        self.parameters = parameters
        self.expected_pairs = expected_pairs
        self.workers = workers
        self.entries: dict[str, MapEntry] = {}
        self.loops: list[LoopCandidate] = []
        self.null_scores: list[float] = list(known)
        self._null_is_known = null_scores is not None
        self._patterns = sensor_patterns or SensorPatterns(self.settings)
        self._on_pair = on_pair
        self._adding = Lock()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Patterns fixed to the sensor that were found, in words."""
        return self._patterns.warnings

    @property
    def cleaned(self) -> dict[str, MapEntry]:
        """The submaps by id, without the patterns of their sensor: as they are compared."""
        return {name: self._patterns.cleaned(entry) for name, entry in self.entries.items()}

    def __repr__(self) -> str:
        return f"LoopDetector({len(self.entries)} submaps, {len(self.loops)} loops)"

    def add(self, submap: Submap, odometry: Array | None = None) -> list[LoopCandidate]:
        """Map a submap, compare it with the earlier ones, store it.

        Safe to call from several threads: submaps are added one after the other.

        Parameters
        ----------
        submap : Submap
            A submap with a name that is not taken; one without a name is named by its number.
        odometry : array, (4, 4), optional
            T_world_submap by odometry: more of `max_false_loops` is spent on pairs that it makes plausible.

        Returns
        -------
        list of LoopCandidate
            The accepted loops.

        Raises
        ------
        TerrainLoopError
            If the name is taken or no map can be made; the detector is then as it was.
        """
        _require(isinstance(submap, Submap), "a Submap", submap)
        _require(
            odometry is None or _is_pose(odometry), "odometry as a rigid transform (4, 4), or None", odometry
        )
        with self._adding:
            query = map_submap(
                submap, self.settings, self.parameters, odometry=odometry, workers=self.workers
            )
            if submap.name == UNNAMED:
                name = f"{UNNAMED}_{len(self.entries):06d}"
                query = replace(query, record=replace(query.record, name=name))
            loops = self._add(query)
            if self.settings.map.fit == "database":
                self.parameters = self.parameters or query.gradient_map.parameters
            return loops

    def add_entry(self, query: MapEntry) -> list[LoopCandidate]:
        """As `add`, for a submap that is mapped already (see `map_submap`)."""
        _require(isinstance(query, MapEntry), "a MapEntry", query)
        with self._adding:
            return self._add(query)

    def _add(self, query: MapEntry) -> list[LoopCandidate]:
        if query.id in self.entries:
            raise TerrainLoopError(
                expected="a submap with a name of its own",
                found=f"a second {query.id!r}",
                mend="name each submap differently",
            )
        stored = list(self.entries.values())[: max(0, len(self.entries) - self.settings.skip_recent)]
        known, since = self.expected_pairs, list(self.entries.values())[len(stored) :]
        share = len(stored) / known if known else share_of_query(max(len(stored), 1))
        pairs = pairs_equivalent(share, plausible_by_odometry(query, stored, since))
        if self.settings.match.decision == "evidence":
            candidates = self._by_evidence(query, stored, pairs)
        else:
            candidates = compare_many(query, stored, self.settings, pairs=pairs, workers=self.workers)
        self.entries[query.id] = query
        for candidate in candidates:
            self._on_pair(candidate)
        loops = [candidate for candidate in candidates if candidate]
        self.loops += loops
        return loops

    def _by_evidence(self, query: MapEntry, stored: Sequence[MapEntry], pairs: Array) -> list[LoopCandidate]:
        """Compare without the patterns of the sensor; null and warp are those of the mission."""
        patterns = self._patterns
        patterns.add(query)
        source, targets = patterns.cleaned(query), [patterns.cleaned(entry) for entry in stored]
        candidates = compare_many(source, targets, self.settings, pairs=pairs, workers=self.workers)
        mirrors = self._mirror_images(source, targets)
        null = MissionNull.of([*self.null_scores, *mirrors.values()], self.settings.calibration)
        decided = [
            by_mission_null(candidate, null, self.settings, among)
            for candidate, among in zip(candidates, pairs, strict=True)
        ]
        decided = patterns.judge(decided, query, stored)
        self.null_scores += [score for index, score in mirrors.items() if not decided[index]]
        return with_mission_warp(decided, self.settings.calibration, earlier=self.loops)

    def _mirror_images(self, query: MapEntry, stored: Sequence[MapEntry]) -> dict[int, float]:
        """Scores of the mirror image of a query against some stored submaps, while the null is not known."""
        wanted = 0 if self._null_is_known else self.settings.calibration.null_pairs
        if len(self.null_scores) >= wanted or not stored:
            return {}
        sample = range(0, len(stored), -(-len(stored) // NULL_PAIRS_PER_QUERY))
        scores = mirror_scores(query, [stored[k] for k in sample], self.settings, workers=self.workers)
        return {k: score for k, score in zip(sample, scores, strict=True) if not np.isnan(score)}


def _require(met: bool, expected: str, found: object) -> None:
    if not met:
        raise TerrainLoopError(
            expected=expected, found=f"{found!r:.60}", mend="see the documentation of LoopDetector"
        )


def _is_count(value: object) -> bool:
    return isinstance(value, int | np.integer) and bool(value >= 0)


def _is_pose(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and is_rigid(value.astype(float))


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and bool(np.isfinite(float(value)))


def mirror_scores(
    source: MapEntry, targets: Sequence[MapEntry], settings: Settings, *, workers: int = 1
) -> Array:
    """Scores (N,) of the mirror image of a submap against others, by the law of one pair; NaN without one."""
    image = mirrored(source, settings)
    candidates = compare_many(image, targets, settings, pairs=NEVER_SIGNIFICANT, workers=workers)
    return np.array([-candidate.log_nfa for candidate in candidates])


def sample_null(
    entries: Sequence[MapEntry],
    settings: Settings,
    *,
    workers: int = 1,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[float]:
    """Scores of mirror images for pairs spread evenly over those that a mission compares, without its loops.

    Ground that is seen twice and is symmetric in parts resembles its own mirror image.
    """
    pairs = [(i, j) for i in range(len(entries)) for j in range(i - settings.skip_recent)]
    count = min(len(pairs), settings.calibration.null_pairs)
    chosen: dict[int, list[MapEntry]] = {}
    for k in np.linspace(0, len(pairs) - 1, count).astype(int) if count else ():
        chosen.setdefault(pairs[k][0], []).append(entries[pairs[k][1]])
    scores, candidates = np.empty(0), []
    for done, (i, targets) in enumerate(chosen.items(), start=1):
        scores = np.append(scores, mirror_scores(entries[i], targets, settings, workers=workers))
        candidates += compare_many(entries[i], targets, settings, pairs=len(pairs), workers=workers)
        on_progress(done, len(chosen))
    return without_loops(scores, candidates, settings, len(pairs))


def fit_database(
    clouds: Sequence[Submap | TrainingData], settings: Settings, *, workers: int = 1
) -> Hyperparameters:
    """Length scale and variance for all maps of a database, so that they are comparable; a typical noise."""
    return fit_hyperparameters(
        clouds,
        length_scale=settings.map.length_scale,
        noise=settings.map.noise,
        max_points=_fit_points(settings),
        exact=settings.map.solver == "exact",
        remove_plane=settings.map.remove_plane,
        seed=settings.seed,
        workers=workers,
    )


def _with_own_noise(
    data: TrainingData, shared: Hyperparameters, settings: Settings, workers: int
) -> Hyperparameters:
    options = FitOptions(
        _fit_points(settings),
        remove_plane=settings.map.remove_plane,
        seed=settings.seed,
        workers=workers,
    )
    return fit_noise(data, shared, options)


def _fit_points(settings: Settings) -> int | None:
    limits = [n for n in (settings.map.max_points, settings.map.fit_points) if n is not None]
    return min(limits, default=None)


def detrend_submap(submap: Submap, settings: Settings) -> TrainingData:
    """What the Gaussian process is fitted to and predicted from."""
    return detrend(submap, remove_plane=settings.map.remove_plane)


def map_submap(
    submap: Submap,
    settings: Settings,
    parameters: Hyperparameters | None = None,
    *,
    data: TrainingData | None = None,
    odometry: Array | None = None,
    workers: int = 1,
    max_memory: float | None = None,
) -> MapEntry:
    """The gradient map of a submap, its keypoints and its field.

    Parameters
    ----------
    submap : Submap
    settings : Settings
    parameters : Hyperparameters, optional
        Hyperparameters of the database; fitted to this submap if not given. Where ``settings.map.fit`` is
        "database", the submap's own noise takes the place of theirs.
    data : TrainingData, optional
        Result of `detrend_submap`, if known.
    odometry : array, (4, 4), optional
        T_world_submap by odometry.
    workers : int
        Threads; the result does not depend on their number.
    max_memory : float, optional
        Bytes that the map may take; all that are available if not given.

    Raises
    ------
    TerrainLoopError
        If no map can be made, or there is not enough memory.
    """
    data = data or detrend_submap(submap, settings)
    if parameters is None:
        parameters = fit_database([data], settings, workers=workers)
    elif settings.map.fit == "database":
        parameters = _with_own_noise(data, parameters, settings, workers)
    gradient_map = GradientMap.from_points(
        data,
        parameters.length_scale,
        parameters.variance,
        parameters.noise,
        settings.map.resolution,
        max_points=settings.map.max_points,
        local_noise=settings.map.local_noise,
        solver=settings.map.solver,
        max_variance_ratio=settings.map.max_variance_ratio,
        seed=settings.seed,
        workers=workers,
        max_memory=max_memory,
    )
    record = SubmapRecord.of(submap, None if odometry is None else np.array(odometry, dtype=float))
    for words in gradient_map.warnings:
        logger.warning("%s: %s", submap.name, words)
    record = replace(record, notes="; ".join(filter(None, [record.notes, *gradient_map.warnings])))
    check_memory(FEATURE_BYTES_PER_PIXEL * gradient_map.mask.size, "the keypoints of a map", max_memory)
    with memory_errors("the keypoints of a map"):
        return MapEntry.of(record, gradient_map, settings)


def map_pair(
    source: Submap, target: Submap, settings: Settings, *, workers: int = 1
) -> tuple[MapEntry, MapEntry]:
    """Two submaps mapped with one length scale and variance, so that they can be compared."""
    data = [detrend_submap(submap, settings) for submap in (source, target)]
    shared = fit_database(data, settings, workers=workers) if settings.map.fit == "database" else None
    return (
        map_submap(source, settings, shared, data=data[0], workers=workers),
        map_submap(target, settings, shared, data=data[1], workers=workers),
    )
