"""Order of files by name: what is clear, what is refused, what the stamps decide."""

import random

import numpy as np
import pytest

from terrainloop.errors import TerrainLoopError
from terrainloop.io.ordering import order_of_names

CLEAR = {
    "counters": ["cloud8", "cloud9", "cloud10", "cloud100"],
    "counters after other numbers": ["rover3_map_9", "rover3_map_10", "rover3_map_11"],
    "two counters": ["r1_s9", "r1_s10", "r2_s1", "r2_s9", "r2_s10"],
    "seconds": ["8.5", "9.5", "10.5"],
    "copies": ["scan", "scan (2)", "scan (9)", "scan (10)"],
    "seconds and nanoseconds": ["1700000000_5", "1700000000_70", "1700000000_123456789", "1700000001_4"],
    "dates": ["2023-12-31", "2024-1-2", "2024-1-10", "2024-02-01"],
    "dates and times": ["20231231_235959", "20240101_000001", "20240203_010203"],
    "times in ISO 8601": ["2024-01-05T23-10-59", "2024-01-06T01-02-03", "2024-02-01T00-00-01"],
    "versions of three numbers": ["1.2.9", "1.2.10", "1.10.1"],
    "negative numbers": ["-12", "-2", "0", "3", "11"],
    "negative numbers after a name": ["x_-10", "x_-9", "x_9", "x_10"],
    "hyphens": ["scan-8", "scan-9", "scan-10"],
    "suffixes": ["9_left", "9_right", "10_left", "10_right"],
    "years first, short": ["24-01-15", "24-01-16", "24-02-03"],
    "times": ["10-05-30", "10-06-10", "11-01-02"],
    "words with months in them": ["decimated_1", "junction_2", "marble_3"],
    "digits of other scripts": ["\u0669", "\u0661\u0660"],
    "counter and time": ["1_1700000009.5", "2_1700000010.25", "10_1700000011.125"],
    "words": ["alpha", "beta", "gamma"],
    "prefixes in order of the counter": ["a_1", "b_2", "c_3", "c_10"],
    "letters after a counter": ["0a", "0b", "1a", "10a"],
}

AMBIGUOUS = {
    "decimals or versions": ["3.9", "3.10"],
    "decimals or versions, named": ["v1.25", "v1.5"],
    "all with a hyphen": ["-7", "-12"],
    "prefixes against the counter": ["evening_1", "dawn_2"],
    "numbered prefixes against the counter": ["robot1_map_12", "robot2_map_11"],
    "days first": ["15-01-2024", "03-02-2024"],
    "days first, dots": ["5.9.2024", "12.10.2024"],
    "days first, short years": ["15-01-24", "03-02-24"],
    "days first, no separators": ["15012024", "03022024"],
    "months": ["2024Jan05", "2024Feb07"],
    "months at length": ["april", "march", "may"],
    "weekdays": ["monday", "friday"],
    "times of day": ["1_morning", "2_afternoon"],
    "number words": ["site_one", "site_two", "site_three"],
    "Roman numerals": ["leg_IV", "leg_IX", "leg_V"],
    "superscripts": ["scan\u00b9", "scan\u00b2"],
    "am and pm": ["9-30AM", "1-15PM"],
    "capitals": ["B", "a"],
    "only zeros differ": ["7", "07"],
    "hexadecimal": ["9", "a", "10"],
    "padded hexadecimal": ["0f", "10", "1f", "20"],
    "hashes": ["1b2f", "12cc", "e04a"],
    "counters in letters": ["cloud_z", "cloud_aa", "cloud_ab"],
    "punctuation": ["scan-1", "scan0", "scan1"],
}


def _shuffled(names):
    return random.Random(0).sample(names, len(names))


def _uninformative(names):
    return 500.0 + 7.0 * np.arange(len(names))


@pytest.mark.parametrize("kind", CLEAR)
def test_clear_names_are_put_in_natural_order(kind, caplog):
    names = _shuffled(CLEAR[kind])
    for stamps in ([], [_uninformative(names)]):
        assert [names[i] for i in order_of_names(names, stamps)] == CLEAR[kind]
    assert not caplog.records


@pytest.mark.parametrize("kind", AMBIGUOUS)
def test_ambiguous_names_are_refused_with_poses_and_reported_without(kind, caplog):
    names = _shuffled(AMBIGUOUS[kind])
    with pytest.raises(TerrainLoopError, match="one possible order") as caught:
        order_of_names(names, [_uninformative(names)])
    assert any(name in str(caught.value) for name in names)
    assert not caplog.records
    assert sorted(order_of_names(names)) == list(range(len(names)))
    assert ["ambiguous" in record.getMessage() for record in caplog.records] == [True]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["3.10", "3.9"], [3.1, 3.9]),
        (["1700000000_25", "1700000000_5"], [1700000000.25, 1700000000.5]),
        (["1700000000_5", "1700000000_25000000"], [1700000000.000000005, 1700000000.025]),
        (["robot2_1700000003.5", "robot1_1700000007.5"], [1700000003.5, 1700000007.5]),
        (["b-1700000001000000000", "a-1700000002000000000"], [1700000001.0, 1700000002.0]),
        (["evening_1", "dawn_2"], [1.0, 2.0]),
        (["-7", "-2"], [-7.0, -2.0]),
    ],
)
def test_stamps_that_are_in_the_names_decide(names, stamps):
    order = order_of_names(names[::-1], [np.array(stamps)])
    assert [names[::-1][i] for i in order] == names


def test_an_index_may_start_elsewhere():
    assert order_of_names(["1", "2", "3"], [np.arange(3.0)]) == [0, 1, 2]


@pytest.mark.parametrize(
    ("names", "stamps", "said"),
    [
        (["s1", "s2", "s3"], [3.0, 1.0, 2.0], "stamp 1 after 3"),
        (["1700000001.5", "1700000002.5", "1700000003.5"], np.arange(3) + 1700000000.5, "1700000001.5"),
        (
            ["1700000001500", "1700000002500", "1700000003500"],
            np.arange(3) + 1700000002.5,
            "stamp 1700000003.5 where",
        ),
    ],
)
def test_stamps_that_contradict_the_names_are_refused(names, stamps, said):
    with pytest.raises(TerrainLoopError, match=said):
        order_of_names(names, [np.array(stamps)])


def test_repeated_stamps_are_reported(caplog):
    assert order_of_names(["a", "b", "c"], [np.array([1.0, 1.0, 2.0])]) == [0, 1, 2]
    assert ["repeats" in record.getMessage() for record in caplog.records] == [True]


def test_names_of_any_length_make_a_short_message():
    names = ["x" * 250 + "_2", "w" * 250 + "_3", "v" * 250 + "_1"]
    with pytest.raises(TerrainLoopError) as caught:
        order_of_names(names, [_uninformative(names)])
    assert len(str(caught.value)) < 500
