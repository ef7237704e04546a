"""Benchmarks of matching: recall by method, false alarms, covariance, time.

    python benchmarks/matching.py recall MISSION...   keypoints, dense: by shared ground and direction
    python benchmarks/matching.py null MISSION...     submaps of different missions, which share nothing
    python benchmarks/matching.py errors MISSION...   errors of accepted loops against their covariance
    python benchmarks/matching.py time MISSION        one query against 14 submaps, by stage
    python benchmarks/matching.py sensors             stereo submaps against LiDAR submaps of one world
    python benchmarks/matching.py covariance          errors against covariance by drift, sensor and origin

A mission is a folder with clouds and truth.tum ('terrainloop simulate' makes some); passes.csv beside them
names sessions; only pairs of different sessions are compared. Maps are cached in
~/.cache/terrainloop-benchmarks. With --figure F.png, null and errors also plot expected against observed.
"""

import argparse
import pickle
import platform
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import lru_cache
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.random import SeedSequence
from provenance import fingerprint, package
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from terrainloop import Settings, Submap
from terrainloop.detection.detector import (
    NEVER_SIGNIFICANT,
    LoopDetector,
    fit_database,
    map_submap,
    sample_null,
)
from terrainloop.detection.mission import MissionMapping, detect_mission
from terrainloop.evaluation.overlap import world_boxes
from terrainloop.evaluation.pairs import evaluate_pairs
from terrainloop.evaluation.summary import OVERLAP_BANDS
from terrainloop.evaluation.truth import GroundTruth
from terrainloop.geometry import inverse, parameters_of, se3, transform, yaw_of
from terrainloop.io.clouds import write_cloud
from terrainloop.io.files import write_whole
from terrainloop.io.missions import load_mission, read_sessions
from terrainloop.io.trajectories import read_trajectory
from terrainloop.matching import decision, hypotheses, register
from terrainloop.matching.mission_warp import with_mission_warp
from terrainloop.matching.register import compare, compare_many
from terrainloop.record import SubmapRecord
from terrainloop.simulation.missions import submap_cloud, thin
from terrainloop.simulation.odometry import estimate, true_poses
from terrainloop.simulation.paths import revisiting_path
from terrainloop.simulation.setups import SETUPS
from terrainloop.simulation.terrain import make_terrain

CACHE = Path.home() / ".cache" / "terrainloop-benchmarks"
BANDS = OVERLAP_BANDS[::-1]
EVIDENCE = Settings()
INLIERS = Settings.model_validate({"match": {"decision": "inliers"}})


DEFAULT = "evidence (default)"
METHODS = {"keypoints, inlier count": INLIERS, DEFAULT: EVIDENCE}


@lru_cache(maxsize=4)
def mapped(folder):
    """Mapped submaps, their records and true poses, and sessions of a mission."""
    mission = load_mission(folder)
    key = fingerprint(*package(), Path(__file__), folder, settings=EVIDENCE.model_dump())
    cache = CACHE / f"{key[:16]}.pickle"
    if not cache.exists():
        content = [cloud.entry for cloud in MissionMapping.of(mission, EVIDENCE, 2).clouds(1)]
        CACHE.mkdir(parents=True, exist_ok=True)
        write_whole(
            cache, lambda file: file.write(pickle.dumps(content))
        )  # two processes may map one mission
    entries = pickle.loads(cache.read_bytes())
    sessions = None
    if (folder / "passes.csv").exists():
        sessions = read_sessions(folder / "passes.csv")
    records = [entry.record for entry in entries]
    return entries, records, read_trajectory(folder / "truth.tum").poses, sessions


def compare_all(job):
    """One submap of one mission against several of another."""
    settings, source, index, target, others, pairs = job
    cv2.setNumThreads(1)
    query, stored = mapped(source)[0][index], mapped(target)[0]
    with threadpool_limits(1):
        return compare_many(query, [stored[other] for other in others], settings, pairs=pairs)


