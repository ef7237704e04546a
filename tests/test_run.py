"""What a run leaves in its folder: all of it or nothing, never beside what an earlier run left."""

import errno
import json
import os
import signal
import socket
import subprocess
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from terrainloop.config import Settings
from terrainloop.detection import run as module
from terrainloop.detection.detector import LoopDetector
from terrainloop.detection.mission import detect_mission
from terrainloop.detection.run import CORRECTED, DERIVED, OF_A_RUN, Run, RunWriter
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.io.missions import Mission
from terrainloop.loop import LoopCandidate
from terrainloop.record import SubmapRecord

UNFINISHED = Run(Settings(), Hyperparameters(0.4, 0.01, 0.02), (SubmapRecord("a"), SubmapRecord("b")), ())


def candidate(number, accepted):
    reason = "0.001 false loops expected" if accepted else f"kind {number % 3}: chance explains it"
    pair = LoopCandidate.without_transform(f"b{number}", f"a{number}", reason)
    T = np.eye(4)
    return replace(pair, accepted=accepted, T_target_source=T, covariance=np.eye(6))


def write(folder, loops, pairs=4, *, complete=True):
    """A run of so many loops among so many pairs."""
    with RunWriter.open(Path(folder)) as writer:
        tally = module.Tally()
        for number in range(pairs):
            pair = candidate(number, number < loops)
            writer.add(pair)
            tally.add(pair)
        return writer.finish(tally.of(replace(UNFINISHED, complete=complete)))


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_run_is_read_as_it_was_written(tmp_path):
    written = write(tmp_path / "out", 2, 9, complete=False)
    read = Run.read(tmp_path / "out")
    assert read.settings == written.settings
    assert read.parameters == written.parameters
    assert [record.name for record in read.submaps] == ["a", "b"]
    assert [(loop.source, loop.target) for loop in read.loops] == [("b0", "a0"), ("b1", "a1")]
    assert read.rejections == written.rejections == {"kind 2": 3, "kind 0": 2, "kind 1": 2}
    assert read.num_pairs == written.num_pairs == len(list(read.pairs())) == 9
    assert not read.complete
    assert set(content(tmp_path / "out")) == set(OF_A_RUN)


def test_a_later_run_replaces_all_that_the_earlier_one_left(tmp_path):
    write(tmp_path, 3)
    for name in (*CORRECTED, *DERIVED):
        (tmp_path / name).write_bytes(b"stale")
    (tmp_path / "notes.txt").write_bytes(b"mine")
    write(tmp_path, 1)
    assert len(Run.read(tmp_path).loops) == 1
    assert set(content(tmp_path)) == {*OF_A_RUN, "notes.txt"}


# --- disks


