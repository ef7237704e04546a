"""The reproduction on a tiny mission with made-up methods: runner, judging, figures, tables."""

import csv
import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml

from reproduce import figures, kept, missions, runner, table, visual
from reproduce.__main__ import arguments
from reproduce.missions import FRAMES_FILE, Drive, StandIn, pairs_of, simulated
from reproduce.results import Result, best_of_each
from reproduce.runner import read_pairs, run_all, tasks_of
from reproduce.visual import Frames
from terrainloop.errors import TerrainLoopError
from terrainloop.io.files import write_whole_text
from terrainloop.io.trajectories import Trajectory, read_trajectory, write_tum

METHODS = """
import numpy as np
from reproduce.baselines.method import Match, Method, require

def made(name, describe, score, **settings):
    return Method(name, settings, "made up 1.0", describe, score)

def center(observation):
    return observation.T_odometry_submap

def near(source, target):
    T = np.linalg.inv(target) @ source
    return Match(-float(np.linalg.norm(T[:3, 3])), T)
"""
GOOD = (
    METHODS
    + """
def methods(scale):
    return (made("good", center, near, k=1), made("good", center, near, k=2), made("other", center, near))
"""
)
CRASHING = (
    METHODS
    + """
import os
def methods(scale):
    return (made("crashing", lambda observation: os._exit(11), near),)
"""
)
ABSENT = (
    METHODS
    + """
def methods(scale):
    require("no_such_package_at_all", "no-such-package-at-all")
"""
)


@pytest.fixture(scope="module", autouse=True)
def modules(tmp_path_factory):
    """The methods of this test can be imported."""
    folder = tmp_path_factory.mktemp("methods")
    for name, code in (("good", GOOD), ("crashing", CRASHING), ("absent", ABSENT)):
        (folder / f"made_{name}.py").write_text(code)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield


@pytest.fixture(scope="module")
def drive(mission_folder, tmp_path_factory):
    """The mission of five clouds without the broken one."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "clouds").mkdir()
    whole = [0, 1, 3, 4]
    for i in whole:
        (folder / "clouds" / f"{i:06d}.ply").symlink_to(mission_folder / "clouds" / f"{i:06d}.ply")
    for name in ("odometry.tum", "truth.tum"):
        poses = read_trajectory(mission_folder / name).poses[whole]
        write_tum(folder / name, Trajectory(np.arange(4.0), poses))
    return Drive("tiny", folder, 0.3)


@pytest.fixture(scope="module")
def run(drive, tmp_path_factory):
    """Tasks of all made-up methods, run once, and what was told."""
    out = tmp_path_factory.mktemp("out")
    tasks = tasks_of(drive, ["made_good", "made_crashing"], out, first_only=False)
    return tasks, run_all(tasks, workers=2), out


def results_of(tasks):
    return [Result.of(task) for task in tasks]


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_pair_but_neighbours_is_scored(run, drive):
    _, done, _ = run
    pairs = read_pairs(done[0].csv)
    assert [(pair.source, pair.target) for pair in pairs] == [
        ("000003", "000000"),
        ("000004", "000000"),
        ("000004", "000001"),
    ]
    poses = drive.mission.odometry.poses
    np.testing.assert_allclose(pairs[0].T_target_source, np.linalg.inv(poses[0]) @ poses[2], atol=1e-12)
    assert pairs[0].score == -np.linalg.norm(pairs[0].T_target_source[:3, 3])


def test_pairs_of_one_session_are_left_out():
    assert pairs_of("abcd", None) == [(2, 0), (3, 0), (3, 1)]
    assert pairs_of("abcd", {"a": "x", "b": "y", "c": "x", "d": "y"}) == [(3, 0)]


def test_record_of_a_task(run):
    record = json.loads(run[1][1].json.read_text())
    assert record["settings"] == {"k": 2}
    assert record["software"] == "made up 1.0"
    assert record["pairs"] == 3
    assert record["describe_ms"] >= 0
    assert record["pair_wall_ms"] > 0
    assert 1e-4 < record["megabytes"] < 1e-3  # a pose: 16 numbers of 8 bytes and their wrapping


def test_a_crash_stops_no_other(run):
    tasks, done, _ = run
    assert [task.stem for task in done] == ["made_good-0", "made_good-1", "made_good-2"]
    assert not tasks[3].csv.exists()
    assert not tasks[3].json.exists()


def test_a_crash_is_told_in_a_line(run, capsys):
    assert run_all([run[0][3]], workers=1) == []
    told = capsys.readouterr().out.splitlines()
    assert told[-1].startswith("[1/1] tiny made_crashing-0: failed (exit 11)")


def test_what_is_done_is_not_done_again(run, capsys):
    before = [task.csv.stat().st_mtime_ns for task in run[1]]
    assert run_all(run[1], workers=1) == run[1]
    assert [task.csv.stat().st_mtime_ns for task in run[1]] == before
    assert capsys.readouterr().out == "3 tasks, 3 of them done before\n"


def test_other_settings_or_software_are_run_again(run):
    task = run[1][0]
    assert task.done
    assert not replace(task, method=replace(task.method, settings={"k": 3})).done
    assert not replace(task, method=replace(task.method, software="made up 1.1")).done


def test_results_of_other_code_or_another_machine_are_run_again(run, monkeypatch):
    for name in ("code_key", "processor"):
        with monkeypatch.context() as patch:
            patch.setattr(runner, name, lambda: "another")
            assert not replace(run[1][0]).done
    assert replace(run[1][0]).done


def test_results_of_another_mission_are_run_again(run, drive, tmp_path):
    """What is in the clouds counts; where they are and their dates do not."""
    copy = shutil.copytree(drive.path, tmp_path / "copy")
    assert replace(run[1][0], drive=Drive("tiny", copy, 0.3)).done
    (copy / "clouds" / "000003.ply").write_bytes((copy / "clouds" / "000004.ply").read_bytes())
    assert not replace(run[1][0], drive=Drive("tiny", copy, 0.3)).done


@pytest.mark.parametrize("record", ["", "{}", "[]", '{"key": null}', '{"software": "made up 1.0"}'])
def test_a_record_without_a_key_is_of_no_use(run, tmp_path, record):
    task = replace(run[1][0], folder=tmp_path)
    task.csv.write_text("source,target\n")
    task.json.write_text(record)
    assert not task.done


def test_code_is_that_of_both_packages_and_what_they_run_on(monkeypatch, tmp_path):
    (tmp_path / "kept.py").write_text("")
    keys = {kept.code_key.__wrapped__()}
    for name, value in (("__file__", str(tmp_path / "kept.py")), ("package", lambda: ()), ("versions", dict)):
        with monkeypatch.context() as patch:
            patch.setattr(kept, name, value)
            keys.add(kept.code_key.__wrapped__())
    assert len(keys) == 4


def test_missing_package_is_told_in_a_line_and_left_out(drive, tmp_path, capsys):
    tasks = tasks_of(drive, ["made_absent", "made_good"], tmp_path, first_only=True)
    assert [(task.method.name, task.variant) for task in tasks] == [("good", 0), ("other", 2)]
    told = capsys.readouterr().out.splitlines()
    assert len(told) == 1
    assert "pip install no-such-package-at-all" in told[0]


def test_half_a_file_is_never_left(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")

    def fail(file):
        file.write("new")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole_text(path, fail)
    assert path.read_text() == "old"


def test_results_are_judged(run):
    result = results_of(run[1])[0]
    metrics = result.metrics("overlap")
    assert (metrics.pairs, metrics.true_pairs) == (3, 1)
    assert metrics.recall_at_full_precision.value == 1.0  # odometry is the truth here
    assert len(result.registered) == 1
    assert result.registered[0].position_error < 1e-9


def changed(result, change):
    """The same result, each pair's candidate changed."""
    pairs = [replace(pair, candidate=change(pair.candidate)) for pair in result.pairs]
    return replace(result, pairs=pairs)


