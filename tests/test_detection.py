"""The detector: loops of a revisit, its database, and whole missions with a broken cloud."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import BROKEN, PLACES

from terrainloop.config import MatchSettings
from terrainloop.detection import detector as detecting
from terrainloop.detection.detector import LoopDetector, fit_database, map_submap
from terrainloop.detection.mission import detect_mission
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import parameters_of, transform
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.io.missions import load_mission
from terrainloop.io.results import write_loops, write_submaps
from terrainloop.loop import LoopCandidate
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
    detector = LoopDetector(settings, parameters=PARAMETERS, **options)
    return detector, [detector.add_mapped(submap) for submap in mapped.values()]


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
    detector, found = run(mapped, strict)
    loops = [loop for each in found for loop in each]
    assert pairs(loops) == [("000003", "000000")]  # source is the later one
    assert all(loop.accepted for loop in loops)
    assert_pose(loops[0], true_loop)
    assert list(detector.submaps) == WHOLE


def test_candidates_hold_the_rejected_pairs_too(mapped, strict):
    detector, found = run(mapped, strict.model_copy(update={"skip_recent": 0}))
    expected = [(a, b) for i, a in enumerate(WHOLE) for b in WHOLE[:i]]
    assert pairs(detector.candidates) == expected
    assert [c for c in detector.candidates if c] == [loop for each in found for loop in each]
    assert all(candidate.reason for candidate in detector.candidates)


@pytest.mark.parametrize("skip", [0, 1, 2, 99])
def test_recent_submaps_are_not_compared(mapped, strict, skip):
    detector, _ = run(mapped, strict.model_copy(update={"skip_recent": skip}))
    distance = {WHOLE.index(a) - WHOLE.index(b) for a, b in pairs(detector.candidates)}
    assert distance == set(range(skip + 1, len(WHOLE)))


def test_workers_do_not_change_a_byte(mapped, strict, tmp_path):
    for workers in (1, 3):
        detector, _ = run(mapped, strict.model_copy(update={"skip_recent": 0}), workers=workers)
        write_loops(tmp_path / f"{workers}.csv", detector.candidates)
    assert (tmp_path / "1.csv").read_bytes() == (tmp_path / "3.csv").read_bytes()


def test_a_name_that_is_taken_leaves_the_database_as_it_was(mapped, submaps, strict):
    detector, _ = run(mapped, strict)
    stored, candidates = dict(detector.submaps), list(detector.candidates)
    for again in (
        lambda: detector.add_mapped(mapped["000001"]),
        lambda: detector.add(Submap(submaps["000003"].points, name="000001")),
    ):
        with pytest.raises(TerrainLoopError, match="000001"):
            again()
        assert detector.submaps == stored
        assert detector.candidates == candidates


def test_add_maps_and_compares(submaps, mapped, strict, true_loop):
    detector = LoopDetector(strict.model_copy(update={"skip_recent": 0}), parameters=PARAMETERS)
    assert detector.add(submaps["000000"]) == []
    (loop,) = detector.add(submaps["000003"])
    assert_pose(loop, true_loop)
    by_hand = mapped["000003"].gradient_map
    assert detector.submaps["000003"].gradient_map.elevation.tobytes() == by_hand.elevation.tobytes()


def test_a_database_shares_its_hyperparameters(submaps, strict):
    detector = LoopDetector(strict)
    for name in ("000000", "000001"):
        detector.add(submaps[name])
    used = [stored.gradient_map.parameters for stored in detector.submaps.values()]
    assert used == [detector.parameters] * 2
    assert detector.parameters == fit_database([submaps["000000"]], strict)
    # What the clouds were made with, and near what the world is made of.
    assert detector.parameters.noise == pytest.approx(0.01, rel=0.3)
    assert 0.2 < detector.parameters.length_scale < 0.8


def test_known_hyperparameters_are_used(submaps, strict):
    detector = LoopDetector(strict, parameters=PARAMETERS)
    detector.add(submaps["000001"])
    assert detector.submaps["000001"].gradient_map.parameters == PARAMETERS


def test_per_submap_fit_gives_each_its_own(submaps, strict):
    thin = strict.map.model_copy(update={"fit": "submap", "max_points": 300, "resolution": 0.3})
    detector = LoopDetector(strict.model_copy(update={"map": thin}))
    for name in ("000000", "000001"):
        detector.add(submaps[name])
    first, second = (stored.gradient_map.parameters for stored in detector.submaps.values())
    assert first != second
    assert detector.parameters is None


def test_a_submap_that_cannot_be_mapped_leaves_the_detector_as_it_was(submaps, strict):
    """The first submap has an absurd grid; its fit must not rule the database."""
    detector = LoopDetector(
        strict.model_copy(update={"map": strict.map.model_copy(update={"resolution": 1e-6})})
    )
    with pytest.raises(TerrainLoopError, match="pixels"):
        detector.add(submaps["000000"])
    assert detector.submaps == {}
    assert detector.candidates == []
    assert detector.parameters is None


@pytest.fixture
def told(monkeypatch):
    """Compares nothing; keeps what each query was told of the number of pairs."""
    kept = {}

    def compare(source, target, settings, *, pairs):
        kept.setdefault(source.name, []).append(pairs)
        return LoopCandidate.without_transform(source.name, target.name, "not compared")

    monkeypatch.setattr(detecting, "compare", compare)
    return kept


@pytest.mark.parametrize("skip", [0, 3])
def test_however_long_it_runs_max_false_loops_is_shared_out_once(told, strict, skip):
    """Each pair may spend 1 / pairs of it; all of them together one whole, and nearly that."""
    detector = LoopDetector(strict.model_copy(update={"skip_recent": skip}), workers=2)
    for number in range(60):
        detector.add_mapped(SimpleNamespace(name=str(number)))
    assert [len(pairs) for pairs in told.values()] == list(range(1, 60 - skip))
    assert all(len(set(pairs)) == 1 for pairs in told.values())  # alike for all of a query
    shares = np.array([sum(1 / n for n in pairs) for pairs in told.values()])
    assert 0.95 < shares.sum() <= 1.0
    assert (np.diff(shares) < 0).all()


def test_expected_pairs_share_max_false_loops_evenly(told, strict):
    detector = LoopDetector(strict, expected_pairs=77)
    for number in range(10):
        detector.add_mapped(SimpleNamespace(name=str(number)))
    assert {n for pairs in told.values() for n in pairs} == {77}


@pytest.mark.parametrize("skip", [0, 1, 2, 3, 99])
def test_a_mission_knows_its_pairs(told, mission_folder, strict, skip):
    thin = strict.map.model_copy(update={"max_points": 100, "resolution": 0.5})
    settings = strict.model_copy(update={"map": thin, "skip_recent": skip})
    detector, _ = detect_mission(load_mission(mission_folder), settings)
    compared = [n for pairs in told.values() for n in pairs]
    assert len(compared) == len(detector.candidates) == sum(range(len(WHOLE) - skip))
    assert all(n == len(compared) for n in compared)


@pytest.fixture(scope="module")
def detected(mission_folder, strict):
    stages = []
    detector, records = detect_mission(
        load_mission(mission_folder), strict, on_progress=lambda *told: stages.append(told)
    )
    return detector, records, stages


def test_mission_goes_on_past_a_broken_cloud(detected, true_loop):
    detector, records, _ = detected
    assert [record.name for record in records] == list(PLACES)
    assert [record.status for record in records] == ["ok", "ok", "broken", "ok", "ok"]
    broken = records[2]
    assert broken.points == 0
    assert broken.hull.shape == (0, 2)
    assert "expected" in broken.notes
    assert list(detector.submaps) == WHOLE
    loops = [candidate for candidate in detector.candidates if candidate]
    assert pairs(loops) == [("000003", "000000")]
    assert_pose(loops[0], true_loop)


def test_mission_maps_share_their_hyperparameters(detected):
    detector, _, _ = detected
    used = {stored.gradient_map.parameters for stored in detector.submaps.values()}
    assert used == {detector.parameters}


def test_mission_tells_its_progress(detected):
    _, _, stages = detected
    assert stages == [("maps", n, 5) for n in range(1, 6)] + [("pairs", n, 4) for n in range(1, 5)]


def test_mission_is_the_same_for_two_processes(detected, mission_folder, strict, tmp_path):
    parallel, records = detect_mission(load_mission(mission_folder), strict, workers=2)
    for name, detector, known in (("one", detected[0], detected[1]), ("two", parallel, records)):
        write_loops(tmp_path / f"{name}.csv", detector.candidates)
        write_submaps(tmp_path / f"{name}_submaps.csv", known)
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()
    assert (tmp_path / "one_submaps.csv").read_bytes() == (tmp_path / "two_submaps.csv").read_bytes()
    assert len(parallel.candidates) == 3


def test_mission_with_a_fit_for_each_submap(mission_folder, strict):
    thin = strict.map.model_copy(update={"fit": "submap", "max_points": 250, "resolution": 0.3})
    settings = strict.model_copy(update={"map": thin, "match": MatchSettings(iterations=10)})
    detector, _ = detect_mission(load_mission(mission_folder), settings)
    used = {stored.gradient_map.parameters for stored in detector.submaps.values()}
    assert len(used) == len(WHOLE)


@pytest.mark.parametrize("fit", ["database", "submap"])
def test_mission_of_broken_clouds_is_an_error(tmp_path, strict, fit):
    for name in "ab":
        (tmp_path / f"{name}.ply").write_bytes(b"no cloud")
    settings = strict if fit == "database" else per_submap(strict)
    with pytest.raises(TerrainLoopError, match=r"usable.*2 broken"):
        detect_mission(load_mission(tmp_path), settings)