def full(*args, **kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


STAGES = [
    (module.LoopFile, "__init__"),
    (module.LoopFile, "write"),
    (module, "write_loops"),
    (module, "write_submaps"),
    (module, "write_whole_text"),
]


@pytest.mark.parametrize(("owner", "name"), STAGES, ids=lambda value: getattr(value, "__name__", value))
@pytest.mark.parametrize("earlier", [True, False])
def test_a_full_disk_at_any_stage_leaves_the_folder_as_it_was(tmp_path, monkeypatch, owner, name, earlier):
    folder = tmp_path / "out"
    if earlier:
        write(folder, 3)
    before = content(folder) if earlier else None
    with monkeypatch.context() as patched:
        patched.setattr(owner, name, full)
        with pytest.raises(OSError, match="No space left") as caught:
            write(folder, 1)
    assert caught.value.filename == str(folder)
    assert (content(folder) if folder.exists() else None) == before


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 pages."""
    disk = tmp_path / "disk"
    disk.mkdir()
    size = 64 * os.sysconf("SC_PAGE_SIZE")
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", disk]
    try:
        mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("mounting is not permitted here")
    yield disk
    subprocess.run(["umount", disk], check=True)


def error_of(action):
    try:
        action()
    except OSError as error:
        return error
    return None


def test_a_disk_that_is_really_full(small_disk):
    """Ever more room, page by page, until the run fits beside the earlier one."""
    page, folder = os.sysconf("SC_PAGE_SIZE"), small_disk / "out"
    write(folder, 3)
    before, failures = content(folder), 0
    for room in range(64):
        filler = small_disk / "filler"
        free = os.statvfs(small_disk).f_bavail
        filler.write_bytes(bytes(max(0, free - room) * page))
        error = error_of(lambda: write(folder, 1, 40))
        if error is None:
            break
        failures += 1
        assert (error.errno, error.filename) == (errno.ENOSPC, str(folder))
        assert content(folder) == before
        filler.unlink()
    assert failures > 3
    assert len(Run.read(folder).loops) == 1
    assert set(content(folder)) == set(OF_A_RUN)


@pytest.mark.parametrize("name", ["pairs.csv", "match.png"])
def test_a_folder_in_the_way_of_a_file_is_found_before_the_work(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(IsADirectoryError, match=name), RunWriter.open(tmp_path):
        pytest.fail("the work has begun")


# --- interrupts, other processes


def test_an_interrupt_while_files_are_moved_waits_until_all_are(tmp_path, monkeypatch):
    write(tmp_path, 3)
    replaced, move = [], Path.replace

    def interrupted(self, target):
        if target.parent == tmp_path:
            replaced.append(target.name)
            if len(replaced) == 2:
                os.kill(os.getpid(), signal.SIGINT)
        return move(self, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, 1)
    assert len(Run.read(tmp_path).loops) == 1
    assert set(content(tmp_path)) == set(OF_A_RUN)


def test_what_a_killed_process_left_is_removed_and_that_of_a_live_one_is_not(tmp_path):
    dead = subprocess.Popen(["true"])
    dead.wait()
    names = {
        f".terrainloop-{socket.gethostname()}-{dead.pid}-x": False,
        f".terrainloop-{socket.gethostname()}-{os.getppid()}-x": True,
        f".terrainloop-elsewhere-{dead.pid}-x": True,  # on another machine, who knows
        f".terrainloop-{socket.gethostname()}-notes": True,
    }
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "pairs.csv").touch()
    write(tmp_path, 1)
    assert {name: (tmp_path / name).exists() for name in names} == names


def test_two_runs_into_one_folder_leave_one_of_them_whole(tmp_path):
    def repeatedly(loops):
        for _ in range(10):
            write(tmp_path, loops, pairs=5)

    threads = [threading.Thread(target=repeatedly, args=(loops,)) for loops in (1, 4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    run = Run.read(tmp_path)
    assert len(run.loops) in (1, 4)
    assert sum(map(bool, run.pairs())) == len(run.loops)
    assert set(content(tmp_path)) == set(OF_A_RUN)


def test_an_incomplete_run_counts_what_was_written(tmp_path):
    """An interrupt may come between the writing of a pair and its counting."""
    with RunWriter.open(tmp_path) as writer:
        for number in range(5):
            writer.add(candidate(number, number == 3))
        run = writer.finish(replace(UNFINISHED, complete=False))
    assert run.num_pairs == Run.read(tmp_path).num_pairs == 5
    assert [loop.source for loop in run.loops] == ["b3"]


# --- missions


@pytest.fixture(scope="module")
def thin(strict):
    coarse = strict.map.model_copy(update={"max_points": 150, "resolution": 0.5})
    return strict.model_copy(update={"map": coarse, "skip_recent": 0})


@pytest.mark.parametrize("written", [True, False])
def test_an_interrupt_among_the_pairs_keeps_those_compared(mission_folder, thin, tmp_path, written):
    seen = []

    def on_pair(pair):
        seen.append(pair)
        if len(seen) == 3:
            raise KeyboardInterrupt

    run = detect_mission(mission_folder, thin, output=tmp_path if written else None, on_pair=on_pair)
    assert not run.complete
    assert run.num_pairs == 3
    assert run.loops == tuple(pair for pair in seen if pair)
    assert len(run.submaps) == 5
    if written:
        read = Run.read(tmp_path)
        assert not read.complete
        assert [pair.source for pair in read.pairs()] == [pair.source for pair in seen]


@pytest.mark.parametrize("error", [RuntimeError, OSError, TerrainLoopError, SystemExit])
def test_an_error_of_the_caller_leaves_nothing(mission_folder, thin, tmp_path, error):
    def on_pair(pair):
        raise error(expected="", found="", mend="") if error is TerrainLoopError else error("from the caller")

    write(tmp_path, 2)
    before = content(tmp_path)
    for output in (tmp_path, tmp_path / "new"):
        with pytest.raises(error):
            detect_mission(mission_folder, thin, output=output, on_pair=on_pair)
    assert content(tmp_path) == before


def test_an_interrupt_among_the_maps_leaves_nothing(mission_folder, thin, tmp_path):
    def on_progress(stage, done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        detect_mission(mission_folder, thin, output=tmp_path / "new", on_progress=on_progress)
    assert not (tmp_path / "new").exists()


def test_an_interrupt_while_a_query_is_compared_keeps_the_ones_before(
    mission_folder, thin, tmp_path, monkeypatch
):
    add, added = LoopDetector.add_entry, []

    def interrupted(self, query):
        added.append(query)
        if len(added) == 3:
            raise KeyboardInterrupt
        return add(self, query)

    monkeypatch.setattr(LoopDetector, "add_entry", interrupted)
    run = detect_mission(mission_folder, thin, output=tmp_path)
    assert not run.complete
    assert run.num_pairs == 1


def test_pairs_are_counted_without_an_output_too(mission_folder, thin):
    assert detect_mission(mission_folder, thin).num_pairs == 6


@pytest.mark.parametrize("odd", [b"\xff\xfe", b"new\nline", b"\x1b[31m"])
def test_a_name_that_is_no_text_costs_its_own_cloud(mission_folder, thin, tmp_path, odd):
    cloud = mission_folder / "clouds" / "000000.ply"
    name = os.fsdecode(odd + b".ply")
    try:
        (tmp_path / name).symlink_to(cloud)
    except OSError:
        pytest.skip("the file system takes text only")
    mission = Mission(tmp_path, (cloud, tmp_path / name, cloud.with_name("000001.ply")))
    run = detect_mission(mission, thin, output=tmp_path / "out")
    assert [record.status for record in run.submaps] == ["ok", "broken", "ok"]
    assert run.submaps[1].name.isprintable()
    read = Run.read(tmp_path / "out")
    assert [record.name for record in read.submaps] == [record.name for record in run.submaps]


@pytest.mark.parametrize("workers", [0, -1, 1.5, "2", True])
def test_impossible_numbers_of_workers(mission_folder, workers):
    with pytest.raises(TerrainLoopError, match="number of workers"):
        detect_mission(mission_folder, workers=workers)


# --- reading


DAMAGE = {
    "binary": b"\xff\xfe\x00",
    "wrong": b'{"loops": 3e999, "complete": "maybe"}',
    "table": b"source,target\n1,2\n",
    "nested": b"[" * 100,
}


@pytest.mark.parametrize("name", OF_A_RUN)
@pytest.mark.parametrize("damage", [*DAMAGE, "empty", "folder"])
def test_a_damaged_file_of_a_run_is_named(tmp_path, name, damage):
    write(tmp_path, 2)
    if damage == "folder":
        (tmp_path / name).unlink()
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_bytes(DAMAGE.get(damage, b""))
    if (name, damage) == ("config.yaml", "empty"):  # the defaults
        assert Run.read(tmp_path).settings == Settings()
        return
    with pytest.raises(TerrainLoopError, match=name):
        list(Run.read(tmp_path).pairs())


@pytest.mark.parametrize("name", OF_A_RUN)
def test_a_missing_file_of_a_run(tmp_path, name):
    write(tmp_path, 2)
    (tmp_path / name).unlink()
    if name == "run.json":  # which earlier versions did not write
        assert Run.read(tmp_path).complete
    else:
        with pytest.raises(TerrainLoopError, match=name):
            list(Run.read(tmp_path).pairs())


@pytest.mark.parametrize(
    "change",
    [
        {"hyperparameters": {"length_scale": 1.0}},
        {"hyperparameters": [1, 2, 3]},
        {"rejections": ["chance"]},
        {"rejections": {"chance": "many"}},
        {"loops": 7},
        {"complete": None},
    ],
    ids=str,
)
def test_a_description_that_does_not_fit(tmp_path, change):
    write(tmp_path, 2)
    about = json.loads((tmp_path / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps(about | change))
    with pytest.raises(TerrainLoopError, match=r"run\.json"):
        Run.read(tmp_path)


def test_pairs_of_a_run_that_was_not_written():
    with pytest.raises(TerrainLoopError, match="output"):
        UNFINISHED.pairs()