def test_best_settings_are_chosen_by_the_reading(run):
    first, second, other = results_of(run[1])
    backwards = changed(first, lambda candidate: replace(candidate, score=-candidate.score))
    astray = replace(second, pairs=[replace(pair, position_error=5.0) for pair in second.pairs])
    for order in ([backwards, astray, other], [astray, backwards, other]):
        assert best_of_each(order, "overlap") == [astray, other]
        assert best_of_each(order, "pose") == [backwards, other]


def test_a_method_that_could_compare_nothing_is_left_out(run):
    first, *_, other = results_of(run[1])
    silent = changed(first, lambda candidate: replace(candidate, score=-np.inf))
    assert best_of_each([silent, other], "overlap") == [other]


def test_figures_have_their_numbers_beside_them(run, drive, tmp_path):
    results = results_of(run[1])
    looks = figures.looks_of(["good", "other"])
    chosen = {"tiny": [results[0], results[2]]}
    plates = {
        "fig6": figures.trajectories([drive]),
        "fig8": figures.precision_recall_curves(chosen, "overlap", looks, "title"),
        "fig9": figures.precision_by_inliers(results[:1]),
        "fig10": figures.aligned_clouds(results[0]),
    }
    for stem, plate in plates.items():
        plate.save(tmp_path, stem)
        assert (tmp_path / f"{stem}.png").read_bytes().startswith(b"\x89PNG")
    assert [float(row["x_m"]) for row in rows_of(tmp_path / "fig6.csv")] == pytest.approx([0, 4, 0.5, -5])
    curve = [(row["method"], row["precision"], row["recall"]) for row in rows_of(tmp_path / "fig8.csv")]
    assert curve[0] == ("good", "1.0", "1.0")
    assert len(curve) == 6
    assert {row["matched"] for row in rows_of(tmp_path / "fig9.csv")} == {"0"}  # its scores are negative
    (loop,) = rows_of(tmp_path / "fig10.csv")
    assert (loop["source"], loop["target"]) == ("000003", "000000")