def processes():
    # Threads of the maps' solver do not survive a fork.
    return ProcessPoolExecutor(2, mp_context=get_context("spawn"))


def detected(job):
    """Every pair of a mission, as 'terrainloop detect --all-pairs' decides it."""
    folder, method = job
    cv2.setNumThreads(1)
    entries, settings, pairs = mapped(folder)[0], METHODS[method].model_copy(update={"skip_recent": 0}), []
    with threadpool_limits(1):
        by_evidence = settings.match.decision == "evidence"
        detector = LoopDetector(
            settings,
            expected_pairs=len(entries) * (len(entries) - 1) // 2,
            null_scores=sample_null(entries, settings) if by_evidence else (),
            on_pair=pairs.append,
        )
        for entry in entries:
            detector.add_entry(entry)
    return with_mission_warp(pairs, settings.calibration)


def judged(folder, candidates):
    """Pairs of a mission that odometry does not connect, evaluated against the truth; how they are turned."""
    _, records, poses, sessions = mapped(folder)
    turned = {
        (records[i].name, records[j].name): abs(yaw_of(inverse(poses[j]) @ poses[i]))
        for i in range(len(poses))
        for j in range(i)
    }
    return evaluate_pairs(candidates, GroundTruth(records, poses, sessions)), turned


def recall(folders, _):
    print("| mission | method | " + " | ".join(f"IoU {a}-{b}: best, accepted" for a, b in BANDS), end="")
    print(" | same way | opposite | across | loops | wrong | disjoint |")
    print("|---" * 10 + "|")
    total = defaultdict(list)
    with processes() as pool:
        jobs = [(folder, method) for folder in folders for method in METHODS]
        for (folder, method), candidates in zip(jobs, pool.map(detected, jobs), strict=True):
            pairs, turned = judged(folder, candidates)
            row = recall_row(pairs, turned)
            total[method].append(row)
            print(f"| {folder.name} | {method} | {cells(row)} |", flush=True)
    for method, rows in total.items():
        mean = [np.nanmean(values) for values in zip(*(row[:7] for row in rows), strict=True)]
        print(f"| mean, sums | {method} | {cells([*mean, *np.sum([row[7:] for row in rows], axis=0)])} |")


def recall_row(pairs, turned):
    score = np.array([p.candidate.score for p in pairs])
    overlap = np.array([p.overlap for p in pairs])
    right = np.array([p.pose_is_right for p in pairs])
    accepted = np.array([bool(p.candidate) for p in pairs])
    turn = np.array([turned[p.candidate.source, p.candidate.target] for p in pairs])
    first_false = score[~right].max(initial=-np.inf)  # also where they do share ground
    row = []
    for low, high in BANDS:
        band = (overlap > low) & (overlap <= high)
        row += [share(right & (score > first_false), band), share(right & accepted, band)]
    for low, high in ((0, 45), (135, 180), (45, 135)):
        way = (overlap > 0.1) & (np.degrees(turn) >= low) & (np.degrees(turn) <= high)
        row.append(share(right & accepted, way))
    return [*row, accepted.sum(), (accepted & ~right).sum(), (accepted & (overlap <= 0)).sum()]


def share(what, of):
    return what[of].mean() if of.any() else np.nan


def cells(row):
    best = f"{row[0]:.2f}, {row[1]:.2f} | {row[2]:.2f}, {row[3]:.2f}"
    ways = " | ".join(f"{value:.2f}" for value in row[4:7])
    return f"{best} | {ways} | " + " | ".join(f"{int(n)}" for n in row[7:10])


