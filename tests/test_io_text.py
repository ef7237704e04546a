"""Clouds in text: which columns are read, and what counts as a number."""

import numpy as np
import pytest
from clouds_util import ground

from terrainloop.errors import TerrainLoopError
from terrainloop.io import read_cloud

POINTS = ground()
X, Y, Z = POINTS.T
TIME = np.arange(len(POINTS)) * 0.01
INTENSITY = np.arange(len(POINTS)) % 255.0


def _lines(*columns, separator=" "):
    rows = np.column_stack(columns).tolist()
    return "".join(separator.join(map(repr, row)) + "\n" for row in rows)


def _read(tmp_path, text, suffix="csv"):
    path = tmp_path / f"a.{suffix}"
    path.write_text(text, encoding="utf-8", newline="")
    return read_cloud(path)


def _commas(*columns):
    return _lines(*columns, separator=",")


NAMED = {
    "units behind underscores": "t,x_m,y_m,z_m\n" + _commas(TIME, X, Y, Z),
    "units in brackets": "id;X [m];Y [m];Z [m]\n" + _lines(TIME, X, Y, Z, separator=";"),
    "units in parentheses": "time(s),X(m),Y(m),Z(m)\n" + _commas(TIME, X, Y, Z),
    "units in words": "time,x (metres),y (metres),z (meters)\n" + _commas(TIME, X, Y, Z),
    "units between blanks": "# t x [m] y [m] z [m]\n" + _lines(TIME, X, Y, Z),
    "units after a slash": "t,x/m,y/m,z/m\n" + _commas(TIME, X, Y, Z),
    "Easting and Northing": "Northing\tEasting\tElevation\n" + _lines(Y, X, Z, separator="\t"),
    "height last": "ID,East,North,Height\n" + _commas(TIME, X, Y, Z),
    "ParaView": '"RTData","Points:0","Points:1","Points:2"\n' + _commas(TIME, X, Y, Z),
    "ParaView, newer": '"Points_0","Points_1","Points_2","RTData"\n' + _commas(X, Y, Z, TIME),
    "CloudCompare": "//X Y Z Intensity\n" + _lines(X, Y, Z, TIME),
    "CloudCompare, reordered": "//R Z Y X\n" + _lines(TIME, Z, Y, X),
    "pandas, with an index": ",x,y,z\n" + _commas(TIME, X, Y, Z),
    "an index named #": "#,x,y,z\n" + _commas(TIME, X, Y, Z),
    "R": '"t" "x" "y" "z"\n' + _lines(TIME, X, Y, Z),
    "commas above blanks": "# t, x, y, z\n" + _lines(TIME, X, Y, Z),
    "blanks above commas": "t x y z\n" + _commas(TIME, X, Y, Z),
    "semicolons above tabs": "t;x;y;z\n" + _lines(TIME, X, Y, Z, separator="\t"),
    "trailing separators": "t,x,y,z,\n" + _commas(TIME, X, Y, Z).replace("\n", ",\n"),
    "trailing separators below": "t,x,y,z\n" + _commas(TIME, X, Y, Z).replace("\n", ",\n"),
    "an empty last column": "t,x,y,z,note\n" + _commas(TIME, X, Y, Z).replace("\n", ",\n"),
    "an empty first column": "note\tx\ty\tz\n\t" + _lines(X, Y, Z, separator="\t").replace("\n", "\n\t"),
    "a label before the names": "# columns: t x y z\n" + _lines(TIME, X, Y, Z),
    "comments around the names": "# made by hand\n# t x y z\n# 400 of them\n" + _lines(TIME, X, Y, Z),
    "names unknown beside": "curvy,x,blue-ish,y,z\n" + _commas(TIME, X, TIME, Y, Z),
    "position": "pos_x,pos_y,pos_z\n" + _commas(X, Y, Z),
    "a message of ROS": "time,point.x,point.y,point.z\n" + _commas(TIME, X, Y, Z),
    "coordinates both ways": "easting,northing,elevation,x,y,z\n" + _commas(TIME, TIME, TIME, X, Y, Z),
    "degrees beside": "lat,lon,x,y,z\n" + _commas(TIME, TIME, X, Y, Z),
    "normals before": "nx,ny,nz,x,y,z\n" + _commas(TIME, TIME, TIME, X, Y, Z),
    "CR alone": ("t,x,y,z\n" + _commas(TIME, X, Y, Z)).replace("\n", "\r"),
    "a count of points": "400\n" + _lines(X, Y, Z, TIME),
    "a title": "A scan of the yard\n" + _lines(X, Y, Z),
    "a sentence": "# frame: x forward, y left, z up\n" + _lines(X, Y, Z, TIME, TIME, TIME),
    "a sentence without commas": "# here x points forward y left z up\n" + _lines(X, Y, Z, TIME),
    "a sentence above three": "# z is up\n" + _lines(X, Y, Z),
    "a sentence with as many words": "# exported 2024-05-01 by v1.2\n" + _lines(X, Y, Z, TIME),
    "a sentence with two commas": "# x forward, y left, z up\n" + _lines(X, Y, Z),
    "a note on the names": "# x, y and z are in metres\n" + _lines(X, Y, Z),
    "nothing": _lines(X, Y, Z, TIME, TIME),
}
NAMED["every cell in quotes"] = '"t","x","y","z"\n' + "".join(
    ",".join(f'"{value!r}"' for value in row) + "\n" for row in np.c_[TIME, POINTS].tolist()
)


