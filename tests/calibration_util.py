"""What test_calibration.py measures of a calibration, on simulated drives and on ground in closed form."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
from conftest import World, map_of
from make_calibration_fixture import PATH, unpacked
from scipy.stats import chi2

from terrainloop.config import Calibration, Settings
from terrainloop.detection.detector import map_submap
from terrainloop.entry import MapEntry
from terrainloop.evaluation.overlap import box_iou, world_boxes
from terrainloop.evaluation.pairs import evaluate_pairs
from terrainloop.evaluation.truth import GroundTruth
from terrainloop.field import field_of, field_spacing
from terrainloop.geometry import inverse, parameters_of, se2, yaw_of
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.matching import decision
from terrainloop.matching.hypotheses import Pair
from terrainloop.matching.lift import PlanarPrecision, lift_to_se3
from terrainloop.matching.mission_warp import warp_variance
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.query import Query, rotate, search_grid
from terrainloop.matching.refine import Refinement, refine
from terrainloop.matching.register import compare
from terrainloop.record import SubmapRecord
from terrainloop.submap import Submap

DRIFTING = ("etna_301", "mars_302", "morocco_303")
RIGID = "rigid_304"
# Constants that are used after the search only: with another value its result need not be made again.
AFTER_SEARCH = {
    "tail",
    "independent_tests",
    "min_correlation",
    "ambiguity_ratio",
    "ambiguity_chance",
    "equivalence_ratio",
    "min_participation",
    "dense_hypotheses",
    "block",
    "noise_factor",
    "warp_noise_factor",
    "usual_warp",
    "usual_warp_samples",
    "reach_of_radius",
    "motion_by_warp",
    "rotation_by_warp",
}


def calibrated(**changes):
    """Default settings but for some constants of the calibration."""
    return Settings.model_validate({"calibration": changes})


@dataclass(frozen=True, eq=False)
class Drive:
    """Submaps at rest, their true poses, and the overlap (M, M) of their bounding boxes."""

    entries: list[MapEntry]
    truth: np.ndarray
    overlap: np.ndarray

    @classmethod
    @cache
    def of(cls, name):
        with np.load(PATH) as file:
            steps, counts, truth, parameters = (
                file[f"{name}.{key}"] for key in ("steps", "counts", "truth", "parameters")
            )
        clouds = [unpacked(part) for part in np.split(steps.T, np.cumsum(counts)[:-1])]
        submaps = [Submap(cloud, f"{name}-{index:02d}") for index, cloud in enumerate(clouds)]
        with ThreadPoolExecutor(2) as pool:
            entries = list(
                pool.map(lambda s: map_submap(s, Settings(), Hyperparameters(*parameters)), submaps)
            )
        overlap = box_iou(world_boxes([entry.record.hull for entry in entries], truth))
        return cls(entries, truth, overlap)

    def revisits(self, most):
        """Pairs (source, target) that are not consecutive and share more than a tenth, up to `most`."""
        chosen = (self.overlap > 0.1) & (self.overlap <= most)
        return [(self.entries[i], self.entries[j]) for i, j in np.argwhere(np.tril(chosen, -2))]

    def true_pose(self, candidate):
        """T_target_source."""
        names = [entry.name for entry in self.entries]
        source, target = (self.truth[names.index(name)] for name in (candidate.source, candidate.target))
        return inverse(target) @ source


def unrelated_pairs():
    """Every second pair of submaps of different drives, which share nothing."""
    drives = [Drive.of(name).entries for name in DRIFTING]
    return [(a, b) for k in range(3) for a in drives[k] for b in drives[k - 1]][::2]


@cache
def searches_of_unrelated(settings):
    return searched(unrelated_pairs(), settings)


@cache
def searches_of_revisits(name, most, settings):
    return searched(Drive.of(name).revisits(most), settings)


def searched(pairs, settings):
    """The searches of pairs (source, target) of submaps, whose fields are made anew."""
    targets_of = {}
    for source, target in pairs:
        targets_of.setdefault(source.name, (source, []))[1].append(target)

    def search_all(job):
        source, queries, found = with_field(job[0], settings), {}, []
        for target in (with_field(target, settings) for target in job[1]):
            grid = search_grid(source, target, settings)
            if grid not in queries:
                field = source.field_at(grid.spacing, settings)
                queries[grid] = Query.of(source, grid, rotate(field, settings.calibration))
            found.append(Pair.of(queries[grid], target, settings))
        return found

    with ThreadPoolExecutor(2) as pool:
        return [pair for found in pool.map(search_all, targets_of.values()) for pair in found]


def with_field(entry, settings):
    spacing = field_spacing(entry.gradient_map, settings.calibration)
    return replace(entry, field=field_of(entry.gradient_map, spacing, settings.calibration))


def search_settings(settings):
    """The settings whose searches can be used: the default's, unless a constant of the search differs."""
    changed = {name for name, value in settings.calibration if value != getattr(Settings().calibration, name)}
    return Settings() if changed <= AFTER_SEARCH else settings