def null(folders, figure):
    """Expected and observed false alarms over pairs of submaps of different missions."""
    scores, accepted = defaultdict(list), 0
    with processes() as pool:
        for a, b in combinations(folders, 2):
            others = list(range(len(mapped(b)[0])))
            jobs = [(EVIDENCE, a, i, b, others, NEVER_SIGNIFICANT) for i in range(len(mapped(a)[0]))]
            for found in pool.map(compare_all, jobs):
                scores[" ".join(sorted({a.name.split("_")[0], b.name.split("_")[0]}))] += [
                    c.score for c in found
                ]
    count = sum(map(len, scores.values()))
    accepted = sum(
        (np.array(s) >= np.log10(count / EVIDENCE.match.max_false_loops)).sum() for s in scores.values()
    )
    print(
        f"{count} pairs that share nothing; accepted as one mission with max_false_loops 0.01: {accepted}\n"
    )
    levels = (1, 0.1, 0.03, 0.01, 0.003, 0.001)
    print("| worlds | pairs | " + " | ".join(f"{x:g} per pair" for x in levels) + " | largest score |")
    print("|---" * (len(levels) + 3) + "|")
    for name, values in {"all": np.concatenate(list(scores.values())), **scores}.items():
        values = np.asarray(values)
        ratios = [f"{(values >= -np.log10(x)).sum()} / {-np.expm1(-x) * len(values):.1f}" for x in levels]
        print(f"| {name} | {len(values)} | {' | '.join(ratios)} | {values.max():.1f} |")
    if figure:
        drawing = Figure(figsize=(6, 4.5), layout="constrained")
        axes = drawing.subplots()
        score = np.linspace(-0.5, 4.5, 200)
        for values in scores.values():
            observed = [(np.asarray(values) >= s).mean() for s in score]
            axes.plot(score, observed, lw=0.8, color="0.6")
        everything = np.concatenate(list(scores.values()))
        axes.plot(score, [(everything >= s).mean() for s in score], lw=2, label="observed")
        axes.plot(score, -np.expm1(-(10.0**-score)), "k--", label="expected")
        axes.set(
            yscale="log", ylim=(0.5 / count, 1.2), xlabel="score", title=f"{count} pairs that share nothing"
        )
        axes.set_ylabel("share of pairs at or above it (grey: by worlds)")
        axes.legend()
        drawing.savefig(figure, dpi=110)


def errors(folders, figure):
    """Errors of accepted loops of the right place, and their squares normalised by the covariance."""
    print("| mission | loops | x-y, m | z, m | yaw, deg ", end="")
    print("| NEES / 6 | x, y, yaw / 3 | z, roll, pitch / 3 | within 95 % |")
    print("|---" * 9 + "|")
    all_squares = defaultdict(list)
    with processes() as pool:
        results = pool.map(detected, [(folder, DEFAULT) for folder in folders])
        for folder, candidates in zip(folders, results, strict=True):
            pairs, _ = judged(folder, candidates)
            _, records, poses, _ = mapped(folder)
            order = {record.name: index for index, record in enumerate(records)}
            squares, plane, rest = all_squares[folder.name], [], []
            good = [p for p in pairs if p.candidate and p.pose_is_right]
            for p in good:
                c = p.candidate
                truth = inverse(poses[order[c.target]]) @ poses[order[c.source]]
                for part, values in ((ALL, squares), (PLANE, plane), (REST, rest)):
                    values.append(normalised(c, truth, part))
            median = [
                np.median([getattr(p, name) for p in good])
                for name in ("position_error", "height_error", "yaw_error")
            ]
            within = np.mean(np.array(squares) < chi2.ppf(0.95, 6))
            nees = f"{np.mean(squares) / 6:.2f} | {np.mean(plane) / 3:.2f} | {np.mean(rest) / 3:.2f}"
            print(
                f"| {folder.name} | {len(good)} | {median[0]:.3f} | {median[1]:.3f} "
                f"| {np.degrees(median[2]):.2f} | {nees} | {within:.0%} |",
                flush=True,
            )

    if figure:
        drawing = Figure(figsize=(6, 4.5), layout="constrained")
        axes = drawing.subplots()
        for squares in all_squares.values():
            axes.plot(np.sort(squares), (np.arange(len(squares)) + 0.5) / len(squares), lw=0.8, color="0.6")
        together = np.sort(np.concatenate(list(all_squares.values())))
        axes.plot(together, (np.arange(len(together)) + 0.5) / len(together), lw=2, label="observed")
        square = np.linspace(0, 30, 200)
        axes.plot(square, chi2.cdf(square, 6), "k--", label="chi-squared, 6 degrees of freedom")
        axes.set(xlim=(0, 30), xlabel="normalised squared error", ylabel="share of loops (grey: by mission)")
        axes.set_title(f"{len(together)} accepted loops")
        axes.legend()
        drawing.savefig(figure, dpi=110)


