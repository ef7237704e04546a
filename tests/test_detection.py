"""The detector: loops of a revisit, its database, and whole missions with a broken cloud."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from conftest import BROKEN, PLACES

from terrainloop.config import MatchSettings, Settings
from terrainloop.detection import detector as detecting
from terrainloop.detection.detector import LoopDetector, fit_database, map_submap
from terrainloop.detection.mission import detect_mission
from terrainloop.detection.run import CORRECTED, OF_A_RUN
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import parameters_of, se3, transform
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.io.missions import load_mission
from terrainloop.io.results import write_loops
from terrainloop.io.trajectories import read_trajectory
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mission_warp import warp_variance
from terrainloop.submap import Submap

PARAMETERS = Hyperparameters(0.4, 0.01, 0.011)
WHOLE = [name for name in PLACES if name != BROKEN]


def per_submap(settings):
    return settings.model_copy(update={"map": settings.map.model_copy(update={"fit": "submap"})})


@pytest.fixture(scope="module")
def submaps(mission_folder):
    return {submap.name: submap for submap in load_mission(mission_folder) if submap.name != BROKEN}


@pytest.fixture(scope="module")
def mapped(submaps, strict):
    return {name: map_submap(submap, strict, PARAMETERS) for name, submap in submaps.items()}


def run(mapped, settings, **options):
    """The detector, the loops of each submap, and every pair compared."""
    compared = []
    detector = LoopDetector(settings, parameters=PARAMETERS, on_pair=compared.append, **options)
    return detector, [detector.add_entry(submap) for submap in mapped.values()], compared


def pairs(candidates):
    return [(candidate.source, candidate.target) for candidate in candidates]


def assert_pose(loop, truth):
    middle = np.array([*PLACES["000000"].centre, 0.0])
    offset = transform(loop.T_target_source, middle) - transform(truth, middle)
    assert np.hypot(*offset[:2]) < 0.15
    assert abs(offset[2]) < 0.03
    turn = parameters_of(loop.T_target_source)[3:] - parameters_of(truth)[3:]
    assert np.abs(turn).max() < np.radians(3.0)


def test_a_revisit_is_a_loop_and_nothing_else_is(mapped, strict, true_loop):
    detector, found, _ = run(mapped, strict)
    loops = [loop for each in found for loop in each]
    assert pairs(loops) == [("000003", "000000")]  # source is the later one
    assert all(loop.accepted for loop in loops)
    assert_pose(loops[0], true_loop)
    assert list(detector.entries) == WHOLE
    assert detector.loops == loops


def test_every_pair_flows_through_the_sink(mapped, strict):
    detector, found, compared = run(mapped, strict.model_copy(update={"skip_recent": 0}))
    expected = [(a, b) for i, a in enumerate(WHOLE) for b in WHOLE[:i]]
    assert pairs(compared) == expected
    assert [c for c in compared if c] == [loop for each in found for loop in each] == detector.loops
    assert all(candidate.reason for candidate in compared)


@pytest.mark.parametrize("skip", [0, 1, 2, 99])
def test_recent_submaps_are_not_compared(mapped, strict, skip):
    _, _, compared = run(mapped, strict.model_copy(update={"skip_recent": skip}))
    distance = {WHOLE.index(a) - WHOLE.index(b) for a, b in pairs(compared)}
    assert distance == set(range(skip + 1, len(WHOLE)))


def test_workers_do_not_change_a_byte(mapped, strict, tmp_path):
    for workers in (1, 3):
        _, _, compared = run(mapped, strict.model_copy(update={"skip_recent": 0}), workers=workers)
        write_loops(tmp_path / f"{workers}.csv", compared)
    assert (tmp_path / "1.csv").read_bytes() == (tmp_path / "3.csv").read_bytes()


def test_a_name_that_is_taken_leaves_the_database_as_it_was(mapped, submaps, strict):
    detector, _, _ = run(mapped, strict)
    stored, loops = dict(detector.entries), list(detector.loops)
    for again in (
        lambda: detector.add_entry(mapped["000001"]),
        lambda: detector.add(Submap(submaps["000003"].points, name="000001")),
    ):
        with pytest.raises(TerrainLoopError, match="000001"):
            again()
        assert detector.entries == stored
        assert detector.loops == loops


def test_add_maps_and_compares(submaps, mapped, strict, true_loop):
    detector = LoopDetector(strict.model_copy(update={"skip_recent": 0}), parameters=PARAMETERS)
    assert detector.add(submaps["000000"]) == []
    (loop,) = detector.add(submaps["000003"])
    assert_pose(loop, true_loop)
    by_hand = mapped["000003"].gradient_map
    assert detector.entries["000003"].gradient_map.elevation.tobytes() == by_hand.elevation.tobytes()


def test_a_database_shares_its_hyperparameters(submaps, strict):
    detector = LoopDetector(strict)
    for name in ("000000", "000001"):
        detector.add(submaps[name])
    first, second = (stored.gradient_map.parameters for stored in detector.entries.values())
    assert first == detector.parameters
    assert replace(second, noise=first.noise) == first
    assert detector.parameters == fit_database([submaps["000000"]], strict)
    # What the clouds were made with, and near what the world is made of.
    assert detector.parameters.noise == pytest.approx(0.01, rel=0.3)
    assert 0.2 < detector.parameters.length_scale < 0.8


def test_known_hyperparameters_are_used(submaps, strict):
    detector = LoopDetector(strict, parameters=PARAMETERS)
    detector.add(submaps["000001"])
    used = detector.entries["000001"].gradient_map.parameters
    assert (used.length_scale, used.variance) == (PARAMETERS.length_scale, PARAMETERS.variance)
    assert detector.parameters == PARAMETERS


def test_each_submap_of_a_database_has_its_own_noise(submaps, strict):
    """The second as another sensor would have seen it, with errors four times as large."""
    cloud = submaps["000001"].points.copy()
    cloud[:, 2] += np.random.default_rng(0).normal(0, 0.04, len(cloud))
    detector = LoopDetector(strict)
    for submap in (submaps["000000"], Submap(cloud, name="rough")):
        detector.add(submap)
    first, second = (stored.gradient_map.parameters for stored in detector.entries.values())
    assert second.noise == pytest.approx(np.hypot(first.noise, 0.04), rel=0.15)
    assert replace(second, noise=first.noise) == first


def test_fixed_hyperparameters_of_every_submap_are_used_as_they_are(submaps, strict):
    known = map_submap(submaps["000001"], per_submap(strict), PARAMETERS)
    assert known.gradient_map.parameters == PARAMETERS


def test_per_submap_fit_gives_each_its_own(submaps, strict):
    thin = strict.map.model_copy(update={"fit": "submap", "max_points": 300, "resolution": 0.3})
    detector = LoopDetector(strict.model_copy(update={"map": thin}))
    for name in ("000000", "000001"):
        detector.add(submaps[name])
    first, second = (stored.gradient_map.parameters for stored in detector.entries.values())
    assert first != second
    assert detector.parameters is None


def test_a_submap_that_cannot_be_mapped_leaves_the_detector_as_it_was(submaps, strict):
    """The first submap has an absurd grid; its fit must not rule the database."""
    detector = LoopDetector(
        strict.model_copy(update={"map": strict.map.model_copy(update={"resolution": 1e-6})})
    )
    with pytest.raises(TerrainLoopError, match="pixels"):
        detector.add(submaps["000000"])
    assert detector.entries == {}
    assert detector.loops == []
    assert detector.parameters is None


@pytest.fixture
def told(monkeypatch):
    """Compares nothing; keeps what each query was told of the number of pairs."""
    kept = {}

    def compare_many(source, targets, settings, *, pairs, workers):
        if targets:
            kept[source.name] = np.broadcast_to(pairs, len(targets)).tolist()
        return [LoopCandidate.without_transform(source.name, t.name, "not compared") for t in targets]

    monkeypatch.setattr(detecting, "compare_many", compare_many)
    return kept


def named(mapped, name):
    entry = mapped["000000"]
    return replace(entry, record=replace(entry.record, name=name))


@pytest.mark.parametrize("skip", [0, 3])
def test_however_long_it_runs_max_false_loops_is_spent_once(told, mapped, strict, skip):
    """A pair may spend 1 / pairs of it; two epochs of `allowance` spend two thirds."""
    detector = LoopDetector(strict.model_copy(update={"skip_recent": skip}), null_scores=[], workers=2)
    for number in range(65 + skip):
        detector.add_entry(named(mapped, str(number)))
    assert [len(pairs) for pairs in told.values()] == list(range(1, 65))
    assert all(len(set(pairs)) == 1 for pairs in told.values())  # without odometry alike for all of a query
    assert sum(1 / n for pairs in told.values() for n in pairs) == pytest.approx(2 / 3)


def test_expected_pairs_share_max_false_loops_evenly(told, mapped, strict):
    detector = LoopDetector(strict, expected_pairs=77, null_scores=[])
    for number in range(10):
        detector.add_entry(named(mapped, str(number)))
    assert [n for pairs in told.values() for n in pairs] == pytest.approx([77] * 36)


def test_odometry_says_where_to_spend_it(told, mapped, strict):
    detector = LoopDetector(strict, expected_pairs=30, null_scores=[])
    for number, x in enumerate((0, 100, 200, 3)):
        entry = named(mapped, str(number))
        pose = se3(x, 0, 0, 0, 0, 0)
        hull = np.array([[-4.0, 0], [4, 0], [0, 4]])
        detector.add_entry(replace(entry, record=replace(entry.record, odometry=pose, hull=hull)))
    # Half of the 2 / 30 of the last query, which skips its neighbour, is for the first submap.
    *_, among = told.values()
    assert among == pytest.approx([20, 60])


@pytest.mark.parametrize("skip", [0, 1, 2, 3, 99])
def test_a_mission_knows_its_pairs(told, mission_folder, strict, skip):
    thin = strict.map.model_copy(update={"max_points": 100, "resolution": 0.5})
    settings = strict.model_copy(update={"map": thin, "skip_recent": skip})
    seen = []
    detect_mission(load_mission(mission_folder), settings, on_pair=seen.append)
    compared = [n for pairs in told.values() for n in pairs]
    assert len(compared) == len(seen) == sum(range(len(WHOLE) - skip))
    assert not compared or sum(1 / n for n in compared) == pytest.approx(1)


@pytest.fixture(scope="module")
def detected(mission_folder, strict, tmp_path_factory):
    stages = []
    run = detect_mission(
        mission_folder,
        strict,
        output=tmp_path_factory.mktemp("run"),
        on_progress=lambda *told: stages.append(told),
    )
    return run, stages


def test_mission_goes_on_past_a_broken_cloud(detected, true_loop):
    run, _ = detected
    assert [record.name for record in run.submaps] == list(PLACES)
    assert [record.status for record in run.submaps] == ["ok", "ok", "broken", "ok", "ok"]
    broken = run.submaps[2]
    assert broken.points == 0
    assert broken.hull.shape == (0, 2)
    assert "expected" in broken.notes
    assert list(run.entries) == WHOLE
    assert pairs(run.loops) == [("000003", "000000")]
    assert_pose(run.loops[0], true_loop)


def test_mission_maps_share_their_hyperparameters_but_not_the_noise(detected):
    run, _ = detected
    used = [stored.gradient_map.parameters for stored in run.entries.values()]
    assert {replace(each, noise=run.parameters.noise) for each in used} == {run.parameters}
    assert len(set(used)) == len(used)
    assert [each.noise for each in used] == pytest.approx([run.parameters.noise] * len(used), rel=0.2)


def test_mission_reports_its_progress(detected):
    _, stages = detected
    done = [("maps", n, 5) for n in range(1, 6)]
    done += [
        ("mirror images", n, 2) for n in range(1, 3)
    ]  # two submaps have earlier ones that are not skipped
    assert stages == done + [("pairs", n, 4) for n in range(1, 5)]


def test_poses_of_a_mission_with_odometry_are_corrected_and_written(detected):
    run, _ = detected
    written = read_trajectory(run.folder / "poses.tum")
    np.testing.assert_allclose(written.poses, run.corrected.poses, atol=1e-9)
    assert len(written) == len(run.corrected.graph.names)
    _, values = gtsam.readG2o(str(run.folder / "graph.g2o"), True)
    assert values.size() == len(written)


def test_poses_that_cannot_be_corrected_are_a_warning(detected, monkeypatch):
    run = replace(detected[0], corrected=None)
    monkeypatch.setitem(sys.modules, "gtsam", None)
    loop = replace(next(iter(run.pairs())), accepted=True, covariance=np.eye(6))
    without = replace(run, loops=(loop,)).with_corrected_poses()
    assert without.corrected is None
    assert without.warnings[-1].startswith("no corrected poses: expected GTSAM")


def test_mission_is_the_same_for_two_processes(detected, mission_folder, strict, tmp_path):
    one, two = detected[0], detect_mission(mission_folder, strict, output=tmp_path, workers=2)
    names = {path.name for path in one.folder.iterdir()}
    assert names == {*OF_A_RUN, *CORRECTED}  # the mission has odometry
    for name in names:
        assert (one.folder / name).read_bytes() == (two.folder / name).read_bytes()
    assert one.num_pairs == two.num_pairs == 3


def test_covariances_are_those_of_the_warp_of_all_loops_so_far(mapped, strict):
    again = {
        f"{name} again": replace(submap, record=replace(submap.record, name=f"{name} again"))
        for name, submap in mapped.items()
    }
    detector, found, _ = run(mapped | again, strict.model_copy(update={"skip_recent": 0}), null_scores=[])
    assert sum(map(bool, found)) >= 3
    known = []
    for loops in found:
        known += [loop.warp for loop in loops]
        for loop in loops:
            variance = warp_variance(known, strict.calibration)
            np.testing.assert_array_equal(loop.covariance, loop.warp.covariance(variance))
    assert [loop.warp for loop in detector.loops] == known


def test_loops_of_a_mission_have_the_covariance_of_the_whole_mission(detected, strict):
    run, _ = detected
    variance = warp_variance([loop.warp for loop in run.loops], strict.calibration)
    for loop in run.loops:
        np.testing.assert_array_equal(loop.covariance, loop.warp.covariance(variance))


def test_mission_with_a_fit_for_each_submap(mission_folder, strict):
    thin = strict.map.model_copy(update={"fit": "submap", "max_points": 250, "resolution": 0.3})
    settings = strict.model_copy(update={"map": thin, "match": MatchSettings(iterations=10)})
    run = detect_mission(mission_folder, settings)
    used = {stored.gradient_map.parameters for stored in run.entries.values()}
    assert len(used) == len(WHOLE)
    assert run.parameters is None


@pytest.mark.parametrize("fit", ["database", "submap"])
def test_mission_of_broken_clouds_is_an_error(tmp_path, strict, fit):
    for name in "ab":
        (tmp_path / f"{name}.ply").write_bytes(b"no cloud")
    settings = strict if fit == "database" else per_submap(strict)
    with pytest.raises(TerrainLoopError, match=r"usable.*2 broken"):
        detect_mission(load_mission(tmp_path), settings)


def test_the_detector_takes_the_knob(strict):
    assert LoopDetector(strict, max_false_loops=0.3).settings.match.max_false_loops == 0.3
    assert LoopDetector(max_false_loops=0.3).settings == Settings(max_false_loops=0.3)
    with pytest.raises(TerrainLoopError, match="positive max_false_loops"):
        LoopDetector(strict, max_false_loops=0)


@pytest.mark.parametrize("settings", ["paper", 3, {}])
def test_what_is_no_settings_is_refused(settings):
    with pytest.raises(TerrainLoopError, match="expected settings"):
        LoopDetector(settings)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("parameters", 3),
        ("expected_pairs", -1),
        ("expected_pairs", "many"),
        ("expected_pairs", 2.5),
        ("null_scores", [1.0, np.nan]),
        ("null_scores", "abc"),
        ("sensor_patterns", []),
        ("on_pair", 3),
    ],
)
def test_impossible_arguments_are_refused(name, value):
    expected = {"parameters": "Hyperparameters", "sensor_patterns": "SensorPatterns"}.get(name, name)
    with pytest.raises(TerrainLoopError, match=f"expected.*{expected}"):
        LoopDetector(**{name: value})


def test_what_is_no_entry_is_refused(strict):
    with pytest.raises(TerrainLoopError, match="expected a MapEntry"):
        LoopDetector(strict).add_entry(3)


@pytest.mark.parametrize("submap", [np.zeros((300, 3)), "a.ply", None])
def test_what_is_no_submap_is_refused(strict, submap):
    with pytest.raises(TerrainLoopError, match="expected a Submap"):
        LoopDetector(strict).add(submap)


@pytest.mark.parametrize(
    "odometry",
    [
        np.eye(4).astype(object),
        np.eye(4).astype(str),
        np.eye(3),
        np.eye(4).tolist(),
        np.zeros((4, 4)),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([2.0, 1.0, 1.0, 1.0]),
        np.eye(4) + np.eye(4)[:, [3, 0, 1, 2]],
        se3(1e12, 0, 0, 0, 0, 0),
        se3(np.nan, 0, 0, 0, 0, 0),
    ],
)
def test_what_is_no_rigid_odometry_is_refused(submaps, strict, odometry):
    detector = LoopDetector(strict)
    with pytest.raises(TerrainLoopError, match="odometry as a rigid transform"):
        detector.add(next(iter(submaps.values())), odometry)
    assert not detector.entries


def test_submaps_without_a_name_are_numbered(submaps, strict):
    detector = LoopDetector(strict, parameters=PARAMETERS)
    for name in ("000000", "000001"):
        detector.add(Submap(submaps[name].points))
    assert list(detector.entries) == ["submap_000000", "submap_000001"]


def test_threads_may_share_a_detector(mapped, strict):
    """Every pair is compared once, whoever adds which submap when."""
    compared = []
    settings = strict.model_copy(update={"skip_recent": 0})
    detector = LoopDetector(settings, parameters=PARAMETERS, on_pair=compared.append)
    with ThreadPoolExecutor(4) as pool:
        loops = [loop for found in pool.map(detector.add_entry, mapped.values()) for loop in found]
    count = len(mapped)
    assert len({frozenset(pair) for pair in pairs(compared)}) == len(compared) == count * (count - 1) // 2
    assert len(loops) == len(detector.loops) == 1


def test_sessions_may_repeat_names(mapped, strict):
    again = [
        replace(entry, record=replace(entry.record, session="second")) for entry in list(mapped.values())[:2]
    ]
    detector = LoopDetector(strict, parameters=PARAMETERS)
    for entry in [*list(mapped.values())[:2], *again]:
        detector.add_entry(entry)
    assert list(detector.entries) == ["000000", "000001", "second/000000", "second/000001"]