@pytest.mark.parametrize("suffix", ["csv", "xyz"])
@pytest.mark.parametrize("case", NAMED)
def test_columns_are_found(tmp_path, case, suffix):
    assert np.array_equal(_read(tmp_path, NAMED[case], suffix).points, POINTS)


UNCLEAR = {
    "fewer names than columns": "x,y,z\n" + _commas(TIME, X, Y, Z),
    "more names than columns": "x,y,z,t,i\n" + _commas(X, Y, Z, TIME),
    "fewer in a comment": "# x y z\n" + _lines(TIME, X, Y, Z),
    "more in a comment": "# t, x, y, z\n" + _lines(X, Y, Z),
    "unknown names": "t,a,b,c\n" + _commas(TIME, X, Y, Z),
    "unknown names of three": "a,b,c\n" + _commas(X, Y, Z),
    "unknown names in a comment": "# zeit rechts hoch hoehe\n" + _lines(TIME, X, Y, Z),
    "unknown names between commas": "# my time, to the right, ahead, above\n" + _lines(TIME, X, Y, Z),
    "unknown names between semicolons": "# ahead;to the right;above\n" + _lines(Y, X, Z),
    "unknown systems": "# Y_utm X_utm Z_utm\n" + _lines(Y, X, Z),
    "names of two": "t,x,y,height_above_ground\n" + _commas(TIME, X, Y, Z),
    "degrees": "longitude,latitude,altitude\n" + _commas(X, Y, Z),
    "degrees, shorter": "# lon lat alt\n" + _lines(X, Y, Z),
    "north first and down": "# north east down\n" + _lines(X, Y, Z),
    "millimetres": "x_mm,y_mm,z_mm\n" + _commas(X, Y, Z),
    "feet": "# X[ft] Y[ft] Z[ft]\n" + _lines(X, Y, Z),
    "heights in feet": "x [m],y [m],z [ft]\n" + _commas(X, Y, Z),
    "twice": "x,y,z,x,y,z\n" + _commas(X, Y, Z, Z, Y, X),
    "pixels and metres": "x,y,easting,northing,elevation\n" + _commas(TIME, TIME, X, Y, Z),
    "two headers": "# t x y z\n# x y z t\n" + _lines(TIME, X, Y, Z),
    "a grid": "ncols 4\nnrows 400\ncellsize 1\n" + _lines(X, Y, Z, TIME),
    "another count of points": "399\n" + _lines(X, Y, Z),
    "a sentence or names": "# x forward y left z up\n" + _lines(TIME, TIME, TIME, X, Y, Z),
    "another format": "OFF\n400 0 0\n" + _lines(X, Y, Z),
    "UTF-16": "".join(f"{c}\0" for c in "x,y,z\n" + _commas(X, Y, Z)),
    "separated by bars": "t|x|y|z\n" + _lines(TIME, X, Y, Z),
    "velocities": "vx,vy,vz,px\n" + _commas(TIME, X, Y, Z),
    "less in the first line": "1.0 2.0\n" + _lines(X, Y, Z),
    "letters without end": "a" * 70_000 + "\n" + _lines(X, Y, Z),
}