def test_tables(run, tmp_path):
    by_mission = {"tiny": results_of(run[1])}
    rows = table.main_table(by_mission)
    assert [(row["mission"], row["method"]) for row in rows] == [("tiny", "good"), ("tiny", "other")]
    table.save(tmp_path, "table", rows, table.markdown_of_table(rows, ["A note."]))
    text = (tmp_path / "table.md").read_text()
    assert text.startswith("A note.")
    assert "| good | 1.00, 1.00 |" in text
    assert len(rows_of(tmp_path / "table.csv")) == 2
    spent = table.times(by_mission)
    assert spent[0]["query_against_14_maps_s"] == pytest.approx(
        (spent[0]["ms_per_map"] + 14 * spent[0]["ms_per_pair"]) / 1e3
    )
    assert len(table.sweep(by_mission["tiny"])) == 3 * 2 * 3  # results, grounds, readings


def test_visual_loops_are_judged_by_place():
    near = np.zeros((4, 4), dtype=bool)
    near[2, 0] = near[3, 1] = True
    frames = Frames("tiny", np.array([-1, 0, 0, 0]), np.array([0, 9, 30, 20]), near, near)
    scores, is_true, is_right = frames.judged(near)
    assert scores.tolist() == [-np.inf, 9, 30, 20]
    assert is_true.tolist() == [False, False, True, True]
    assert is_right.tolist() == [False, False, True, False]


def test_visual_loops_are_found_again_by_other_code(drive, tmp_path, monkeypatch):
    found = []

    def write(drive, file, skipped):
        found.append(skipped)
        file.write_text("image,closed,inliers\n0,-1,0\n")

    monkeypatch.setattr(visual, "_write", write)
    folder = shutil.copytree(drive.path, tmp_path / "drive")
    np.save(folder / FRAMES_FILE, np.eye(4)[None, None])
    for skipped in (14, 14, 0, 0):
        Frames.of(Drive("tiny", folder, 0.3), tmp_path / "frames.csv", skipped)
    assert found == [14, 0]
    monkeypatch.setattr(visual, "code_key", lambda: "of other code")
    Frames.of(Drive("tiny", folder, 0.3), tmp_path / "frames.csv", 0)
    assert found == [14, 0, 0]


def test_visual_figure_tells_its_control(tmp_path):
    near = np.eye(4, k=-1, dtype=bool)
    control = Frames("tiny", np.array([-1, 0, 1, 0]), np.array([0, 9, 30, 20]), near, near)
    figures.visual_curves([control], [control]).save(tmp_path, "fig7")
    assert (tmp_path / "fig7.png").exists()
    rows = [row for row in rows_of(tmp_path / "fig7.csv") if row["true"].startswith("control")]
    assert [row["precision"][:4] for row in rows] == ["1.0", "0.5", "0.66"]


@pytest.fixture
def simulations(monkeypatch):
    """Missions that are simulated, in name only."""
    made = []
    monkeypatch.setattr(missions, "simulate_mission", lambda **asked: made.append(asked) or asked)
    monkeypatch.setattr(
        missions,
        "write_mission",
        lambda asked, folder: (folder / "simulation.yaml").write_text(yaml.safe_dump(asked)),
    )
    monkeypatch.setattr(missions, "_write_appearance", lambda asked, folder: None)
    return made


FLAT = StandIn("Flat", "flat", 1, "stereo", 0.3)


def test_simulated_mission_is_kept_and_another_refused(simulations, tmp_path):
    for _ in range(2):
        assert simulated(FLAT, tmp_path, 2).path == tmp_path / "Flat"
    assert len(simulations) == 1
    with pytest.raises(TerrainLoopError, match="another output folder"):
        simulated(FLAT, tmp_path, 3)


def test_other_code_simulates_a_mission_anew(simulations, tmp_path, monkeypatch):
    left_over = simulated(FLAT, tmp_path, 2).path / "clouds.ply"
    left_over.touch()
    monkeypatch.setattr(missions, "code_key", lambda: "of other code")
    simulated(FLAT, tmp_path, 2)
    assert len(simulations) == 2
    assert not left_over.exists()
    simulated(FLAT, tmp_path, 2)
    assert len(simulations) == 2


def test_of_a_large_real_mission_the_middle_is_taken(drive, tmp_path, monkeypatch):
    whole = missions.real(drive.path, tmp_path)
    assert whole.path == drive.path
    monkeypatch.setattr(missions, "REAL_SUBMAPS", 2)
    part = missions.real(drive.path, tmp_path)
    assert part.mission.names == ("000000", "000003")
    np.testing.assert_allclose(part.poses, drive.poses[[0, 2]], atol=1e-9)
    assert len(part.mission.read(1)) == len(drive.mission.read(2))


def test_unknown_figure_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["reproduce", "--only", "fig8,fig5"])
    with pytest.raises(SystemExit, match="2"):
        arguments()
    assert "unknown fig5" in capsys.readouterr().err