ALL, PLANE, REST = [0, 1, 2, 3, 4, 5], [0, 1, 5], [2, 3, 4]


def normalised(candidate, truth, part):
    """Squared error of some of (x, y, z, roll, pitch, yaw), normalised by its covariance."""
    error = parameters_of(candidate.T_target_source) - parameters_of(truth)
    error[3:] = (error[3:] + np.pi) % (2 * np.pi) - np.pi
    return error[part] @ np.linalg.solve(candidate.covariance[np.ix_(part, part)], error[part])


def query_time(folders, _):
    """The last submap against 14 others; stages are timed on one thread."""
    cv2.setNumThreads(1)
    entries = mapped(folders[0])[0]
    query, stored = entries[-1], entries[:14]
    spent = defaultdict(float)

    def timed(name, original):
        def wrapper(*args, **kwargs):
            start = time.perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                spent[name] += time.perf_counter() - start

        return wrapper

    print(f"{platform.machine()}, {folders[0].name}, submap {query.name} against {len(stored)}")
    with threadpool_limits(1):
        for threads in (1, 2):
            times = []
            for _ in range(7):
                start = time.perf_counter()
                compare_many(query, stored, EVIDENCE, pairs=105, workers=threads)
                times.append(time.perf_counter() - start)
            print(f"{threads} thread(s): median {1e3 * np.median(times):.0f} ms")
        stages = (
            *((register, name) for name in ("search_grid", "rotate", "Query")),
            *((hypotheses, name) for name in ("search", "refine")),
            *((decision, name) for name in ("propose_hypotheses", "refine", "_objection", "_candidate")),
        )
        with ExitStack() as stack:
            for module, name in stages:
                label = f"{module.__name__.rpartition('.')[2]}.{name}"
                owner, attribute = (module.Query, "of") if name == "Query" else (module, name)
                stack.enter_context(patch.object(owner, attribute, timed(label, getattr(owner, attribute))))
            compare_many(query, stored, EVIDENCE, pairs=105)
    for name, seconds in spent.items():
        print(f"  {name}: {1e3 * seconds / len(stored):.2f} ms per pair")


def driven(kind, terrain, for_path, drive, streams):
    """Submaps that a sensor makes on a drive: their clouds and true poses."""
    setup, (for_odometry, for_sensor) = SETUPS[kind], streams
    path = revisiting_path(np.random.default_rng(for_path), drive, setup.frame_spacing)
    true = true_poses(terrain, path)
    frames = estimate(true, setup.frames, setup.drift, np.random.default_rng(for_odometry))
    count = len(true) // setup.frames
    clouds = []
    with ThreadPoolExecutor() as pool:
        for i, stream in enumerate(for_sensor.spawn(count)):
            chosen = slice(i * setup.frames, (i + 1) * setup.frames)
            clouds.append(submap_cloud(setup, terrain, true[chosen], frames.local[chosen], stream, pool))
    return clouds, list(frames.truth[:count])


def seen_by_the_other(records, poses):
    """Share of the bounding box of each submap (rows) that lies in that of each other."""
    boxes = world_boxes([record.hull for record in records], poses)
    low = np.maximum(boxes[:, None, :2], boxes[:, :2])
    shared = np.clip(np.minimum(boxes[:, None, 2:], boxes[:, 2:]) - low, 0, None).prod(axis=-1)
    return shared / (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)[:, None]