def decided(pairs, settings):
    """What is made of pairs that have been searched; each counts as a run of its own."""

    def decide(pair):
        query = SimpleNamespace(entry=pair.source, pair=pair)
        return decision.compare_by_evidence(query, pair.target, 1, settings)

    def again(query, target, settings):
        return replace(query.pair, settings=settings)

    with patch.object(decision.Pair, "of", again), ThreadPoolExecutor(2) as pool:
        return list(pool.map(decide, pairs))


def false_alarms(candidates):
    """False alarms observed over those expected, where one and where a tenth of one is expected in a pair."""
    scores = np.array([candidate.score for candidate in candidates])
    return {
        f"false alarms at {level:g}": np.mean(scores >= -np.log10(level)) / -np.expm1(-level)
        for level in (1.0, 0.1)
    }


def of_unrelated(settings, every=1):
    """False alarms among submaps that share nothing; loops too, over those that are allowed."""
    candidates = decided(searches_of_unrelated(search_settings(settings))[::every], settings)
    allowed = settings.match.max_false_loops * len(candidates)
    return false_alarms(candidates) | {
        "false loops": sum(map(bool, candidates)) / allowed,
        "largest score of unrelated ground": max(candidate.score for candidate in candidates),
    }


def of_small_maps(settings):
    """False alarms among maps so small that they have few places to confuse."""
    corner = {"origin": (-1.0, -1.0), "shape": (28, 28)}
    submaps = [
        MapEntry.of(SubmapRecord(str(seed)), World.of(seed).map(**corner), settings) for seed in range(10, 26)
    ]
    candidates = [compare(a, b, settings) for a, b in combinations(submaps, 2)]
    return {f"{name}, small maps": value for name, value in false_alarms(candidates).items()}


def of_revisits(settings, most=1.0):
    """Share of the revisits that become loops by the ground they share, and how evident they are.

    Of those that share up to `most`.
    """
    evaluated = []
    for name in DRIFTING:
        drive = Drive.of(name)
        pairs = searches_of_revisits(name, most, search_settings(settings))
        truth = GroundTruth([entry.record for entry in drive.entries], drive.truth)
        evaluated += evaluate_pairs(decided(pairs, settings), truth)
    much = np.array([pair.overlap > 0.3 for pair in evaluated])
    loop, right = (
        np.array(values)
        for values in zip(*((bool(p.candidate), p.pose_is_right) for p in evaluated), strict=True)
    )
    score = np.array([max(pair.candidate.score, 0.0) for pair in evaluated])
    measured = {
        "wrong loops": np.sum(loop & ~right),
        "revisits called ambiguous": sum("ambiguous" in pair.candidate.reason for pair in evaluated),
    }
    for name, band in (("above 30 %", much), ("at 10-30 %", ~much)):
        if band.any():
            measured[f"recall {name}"] = np.mean((loop & right)[band])
            measured[f"mean score {name}"] = score[band].mean()
    return measured


@dataclass(frozen=True, eq=False)
class Closure:
    """A loop of the right place, refined, and the true T_target_source."""

    pair: Pair
    refinement: Refinement
    truth: np.ndarray

    def lifted(self, calibration):
        """The error of the pose, and its warp by a calibration."""
        refinement = replace(self.refinement, calibration=calibration)
        overlay = Overlay(*self.pair.maps, refinement.T_target_source)
        precision = PlanarPrecision(refinement.pivot, refinement.covariance)
        T, warp = lift_to_se3(overlay, precision, calibration)
        error = parameters_of(T) - parameters_of(self.truth)
        error[3:] = (error[3:] + np.pi) % (2 * np.pi) - np.pi
        return error, warp


