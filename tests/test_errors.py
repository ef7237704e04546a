"""The one family of errors."""

import pickle

from terrainloop.errors import TerrainLoopError


def test_what_is_quoted_is_short_and_keeps_both_ends():
    error = TerrainLoopError(expected="a", found="begin " + "x" * 1_000_000 + " end", mend="b")
    assert len(str(error)) < 350
    assert "found begin xxx" in str(error)
    assert "xxx end; b" in str(error)
    assert len(error.found) == 300


def test_what_is_short_is_kept():
    assert TerrainLoopError(expected="a", found="x" * 300, mend="b").found == "x" * 300


def test_it_is_one_line_that_no_terminal_obeys():
    error = TerrainLoopError(expected="a\n", found="b\x1b[2J\r\udcff é", mend="c\t")
    assert str(error) == r"expected a\n; found b\x1b[2J\r\udcff é; c\t"


def test_it_survives_processes():
    error = TerrainLoopError(expected="a", found="y" * 500, mend="b")
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.found) == (str(error), error.found)
