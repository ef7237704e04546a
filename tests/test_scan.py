"""Scans are checked when they are made."""

import numpy as np
import pytest

from terrainloop.errors import TerrainLoopError
from terrainloop.scan import Scan


def test_points_that_are_none_are_dropped_with_their_intensity():
    points = np.array([[0, 0, 0], [np.nan, 0, 0], [1, 2, 3], [np.inf, 0, 0], [1e12, 0, 0]], np.float32)
    scan = Scan(points, 5, intensity=np.arange(5))
    np.testing.assert_array_equal(scan.points, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_array_equal(scan.intensity, [0, 2])
    assert scan.stamp == 5.0
    assert len(scan) == 2
    assert not scan.points.flags.writeable


def test_a_scan_may_be_empty():
    assert len(Scan(np.empty((0, 3)))) == 0


@pytest.mark.parametrize(
    "arguments",
    [
        (np.zeros((3, 2)),),
        (np.zeros(3),),
        ("abc",),
        ([[1, 2, 3], [1, 2]],),
        (np.zeros((3, 3), complex),),
        (np.zeros((3, 3)), np.nan),
        (np.zeros((3, 3)), "now"),
        (np.zeros((3, 3)), 0.0, np.zeros(2)),
    ],
)
def test_what_is_no_scan_is_refused(arguments):
    with pytest.raises(TerrainLoopError, match="expected"):
        Scan(*arguments)
