"""The methods that ours is held against: each finds a submap that was moved, and scores it above others."""

import numpy as np
import pytest

from reproduce.baselines import (
    fpfh,
    kiss,
    map_closures,
    odometry_icp,
    ours,
    random_score,
    scan_context,
)
from reproduce.baselines.method import NOT_COMPARABLE, Observation, Scale, require
from terrainloop.config import Settings
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, se3, transform, yaw_of
from terrainloop.matching.register import compare
from terrainloop.submap import Submap

PACKAGES = {
    fpfh: "open3d",
    kiss: "kiss_matcher",
    map_closures: "map_closures.map_closures",
    odometry_icp: "small_gicp",
}
MOVED = se3(0.6, -0.4, 0.3, 0.0, 0.0, 2.0)  # T_target_source


def need_package_of(module):
    """Skip where the package of a method is missing, or a library of the system that it asks for."""
    if module in PACKAGES:
        pytest.importorskip(PACKAGES[module], exc_type=ImportError)


def methods_of(module, places):
    need_package_of(module)
    return module.methods(Scale.of([place.submap for place in places]))


def moved(points, rng):
    """The same ground in another frame, with errors of its own."""
    return transform(inverse(MOVED), points + rng.normal(0, 0.001, points.shape))


@pytest.fixture(scope="module")
def places(world):
    """A place, the same one moved, and two others, each an Observation; odometry has drifted."""
    rng = np.random.default_rng(7)
    here, there, yonder = (
        world(3).observe(np.eye(4), centre, seed=seed, count=8000, noise=0.002)
        for seed, centre in enumerate([(0, 0), (5, 5), (-5, 4)])
    )
    drift = se3(0.05, -0.04, 0.02, 0.0, 0.0, np.radians(1.5))
    poses = np.eye(4), MOVED @ drift, se3(10, 10, 0, 0, 0, 0), se3(-10, 10, 0, 0, 0, 0)
    clouds = here, moved(here, rng), there, yonder
    names = "here", "again", "there", "yonder"
    return [
        Observation(Submap(points, name), T) for points, name, T in zip(clouds, names, poses, strict=True)
    ]


def finds(method, places, metres, degrees):
    """Whether the moved place is found, where it is, and with a score above those of the others."""
    here, again, *others = (method.describe(place) for place in places)
    match = method.score(again, here)
    middle = np.append(places[1].submap.points.mean(axis=0), 1.0)
    offset = np.linalg.norm(((match.T_target_source - MOVED) @ middle)[:3])
    turn = abs(np.degrees(yaw_of(inverse(MOVED) @ match.T_target_source)))
    above_others = all(match.score > method.score(again, other).score for other in others)
    return offset < metres and turn < degrees and above_others


# Largest errors in metres and degrees; Scan Context turns by sectors of 6 degrees.
FINDERS = {fpfh: (0.01, 0.1), kiss: (0.02, 0.5), odometry_icp: (0.01, 0.1), scan_context: (0.01, 3.01)}


@pytest.mark.parametrize(
    ("module", "errors"), FINDERS.items(), ids=lambda v: getattr(v, "__name__", "").rpartition(".")[2]
)
def test_finds_the_place_that_was_moved(places, module, errors):
    assert finds(methods_of(module, places)[0], places, *errors)


def test_kiss_matcher_does_not_mind_where_the_origin_is(places):
    """Its normals turn to the origin: one within the ground would tear them apart."""
    deep = [
        Observation(Submap(place.submap.points + np.array([0, 0, height]), place.submap.name))
        for place, height in zip(places, (0.0, -30.0, 1.0, 2.0), strict=True)
    ]
    method = methods_of(kiss, places)[0]
    here, again = (method.describe(place) for place in deep[:2])
    T = method.score(again, here).T_target_source
    np.testing.assert_allclose(T[:3, 3], MOVED[:3, 3] + [0, 0, 30], atol=0.05)


