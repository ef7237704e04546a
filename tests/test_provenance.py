"""What is kept is kept under its code, data and settings: a changed byte counts, a changed date does not."""

import os
import shutil
from pathlib import Path

import pytest

import terrainloop
from benchmarks.provenance import fingerprint, package, processor


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "root"
    (root / "below").mkdir(parents=True)
    (root / "one.py").write_text("x = 1\n")
    (root / "below" / "core.so").write_bytes(b"\x7fELF\x00")
    return root


def rewrite(path):
    path.write_bytes(path.read_bytes()[:-1] + b"!")


def swap(root):
    one, other = root / "one.py", root / "below" / "core.so"
    before = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(before)


CHANGES = {
    "a byte of a source": lambda root: rewrite(root / "one.py"),
    "a byte of the compiled core": lambda root: rewrite(root / "below" / "core.so"),
    "one file more": lambda root: (root / "below" / "two.py").touch(),
    "one file less": lambda root: (root / "one.py").unlink(),
    "another name": lambda root: (root / "one.py").rename(root / "two.py"),
    "another folder": lambda root: (root / "one.py").rename(root / "below" / "one.py"),
    "contents swapped": swap,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_changes_the_content_changes_the_fingerprint(folder, change):
    before = fingerprint(folder, seed=1)
    change(folder)
    assert fingerprint(folder, seed=1) != before


def touch(root):
    os.utime(root / "one.py", (1, 1))


def compile_(root):
    (root / "__pycache__").mkdir()
    (root / "__pycache__" / "one.cpython-311.pyc").write_bytes(b"made from one.py, at some time")


@pytest.mark.parametrize("change", [touch, compile_])
def test_dates_and_caches_do_not_count(folder, change):
    before = fingerprint(folder, seed=1)
    change(folder)
    assert fingerprint(folder, seed=1) == before


def test_where_the_files_are_does_not_count(folder, tmp_path):
    moved = shutil.copytree(folder, tmp_path / "elsewhere")
    assert fingerprint(folder) == fingerprint(moved)
    assert fingerprint(folder / "one.py") == fingerprint(moved / "one.py")


def test_what_is_behind_a_link_counts(folder, tmp_path):
    """A mission may link to its folder of clouds, or to each of them."""
    mission = tmp_path / "mission"
    mission.mkdir()
    (mission / "clouds").symlink_to(folder)
    (mission / "truth.tum").symlink_to(folder / "one.py")
    before = fingerprint(mission)
    rewrite(folder / "below" / "core.so")
    after = fingerprint(mission)
    assert after != before
    rewrite(folder / "one.py")
    assert fingerprint(mission) != after


def test_settings_count_whatever_their_order():
    before = fingerprint(settings={"a": 1, "b": [0.5, None]}, seed=1)
    assert fingerprint(seed=1, settings={"b": [0.5, None], "a": 1}) == before
    assert fingerprint(settings={"a": 1, "b": [0.5, 0.0]}, seed=1) != before
    assert fingerprint(settings={"a": 1, "b": [0.5, None]}, seed=2) != before


def test_settings_that_have_no_fixed_text_are_refused():
    """The text of most objects names their address: their key would never be met again."""
    with pytest.raises(TypeError):
        fingerprint(settings=object())


def test_the_package_is_the_one_that_is_imported_with_its_core(monkeypatch, tmp_path):
    copy = shutil.copytree(Path(terrainloop.__file__).parent, tmp_path / "terrainloop")
    monkeypatch.setattr(terrainloop, "__path__", [str(copy)])
    assert copy in package()
    assert any(root.suffix in (".so", ".pyd") for root in package())
    before = fingerprint(*package())
    rewrite(copy / "matching" / "ransac.py")
    assert fingerprint(*package()) != before


def test_the_processor_has_a_name():
    assert processor().strip()
    assert "\n" not in processor()
