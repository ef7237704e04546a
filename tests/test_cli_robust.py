"""Commands under interrupts, full disks, odd names and terminals: one line, the right code, no half."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import BROKEN, PLACES, STRICT
from test_processes import MARK, marked_processes, needs_proc, wait_until

import terrainloop.cli
import terrainloop.cli.app
import terrainloop.cli.terminal
from terrainloop.config import Settings
from terrainloop.detection.run import Run
from terrainloop.errors import TerrainLoopError
from terrainloop.gradient_map import GradientMap
from terrainloop.io.clouds import write_cloud
from terrainloop.io.trajectories import read_trajectory

THIN = STRICT.model_copy(
    update={"map": STRICT.map.model_copy(update={"max_points": 150, "resolution": 0.5}), "skip_recent": 0}
)


@pytest.fixture
def fails(monkeypatch, cli):
    """Runs a command that raises an error; gives what a user sees."""

    def run(error):
        def app():
            raise error

        monkeypatch.setattr(terrainloop.cli.app, "app", app)
        return cli("anything")

    return run


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "thin.yaml"
    path.write_text(THIN.to_yaml(), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def many(mission_folder, tmp_path_factory):
    """A mission of 24 clouds, links to four."""
    folder = tmp_path_factory.mktemp("many")
    whole = [name for name in PLACES if name != BROKEN]
    for number in range(24):
        source = mission_folder / "clouds" / f"{whole[number % len(whole)]}.ply"
        (folder / f"cloud_{number:02d}.ply").symlink_to(source)
    return folder


def cloud(mission_folder, name="000000"):
    return mission_folder / "clouds" / f"{name}.ply"


# --- errors of the system


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
        OSError(errno.EDQUOT, os.strerror(errno.EDQUOT), "out"),
        OSError("something"),
        OSError(),
        BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)),
        PermissionError(errno.EACCES, os.strerror(errno.EACCES), b"by\xfftes"),
        FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "new\nline\x1b[31m"),
    ],
    ids=repr,
)
def test_errors_of_the_system_are_one_line_that_holds(fails, error):
    code, out, err = fails(error)
    assert (code, out) == (2, "")
    (line,) = err.splitlines()
    assert line.startswith("terrainloop: expected ")
    assert line.isprintable()
    assert "None" not in line
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    assert full == ("free some space" in line)


def test_an_error_of_megabytes_is_short(fails):
    code, _, err = fails(TerrainLoopError(expected="a number", found="9" * 10_000_000, mend="shorten it"))
    assert code == 2
    assert len(err) < 1000


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_output_that_finds_no_room():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "terrainloop", "config"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "No space left on device" in line


# --- interrupts

WAITING = """
import sys, time
import terrainloop.cli.app

def app():
    try:
        print("started", flush=True)
        time.sleep(60)
    finally:
        if "stubborn" in sys.argv:
            print("ending", flush=True)
            time.sleep(60)

terrainloop.cli.app.app = app
from terrainloop.cli import main
main()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("twice", [False, True])
def test_the_first_signal_ends_in_order_and_the_second_at_once(name, twice):
    number = getattr(signal, name)
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING, *(["stubborn"] if twice else [])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            assert process.stdout.readline() == "started\n"
            process.send_signal(number)
            if twice:
                assert process.stdout.readline() == "ending\n"
                process.send_signal(number)
            _, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == (-number if twice else 128 + number)
    assert err == ("" if twice else "terrainloop: interrupted before it was done\n")


def test_what_the_parent_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        interrupt = terrainloop.cli._Interrupt()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is interrupt
        interrupt.restore()
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def start_detect(many, output, config):
    """`detect` with two workers in a process group of its own; `-v` tells how far it is."""
    arguments = ["detect", many, "-o", output, "--config", config, "--workers", 2, "-v", "--json"]
    return subprocess.Popen(
        [sys.executable, "-m", "terrainloop", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, MARK: str(output)},
        start_new_session=True,
    )


LAST_BEFORE_PAIRS = "mirror images compared"


def interrupt(process, after, number, *, group):
    """Signal once stderr has the text; gives stdout, and the lines of stderr after the signal."""
    with process:
        try:
            assert any(after in line for line in process.stderr)
            if after == LAST_BEFORE_PAIRS:
                time.sleep(0.5)
            (os.killpg if group else os.kill)(process.pid, number)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    return out, [line for line in err.splitlines() if not line.startswith("info: ")]