def street(seed):
    """Points (N, 3) of walls about a street of 40 m, which is what MapClosures looks for."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-20, 20, (2, 60, 3))
    ends[1] = ends[0] + rng.uniform(-4, 4, (60, 3))
    along = rng.random((800, 60, 1))
    walls = (ends[0] + along * (ends[1] - ends[0])).reshape(-1, 3)
    walls[:, 2] = rng.uniform(0, 3, len(walls))
    ground = np.c_[rng.uniform(-20, 20, (20000, 2)), rng.normal(0, 0.01, 20000)]
    return np.r_[walls, ground]


def test_map_closures_finds_the_street_that_was_moved():
    here, there = street(3), street(2)
    clouds = here, moved(here, np.random.default_rng(3)), there
    places = [Observation(Submap(points, str(number))) for number, points in enumerate(clouds)]
    assert finds(methods_of(map_closures, places)[0], places, 0.3, 1.0)


@pytest.mark.parametrize("module", [fpfh, odometry_icp, scan_context, random_score])
def test_a_pair_scores_the_same_whatever_was_scored_before(places, module):
    method = methods_of(module, places)[0]
    here, again, there, yonder = (method.describe(place) for place in places)
    first = method.score(again, here)
    method.score(yonder, there)
    second = method.score(again, here)
    assert first.score == second.score
    np.testing.assert_allclose(first.T_target_source, second.T_target_source, atol=1e-6)


@pytest.mark.parametrize("module", [fpfh, kiss, map_closures, odometry_icp, scan_context])
def test_settings_scale_with_the_submaps(places, module):
    need_package_of(module)
    small, large = (module.methods(Scale(spacing=0.02 * k, side=10.0 * k)) for k in (1, 4))
    assert len({tuple(method.settings.items()) for method in small}) == len(small) >= 2
    for one, other in zip(small, large, strict=True):
        lengths = [name for name in one.settings if name.endswith("_m")]
        assert lengths
        assert [other.settings[name] for name in lengths] == pytest.approx(
            [4 * one.settings[name] for name in lengths], rel=0.02
        )


def test_scan_context_keeps_the_highest_point_of_a_bin():
    angles, radii = np.meshgrid(np.radians(np.arange(3.0, 360.0, 6.0)), np.arange(0.25, 10.0, 0.5))
    xy = np.c_[(radii * np.cos(angles)).ravel(), (radii * np.sin(angles)).ravel()]  # a point a bin
    heights = np.random.default_rng(0).uniform(1.0, 2.0, len(xy))
    heights[0] = 0.0
    points = np.r_[np.c_[xy, heights], np.c_[xy, 0.5 * heights]]
    method = scan_context.methods(Scale(spacing=0.5, side=20.0))[0]
    kept = method.describe(Observation(Submap(points, "bins"))).heights
    np.testing.assert_allclose(kept, heights.reshape(20, 60), atol=1e-9)


def test_without_odometry_icp_compares_nothing(places):
    method = methods_of(odometry_icp, places)[0]
    here, again = (method.describe(Observation(place.submap)) for place in places[:2])
    assert method.score(again, here).score == NOT_COMPARABLE


def test_the_random_classifier_knows_nothing():
    (method,) = random_score.methods(Scale(0.02, 10.0))
    names = [f"{number:06d}" for number in range(40)]
    scores = [method.score(a, b).score for a in names for b in names]
    assert len(set(scores)) == len(scores)
    assert np.quantile(scores, [0.25, 0.5, 0.75]) == pytest.approx([0.25, 0.5, 0.75], abs=0.03)
    assert np.isnan(method.score("a", "b").T_target_source).all()


@pytest.fixture(scope="module")
def small_places(world):
    frames = np.eye(4), MOVED, se3(4.0, 4.5, 0.2, 0.0, 0.0, 0.8)
    centres = (0.0, 0.0), (0.3, -0.2), (5.5, 5.5)
    clouds = [world(1).observe(T, at, seed=i) for i, (T, at) in enumerate(zip(frames, centres, strict=True))]
    return [Observation(Submap(cloud, str(number))) for number, cloud in enumerate(clouds)]


@pytest.mark.parametrize("kind", ["strict", "by_inliers"])
def test_ours_says_what_the_pipeline_says(small_places, kind, request):
    settings = request.getfixturevalue(kind)
    parameters = ours.parameters_for(settings, [place.submap for place in small_places])
    method = ours.method("terrainloop", settings, parameters)
    here, again, other = (method.describe(place) for place in small_places)
    candidate, match = compare(again, here, settings), method.score(again, here)
    assert candidate
    assert match.score == (candidate.inliers if kind == "by_inliers" else candidate.score)
    np.testing.assert_array_equal(match.T_target_source, candidate.T_target_source)
    assert np.linalg.norm((match.T_target_source - MOVED)[:2, 3]) < 0.1
    assert method.score(other, here).score < match.score


def test_the_papers_maps_have_hyperparameters_of_their_own():
    assert ours.parameters_for(Settings.preset("paper"), []) is None


def test_the_papers_score_is_nought_where_the_gradients_differ(small_places, by_inliers):
    match = by_inliers.match.model_copy(update={"max_ssd_ratio": 1e-6})
    settings = by_inliers.model_copy(update={"match": match})
    parameters = ours.parameters_for(settings, [place.submap for place in small_places])
    method = ours.method("paper", settings, parameters)
    here, again = (method.describe(place) for place in small_places[:2])
    assert method.score(again, here).score == 0.0


def test_a_package_that_is_missing_is_one_clear_line():
    with pytest.raises(TerrainLoopError, match="pip install no-such-package"):
        require("no_such_module", "no-such-package")


def test_a_package_that_lacks_a_library_of_the_system_is_not_to_be_installed_again(tmp_path, monkeypatch):
    line = "libusb-1.0.so.0: cannot open shared object file"
    (tmp_path / "half_installed.py").write_text(f"raise ImportError({line!r})")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(TerrainLoopError, match=r"found libusb-1\.0") as error:
        require("half_installed", "half-installed")
    assert "pip install" not in str(error.value)
    assert "\n" not in str(error.value)