@pytest.mark.parametrize("suffix", ["csv", "xyz"])
@pytest.mark.parametrize("case", UNCLEAR)
def test_what_is_not_understood_is_refused(tmp_path, case, suffix):
    with pytest.raises(TerrainLoopError, match=rf"^expected .*a\.{suffix}"):
        _read(tmp_path, UNCLEAR[case], suffix)


MISSING = [
    "nan",
    "-nan",
    "1.#QNAN0",
    "-1.#IND",
    "1.#INF",
    "nan(ind)",
    "-nan(snan)",
    "inf",
    "NULL",
    "*",
    "N/A",
    "-",
    "1e400",
    "none",
    "#N/A",
    "NoData",
]


@pytest.mark.parametrize("separator", [" ", ",", "\t"])
@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("missing", [*MISSING, ""])
def test_points_without_a_value_are_dropped_openly(tmp_path, missing, axis, separator):
    if separator == " " and missing in ("", "#N/A"):
        pytest.skip("between blanks that is no cell")
    rows = [[repr(value) for value in row] for row in POINTS.tolist()]
    for row in rows[::9]:
        row[axis] = missing
    text = "\n".join(separator.join(row) for row in rows)
    submap = _read(tmp_path, text)
    whole = np.arange(len(POINTS)) % 9 != 0
    assert np.array_equal(submap.points, POINTS[whole])
    assert submap.repairs == (f"dropped {(~whole).sum()} of 400 points: not finite",)


NO_NUMBERS = [
    "0x1F",
    "1_000.5",
    "1d3",
    "1,5",
    "1.5f",
    "true",
    "\u0661",
    "1\u00a0234.5",
    "1'234.5",
    "12:30",
    "--5",
    "1e",
    "1.2.3",
    "NaN?!",
    "\u22121.5",
]


@pytest.mark.parametrize("cell", NO_NUMBERS)
@pytest.mark.parametrize("separator", [" ", ";"])
def test_other_words_are_refused(tmp_path, cell, separator):
    rows = [[repr(value) for value in row] for row in POINTS.tolist()]
    rows[200][2] = cell
    with pytest.raises(TerrainLoopError, match=r"a\.csv"):
        _read(tmp_path, "\n".join(separator.join(row) for row in rows))


def test_decimal_commas_between_commas_are_not_taken_for_columns(tmp_path):
    rows = [[f"{value:.3f}".replace(".", ",") for value in row] for row in POINTS.tolist()]
    with pytest.raises(TerrainLoopError, match="decimal commas"):
        _read(tmp_path, "\n".join(",".join(row) for row in rows))


def test_a_missing_value_that_leaves_no_gap_does_not_shift_the_columns(tmp_path):
    lines = _lines(X, Y, Z, INTENSITY).splitlines()
    lines[7] = "1.0 2.0      254.0"
    with pytest.raises(TerrainLoopError, match="3 values instead of 4"):
        _read(tmp_path, "\n".join(lines), "xyz")


def test_quotes_that_are_not_closed_swallow_no_lines(tmp_path):
    lines = _commas(X, Y, Z).splitlines()
    lines = [line + ',"a"' for line in lines]
    lines[100], lines[300] = lines[100][:-1], lines[300][:-1]
    with pytest.raises(TerrainLoopError, match=r"a\.csv"):
        _read(tmp_path, "\n".join(lines))


def test_comments_and_blank_lines_within(tmp_path):
    text = _lines(X, Y, Z).replace("\n", "\r\r\n\n # all 1 2 3\n", 50)
    assert np.array_equal(_read(tmp_path, text, "xyz").points, POINTS)


@pytest.mark.parametrize("line", ["a,b", "# a remark", '"1,2,3', "1 2"])
def test_a_search_for_numbers_is_bounded(tmp_path, line):
    path = tmp_path / "cloud.csv"
    path.write_text(100_000 * f"{line}\n")
    with pytest.raises(TerrainLoopError, match="more than 65536 characters above the first line of numbers"):
        read_cloud(path)


def test_a_line_without_end_is_refused(tmp_path):
    path = tmp_path / "cloud.xyz"
    path.write_text(100_000 * "1 2 ")
    with pytest.raises(TerrainLoopError, match="a line of 399999 characters"):
        read_cloud(path)