@needs_proc
@pytest.mark.parametrize(
    ("number", "group"), [(signal.SIGINT, True), (signal.SIGTERM, False), (signal.SIGKILL, False)]
)
def test_interrupted_among_the_maps(many, config, tmp_path, number, group):
    output = tmp_path / "out"
    process = start_detect(many, output, config)
    out, lines = interrupt(process, "cloud_01", number, group=group)
    assert out == ""
    wait_until(lambda: not marked_processes(str(output)), 10)
    if number == signal.SIGKILL:
        assert lines == []
        assert [path.name.startswith(".terrainloop-") for path in output.iterdir()] == [True]
    else:
        assert process.returncode == 128 + number
        assert lines == ["terrainloop: interrupted before it was done"]
        assert not output.exists()


@needs_proc
@pytest.mark.parametrize(("number", "group"), [(signal.SIGINT, True), (signal.SIGTERM, False)])
def test_interrupted_among_the_pairs(many, config, tmp_path, number, group):
    output = tmp_path / "out"
    process = start_detect(many, output, config)
    out, lines = interrupt(process, LAST_BEFORE_PAIRS, number, group=group)
    assert process.returncode == 128 + number
    (line,) = lines
    assert line.startswith("warning: interrupted after ")
    result, run = json.loads(out), Run.read(output)
    assert not result["complete"]
    assert not run.complete
    pairs = list(run.pairs())
    assert len(pairs) == result["pairs"] == run.num_pairs < 24 * 23 / 2
    assert [pair.source for pair in pairs if pair] == [loop.source for loop in run.loops]
    assert len(result["loops"]) == len(run.loops)
    assert len(run.submaps) == 24