def sensors(_, __):
    """Stereo submaps against LiDAR submaps of one simulated world, driven along one path."""
    seed, drive = SeedSequence(7), 112.0
    print("| world | pairs | half of the stereo submap seen by the LiDAR | found | wrong | error |")
    print("|---" * 6 + "|")
    for world in ("etna", "mars", "morocco"):
        for_terrain, for_path, *streams = seed.spawn(6)
        lidar = SETUPS["lidar"]
        path = revisiting_path(np.random.default_rng(for_path), drive, lidar.frame_spacing)
        half = np.abs(path.xy).max() + lidar.sensor.max_range + 2.0
        terrain = make_terrain(world, for_terrain, 2 * float(half), SETUPS["stereo"].terrain_resolution)
        targets, target_poses = driven("lidar", terrain, for_path, drive, streams[:2])
        sources, source_poses = driven("stereo", terrain, for_path, drive, streams[2:])
        submaps = [
            Submap(points, f"{i:03d}", stamp=float(i)) for i, points in enumerate([*targets, *sources])
        ]
        first = len(targets)
        parameters = fit_database(submaps[first : first + 3], EVIDENCE, workers=2)
        ready = [map_submap(s, EVIDENCE, parameters, workers=2) for s in submaps]
        compared = len(sources) * first
        candidates = [compare(b, a, EVIDENCE, pairs=compared) for b in ready[first:] for a in ready[:first]]
        records, poses = [SubmapRecord.of(s) for s in submaps], np.array(target_poses + source_poses)
        seen = seen_by_the_other(records, poses)
        pairs = evaluate_pairs(candidates, GroundTruth(records, poses))
        halves = [p for p in pairs if seen[int(p.candidate.source), int(p.candidate.target)] > 0.5]
        found = [p for p in halves if p.candidate and p.pose_is_right]
        wrong = sum(bool(p.candidate) and not p.pose_is_right for p in pairs)
        error = np.median([p.position_error for p in found])
        print(
            f"| {world} | {len(pairs)} | {len(halves)} | {len(found)} | {wrong} | {error:.3f} m |", flush=True
        )


DRIVES = (  # sensor, world, seed, submaps; seeds 400-419 were tuned on
    *(("stereo", world, 420 + k, 16) for k, world in enumerate(2 * ("etna", "mars", "morocco"))),
    *(("lidar", world, 426 + k, 10) for k, world in enumerate(("etna", "mars"))),
    *(("survey", world, 428 + k, 24) for k, world in enumerate(("etna", "mars"))),
)
ORIGINS = {"first pose": 0, "last pose": -1}  # of the rover in the submap: ground ahead, or all round


def covariance(_, __):
    """Errors of the loops of simulated drives, normalised by their covariances, by drift and origin."""
    found = defaultdict(list)
    for sensor, world, seed, submaps in DRIVES:
        setup = SETUPS[sensor]
        true, seen, for_odometry = observed(setup, world, seed, submaps)
        for times in (0, 1, 5) if setup.frames > 1 else (0,):
            for origin in ORIGINS if setup.frames > 1 else ("first pose",):
                local, poses = stitched(setup, true, times, ORIGINS[origin], for_odometry)
                found[sensor, origin, times] += judged_covariances(setup, seen, local, poses)
                print(f"{sensor} {world} {seed}, origin {origin}, drift {times} x", file=sys.stderr)
    print("| sensor | origin | drift | loops | NEES / 6 | x, y, yaw / 3 | z, roll, pitch / 3 ", end="")
    print("| within 95 % | as they were decided: NEES / 6, within 95 % |")
    print("|---" * 9 + "|")
    for (sensor, origin, times), rows in found.items():
        total, plane, rest, online = np.array(rows).T
        drift = f"{times} x" if times else "rigid"
        nees = f"{total.mean() / 6:.2f} | {plane.mean() / 3:.2f} | {rest.mean() / 3:.2f}"
        print(
            f"| {sensor} | {origin} | {drift} | {len(rows)} | {nees} | {within_95(total):.0%} "
            f"| {online.mean() / 6:.2f}, {within_95(online):.0%} |"
        )


