"""Every command as users run it: what it writes, what it says, and how it ends."""

import csv
import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml
from conftest import BROKEN, PLACES, STRICT

import terrainloop.config
import terrainloop.detection.mission  # it must have the true Settings before the demo's are replaced
from terrainloop.cli.terminal import console_of, table_of
from terrainloop.config import Settings
from terrainloop.geometry import parameters_of, transform
from terrainloop.gradient_map import GradientMap
from terrainloop.simulation.names import SENSORS, WORLDS

COMMANDS = ("demo", "map", "match", "detect", "info", "evaluate", "simulate", "config")
CONTRACT = [  # DESIGN.md, section 3
    *("source", "target", "tx_m", "ty_m", "tz_m", "roll_rad", "pitch_rad", "yaw_rad"),
    *("inliers", "ssd", "overlap", "score", "accepted", "reason"),
]
FAST = STRICT.model_copy(
    update={"map": STRICT.map.model_copy(update={"max_points": 550, "resolution": 0.12})}
)


@pytest.fixture
def ok(cli):
    """Runs a command that must succeed; gives its stdout."""

    def run(*arguments):
        code, out, err = cli(*arguments)
        assert code == 0, err
        return out

    return run


@pytest.fixture
def refused(cli):
    """Runs a command that must refuse its input; gives the one line it says."""

    def run(*arguments):
        code, out, err = cli(*arguments)
        assert code == 2, err
        assert out == ""
        # Bars of what was done before are not part of the message.
        (line,) = (
            line
            for line in err.splitlines()
            if line.strip() and "\N{BOX DRAWINGS HEAVY HORIZONTAL}" not in line
        )
        assert line.startswith("terrainloop: expected ")
        assert "; found " in line
        assert line.count("; ") >= 2  # and how to mend it
        return line

    return run


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "fast.yaml"
    path.write_text(FAST.to_yaml(), encoding="utf-8")
    return path


def cloud(mission_folder, name):
    return mission_folder / "clouds" / f"{name}.ply"


def in_one_line(text):
    return " ".join(text.split())


# --- help


def test_help_names_every_command(ok):
    text = ok("--help")
    for command in COMMANDS:
        assert command in text


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command(ok, command):
    text = ok(command, "--help")
    assert "Usage" in text
    for option in ("--json", "--quiet", "--verbose", "-q", "-v"):
        assert option in text
    assert ok(command, "-h") == text


@pytest.mark.parametrize("command", ["map", "match", "detect"])
def test_help_tells_units(ok, command):
    assert "metres" in in_one_line(ok(command, "--help"))


@pytest.mark.parametrize(("command", "names"), [("simulate", (*WORLDS, *SENSORS)), ("demo", WORLDS)])
def test_help_lists_every_world_and_sensor(ok, command, names):
    text = ok(command, "--help")
    assert [name for name in names if name not in text] == []


