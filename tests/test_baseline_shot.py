import shutil
from pathlib import Path

import numpy as np
import pytest

from reproduce.baselines import shot
from reproduce.baselines.method import NOT_COMPARABLE, Observation, Scale
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, se3, transform
from terrainloop.submap import Submap

T_TARGET_SOURCE = se3(300.0, -200.0, 12.0, 0.0, 0.0, np.radians(130.0))  # far off: floats have seven digits
SCALE = Scale(spacing=0.05, side=8.0)

needs_pcl = pytest.mark.skipif(
    not (list(Path("/usr/include").glob("pcl-*")) and shutil.which("cmake") and shutil.which("c++")),
    reason="needs libpcl-dev, cmake and a C++ compiler",
)


@pytest.fixture(scope="module")
def by_name():
    """The first choice of settings of each method."""
    return {method.name: method for method in reversed(shot.methods(SCALE))}


@pytest.fixture(scope="module")
def ground(world):
    return world(3).observe(np.eye(4), (0.0, 0.0), seed=1, count=7000, side=8.0, noise=0.002)


def observation(points, colours=None):
    return Observation(Submap(points), colours=colours)


def painted(points, seed):
    """Smooth colours, another pattern for each seed."""
    rng = np.random.default_rng(seed)
    waves = np.sin(points[:, :2] @ rng.normal(0, 2, (2, 12)) + rng.uniform(0, 6, 12))
    return np.clip(128 + 30 * waves @ rng.normal(0, 1, (12, 3)), 0, 255).astype(np.uint8)


def position_error(T, points):
    return np.linalg.norm(transform(T, points) - transform(T_TARGET_SOURCE, points), axis=1).max()


@needs_pcl
def test_finds_a_submap_that_was_moved(by_name, ground):
    method = by_name["SHOT + RANSAC"]
    source = method.describe(observation(ground))
    target = method.describe(observation(transform(T_TARGET_SOURCE, ground)))
    match = method.score(source, target)
    assert position_error(match.T_target_source, ground) < 0.05
    back = method.score(target, source)
    assert position_error(inverse(back.T_target_source), ground) < 0.05
    assert match.score > 50


@needs_pcl
def test_other_ground_scores_far_less(by_name, ground, world):
    method = by_name["SHOT + RANSAC"]
    elsewhere = world(4).observe(np.eye(4), (0.0, 0.0), seed=2, count=7000, side=8.0, noise=0.002)
    source, other = (method.describe(observation(points)) for points in (ground, elsewhere))
    assert method.score(source, other).score < method.score(source, source).score / 10


@needs_pcl
def test_keypoints_are_points_of_the_ground_where_it_bends_most(by_name, world):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-4, 4, (20000, 2))
    bent = np.hypot(*(xy - [1.0, 2.0]).T) < 1.0
    z = np.where(bent, 0.2 * np.cos(6 * xy[:, 0]) * np.cos(6 * xy[:, 1]), 0.05 * xy[:, 0])
    kept = by_name["SHOT + RANSAC"].describe(observation(np.c_[xy, z]))
    strongest = kept.points[:30]
    assert (np.hypot(*(strongest[:, :2] - [1.0, 2.0]).T) < 1.6).all()
    apart = np.linalg.norm(kept.points[:, None] - kept.points, axis=-1) + 9 * np.eye(len(kept.points))
    assert apart.min() >= 0.01 * SCALE.side


@needs_pcl
@pytest.mark.parametrize("name", ["SHOT + RANSAC", "CSHOT + RANSAC"])
def test_same_input_gives_the_same_output(by_name, ground, name):
    method = by_name[name]
    moved = transform(T_TARGET_SOURCE, ground[::2])
    a, again = (method.describe(observation(ground, painted(ground, 0))) for _ in range(2))
    b = method.describe(observation(moved, painted(ground[::2], 0)))
    assert a.descriptors.tobytes() == again.descriptors.tobytes()
    assert np.allclose(np.linalg.norm(a.descriptors, axis=1), 1, atol=1e-4)  # matching relies on it
    first, second = method.score(a, b), method.score(again, b)
    assert first.score == second.score
    assert first.T_target_source.tobytes() == second.T_target_source.tobytes()


@needs_pcl
def test_colour_helps_where_there_is_no_shape(by_name):
    xy = np.random.default_rng(0).uniform(-4, 4, (7000, 2))
    flat = np.c_[xy, np.random.default_rng(1).normal(0, 0.01, len(xy))]
    moved = transform(T_TARGET_SOURCE, flat)
    method = by_name["CSHOT + RANSAC"]
    source, target, other = (
        method.describe(observation(points, painted(flat, seed)))
        for points, seed in ((flat, 0), (moved, 0), (moved, 1))
    )
    match = method.score(source, target)
    assert position_error(match.T_target_source, flat) < 0.1
    assert method.score(source, other).score < match.score / 5


@needs_pcl
def test_colour_is_not_made_up(by_name, ground):
    method = by_name["CSHOT + RANSAC"]
    coloured, bare = (
        method.describe(observation(ground, painted(ground, 0))),
        method.describe(observation(ground)),
    )
    match = method.score(coloured, bare)
    assert match.score == NOT_COMPARABLE
    assert np.isnan(match.T_target_source).all()


@needs_pcl
def test_too_few_matches_are_no_match(by_name, ground):
    method = by_name["SHOT + RANSAC"]
    kept = method.describe(observation(ground))
    none = shot.Keypoints(kept.points[:0], kept.descriptors[:0])
    two = shot.Keypoints(kept.points[:2], kept.descriptors[:2])
    for few in (none, two):
        for match in (method.score(kept, few), method.score(few, kept)):
            assert match.score == 0
            assert np.isnan(match.T_target_source).all()


@needs_pcl
def test_the_methods_are_two_with_the_same_choices():
    methods = shot.methods(SCALE)
    settings = [method.settings for method in methods]
    assert [method.name for method in methods] == ["SHOT + RANSAC"] * 2 + ["CSHOT + RANSAC"] * 2
    assert settings[:2] == settings[2:]
    assert len({tuple(choice.items()) for choice in settings}) == 2
    assert methods[0].software.startswith("PCL 1.")


def test_without_cmake_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(TerrainLoopError, match=r"no cmake.*apt install libpcl-dev cmake g\+\+") as error:
        shot.methods(SCALE)
    assert "\n" not in str(error.value)


def test_a_failed_build_says_why_and_leaves_nothing(tmp_path, monkeypatch):
    cmake = tmp_path / "cmake"
    cmake.write_text(
        "#!/bin/sh\necho 'CMake Error at CMakeLists.txt:10:' >&2\necho 'no PCL here' >&2\nexit 1\n"
    )
    cmake.chmod(0o755)
    cache = tmp_path / "cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(TerrainLoopError, match=r"no PCL here.*apt install libpcl-dev") as error:
        shot.methods(SCALE)
    assert "\n" not in str(error.value)
    assert not list((cache / "terrainloop").iterdir())