def within_95(squares):
    return np.mean(squares < chi2.ppf(0.95, 6))


def observed(setup, world, seed, submaps):
    """True poses of a drive, what the sensor sees at each, and the seed of its odometry."""
    for_terrain, for_path, for_odometry, for_sensor = SeedSequence(seed).spawn(4)
    path = revisiting_path(
        np.random.default_rng(for_path), submaps * setup.submap_length, setup.frame_spacing
    )
    half = np.abs(path.xy).max() + setup.sensor.max_range + 2.0
    terrain = make_terrain(world, for_terrain, 2 * float(half), setup.terrain_resolution)
    true = true_poses(terrain, path)
    seen = [
        setup.sensor.observe(terrain, T @ setup.T_body_sensor, np.random.default_rng(stream))
        for T, stream in zip(true, for_sensor.spawn(len(true)), strict=True)
    ]
    return true, seen, for_odometry


def stitched(setup, true, times, origin, for_odometry):
    """T_submap_body of each frame by an odometry that drifts some times as much as usual, T_world_submap.

    The origin of a submap is that of one of its frames.
    """
    usual, frames = setup.drift, setup.frames
    drift = replace(
        usual,
        position=times * usual.position,
        heading_deg=times * usual.heading_deg,
        jitter_deg=usual.jitter_deg if times else 0.0,
    )
    estimated, smooth = (
        estimate(true, frames, d, np.random.default_rng(for_odometry)).local
        for d in (drift, replace(drift, jitter_deg=0.0))
    )
    local, poses = [], []
    for first in range(0, len(true), frames):
        at = first + origin % frames
        x, y, z = smooth[at][:3, 3]
        T_frame = se3(x, y, z, 0.0, 0.0, yaw_of(smooth[at]))
        local += [inverse(T_frame) @ T for T in estimated[first : first + frames]]
        poses.append(true[at] @ inverse(smooth[at]) @ T_frame)
    return local, np.array(poses)


def judged_covariances(setup, seen, local, poses):
    """Normalised squared errors of the loops of a drive: of all six, (x, y, yaw), (z, roll, pitch), and of
    all six by the covariances that the loops had when they were decided."""
    frames = setup.frames
    with tempfile.TemporaryDirectory() as folder:
        (clouds := Path(folder) / "clouds").mkdir()
        for first in range(0, len(local), frames):
            points = [
                transform(T @ setup.T_body_sensor, points)
                for T, points in zip(local[first : first + frames], seen[first : first + frames], strict=True)
            ]
            cloud = thin(np.concatenate(points), setup.voxel).astype(np.float32)
            write_cloud(clouds / f"{first // frames:03d}.ply", cloud)
        decided = []
        run = detect_mission(folder, EVIDENCE, on_pair=decided.append, workers=1)
    truth = GroundTruth(run.submaps, poses)
    online = {(c.source, c.target): c for c in decided}
    rows = []
    for pair in evaluate_pairs(run.loops, truth):
        c = pair.candidate
        T = inverse(poses[int(c.target)]) @ poses[int(c.source)]
        if pair.pose_is_right:
            earlier = normalised(online[c.source, c.target], T, ALL)
            rows.append([*(normalised(c, T, part) for part in (ALL, PLANE, REST)), earlier])
    return rows


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("recall", "null", "errors", "time", "sensors", "covariance"))
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--figure", type=Path, help="of what null or errors found, PNG")
    args = parser.parse_args()
    run = {
        "recall": recall,
        "null": null,
        "errors": errors,
        "time": query_time,
        "sensors": sensors,
        "covariance": covariance,
    }
    run[args.what](args.folders, args.figure)


if __name__ == "__main__":
    main()
