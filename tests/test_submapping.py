"""Scans are joined into upright submaps of a bounded length, in bounded memory."""

import numpy as np
import pytest

from terrainloop.geometry import inverse, se3, transform
from terrainloop.scan import PosedScan, Scan
from terrainloop.slam import submapping
from terrainloop.slam.submapping import LENGTH_OF_REACH, RANGE_OF_REACH, Submapper

T_BODY_SENSOR = se3(0.2, 0.1, 1.1, 0.1, 0.4, -0.2)


def ground(xy):
    return 0.2 * np.sin(xy[:, 0]) * np.cos(0.7 * xy[:, 1])


def scan_from(T_world_sensor, stamp, *, reach=5.0, count=800, seed=0):
    """Points of the ground within a disc below the sensor, in its frame."""
    rng = np.random.default_rng([seed, int(10 * stamp)])
    radius, angle = reach * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    xy = T_world_sensor[:2, 3] + np.c_[radius * np.cos(angle), radius * np.sin(angle)]
    return Scan(transform(inverse(T_world_sensor), np.c_[xy, ground(xy)]), stamp)


def straight(metres, step=0.25, **options):
    for k, x in enumerate(np.arange(0, metres, step)):
        T = se3(x, 0, 0, 0, 0, 0.3) @ T_BODY_SENSOR
        yield PosedScan(scan_from(T, float(k), **options), T)


def submaps_of(scans, **options):
    submapper = Submapper(**options)
    found = [submap for posed in scans if (submap := submapper.add(posed))]
    last = submapper.finish()
    return [*found, *([last] if last else [])]


def test_points_lie_on_the_ground_where_odometry_puts_them():
    for posed in submaps_of(straight(12.0), length=4.0):
        world = transform(posed.T_world_submap, posed.submap.points)
        np.testing.assert_allclose(world[:, 2], ground(world[:, :2]), atol=1e-9)
        assert posed.T_world_submap[2, 2] == 1.0  # upright


def test_submaps_are_as_long_as_they_should_be():
    submaps = submaps_of(straight(20.0), length=4.0)
    assert [posed.submap.name for posed in submaps] == [f"{k:06d}" for k in range(5)]
    along = [posed.T_world_submap[0, 3] for posed in submaps]
    np.testing.assert_allclose(np.diff(along[:-1]), 4.25, atol=0.3)
    assert all(posed.submap.stamp in range(80) for posed in submaps)


@pytest.mark.parametrize("reach", [3.0, 6.0, 12.0])
def test_the_length_follows_from_how_far_the_sensor_sees(reach):
    submaps = submaps_of(straight(4 * reach, step=reach / 20, reach=reach))
    along = np.array([posed.T_world_submap[0, 3] for posed in submaps])
    seen = np.hypot(1.1, 0.9**0.5 * reach)  # the 90th percentile of a disc, from the mast
    assert np.median(np.diff(along)) == pytest.approx(LENGTH_OF_REACH * seen, rel=0.12)


def test_what_is_far_or_of_the_vehicle_is_left_out():
    T = T_BODY_SENSOR
    scan = scan_from(T, 0.0)
    deck = np.random.default_rng(0).uniform(-0.25, 0.25, (200, 3))
    far = np.array([[60.0, 0.0, 0.0], [0.0, 45.0, 0.0]])
    (submap,) = submaps_of([PosedScan(Scan(np.vstack([scan.points, deck, far]), 0.0), T)])
    assert len(submap.submap) == len(scan)
    reach = np.percentile(np.linalg.norm(scan.points, axis=1), 90)
    assert np.linalg.norm(submap.submap.points, axis=1).max() < RANGE_OF_REACH * reach + 1.2


def test_a_vehicle_that_stands_still_adds_nothing():
    T = T_BODY_SENSOR
    still = [PosedScan(scan_from(T, float(k)), T) for k in range(50)]
    (submap,) = submaps_of(still)
    assert len(submap.submap) == 800


def test_a_turn_on_the_spot_ends_a_submap():
    poses = [se3(0, 0, 0, 0, 0, angle) @ T_BODY_SENSOR for angle in np.arange(0, 20, 0.2)]
    submaps = submaps_of([PosedScan(scan_from(T, float(k)), T) for k, T in enumerate(poses)], length=100.0)
    assert len(submaps) == 4  # 20 radians


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(submapping, "MAX_SCAN_POINTS", 300)
    monkeypatch.setattr(submapping, "MAX_SUBMAP_POINTS", 1000)
    submapper = Submapper(length=25.0)
    for posed in straight(20.0, step=0.5):
        submapper.add(posed)
        assert max(map(len, submapper._points), default=0) <= 300
    submap = submapper.finish()
    assert submap is not None
    assert len(submap.submap) == 1000


def test_points_are_drawn_at_random_and_the_same_each_time(monkeypatch):
    monkeypatch.setattr(submapping, "MAX_SUBMAP_POINTS", 1500)
    first, second = (submaps_of(straight(3.0), length=100.0)[0].submap.points for _ in range(2))
    np.testing.assert_array_equal(first, second)
    all_of_it = submaps_of(straight(3.0), length=100.0, seed=1)[0].submap.points
    assert not np.array_equal(first, all_of_it)
    assert abs(first[:, 0].mean() - all_of_it[:, 0].mean()) < 0.3


def test_scans_without_ground_make_no_submap(caplog):
    T = T_BODY_SENSOR
    empty = [PosedScan(Scan(np.empty((0, 3)), float(k)), T) for k in range(5)]
    assert submaps_of(empty) == []
    few = [PosedScan(Scan(np.random.default_rng(0).uniform(1, 2, (20, 3)), 0.0), T)]
    assert submaps_of(few) == []
    assert "no submap of 1 scans" in caplog.text


def test_clouds_of_a_mission_are_submaps_already():
    scans = list(straight(3.0, step=1.0))
    submaps = submaps_of(scans, each_scan=True)
    assert [len(posed.submap) for posed in submaps] == [len(posed.scan) for posed in scans]
    assert [posed.submap.stamp for posed in submaps] == [posed.scan.stamp for posed in scans]