# --- outputs are looked at first, results are printed in any case


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["map", "absent.ply", "-o", "map.jpg"], ".npz"),
        (["map", "absent.ply", "-o", "no/map.npz"], "no"),
        (["map", "absent.ply", "-o", "folder.npz"], "folder"),
        (["map", "absent.ply", "-o", "picture.npz", "--png"], "picture.png"),
        (["match", "absent.ply", "absent.ply", "--figure", "match.doc"], ".png"),
        (["match", "absent.ply", "absent.ply", "--figure", "no/match.png"], "no"),
        (["detect", "absent", "-o", "file"], "file"),
        (["detect", "absent", "-o", "file/below"], "file"),
        (["simulate", "--world", "venus", "-o", "file"], "file"),
        (["simulate", "--world", "venus", "-o", "others"], "00.ply"),
        (["demo", "--world", "venus", "-o", "file/below"], "file"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_outputs_are_refused_before_the_inputs_are_read(cli, monkeypatch, tmp_path, arguments, named):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    for folder in ("folder.npz", "picture.png", "others/clouds"):
        Path(folder).mkdir(parents=True)
    Path("others/clouds/00.ply").touch()
    code, out, err = cli(*arguments)
    assert (code, out) == (2, "")
    (line,) = err.splitlines()
    assert named in line
    assert "absent" not in line
    assert "venus" not in line


@pytest.mark.parametrize(
    "arguments", [["map", "absent.ply", "-o", "map.npz"], ["detect", "absent", "-o", "out"]]
)
def test_folders_without_permission_are_refused_first(cli, monkeypatch, tmp_path, arguments):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(terrainloop.cli.terminal.os, "access", lambda path, mode: False)
    code, _, err = cli(*arguments)
    assert code == 2
    assert "permission" in err
    assert "absent" not in err


@pytest.mark.parametrize("command", ["map", "match"])
def test_results_are_printed_though_the_picture_fails(
    cli, monkeypatch, mission_folder, config, tmp_path, command
):
    import terrainloop.report.figures as figures

    def full(figure, path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(figures, "save_figure", full)
    one = cloud(mission_folder)
    inputs = {
        "map": [one, "-o", tmp_path / "map.npz", "--png"],
        "match": [one, one, "--figure", tmp_path / "match.png"],
    }
    code, out, err = cli(command, *inputs[command], "--config", config, "--json")
    assert code == 2
    assert f"{command}.png" in err
    assert json.loads(out)
    if command == "map":
        assert json.loads(out)["written"] == [str(tmp_path / "map.npz")]
        assert GradientMap.load(tmp_path / "map.npz").resolution == 0.5


# --- names, paths and terminals

ODD = ["o[/red]", "[bold]", "new\nline", "\x1b[31mred", "$x_{$", "ünïcödé", "字"]


@pytest.mark.parametrize("name", ODD, ids=ascii)
@pytest.mark.filterwarnings("ignore:Glyph")
def test_odd_folders(cli, mission_folder, config, tmp_path, name):
    folder = tmp_path / name
    folder.mkdir(parents=True)
    code, out, err = cli("map", cloud(mission_folder), "-o", folder / "map.npz", "--config", config)
    assert (code, err.count("Traceback")) == (0, 0)
    assert all(line.isprintable() for line in out.splitlines())
    assert (name if name.isprintable() else ascii(name)[1:-1]) in out
    code, out, err = cli("map", folder / "absent.ply", "-o", folder / "map.npz")
    (line,) = err.splitlines()
    assert code == 2
    assert line.isprintable()


@pytest.mark.parametrize("name", ["[bold]x[red]", "$x_{$"])
def test_odd_clouds(cli, mission_folder, config, tmp_path, name):
    clouds = [tmp_path / f"{i} {name}.ply" for i in range(2)]
    for path in clouds:
        shutil.copy(cloud(mission_folder), path)
    shutil.copy(cloud(mission_folder, BROKEN), tmp_path / f"broken {name}.ply")
    arguments = ["--config", config, "--workers", 1]
    code, out, err = cli("match", *clouds, "--figure", tmp_path / "match.png", *arguments)
    assert code == 0, err
    assert f"0 {name} to 1 {name}" in out
    code, out, err = cli("map", clouds[0], "-o", tmp_path / "map.npz", "--png", *arguments)
    assert code == 0, err
    code, out, err = cli("detect", tmp_path, "-o", tmp_path / name, *arguments, "-v")
    assert code == 0, err
    assert f"left out broken {name}: expected" in out
    assert f"Written to {tmp_path / name}:" in out
    assert f"info: 0 {name}: 850 points" in err


C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.parametrize("locale", [{}, C_LOCALE], ids=["UTF-8", "C"])
def test_a_terminal_of_ascii_and_paths_that_are_no_text(mission_folder, tmp_path, locale):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("the file system takes text only")
    shutil.copy(cloud(mission_folder), folder / "höhe.ply")
    done = subprocess.run(
        [sys.executable, "-m", "terrainloop", "map", folder / "höhe.ply", "-o", folder / "größe.npz", "-v"],
        env={**os.environ, "PYTHONIOENCODING": "ascii", **locale},
        capture_output=True,
        check=False,
    )
    assert (done.stdout + done.stderr).isascii()
    if locale:  # there the cloud has no name that could be printed
        assert done.returncode == 2
        assert done.stderr.startswith(b"terrainloop: expected a name")
    else:
        assert done.returncode == 0, done.stderr
        assert b"850 points" in done.stdout
        assert (folder / "größe.npz").exists()


def test_warnings_are_one_line_each(cli, config, tmp_path):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 5, (600, 2)), rng.normal(0, 0.1, 600)])
    points[::7] = np.nan
    path = tmp_path / f"{'long' * 40}.npy"
    np.save(path, points)
    code, out, err = cli("map", path, "-o", tmp_path / "map.npz", "--config", config, "--json")
    assert code == 0, err
    assert json.loads(out)["repairs"]
    lines = err.splitlines()
    assert len(lines) == 2  # what was repaired, and what is wrong with the map
    assert all(line.startswith("warning: longlong") for line in lines)


# --- JSON


def no_constant(name):
    pytest.fail(f"{name} is no JSON")


def test_detect_and_match_agree_on_the_keys_of_a_loop(cli, mission_folder, tmp_path, config):
    sure = tmp_path / "sure.yaml"
    sure.write_text(STRICT.model_copy(update={"skip_recent": 0}).to_yaml())
    arguments = ["--config", sure, "--workers", 1, "--json"]
    code, out, err = cli("detect", mission_folder, "-o", tmp_path / "out", *arguments)
    assert (code, err) == (0, "")
    (loop,) = json.loads(out, parse_constant=no_constant)["loops"]
    clouds = cloud(mission_folder, "000003"), cloud(mission_folder, "000000")
    code, out, err = cli("match", *clouds, *arguments)
    assert (code, err) == (0, "")
    match = json.loads(out, parse_constant=no_constant)
    assert set(loop) == set(match)
    assert np.shape(loop["covariance"]) == (6, 6)
    # Maps differ by the hyperparameters, which one was fitted to the mission.
    np.testing.assert_allclose(loop["T_target_source"], match["T_target_source"], atol=0.2)


