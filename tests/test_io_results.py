import csv
import pickle
from dataclasses import fields

import numpy as np
import pytest
from clouds_util import UTM, ground

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import se3
from terrainloop.io import read_loops, read_submaps, write_loops, write_submaps
from terrainloop.loop import LoopCandidate
from terrainloop.record import SubmapRecord
from terrainloop.submap import Submap

CONTRACT = (
    *("source", "target", "tx_m", "ty_m", "tz_m", "roll_rad", "pitch_rad", "yaw_rad"),
    *("inliers", "ssd", "overlap", "score", "accepted", "reason"),
)


def _candidates():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    common = {"ssd": 1 / 3, "ssd_ratio": 0.1, "overlap": 0.7, "score": 12.000000000000002}
    found = LoopCandidate(
        source="000007",
        target="000001",
        T_target_source=se3(*UTM, 0.02, -0.01, 3.0),
        covariance=root @ root.T,
        inliers=np.int64(17),
        accepted=np.bool_(True),
        reason='17 inliers, "sure"\nand certain',
        found_by="dense",
        correlation=0.1 + 0.2,
        log_nfa=-12.1,
        inlier_score=1 / 3,
        source_origin=np.array([1.0, 2.0, 3.0]),
        target_origin=UTM,
        **common,
    )
    none = LoopCandidate(
        source="ü 8",
        target="000001",
        T_target_source=np.eye(4),
        covariance=np.full((6, 6), np.nan),
        inliers=0,
        accepted=False,
        reason="",
        **{**common, "ssd": np.inf, "ssd_ratio": np.nan},
    )
    return [found, none]


def test_loops_round_trip(tmp_path):
    path = tmp_path / "loops.csv"
    write_loops(path, _candidates())
    for again, candidate in zip(read_loops(path), _candidates(), strict=True):
        for field in (field for field in fields(LoopCandidate) if field.name != "warp"):
            value, expected = getattr(again, field.name), getattr(candidate, field.name)
            tolerance = 1e-15 if field.name == "T_target_source" else 0  # through angles and back
            if isinstance(expected, str):
                assert value == expected
            else:
                np.testing.assert_allclose(value, expected, rtol=0, atol=tolerance, err_msg=field.name)
    assert [bool(loop) for loop in read_loops(path)] == [True, False]


def test_loops_are_written_again_byte_for_byte(tmp_path):
    write_loops(tmp_path / "a.csv", _candidates()[1:])
    write_loops(tmp_path / "b.csv", read_loops(tmp_path / "a.csv"))
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_loops_keep_the_contract(tmp_path):
    write_loops(tmp_path / "loops.csv", _candidates())
    with (tmp_path / "loops.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0])
    assert tuple(names[:14]) == CONTRACT
    assert names[14:21] == [
        "cov_x_x",
        "cov_x_y",
        "cov_x_z",
        "cov_x_roll",
        "cov_x_pitch",
        "cov_x_yaw",
        "cov_y_y",
    ]
    assert names[34:38] == ["cov_yaw_yaw", "ssd_ratio", "found_by", "correlation"]
    assert names[38:40] == ["log_nfa", "inlier_score"]
    assert names[40:] == [f"{end}_origin_{axis}_m" for end in ("source", "target") for axis in "xyz"]
    assert (rows[0]["accepted"], rows[1]["accepted"]) == ("true", "false")
    assert (rows[0]["inliers"], rows[0]["score"], rows[0]["ssd"]) == ("17", "12.000000000000002", str(1 / 3))
    assert (rows[0]["found_by"], rows[0]["correlation"]) == ("dense", "0.30000000000000004")
    assert (rows[1]["cov_x_x"], rows[1]["ssd"]) == ("nan", "inf")
    assert (rows[1]["found_by"], rows[1]["correlation"]) == ("", "nan")
    assert float(rows[0]["ty_m"]) == UTM[1]
    assert float(rows[0]["yaw_rad"]) == pytest.approx(3.0, abs=1e-15)
    assert float(rows[0]["cov_y_yaw"]) == _candidates()[0].covariance[1, 5]


def test_files_of_before_columns_were_added_are_read(tmp_path):
    path = tmp_path / "loops.csv"
    write_loops(path, _candidates()[1:])
    path.write_text(
        "".join(",".join(line.split(",")[:38]) + "\n" for line in path.read_text("utf-8").splitlines()),
        "utf-8",
    )
    (old,) = read_loops(path)
    assert old.source == "ü 8"
    assert np.isnan(old.log_nfa)
    assert not old.source_origin.any()


def test_columns_added_by_others_are_passed_over(tmp_path):
    path = tmp_path / "loops.csv"
    write_loops(path, _candidates()[1:])
    header, row = path.read_text(encoding="utf-8").splitlines()
    path.write_text(f"{header},ours\n{row},1\n", encoding="utf-8")
    assert read_loops(path)[0].source == "ü 8"


def test_no_candidates_are_a_header(tmp_path):
    write_loops(tmp_path / "loops.csv", [])
    assert len((tmp_path / "loops.csv").read_text().splitlines()) == 1
    assert read_loops(tmp_path / "loops.csv") == []


def test_a_killed_run_leaves_the_old_file(tmp_path):
    path = tmp_path / "loops.csv"
    write_loops(path, _candidates())
    before = path.read_bytes()

    def killed():
        yield _candidates()[1]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_loops(path, killed())
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["loops.csv"]


@pytest.mark.parametrize(
    ("column", "value"),
    [("inliers", "2.5"), ("score", "high"), ("accepted", "yes"), ("cov_yaw_yaw", ""), ("tx_m", "1,5")],
)
def test_a_bad_cell_is_named(tmp_path, column, value):
    path = tmp_path / "loops.csv"
    write_loops(path, _candidates())
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    rows[1][column] = value
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    # Line 4, because the first reason goes over two lines.
    with pytest.raises(TerrainLoopError, match=rf"column {column}; found .*loops\.csv, line 4;"):
        read_loops(path)


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"source,target\na,b\n",
        b"\xff\xfe\x80",
        b'a,"b',
        b"a" * 200_000,
        ",".join(CONTRACT).encode() + b"\n1,2\n",
    ],
)
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "other.csv"
    if content is not None:
        path.write_bytes(content)
    for read in (read_loops, read_submaps):
        with pytest.raises(TerrainLoopError, match=r"other\.csv"):
            read(path)


