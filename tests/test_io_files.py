"""Files that are complete or absent."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from clouds_util import ground

from terrainloop.io import read_cloud, write_cloud
from terrainloop.io.files import write_whole, write_whole_text
from terrainloop.io.rasters import write_geotiff

SUFFIXES = ("ply", "npy", "npz", "xyz")
LIMITED = """
import csv, resource, sys
import numpy as np
from terrainloop.io import write_cloud
from terrainloop.io.files import write_whole_text
from terrainloop.io.rasters import write_geotiff
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
for path in sys.argv[1:]:
    try:
        if path.endswith("csv"):
            write_whole_text(path, lambda file: csv.writer(file).writerows([range(9)] * 9999))
        elif path.endswith("tif"):
            write_geotiff(path, {"a": np.random.default_rng(0).normal(size=(90, 90))}, (0, 0), 0.1)
        else:
            write_cloud(path, np.random.default_rng(0).normal(size=(900, 3)))
    except OSError as error:
        print(error.filename, error.strerror)
"""


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_full_disk_leaves_nothing_behind_and_names_the_file(tmp_path):
    paths = [tmp_path / f"a.{suffix}" for suffix in sorted([*SUFFIXES, "tif", "csv"])]
    for path in paths:
        path.write_text("what was there")
    run = subprocess.run([sys.executable, "-c", LIMITED, *paths], capture_output=True, text=True, check=True)
    assert run.stdout == "".join(f"{path} File too large\n" for path in paths)
    assert run.stderr == ""
    assert [path.read_text() for path in paths] == ["what was there"] * len(paths)
    assert _names(tmp_path) == [path.name for path in paths]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_device_is_written_to_and_stays_a_device(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left") as caught:
        write_cloud(path, ground())
    assert caught.value.filename == str(path)
    assert path.is_symlink()
    assert os.path.realpath(path) == "/dev/full"


def test_a_link_is_followed(tmp_path):
    (tmp_path / "real.ply").write_bytes(b"old")
    (tmp_path / "link.ply").symlink_to("real.ply")
    write_cloud(tmp_path / "link.ply", ground())
    assert (tmp_path / "link.ply").is_symlink()
    assert len(read_cloud(tmp_path / "real.ply")) == 400


def test_a_pipe_is_written_to(tmp_path):
    path = tmp_path / "a.npy"
    os.mkfifo(path)
    read = []
    reader = threading.Thread(target=lambda: read.append(path.read_bytes()))
    reader.start()
    write_cloud(path, ground())
    reader.join()
    write_cloud(tmp_path / "b.npy", ground())
    assert read == [(tmp_path / "b.npy").read_bytes()]


@pytest.mark.parametrize("name", ["absent/a.ply", "folder.ply", "file/a.ply"])
def test_errors_name_what_was_asked_for(tmp_path, name):
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=name) as caught:
        write_cloud(tmp_path / name, ground())
    assert caught.value.filename == str(tmp_path / name)
    assert _names(tmp_path) == ["file", "folder.ply"]


def test_whatever_ends_the_writing_leaves_what_was_there(tmp_path):
    (tmp_path / "a").write_bytes(b"old")

    def write(file):
        file.write(b"new")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "a", write)
    assert (tmp_path / "a").read_bytes() == b"old"
    assert _names(tmp_path) == ["a"]


def test_longest_names(tmp_path):
    path = tmp_path / ("a" * 251 + ".npy")
    write_cloud(path, ground())
    assert len(read_cloud(path)) == 400


def test_text(tmp_path):
    write_whole_text(tmp_path / "a", lambda file: file.write("höhe\r\n1\n"))
    assert (tmp_path / "a").read_bytes() == "höhe\r\n1\n".encode()


def test_rasters_replace_files(tmp_path):
    (tmp_path / "a.tif").write_bytes(b"old")
    write_geotiff(tmp_path / "a.tif", {"a": np.zeros((3, 4), np.float32)}, (0, 0), 0.1)
    assert (tmp_path / "a.tif").read_bytes()[:2] == b"II"