# --- few clouds


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("all_pairs", [False, True])
def test_few_clouds(cli, mission_folder, tmp_path, count, all_pairs):
    for name in [*PLACES][:count]:
        shutil.copy(cloud(mission_folder, name), tmp_path)
    (tmp_path / "thin.yaml").write_text(THIN.model_copy(update={"skip_recent": 1}).to_yaml())
    arguments = ["detect", tmp_path, "-o", tmp_path / "out", "--config", tmp_path / "thin.yaml"]
    code, out, err = cli(*arguments, "--workers", 1, *(["--all-pairs"] if all_pairs else []))
    assert code == 0, err
    assert ("needs two submaps" in out) == (count == 1)
    assert ("--all-pairs" in out) == ("match A B" in out) == (count == 2 and not all_pairs)


# --- workers


@pytest.mark.parametrize("asked", [0, 1, 2, 3000, 10**9])
def test_no_more_workers_than_processors(asked):
    assert 1 <= terrainloop.cli.terminal.worker_count(asked) <= max(1, os.cpu_count())


@pytest.mark.parametrize("command", ["map", "match", "detect", "demo"])
def test_a_negative_number_of_workers_is_wrong_usage(cli, command):
    code, out, err = cli(command, "--workers", -1)
    assert (code, out) == (2, "")
    assert "Traceback" not in err


# --- running again


def test_a_shorter_simulation_replaces_a_longer_one(cli, tmp_path):
    arguments = ["simulate", "--world", "flat", "-o", tmp_path / "mission", "-q", "--submaps"]
    (tmp_path / "mission").mkdir()
    (tmp_path / "mission" / "notes.txt").write_text("mine")
    for submaps in (2, 1):
        assert cli(*arguments, submaps) == (0, "", "")
        assert len(read_trajectory(tmp_path / "mission" / "truth.tum")) == submaps
        assert len([*(tmp_path / "mission" / "clouds").iterdir()]) == submaps
    names = sorted(path.name for path in (tmp_path / "mission").iterdir())
    assert names == ["clouds", "notes.txt", "odometry.tum", "simulation.yaml", "truth.tum"]


def test_a_simulation_that_finds_no_room_leaves_the_earlier_one(monkeypatch, tmp_path):
    import terrainloop.simulation.missions as missions

    mission = missions.simulate_mission("flat", 0, 1)
    missions.write_mission(mission, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}

    def full(path, trajectory):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(missions, "write_tum", full)
    with pytest.raises(OSError, match="No space") as caught:
        missions.write_mission(mission, tmp_path)
    assert caught.value.filename == str(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()} == before


# --- python -m, and without docstrings


def test_python_m_and_optimised_python_print_the_same(cli):
    def printed(*arguments, level):
        command = [sys.executable, "-m", "terrainloop", *arguments]
        env = {**os.environ, "PYTHONOPTIMIZE": level, "COLUMNS": "100"}
        return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout

    assert printed("config", level="2") == Settings().to_yaml()
    assert printed("detect", "--help", level="2") == printed("detect", "--help", level="")
    text = printed("--help", level="2")
    assert "Loop closures from the shape of the ground." in text
    assert "Find the loop closures" in text
    assert "130" in text


@pytest.mark.parametrize("workers", [1, 2])
def test_with_v_a_run_reports_each_cloud_once(cli, config, tmp_path, workers):
    rng = np.random.default_rng(1)
    for name in "ab":
        points = np.column_stack([rng.uniform(0, 5, (400, 2)), rng.normal(0, 0.1, 400)])
        points[0] = np.nan
        np.save(tmp_path / f"{name}.npy", points)
    write_cloud(tmp_path / "c.ply", points[1:])
    arguments = ["detect", tmp_path, "-o", tmp_path / "out", "--config", config, "--workers", workers]
    code, _, err = cli(*arguments, "--json")
    assert (code, err) == (0, "")
    code, _, err = cli(*arguments, "--json", "-v")
    assert code == 0
    lines = err.splitlines()
    assert all(line.startswith("info: ") for line in lines)
    assert "noise" in lines[0]
    assert [line.split(":")[1] for line in lines[1:]] == [" a", " b", " c"]
    for line in lines[1:3]:
        assert "399 points" in line
        assert "dropped 1 of 400 points" in line
        assert "observed" in line
