"""`max_false_loops` is spent at most once, and where odometry says that loops are likely."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import World

from terrainloop.config import Settings
from terrainloop.detection.allowance import pairs_equivalent, plausible_by_odometry, share_of_query
from terrainloop.entry import MapEntry
from terrainloop.geometry import se3
from terrainloop.record import SubmapRecord


def test_all_queries_together_spend_no_more_than_there_is():
    for end in (1, 32, 33, 64, 1000, 100_000):
        assert 0 < sum(map(share_of_query, range(1, end + 1))) <= 1
    spent = np.cumsum([share_of_query(k) for k in range(1, 2**14 + 1)])
    # Epoch m ends at 32 * 2^(m - 1) submaps, when m / (m + 1) has been spent.
    for m in range(1, 10):
        assert spent[32 * 2 ** (m - 1) - 1] == pytest.approx(m / (m + 1))


def test_within_an_epoch_every_pair_may_spend_the_same():
    for first, last in ((1, 32), (33, 64), (513, 1024)):
        shares = [share_of_query(k) / k for k in range(first, last + 1)]
        assert np.ptp(shares) < 1e-12 * shares[0]


def test_a_mission_of_unknown_length_pays_little_for_that():
    """Against a mission whose pairs are known: 1.5 decades at query 1000, where 1 / (k (k + 1)) pays 3.3."""
    k, pairs = 1000, 1000 * 1001 / 2
    assert np.log10(k / share_of_query(k) / pairs) == pytest.approx(1.52, abs=0.02)


@pytest.mark.parametrize("plausible", [[True], [False], [True, False, False], [False, False], [True, True]])
def test_a_query_spends_its_share(plausible):
    among = pairs_equivalent(0.3, np.array(plausible))
    assert (1 / among).sum() == pytest.approx(0.3)


def test_half_is_spent_on_what_is_plausible():
    among = pairs_equivalent(1.0, np.array([True, True, *[False] * 8]))
    np.testing.assert_allclose(1 / among, [0.3, 0.3, *[0.05] * 8])
    assert pairs_equivalent(0.2, np.zeros(0, dtype=bool)).shape == (0,)


def entry(name, position=None, reach=3.0, session=""):
    hull = np.array([[-reach, 0], [0, -reach], [reach, 0], [0, reach]]) if reach else np.empty((0, 2))
    odometry = None if position is None else se3(*position, 0.0, 0.0, 0.0, 1.0)
    record = SubmapRecord(name, hull=hull, session=session, odometry=odometry)
    return replace(mapped(), record=record)


def mapped():
    return MapEntry.of(SubmapRecord("x"), World.of(0).map(shape=(20, 20)), Settings())


def test_what_odometry_says_is_apart_is_not_plausible():
    stored = [entry("a", (0, 0)), entry("b", (20, 0)), entry("c", (40, 0))]
    back = entry("e", (8.0, 0))
    # 32 m from c, 12 from b, 8 from a; it has travelled 40 + 32, 20 + 32, 32 m: up to 6 m + a tenth is near.
    np.testing.assert_array_equal(plausible_by_odometry(back, stored, []), [True, False, False])
    np.testing.assert_array_equal(plausible_by_odometry(entry("e", (10, 0)), stored, []), [True, True, False])
    on_the_way = [entry("d", (40, 80))]  # 160 m more, of which it may be off by a tenth
    np.testing.assert_array_equal(plausible_by_odometry(back, stored, on_the_way), [True, True, False])


@pytest.mark.parametrize(
    "far", [entry("b", None), entry("b", (900, 0), reach=None), entry("b", (900, 0), session="other")]
)
def test_what_is_not_known_to_be_apart_is_plausible(far):
    stored = [entry("a", (0, 0)), far]
    np.testing.assert_array_equal(plausible_by_odometry(entry("c", (1, 0)), stored, []), [True, True])


def test_without_odometry_all_is_plausible():
    assert plausible_by_odometry(entry("c"), [entry("a"), entry("b")], []).all()
    assert plausible_by_odometry(entry("c"), [], []).shape == (0,)