def test_help_loads_nothing_heavy():
    script = (
        "import sys\n"
        "from terrainloop.cli import main\n"
        f"for command in {[[], *[[c] for c in COMMANDS]]}:\n"
        "    sys.argv = ['terrainloop', *command, '--help']\n"
        "    try:\n"
        "        main()\n"
        "    except SystemExit as ended:\n"
        "        assert not ended.code\n"
        "print('loaded', sorted({'cv2', 'scipy', 'matplotlib', 'laspy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded []"


def test_without_a_command_there_is_help(cli):
    _, out, err = cli()
    assert "detect" in out + err


@pytest.mark.parametrize(
    "arguments", [["detekt"], ["map"], ["detect", "here", "--workers", "many"], ["config", "--sped"]]
)
def test_wrong_usage_ends_with_2(cli, arguments):
    code, out, err = cli(*arguments)
    assert code == 2
    assert out == ""
    assert err


def test_version(ok):
    assert ok("--version").strip() == f"terrainloop {terrainloop.__version__}"


# --- config


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_config_prints_settings_that_can_be_read_again(ok, tmp_path, preset):
    (tmp_path / "printed.yaml").write_text(ok("config", "--preset", preset))
    assert Settings.from_yaml(tmp_path / "printed.yaml") == Settings.preset(preset)


def test_config_as_json(ok):
    assert json.loads(ok("config", "--json")) == Settings().model_dump(mode="json")
    assert json.loads(ok("config", "--preset", "paper", "--json", "-q"))["map"]["resolution"] == 0.03


# --- map


def test_map_writes_what_it_says(ok, mission_folder, config, tmp_path):
    output = tmp_path / "map.npz"
    text = ok("map", cloud(mission_folder, "000000"), "-o", output, "--config", config, "--png")
    assert "pixels" in text
    gradient_map = GradientMap.load(output)
    assert gradient_map.resolution == FAST.map.resolution
    assert gradient_map.origin == pytest.approx((-2.5, -2.5), abs=0.05)
    assert gradient_map.mask.mean() > 0.8
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.npz", "map.png"]


def test_map_as_json_and_geotiff_agree(ok, mission_folder, config, tmp_path):
    arguments = ["map", cloud(mission_folder, "000000"), "--config", config, "--json", "-o"]
    told = json.loads(ok(*arguments, tmp_path / "map.tif"))
    again = json.loads(ok(*arguments, tmp_path / "map.npz"))
    assert {**told, "written": 0} == {**again, "written": 0}
    assert told["written"] == [str(tmp_path / "map.tif")]
    assert told["points"] == 850
    assert told["resolution_m"] == FAST.map.resolution
    assert told["noise_m"] == pytest.approx(0.01, rel=0.3)
    gradient_map = GradientMap.load(tmp_path / "map.npz")
    with tifffile.TiffFile(tmp_path / "map.tif") as tiff:
        image, names = tiff.asarray(), tiff.pages[0].description.split(", ")
    assert image.shape == (6, told["rows"], told["columns"])
    for name, band in zip(names, image, strict=True):
        np.testing.assert_array_equal(band, getattr(gradient_map, name)[::-1])


def test_map_depends_on_the_seed_alone(ok, mission_folder, config, tmp_path):
    def written(name, *options):
        ok("map", cloud(mission_folder, "000000"), "-o", tmp_path / name, "--config", config, *options)
        return (tmp_path / name).read_bytes()

    one = written("a.npz", "--workers", 1)
    assert written("b.npz", "--workers", 2) == one
    assert written("c.npz", "--seed", 5) != one  # other points are drawn


# --- match


def match(mission_folder, source, target):
    return "match", cloud(mission_folder, source), cloud(mission_folder, target)


def test_match_of_a_loop(ok, mission_folder, config, true_loop, tmp_path):
    arguments = [*match(mission_folder, "000003", "000000"), "--config", config]
    told = json.loads(ok(*arguments, "--json", "--figure", tmp_path / "match.png"))
    assert told["accepted"] is True
    assert (told["source"], told["target"]) == ("000003", "000000")
    T, covariance = np.array(told["T_target_source"]), np.array(told["covariance"])
    assert T.shape == (4, 4)
    assert covariance.shape == (6, 6)
    middle = np.zeros(3)
    assert np.linalg.norm(transform(T, middle) - transform(true_loop, middle)) < 0.15
    assert np.abs(parameters_of(T) - parameters_of(true_loop))[3:].max() < np.radians(3)
    assert told["inliers"] >= 10
    assert 0 < told["overlap"] < 1
    assert (tmp_path / "match.png").read_bytes().startswith(b"\x89PNG")

    text = in_one_line(ok(*arguments))
    assert "000003 to 000000: loop closure" in text
    assert f"yaw {np.degrees(parameters_of(T)[5]):.3f} +/-" in text


def test_match_of_two_places(ok, mission_folder, config, tmp_path):
    arguments = [*match(mission_folder, "000001", "000000"), "--config", config]
    told = json.loads(ok(*arguments, "--json", "--figure", tmp_path / "match.png"))
    assert told["accepted"] is False
    assert told["reason"]
    assert np.shape(told["T_target_source"]) == (4, 4)
    assert (tmp_path / "match.png").stat().st_size > 10_000
    assert "no loop closure" in in_one_line(ok(*arguments))


def test_match_without_a_feature_is_still_json(ok, mission_folder, config, tmp_path):
    """NaN is no JSON."""
    path = tmp_path / "plane.ply"
    shutil.copy(cloud(mission_folder, "000000"), path)
    unknowable = yaml.safe_load(config.read_text())
    unknowable["map"]["max_variance_ratio"] = 1e-9
    (tmp_path / "none.yaml").write_text(yaml.safe_dump(unknowable))
    told = json.loads(
        ok("match", path, cloud(mission_folder, "000001"), "--config", tmp_path / "none.yaml", "--json"),
        parse_constant=pytest.fail,
    )
    assert told["accepted"] is False
    assert told["T_target_source"] == [[None] * 4] * 4
    assert told["ssd"] is None


# --- detect and evaluate


def run_detect(mission_folder, output, config, *options):
    """In a process of its own, as a module fixture has no capsys."""
    arguments = ["detect", mission_folder, "-o", output, "--config", config, "--workers", "1", *options]
    script = "from terrainloop.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def detected(mission_folder, config, tmp_path_factory):
    """Output folder of a run over all pairs, and what the run said."""
    output = tmp_path_factory.mktemp("run") / "deep" / "out"
    return output, run_detect(mission_folder, output, config, "--all-pairs")


@pytest.fixture
def run(detected, tmp_path):
    """A copy of the output, to be written into."""
    return shutil.copytree(detected[0], tmp_path / "run")


def write_rows(path, rows):
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_detect_ends_well_and_tells_of_the_broken_cloud(detected):
    output, done = detected
    assert done.returncode == 0
    assert {"loops.csv", "pairs.csv", "submaps.csv", "config.yaml"} <= {p.name for p in output.iterdir()}
    text = in_one_line(done.stdout)
    assert "1 loop closure in 6 pairs of 4 submaps" in text
    assert f"left out {BROKEN}: expected" in text
    assert "Traceback" not in done.stderr


def test_detect_keeps_the_contract_of_its_columns(detected):
    output, _ = detected
    upper = [(i, j) for i in range(6) for j in range(i, 6)]
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    for file in ("loops.csv", "pairs.csv"):
        header = (output / file).read_text(encoding="utf-8").splitlines()[0].split(",")
        assert header[:14] == CONTRACT
        assert header[14:35] == [f"cov_{names[i]}_{names[j]}" for i, j in upper]


def test_detect_finds_the_loop(detected, true_loop):
    output, _ = detected
    pairs, loops = rows_of(output / "pairs.csv"), rows_of(output / "loops.csv")
    whole = [name for name in PLACES if name != BROKEN]
    expected = [(a, b) for i, a in enumerate(whole) for b in whole[:i]]
    assert [(row["source"], row["target"]) for row in pairs] == expected
    assert loops == [row for row in pairs if row["accepted"] == "true"]
    (loop,) = loops
    assert (loop["source"], loop["target"]) == ("000003", "000000")
    estimate = [float(loop[name]) for name in CONTRACT[2:8]]
    np.testing.assert_allclose(estimate, parameters_of(true_loop), rtol=0, atol=0.15)
    assert all(row["reason"] for row in pairs)


def test_detect_tells_of_every_cloud(detected):
    rows = rows_of(detected[0] / "submaps.csv")
    assert [(row["name"], row["status"]) for row in rows] == [
        (name, "broken" if name == BROKEN else "ok") for name in PLACES
    ]


def test_detect_writes_its_settings_as_run(detected, config):
    as_run = Settings.from_yaml(detected[0] / "config.yaml")
    assert as_run == FAST.model_copy(update={"skip_recent": 0})


def test_detect_quietly_as_json_and_by_two_workers_gives_the_same(
    ok, detected, mission_folder, config, tmp_path
):
    output = tmp_path / "again"
    arguments = ["detect", mission_folder, "-o", output, "--config", config, "--workers", 2]
    told = json.loads(ok(*arguments, "--all-pairs", "--json"))
    assert told["submaps"] == 4
    assert list(told["broken"]) == [BROKEN]
    assert told["pairs"] == 6
    assert [(loop["source"], loop["target"]) for loop in told["loops"]] == [("000003", "000000")]
    assert len(told["loops"][0]["transform"]) == 6
    for file in ("pairs.csv", "loops.csv", "submaps.csv", "config.yaml"):
        assert (output / file).read_bytes() == (detected[0] / file).read_bytes()


def test_detect_is_silent_when_asked(cli, mission_folder, config, tmp_path):
    options = ["--config", config, "--workers", 1, "--seed", 3, "-q"]
    code, out, err = cli("detect", mission_folder, "-o", tmp_path / "out", *options)
    assert (code, out, err) == (0, "", "")
    assert len(rows_of(tmp_path / "out" / "pairs.csv")) == 3  # consecutive ones are not compared
    assert Settings.from_yaml(tmp_path / "out" / "config.yaml").seed == 3


def test_a_run_by_inliers_is_scored_over_inliers(ok, run, mission_folder, tmp_path):
    for name in ("loops.csv", "pairs.csv", "submaps.csv"):
        (tmp_path / name).write_bytes((run / name).read_bytes())
    (tmp_path / "config.yaml").write_text("match: {decision: inliers}")
    told = json.loads(ok("evaluate", tmp_path, "--truth", mission_folder / "truth.tum", "--json"))
    assert told["threshold"] == "inliers"
    assert [point["min_inliers"] for point in told["precision_recall"]] == list(range(1, 21))
    assert "min_inliers" in rows_of(tmp_path / "precision_recall_curve.csv")[0]
    assert "inliers" in ok("evaluate", tmp_path, "--truth", mission_folder / "truth.tum")


def test_evaluate_scores_the_run(ok, run, mission_folder):
    told = json.loads(ok("evaluate", run, "--truth", mission_folder / "truth.tum", "--json"))
    # Of the 6 pairs one is consecutive (000000 and 000001) and so is 000003 with 000004.
    assert told["pairs"] == 4
    assert told["true_pairs"] == told["accepted"] == told["accepted_true"] == 1
    assert told["accepted_wrong_pose"] == told["accepted_disjoint"] == 0
    assert 0 <= told["median_position_error_m"] < 0.15
    assert told["median_yaw_error_deg"] < 3
    curve = told["precision_recall"]
    at_ten = next(point for point in curve if point["min_score"] == 10)
    assert (at_ten["precision"], at_ten["recall"]) == (1.0, 1.0)
    recalls = [point["recall"] for point in curve]
    assert recalls == sorted(recalls, reverse=True)
    written = rows_of(run / "precision_recall.csv")
    assert [int(row["true_positives"]) for row in written] == [point["true_positives"] for point in curve]
    assert (run / "precision_recall.png").read_bytes().startswith(b"\x89PNG")


RIGHT_BY = ["overlap", "overlap and pose", "pose"]


def test_evaluate_summarises_the_curve(ok, run, mission_folder):
    told = json.loads(ok("evaluate", run, "--truth", mission_folder / "truth.tum", "--json"))
    assert told["threshold"] == "score"
    assert [(m["truth"], m["right_by"]) for m in told["metrics"]] == [("box", by) for by in RIGHT_BY]
    for numbers in told["metrics"]:
        assert (numbers["pairs"], numbers["true_pairs"]) == (4, 1)
        for name in ("recall_at_full_precision", "max_f1", "average_precision"):
            assert numbers[name] == {"value": 1.0, "low": 1.0, "high": 1.0}
    curve = rows_of(run / "precision_recall_curve.csv")
    assert list(dict.fromkeys(row["right_by"] for row in curve)) == RIGHT_BY
    best = curve[0]
    assert (best["precision"], best["recall"], best["false_positives"]) == ("1.0", "1.0", "0")
    scores = {float(row["score"]) for row in rows_of(run / "pairs.csv")}
    assert {float(row["min_score"]) for row in curve} <= scores


def test_evaluate_by_the_ground_observed(ok, run, mission_folder):
    arguments = ["evaluate", run, "--truth", mission_folder / "truth.tum", "--clouds", mission_folder]
    told = json.loads(ok(*arguments, "--json"))
    keys = [(m["truth"], m["right_by"]) for m in told["metrics"]]
    assert keys == [(truth, by) for truth in ("box", "observed") for by in RIGHT_BY]
    assert {m["true_pairs"] for m in told["metrics"]} == {1}
    assert [row["truth"] for row in told["retrieval"]] == ["box", "observed"]
    text = in_one_line(ok(*arguments))
    assert "1 true pair: bounding-box IoU > 0.3 " in text
    assert "1 true pair: IoU of the observed ground > 0.3 " in text
    assert "1.00 (1.00-1.00)" in text


def test_evaluate_leads_with_what_is_right(ok, run, mission_folder, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    text = in_one_line(ok("evaluate", run, "--truth", mission_folder / "truth.tum"))
    assert text.startswith("1 loop accepted: 1 right, 0 wrong by pose (within 0.")
    assert "Found 1 of 1 pair that share over 30 % of their ground (bounding-box IoU). Closed 1 of 1" in text
    assert "R@1 1.00 (1 of 1), P@1 1.00 (1 of 1)" in text
    assert "Within 2 m and 5 deg: 100.0 % of the accepted loops; yaw within 10 deg: 100.0 %" in text
    assert "4 pairs evaluated; 2 left out: consecutive submaps." in text
    assert text.index("right by") > text.index("precision by pose") > text.index("R@1")
    assert ok("evaluate", run, "--truth", mission_folder / "truth.tum", "-q") == ""


def test_evaluate_with_other_tolerances(ok, run, mission_folder):
    arguments = ["evaluate", run, "--truth", mission_folder / "truth.tum", "--json"]
    told = json.loads(ok(*arguments))
    strict = json.loads(ok(*arguments, "--position-tolerance", 1e-6))
    loose = json.loads(ok(*arguments, "--position-tolerance", 2.5, "--yaw-tolerance", 30))
    assert [found["accepted_right_pose"] for found in (told, strict, loose)] == [1, 0, 1]
    assert [found["position_tolerance_m"] for found in (strict, loose)] == [1e-6, 2.5]
    assert loose["yaw_tolerance_deg"] == pytest.approx(30)


def test_evaluate_without_pairs(ok, run, mission_folder, tmp_path):
    file = tmp_path / "sessions.csv"
    file.write_text("cloud,session\n" + "".join(f"{name},one\n" for name in PLACES))
    arguments = ["evaluate", run, "--truth", mission_folder / "truth.tum", "--sessions", file]
    assert in_one_line(ok(*arguments)).startswith("Nothing to evaluate: 0 pairs evaluated; 6 left out")
    assert json.loads(ok(*arguments, "--json"))["retrieval"][0]["recall_at_one"] is None


@pytest.mark.parametrize("columns", [20, 30, 47, 80, 200])
def test_evaluate_cuts_no_number(ok, run, mission_folder, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    text = ok("evaluate", run, "--truth", mission_folder / "truth.tum", "--clouds", mission_folder)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    lines = [
        [cell.strip() for cell in line.split("\N{BOX DRAWINGS LIGHT VERTICAL}")] for line in text.splitlines()
    ]
    rows = [cells for cells in lines if len(cells) > 1]
    written = rows_of(run / "precision_recall.csv")
    assert [row[:3] for row in rows[: len(written)]] == [
        [row["min_score"], row["right_poses"], row["wrong_poses"]] for row in written
    ]
    assert all(len(row) == 7 for row in rows[: len(written)])
    assert [row[0] for row in rows[len(written) :]] == 2 * ["pose", "overlap and pose", "overlap"]
    assert all("1.00 (1.00-1.00)" in row for row in rows[len(written) :])


@pytest.mark.parametrize("columns", range(20, 201, 15))
def test_tables_show_every_cell_at_any_width(columns):
    heads = ["a long heading", "Geschwindigkeitsbegrenzung", "n", "deg >="]
    rows = [["0.71 (0.50-1.00)", "-12.345", "7", "1e-12"], ["[red]", "1", "123456789012", "x [/b]"]]
    console = console_of(io.StringIO())
    console.width = columns
    console.print(table_of("A [title] that is longer than the terminal is wide", heads, rows))
    lines = console.file.getvalue().splitlines()
    body = [[cell.strip() for cell in line.split("\N{BOX DRAWINGS LIGHT VERTICAL}")] for line in lines]
    assert [cells for cells in body if len(cells) == 4] == rows
    assert set(" ".join(heads).split()) <= set(" ".join(lines).split())


def test_evaluate_leaves_out_pairs_of_one_session(ok, run, mission_folder, tmp_path):
    file = tmp_path / "sessions.csv"
    sessions = {"000000": "1", "000001": "2", "000002": "2", "000003": "1", "000004": "3"}
    file.write_text("cloud,session\n" + "".join(f"{name},{s}\n" for name, s in sessions.items()))
    truth = mission_folder / "truth.tum"
    told = json.loads(ok("evaluate", run, "--truth", truth, "--sessions", file, "--json"))
    assert told["pairs"] == 3
    assert told["true_pairs"] == 0
    assert told["precision_recall"][0]["recall"] is None  # nothing to recall


def test_evaluate_takes_another_overlap(ok, run, mission_folder):
    truth = mission_folder / "truth.tum"
    told = json.loads(ok("evaluate", run, "--truth", truth, "--min-overlap", 0.99, "--json"))
    assert told["true_pairs"] == 0
    assert told["accepted_less_overlap"] == 1


# --- simulate and demo


def test_simulate_makes_a_mission(ok, tmp_path):
    arguments = ["simulate", "--world", "flat", "--submaps", 1, "--seed", 4, "--json", "-o"]
    told = json.loads(ok(*arguments, tmp_path / "a"))
    assert told["submaps"] == 1
    assert told["points"] > 1000
    assert told["world"] == "flat"
    files = sorted(
        p.relative_to(tmp_path / "a").as_posix() for p in (tmp_path / "a").rglob("*") if p.is_file()
    )
    assert files == ["clouds/000000.ply", "odometry.tum", "simulation.yaml", "truth.tum"]


@pytest.fixture
def fast_default(monkeypatch):
    """The demo has no settings of its own to make it fast."""
    coarse = FAST.map.model_copy(update={"max_points": 400, "resolution": 0.25})
    faster = FAST.model_copy(update={"map": coarse, "skip_recent": 0})
    monkeypatch.setattr(terrainloop.config, "Settings", lambda: faster)


def test_demo_runs(ok, tmp_path, fast_default):
    submaps = 3
    output = tmp_path / "demo"
    arguments = ["demo", "-o", output, "--submaps", submaps, "--workers", 1, "--world", "flat", "--json"]
    told = json.loads(ok(*arguments))
    assert told["submaps"] == submaps
    assert told["true_pairs_found"] <= told["true_pairs"]
    assert told["false_loops"] == 0
    for picture in told["pictures"]:
        assert Path(picture).read_bytes().startswith(b"\x89PNG")
    assert rows_of(output / "submaps.csv")


def test_without_matplotlib_the_demo_runs_and_names_the_extra(ok, tmp_path, fast_default, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    told = ok("demo", "-o", tmp_path, "--submaps", 3, "--workers", 1, "--world", "flat")
    assert 'Pictures: none; matplotlib is missing: pip install "terrainloop[figures]"' in in_one_line(told)
    assert not list(tmp_path.glob("*.png"))


# --- what cannot be worked with


def test_missing_cloud(refused, tmp_path):
    missing = tmp_path / "missing.ply"
    assert str(missing) in refused("map", missing, "-o", tmp_path / "m.npz")
    assert str(missing) in refused("match", missing, missing)


def test_bad_suffix(refused, mission_folder, tmp_path):
    (tmp_path / "cloud.doc").write_text("1 2 3\n")
    assert ".ply" in refused("map", tmp_path / "cloud.doc", "-o", tmp_path / "m.npz")
    assert ".tif" in refused("map", cloud(mission_folder, "000000"), "-o", tmp_path / "m.jpg")


def test_broken_cloud(refused, mission_folder, tmp_path):
    assert BROKEN in refused("map", cloud(mission_folder, BROKEN), "-o", tmp_path / "m.npz")
    assert not (tmp_path / "m.npz").exists()


def test_mission_without_clouds(refused, tmp_path):
    (tmp_path / "notes.txt").write_text("none here\n")
    assert "clouds" in refused("detect", tmp_path, "-o", tmp_path / "out")
    assert "mission folder" in refused("detect", tmp_path / "absent", "-o", tmp_path / "out")


def test_mission_of_broken_clouds(refused, tmp_path, config):
    (tmp_path / "a.ply").write_bytes(b"nothing")
    line = refused("detect", tmp_path, "-o", tmp_path / "out", "--config", config, "--workers", 1)
    assert "1 broken" in line


def test_mission_with_a_pose_too_few(refused, mission_folder, tmp_path):
    folder = shutil.copytree(mission_folder, tmp_path / "mission")
    lines = (folder / "truth.tum").read_text().splitlines()
    (folder / "truth.tum").write_text("\n".join(lines[:-1]) + "\n")
    assert "truth.tum" in refused("detect", folder, "-o", tmp_path / "out")


@pytest.mark.parametrize("command", ["map", "match", "detect", "config"])
def test_bad_preset(refused, command, mission_folder, tmp_path):
    one, out = cloud(mission_folder, "000000"), tmp_path / "m.npz"
    inputs = {
        "map": [one, "-o", out],
        "match": [one, one],
        "detect": [mission_folder, "-o", out],
        "config": [],
    }
    assert "'papers'" in refused(command, *inputs[command], "--preset", "papers")


@pytest.mark.parametrize("command", ["map", "match", "detect"])
def test_preset_and_config_together(refused, command, mission_folder, config, tmp_path):
    one, out = cloud(mission_folder, "000000"), tmp_path / "m.npz"
    inputs = {"map": [one, "-o", out], "match": [one, one], "detect": [mission_folder, "-o", out]}
    line = refused(command, *inputs[command], "--preset", "paper", "--config", config)
    assert "--preset" in line
    assert "--config" in line


@pytest.mark.parametrize(
    ("content", "named"), [("map: [", "YAML"), ("map: {points: 3}", "map.points"), ("- 1", "top level")]
)
def test_bad_yaml(refused, mission_folder, tmp_path, content, named):
    file = tmp_path / "bad.yaml"
    file.write_text(content)
    line = refused("map", cloud(mission_folder, "000000"), "-o", tmp_path / "m.npz", "--config", file)
    assert str(file) in line
    assert named in line


@pytest.mark.parametrize("count", [0, 3, 6])
def test_truth_of_another_length(refused, run, mission_folder, tmp_path, count):
    lines = (mission_folder / "truth.tum").read_text().splitlines()
    poses = [line for line in lines if not line.startswith("#")]
    (tmp_path / "other.tum").write_text(
        "".join(f"{9 * i} {line.partition(' ')[2]}\n" for i, line in enumerate((poses * 2)[:count]))
    )
    refused("evaluate", run, "--truth", tmp_path / "other.tum")


def test_evaluate_of_no_run(refused, mission_folder, tmp_path):
    assert "pairs.csv" in refused("evaluate", tmp_path, "--truth", mission_folder / "truth.tum")


def test_evaluate_without_truth(refused, run, tmp_path):
    assert "absent.tum" in refused("evaluate", run, "--truth", tmp_path / "absent.tum")


def test_evaluate_with_clouds_of_another_mission(refused, run, mission_folder, tmp_path):
    (tmp_path / "clouds").mkdir()
    arguments = ["evaluate", run, "--truth", mission_folder / "truth.tum", "--clouds", tmp_path]
    assert "clouds" in refused(*arguments)
    shutil.copy(cloud(mission_folder, "000000"), tmp_path / "clouds")
    assert "found 1 there;" in refused(*arguments)


@pytest.mark.parametrize(
    ("file", "change", "named"),
    [
        ("pairs.csv", lambda row: row | {"source": "nobody"}, "no 'nobody'"),
        ("pairs.csv", lambda row: row | {"source": row["target"]}, "two different submaps"),
        ("pairs.csv", lambda row: row | {"source": BROKEN}, "broken"),
        ("pairs.csv", lambda row: row | {"score": "nan"}, "found nan"),
        ("pairs.csv", lambda row: row | {"score": "inf"}, "found inf"),
        ("pairs.csv", lambda row: row | {"tx_m": "inf"}, "rigid transform"),
        ("pairs.csv", lambda row: row | {"tz_m": "-1e300"}, "rigid transform"),
        ("pairs.csv", lambda row: row | {"yaw_rad": "inf"}, "rigid transform"),
        ("pairs.csv", lambda row: row | {"pitch_rad": "nan"}, "rigid transform"),
        ("submaps.csv", lambda row: row | {"name": "000000"}, "'000000'"),
        ("submaps.csv", lambda row: row | {"hull_m": "POLYGON ((0 0, 1 0, 0 0))"}, "three or more"),
        ("submaps.csv", lambda row: row | {"hull_m": "POLYGON ((0 0, 1 0, nan 1, 0 0))"}, "three or more"),
        ("submaps.csv", lambda row: row | {"hull_m": ""}, "three or more"),
    ],
)
def test_evaluate_of_a_damaged_run(refused, run, mission_folder, file, change, named):
    """The last line is damaged, or repeated."""
    rows = rows_of(run / file)
    rows[-1] = change(rows[-1])
    write_rows(run / file, rows)
    assert named in refused("evaluate", run, "--truth", mission_folder / "truth.tum")
    assert not (run / "precision_recall.csv").exists()


def test_evaluate_of_a_pair_that_repeats(refused, run, mission_folder):
    rows = rows_of(run / "pairs.csv")
    write_rows(run / "pairs.csv", [*rows, rows[0]])
    assert "every pair once" in refused("evaluate", run, "--truth", mission_folder / "truth.tum")


def test_evaluate_by_a_truth_with_w_first(refused, run, mission_folder, tmp_path):
    lines = (mission_folder / "truth.tum").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    turned = [[*row[:4], row[7], *row[4:7]] for row in rows]
    (tmp_path / "turned.tum").write_text("".join(" ".join(row) + "\n" for row in turned))
    assert "w first" in refused("evaluate", run, "--truth", tmp_path / "turned.tum")


@pytest.mark.parametrize(
    "options",
    [
        ["--position-tolerance", "0"],
        ["--position-tolerance", "nan"],
        ["--yaw-tolerance", "-5"],
        ["--yaw-tolerance", "inf"],
    ],
)
def test_evaluate_by_numbers_that_are_none(refused, run, mission_folder, options):
    refused("evaluate", run, "--truth", mission_folder / "truth.tum", *options)


@pytest.mark.parametrize(
    "content", ["", "cloud,session\n000000\n", "cloud,session\n000000,1\n", "a,b\n1,2,3\n"]
)
def test_bad_sessions(refused, run, mission_folder, tmp_path, content):
    (tmp_path / "sessions.csv").write_text(content)
    truth = mission_folder / "truth.tum"
    assert "session" in refused("evaluate", run, "--truth", truth, "--sessions", tmp_path / "sessions.csv")


def test_output_that_cannot_be_written(refused, mission_folder, config, tmp_path):
    (tmp_path / "file").write_text("in the way")
    below, one = tmp_path / "file" / "below", cloud(mission_folder, "000000")
    fast = ["--config", config, "--workers", 1]
    for command in (
        ["detect", mission_folder, "-o", below, *fast],
        ["detect", mission_folder, "-o", tmp_path / "file", *fast],
        ["map", one, "-o", below / "m.npz", *fast],
        ["map", one, "-o", below / "m.tif", *fast],
        ["map", one, "-o", tmp_path / "no folder" / "m.npz", *fast],
        ["simulate", "-o", below],
        ["demo", "-o", below],
    ):
        line = refused(*command)
        assert str(tmp_path) in line
        assert "-o" in line


@pytest.mark.parametrize("name", ["absent/match.png", "match.doc"])
def test_figure_that_cannot_be_written(refused, mission_folder, config, tmp_path, name):
    refused(*match(mission_folder, "000001", "000000"), "--config", config, "--figure", tmp_path / name)


@pytest.mark.parametrize(
    "arguments", [["--world", "venus"], ["--submaps", 0], ["--sensor", "sonar"]], ids=lambda a: a[0]
)
def test_simulate_refuses(refused, tmp_path, arguments):
    refused("simulate", "-o", tmp_path / "mission", *arguments)


def test_error_of_a_real_process_is_one_line(tmp_path):
    done = run_detect(tmp_path / "absent", tmp_path / "out", tmp_path / "absent.yaml")
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "absent.yaml" in line


def test_a_fault_of_ours_ends_with_1():
    script = (
        "import sys, terrainloop.config as c\n"
        "c.Settings.preset = None\n"
        "sys.argv = ['terrainloop', 'config']\n"
        "from terrainloop.cli import main\n"
        "main()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert "fault of ours" in done.stderr
    assert "TypeError" in done.stderr


def test_detect_into_the_clouds_of_a_mission(refused, mission_folder, tmp_path):
    shutil.copytree(mission_folder, tmp_path / "mission")
    clouds = tmp_path / "mission" / "clouds"
    before = sorted(clouds.iterdir())
    error = refused("detect", tmp_path / "mission", "-o", clouds)
    assert "output folder apart from the clouds" in error
    assert sorted(clouds.iterdir()) == before