@cache
def closures(name):
    """The loops of a drive by the default settings."""
    found = []
    drive, pairs = Drive.of(name), searches_of_revisits(name, 1.0, Settings())
    for pair, loop in zip(pairs, decided(pairs, Settings()), strict=True):
        if loop:
            x, y, yaw = *loop.T_target_source[:2, 3], yaw_of(loop.T_target_source)
            refinement = refine(*pair.maps, se2(x, y, yaw), Calibration())
            found.append(Closure(pair, refinement, drive.true_pose(loop)))
    return found


def errors_of(name, calibration):
    """Errors of the loops of a drive, and their covariances by the warp of all, and by that of each alone."""
    lifted = [closure.lifted(calibration) for closure in closures(name)]
    pooled = warp_variance([warp for _, warp in lifted], calibration)
    together = [(error, warp.covariance(pooled)) for error, warp in lifted]
    return together, [(error, warp.covariance(warp_variance([warp], calibration))) for error, warp in lifted]


def normalised(errors, part):
    """Squared errors over their covariances, for some of (x, y, z, roll, pitch, yaw)."""
    return np.array([e[part] @ np.linalg.solve(C[np.ix_(part, part)], e[part]) for e, C in errors])


ALL = [0, 1, 2, 3, 4, 5]


def of_errors(settings):
    """NEES over its degrees of freedom, and the share within 95 %, of submaps whose odometry drifts."""
    drives = [errors_of(name, settings.calibration) for name in DRIFTING]
    errors = [pair for together, _ in drives for pair in together]
    single = [pair for _, alone in drives for pair in alone]
    parts = {"all": ALL, "x, y": [0, 1], "z": [2], "roll, pitch": [3, 4], "yaw": [5]}
    nees = {f"NEES of {name}": normalised(errors, p).mean() / len(p) for name, p in parts.items()}
    return nees | {
        "within 95 %": np.mean(normalised(errors, ALL) < chi2.ppf(0.95, 6)),
        "NEES of loops alone": normalised(single, ALL).mean() / 6,
    }


def of_rigid_errors(settings):
    """The same for submaps without drift, and by noise alone."""
    errors, _ = errors_of(RIGID, settings.calibration)
    rigid = [closure.lifted(settings.calibration) for closure in closures(RIGID)]
    noise_only = [(error, warp.rigid) for error, warp in rigid]
    return {
        "NEES, rigid": normalised(errors, ALL).mean() / 6,
        "within 95 %, rigid": np.mean(normalised(errors, ALL) < chi2.ppf(0.95, 6)),
        "NEES of noise, rigid": normalised(noise_only, ALL).mean() / 6,
    }


def of_warped_maps(settings):
    """The warp found between maps of which one rises by a hundredth of the radius, over the true one."""
    options = {"origin": (-4.0, -4.0), "shape": (100, 100)}
    bend = 0.01 / 3.3  # per metre

    def warped(seed, xy):
        height, slope = heights_and_slopes(seed)(xy)
        x, y = xy.T
        return height + bend * x * y, slope + bend * np.c_[y, x]

    ratios = []
    for seed in range(3):
        source = map_of(lambda xy, seed=seed: warped(seed, xy), **options)
        target = World.of(seed).map(**options)
        refinement = refine(source, target, np.eye(3), settings.calibration)
        precision = PlanarPrecision(refinement.pivot, refinement.covariance)
        overlay = Overlay(source, target, refinement.T_target_source)
        warp = lift_to_se3(overlay, precision, settings.calibration)[1]
        variance = warp_variance([warp], settings.calibration)
        ratios.append(np.sqrt(variance / (0.005**2 / 6)))  # one of three parts, of two submaps
    return {"warp found": np.mean(ratios)}


def heights_and_slopes(seed, amplitude=1.0):
    """Ground of a world by positions (N, 2), scaled."""
    ground = World.of(seed)

    def scaled(xy):
        height, slope = ground._height_and_slope(xy)
        return amplitude * height, amplitude * slope

    return scaled