def test_a_short_line_is_an_error(tmp_path):
    path = tmp_path / "loops.csv"
    write_loops(path, _candidates()[1:])
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(TerrainLoopError, match="line 2"):
        read_loops(path)


def _area(hull):
    x, y = (hull - hull[0]).T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def test_the_hull_holds_all_points_and_is_tight():
    points = ground() + UTM
    hull = SubmapRecord.of(Submap(points)).hull
    ahead = np.roll(hull, -1, axis=0) - hull
    behind = points[:, None, :2] - hull
    # Anticlockwise: every point lies left of every edge, but for the rounding to millimetres.
    distance = (ahead[:, 0] * behind[..., 1] - ahead[:, 1] * behind[..., 0]) / np.linalg.norm(ahead, axis=1)
    assert distance.min() > -1e-3
    nearest = np.abs(hull[:, None] - points[:, :2]).max(axis=2).min(axis=1)
    assert nearest.max() <= 0.00051


def test_the_hull_of_a_square():
    x, y = np.meshgrid(np.linspace(-2, 2, 21), np.linspace(0, 3, 21))
    record = SubmapRecord.of(Submap(np.column_stack([x.ravel(), y.ravel(), 0.1 * np.sin(x * y).ravel()])))
    assert {tuple(corner) for corner in record.hull} == {(-2, 0), (2, 0), (2, 3), (-2, 3)}
    assert _area(record.hull) == pytest.approx(12)
    assert (record.points, record.status, record.notes) == (441, "ok", "")


def test_submaps_round_trip(tmp_path):
    path = tmp_path / "submaps.csv"
    mended = SubmapRecord.of(Submap(np.concatenate([ground(), ground()[:9]]) + UTM, name="a", stamp=1.25))
    broken = SubmapRecord("b", 2.0, 0, "broken", notes="expected points, found none")
    write_submaps(path, [mended, broken])
    assert path.read_text().splitlines()[0] == "name,stamp,points,status,hull_m,notes,session"
    for again, record in zip(read_submaps(path), [mended, broken], strict=True):
        for field in ("name", "stamp", "points", "status", "notes", "session"):
            assert getattr(again, field) == getattr(record, field)
        assert np.array_equal(again.hull, record.hull)
        assert again.hull.shape[1] == 2
    assert "dropped 9" in mended.notes
    assert "; " in mended.notes


def test_the_hull_is_well_known_text(tmp_path):
    path = tmp_path / "submaps.csv"
    write_submaps(path, [SubmapRecord("a", 0.0, 100, "ok", np.array([[0.0, 0], [1.5, 0], [0, 2]]))])
    polygon = "POLYGON ((0.000 0.000, 1.500 0.000, 0.000 2.000, 0.000 0.000))"
    assert path.read_text().splitlines()[1] == f'a,0.0,100,ok,"{polygon}",,'


@pytest.mark.parametrize(
    ("column", "line"),
    [
        ("status", "a,0.0,100,fine,,"),
        ("hull_m", "a,0.0,100,ok,POINT (1 2),"),
        ("hull_m", 'a,0.0,100,ok,"POLYGON ((0 0, 1 0, 1 x, 0 0))",'),
        ("hull_m", 'a,0.0,100,ok,"POLYGON ((0 0, 1, 1 1, 0 0))",'),
        ("stamp", "a,noon,100,ok,,"),
        ("notes", "a,0.0,100,ok,"),
    ],
)
def test_a_bad_submap_line_is_named(tmp_path, column, line):
    path = tmp_path / "submaps.csv"
    path.write_text(f"name,stamp,points,status,hull_m,notes\n{line}\n")
    with pytest.raises(TerrainLoopError, match=rf"column {column}; found .*submaps\.csv, line 2;"):
        read_submaps(path)


def test_a_candidate_cannot_be_written_to_and_is_one_line():
    for candidate in (found := _candidates()[0], pickle.loads(pickle.dumps(found))):
        for name in ("T_target_source", "covariance", "source_origin", "target_origin"):
            with pytest.raises(ValueError, match="read-only"):
                getattr(candidate, name)[:] = 0
        assert repr(candidate).startswith("LoopCandidate('000007' to '000001', accepted: 17 inliers")
