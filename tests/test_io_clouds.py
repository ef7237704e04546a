import io
import pickle
import struct
import zipfile

import laspy
import numpy as np
import pytest
from clouds_util import DATA, UTM, ground
from pypcd4 import Encoding, PointCloud

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds import CLOUD_SUFFIXES, read_cloud, read_crs, write_cloud

POINTS = ground() + UTM
SMALL = ground().astype(np.float32)
# On a coarse raster, so that LZF finds something to compress.
RASTER = np.round(np.c_[np.repeat(np.arange(20), 20), np.tile(np.arange(20), 20), 8 * POINTS[:, 2] % 2]) / 2
INTENSITY = np.arange(400, dtype=np.float64)
FACES = b"".join(struct.pack("<B3i", 3, i, i + 1, i + 2) for i in range(9)) + struct.pack(
    "<B4i", 4, 0, 1, 2, 3
)
FACE_HEADER = "element face 10\nproperty list uchar int vertex_indices\n"


def _ply(encoding, body, properties, before="", after="", count=400, newline="\n"):
    header = (
        f"ply\nformat {encoding} 1.0\ncomment by hand\n{before}element vertex {count}\n{properties}{after}"
    )
    return (header + "end_header\n").replace("\n", newline).encode() + body


def _properties(kind, names="xyz"):
    return "".join(f"property {kind} {name}\n" for name in names)


def _lines(*columns, separator=" "):
    rows = np.column_stack(columns).tolist()
    return "".join(separator.join(map(repr, row)) + "\n" for row in rows)


def _mixed(order):
    """A record with the coordinates out of order among other properties."""
    records = np.zeros(
        400,
        [("red", "u1"), ("z", order + "f8"), ("x", order + "f8"), ("id", order + "i4"), ("y", order + "f8")],
    )
    records["x"], records["y"], records["z"] = POINTS.T
    records["id"] = -1
    return records.tobytes()


MIXED = "property uchar red\nproperty double z\nproperty float64 x\nproperty int id\nproperty double y\n"

PLY = {
    "little endian doubles": _ply(
        "binary_little_endian", POINTS.astype("<f8").tobytes(), _properties("double")
    ),
    "big endian doubles": _ply("binary_big_endian", POINTS.astype(">f8").tobytes(), _properties("double")),
    "ascii doubles": _ply("ascii", _lines(POINTS).encode(), _properties("double")),
    "ascii with Windows line ends": _ply(
        "ascii", _lines(POINTS).replace("\n", "\r\n").encode(), _properties("double"), newline="\r\n"
    ),
    "other properties, little endian": _ply("binary_little_endian", _mixed("<"), MIXED),
    "other properties, big endian": _ply("binary_big_endian", _mixed(">"), MIXED),
    "triangles and quads": _ply(
        "binary_little_endian", POINTS.tobytes() + FACES, _properties("double"), after=FACE_HEADER
    ),
    "ascii with faces": _ply(
        "ascii",
        (_lines(POINTS) + "3 0 1 2\n4 0 1 2 3\n" * 5).encode(),
        _properties("double"),
        after=FACE_HEADER,
    ),
    "no faces": _ply(
        "binary_little_endian",
        POINTS.tobytes(),
        _properties("double"),
        after=FACE_HEADER.replace("face 10", "face 0"),
    ),
    "faces before the vertices": _ply(
        "binary_little_endian", FACES + POINTS.tobytes(), _properties("double"), before=FACE_HEADER
    ),
    "ascii, faces before the vertices": _ply(
        "ascii",
        ("3 0 1 2\n4 0 1 2 3\n" * 5 + _lines(POINTS)).encode(),
        _properties("double"),
        before=FACE_HEADER,
    ),
    "lists among the coordinates": _ply(
        "binary_big_endian",
        b"".join(
            struct.pack(f">dB{i % 4}hddi0f", x, i % 4, *[7] * (i % 4), y, z, 0)
            for i, (x, y, z) in enumerate(POINTS.tolist())
        ),
        "property double x\nproperty list uchar short seen_by\nproperty double y\nproperty double z\n"
        "property list int float weights\n",
    ),
    "ascii, lists among the coordinates": _ply(
        "ascii",
        "".join(
            f"{i % 3} {'9 ' * (i % 3)}{x!r} {y!r} 1 0 {z!r}\n" for i, (x, y, z) in enumerate(POINTS.tolist())
        ).encode(),
        "property list uchar int seen_by\nproperty double x\nproperty double y\n"
        "property list uchar int n\nproperty double z\n",
    ),
    "ascii, blank lines and comments": _ply(
        "ascii",
        ("\n  \n" + _lines(POINTS).replace("\n", "\n\n# 1 2 3\ncomment 4 5 6\n")).encode(),
        _properties("double"),
    ),
    "ascii with CR CR LF": _ply(
        "ascii", _lines(POINTS).replace("\n", "\r\r\n").encode(), _properties("double"), newline="\r\r\n"
    ),
    "ascii with CR": _ply(
        "ascii", _lines(POINTS).replace("\n", "\r").encode(), _properties("double"), newline="\r"
    ),
    "binary below CR": _ply(
        "binary_little_endian",
        struct.pack("<i", 10) + POINTS.tobytes(),
        _properties("double"),
        before="element note 1\nproperty int n\n",
        newline="\r",
    ),
    "padding behind": _ply("binary_little_endian", POINTS.tobytes() + bytes(4096), _properties("double")),
    "upper case": _ply("ASCII", _lines(POINTS).encode(), _properties("DOUBLE", "XYZ")),
    "a camera before the vertices": _ply(
        "binary_little_endian",
        struct.pack("<2f", 1, 2) + POINTS.tobytes(),
        _properties("double"),
        before="element camera 1\nproperty float fx\nproperty float fy\n",
    ),
    "ascii, a camera before the vertices": _ply(
        "ascii",
        b"1 2\n3 4\n" + _lines(POINTS).encode(),
        _properties("double"),
        before="element camera 2\nproperty float fx\nproperty float fy\n",
    ),
}


@pytest.mark.parametrize("case", PLY)
def test_ply_doubles_come_out_exactly(tmp_path, case):
    (tmp_path / "some scan.PLY").write_bytes(PLY[case])
    submap = read_cloud(tmp_path / "some scan.PLY", stamp=4.0)
    assert np.array_equal(submap.points, POINTS)
    assert (submap.name, submap.stamp) == ("some scan", 4.0)
    assert submap.intensity is None


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("name", ["intensity", "reflectivity", "scalar_Intensity"])
def test_ply_floats_with_intensity(tmp_path, order, name):
    records = np.rec.fromarrays([*SMALL.T, INTENSITY], dtype=[(n, order + "f4") for n in "xyzi"])
    encoding = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    content = _ply(encoding, records.tobytes(), _properties("float", [*"xyz", name]))
    (tmp_path / "a.ply").write_bytes(content)
    submap = read_cloud(tmp_path / "a.ply")
    assert np.array_equal(submap.points, SMALL)
    assert np.array_equal(submap.intensity, INTENSITY)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_repeated_vertices_are_dropped_openly(tmp_path, encoding):
    twice = np.concatenate([POINTS, POINTS[:7]])
    body = _lines(twice).encode() if encoding == "ascii" else twice.tobytes()
    (tmp_path / "a.ply").write_bytes(_ply(encoding, body, _properties("double"), count=407))
    submap = read_cloud(tmp_path / "a.ply")
    assert np.array_equal(submap.points, POINTS)
    assert "dropped 7 of 407 points" in submap.repairs[0]


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_single_precision_that_lost_the_ground_is_refused(tmp_path, encoding):
    coarse = POINTS.astype("<f4")
    body = _lines(coarse).encode() if encoding == "ascii" else coarse.tobytes()
    (tmp_path / "a.ply").write_bytes(_ply(encoding, body, _properties("float")))
    with pytest.raises(TerrainLoopError, match="as double"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", list(Encoding)[:3])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_pcd(tmp_path, encoding, kind):
    points = {np.float32: SMALL, np.float64: np.round(POINTS, 6)}[kind]
    points = RASTER if encoding == "binary_compressed" else points
    columns = [np.arange(400, dtype=np.uint8), *points.T.astype(kind), INTENSITY.astype(np.float32)]
    names = ("ring", "x", "y", "z", "intensity")
    cloud = PointCloud.from_points(columns, names, [column.dtype for column in columns])
    cloud.save(tmp_path / "a.pcd", encoding)
    assert f"DATA {encoding.value}\n".encode() in (tmp_path / "a.pcd").read_bytes()
    submap = read_cloud(tmp_path / "a.pcd")
    # pypcd4 writes ten decimals of a text.
    np.testing.assert_allclose(submap.points, points, rtol=0, atol=1e-9 if encoding == "ascii" else 0)
    assert np.array_equal(submap.intensity, INTENSITY)


def test_pcd_by_hand_with_unorganised_blanks(tmp_path):
    header = "# .PCD v.7\nVERSION .7\nFIELDS x y z _\nSIZE 8 8 8 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 400\n"
    header += "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 400\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(
        header + _lines(POINTS, INTENSITY).replace(" ", "  ").replace("\n", " \n")
    )
    assert np.array_equal(read_cloud(tmp_path / "a.pcd").points, POINTS)


PCD_HEADER = """# .PCD v0.7
VERSION 0.7
FIELDS x y z
SIZE 8 8 8
TYPE F F F
COUNT 1 1 1
WIDTH 400
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 400
DATA ascii
"""
PCD = {
    "no COUNT": (PCD_HEADER.replace("COUNT 1 1 1\n", ""), ""),
    "no VIEWPOINT": (PCD_HEADER.replace("VIEWPOINT 0 0 0 1 0 0 0\n", ""), ""),
    "no POINTS": (PCD_HEADER.replace("POINTS 400\n", ""), ""),
    "no WIDTH and HEIGHT": (PCD_HEADER.replace("WIDTH 400\nHEIGHT 1\n", ""), ""),
    "no VERSION": (PCD_HEADER.replace("VERSION 0.7\n", ""), ""),
    "organised": (PCD_HEADER.replace("WIDTH 400\nHEIGHT 1\n", "WIDTH 20\nHEIGHT 20\n"), ""),
    "lower case": (PCD_HEADER.replace("F F F", "f f f"), ""),
    "upper case": (PCD_HEADER.replace("ascii", "ASCII").replace("x y z", "X Y Z"), ""),
    "COLUMNS": (PCD_HEADER.replace("FIELDS", "COLUMNS"), ""),
    "several values of a field": (
        PCD_HEADER.replace("x y z", "x _ y _ z").replace("8 8 8", "8 4 8 4 8").replace("F F F", "F F F U F")
        .replace("1 1 1\n", "1 3 1 2 1\n"),
        "",
    ),
    "blank lines": (PCD_HEADER, "\n\n"),
    "CR CR LF": (PCD_HEADER.replace("\n", "\r\r\n"), "\r\r\n"),
    "comments": (PCD_HEADER, "\n# 1 2 3\n"),
}  # fmt: skip


@pytest.mark.parametrize("case", PCD)
def test_pcd_as_others_write_it(tmp_path, case):
    header, newline = PCD[case]
    more = [INTENSITY] * 3 + [INTENSITY] * 2 if "several" in case else []
    x, y, z = POINTS.T
    body = _lines(x, *more[:3], y, *more[3:], z).replace("\n", newline or "\n")
    (tmp_path / "a.pcd").write_bytes((header + body).encode())
    assert np.array_equal(read_cloud(tmp_path / "a.pcd").points, POINTS)


@pytest.mark.parametrize("data", ["binary", "BINARY"])
def test_pcd_with_several_values_of_a_field(tmp_path, data):
    records = np.zeros(400, [("x", "<f8"), ("_", "<u2", (5,)), ("y", "<f8"), ("z", "<f8")])
    records["x"], records["y"], records["z"] = POINTS.T
    header = PCD_HEADER.replace("x y z", "x _ y z").replace("8 8 8", "8 2 8 8").replace("F F F", "F U F F")
    header = header.replace("1 1 1\n", "1 5 1 1\n").replace("ascii", data)
    (tmp_path / "a.pcd").write_bytes(header.encode() + records.tobytes())
    assert np.array_equal(read_cloud(tmp_path / "a.pcd").points, POINTS)


@pytest.mark.parametrize("body", ["nan nan nan", "1 2 1.#QNAN", "1.#IND 2 3", "1 -nan(ind) 3", "1 2 1e999"])
@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_points_that_are_no_numbers_are_dropped_openly(tmp_path, suffix, body):
    text = _lines(POINTS[:-1]) + body + "\n"
    content = (
        _ply("ascii", text.encode(), _properties("double"))
        if suffix == "ply"
        else (PCD_HEADER + text).encode()
    )
    (tmp_path / f"a.{suffix}").write_bytes(content)
    submap = read_cloud(tmp_path / f"a.{suffix}")
    assert np.array_equal(submap.points, POINTS[:-1])
    assert "dropped 1 of 400 points: not finite" in submap.repairs


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("point_format", [1, 6, 8])
def test_las_drops_noise_and_what_is_withheld(tmp_path, suffix, point_format):
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales = [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = ground().T
    kind = np.resize([2, 1, 12, 17], 400)  # ground, unclassified, overlap, bridge
    kind[:20], kind[20:30] = 7, 18
    las.classification = kind
    las.withheld = (np.arange(400) >= 10) & (np.arange(400) < 12) | (np.arange(400) >= 382)
    las.synthetic = np.arange(400) % 2
    las.intensity = INTENSITY
    las.write(tmp_path / f"a.{suffix}")
    submap = read_cloud(tmp_path / f"a.{suffix}")
    assert np.array_equal(submap.intensity, INTENSITY[30:382])
    assert set(submap.repairs) == {
        "dropped 20 of 400 points: withheld",
        "dropped 28 of 400 points: classified as noise (7, 18)",
    }


def test_las_of_noise_alone_says_why_nothing_is_left(tmp_path):
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.x, las.y, las.z = ground().T
    las.classification = np.full(400, 7, np.uint8)
    las.write(tmp_path / "a.las")
    with pytest.raises(TerrainLoopError, match="dropped 400 of 400 points: classified as noise"):
        read_cloud(tmp_path / "a.las")


@pytest.mark.parametrize("point_format", [3, 6])
def test_streamed_laz(tmp_path, point_format):
    content = _las("laz", point_format)
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    (tmp_path / "a.laz").write_bytes(_poked(content, start, "<q", -1) + struct.pack("<q", table))
    (tmp_path / "b.laz").write_bytes(content)
    assert np.array_equal(read_cloud(tmp_path / "a.laz").points, read_cloud(tmp_path / "b.laz").points)


UTM_WKT = (
    'PROJCS["WGS 84 / UTM zone 11N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.25]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]],'
    'PROJECTION["Transverse_Mercator"],UNIT["metre",1,AUTHORITY["EPSG","9001"]]{}]'
)
NAMED_UTM = UTM_WKT.format(',AUTHORITY["EPSG","32611"]')
HEIGHTS = 'VERT_CS["NAVD88",VERT_DATUM["NAVD88",2005],UNIT["metre",1],AUTHORITY["EPSG","5703"]]'
CRS = {
    "none": ({}, None),
    "keys": ({34735: [1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 26911]}, 26911),
    "own keys": ({34735: [1, 1, 0, 1, 3072, 0, 1, 32767]}, None),
    "WKT with a code": ({2112: NAMED_UTM}, 32611),
    "WKT 2": ({2112: 'PROJCRS["x",BASEGEOGCRS["y",ID["EPSG",4326]],ID["EPSG",32611]]'}, 32611),
    "WKT without": ({2112: UTM_WKT.format("")}, UTM_WKT.format("")),
    "with heights": ({2112: f'COMPD_CS["a",{NAMED_UTM},{HEIGHTS}]'}, 32611),
}


def _las_with(records, suffix="las"):
    header = laspy.LasHeader(version="1.4", point_format=6)
    for number, content in records.items():
        data = content.encode() + b"\0" if number == 2112 else np.array(content, "<u2").tobytes()
        header.vlrs.append(laspy.VLR("LASF_Projection", number, "", data))
    header.scales = [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = ground().T
    file = io.BytesIO()
    las.write(file, do_compress=suffix == "laz")
    return file.getvalue()


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("case", CRS)
def test_coordinate_reference_system_of_las(tmp_path, case, suffix):
    records, crs = CRS[case]
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(_las_with(records, suffix))
    assert read_crs(path) == crs
    assert len(read_cloud(path)) == 400


NO_METRES = {
    "geographic keys": {34735: [1, 1, 0, 2, 1024, 0, 1, 2, 2048, 0, 1, 4326]},
    "geocentric keys": {34735: [1, 1, 0, 1, 1024, 0, 1, 3]},
    "US survey feet": {34735: [1, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 2229, 3076, 0, 1, 9003]},
    "heights in feet": {34735: [1, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 26911, 4099, 0, 1, 9002]},
    "geographic WKT": {2112: 'GEOGCS["WGS 84",UNIT["degree",0.01745],AUTHORITY["EPSG","4326"]]'},
    "geographic compound": {2112: f'COMPD_CS["a",GEOGCS["WGS 84"],{HEIGHTS}]'},
    "feet in WKT": {2112: NAMED_UTM.replace('UNIT["metre"', 'UNIT["US survey foot"')},
}


@pytest.mark.parametrize("case", NO_METRES)
def test_las_that_states_other_units_than_metres_is_refused(tmp_path, case):
    (tmp_path / "a.las").write_bytes(_las_with(NO_METRES[case]))
    with pytest.raises(TerrainLoopError, match=r"a\.las.*reproject"):
        read_cloud(tmp_path / "a.las")


def test_only_las_states_a_coordinate_reference_system(tmp_path):
    write_cloud(tmp_path / "a.ply", POINTS)
    assert read_crs(tmp_path / "a.ply") is None
    (tmp_path / "a.las").write_bytes(b"LASF")
    for name in ("a.las", "absent.las"):
        with pytest.raises(TerrainLoopError, match=name):
            read_crs(tmp_path / name)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 3), ("1.4", 6), ("1.4", 7)])
def test_las(tmp_path, suffix, version, point_format):
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, np.floor(UTM)
    las = laspy.LasData(header)
    las.x, las.y, las.z = POINTS.T
    las.intensity = INTENSITY
    las.write(tmp_path / f"a.{suffix}")
    submap = read_cloud(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(submap.points, POINTS, rtol=0, atol=5.1e-4)
    assert np.array_equal(submap.intensity, INTENSITY)


@pytest.mark.parametrize("points", [POINTS, SMALL, np.asfortranarray(POINTS), np.c_[POINTS, INTENSITY]])
def test_npy(tmp_path, points):
    np.save(tmp_path / "a.npy", points)
    assert np.array_equal(read_cloud(tmp_path / "a.npy").points, points[:, :3])


@pytest.mark.parametrize(
    "arrays",
    [
        {"points": POINTS, "other": np.zeros((4, 4)), "intensity": INTENSITY},
        {"xyz": POINTS, "intensity": INTENSITY},
        {**dict(zip("xyz", POINTS.T, strict=True)), "table": np.zeros((4, 4)), "intensity": INTENSITY},
    ],
    ids=["points", "only table", "columns"],
)
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz(tmp_path, arrays, save):
    save(tmp_path / "a.npz", **arrays)
    submap = read_cloud(tmp_path / "a.npz")
    assert np.array_equal(submap.points, POINTS)
    assert np.array_equal(submap.intensity, INTENSITY)


BACKWARDS = POINTS[:, ::-1]
TEXTS = {
    "blanks": _lines(POINTS),
    "comma": _lines(POINTS, separator=","),
    "comma and blank": _lines(POINTS, separator=", "),
    "semicolon": _lines(POINTS, separator=";"),
    "tab": _lines(POINTS, separator="\t"),
    "aligned": "  " + _lines(POINTS).replace(" ", "    ").replace("\n", "  \n  "),
    "byte order mark": "\ufeff" + _lines(POINTS),
    "Windows line ends": _lines(POINTS).replace("\n", "\r\n"),
    "comments": "# a\n// b\n\n" + _lines(POINTS).replace("\n", "  # c\n") + "// d\n",
    "count first": "400\n" + _lines(POINTS),
    "more columns": _lines(POINTS, POINTS, separator=","),
    "words in a further column": _lines(POINTS).replace("\n", " ground\n"),
    "header": "x,y,z\n" + _lines(POINTS, separator=","),
    "header without names that are known": "easting northing height\n" + _lines(POINTS),
    "header in another order": "id;Z;Y;X\n" + _lines(INTENSITY, BACKWARDS, separator=";"),
    "header in quotes": '"z","y","x"\n' + _lines(BACKWARDS, separator=","),
    "header in a comment": "//Z Y X\n" + _lines(BACKWARDS),
    "words in the first column": "name,x,y,z\n# c;d\n"
    + "".join(f"p,{line}" for line in _lines(POINTS, separator=",").splitlines(keepends=True)),
    "empty cells elsewhere": "x,note,y,z\n" + _lines(POINTS, separator=",").replace(",", ",,", 1),
}
TEXTS["empty cells elsewhere"] = "x,note,y,z\n" + "".join(
    f"{x!r},,{y!r},{z!r}\n" for x, y, z in POINTS.tolist()
)


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("suffix", ["xyz", "txt", "csv"])
def test_text(tmp_path, case, suffix):
    (tmp_path / f"a.{suffix}").write_text(TEXTS[case], encoding="utf-8", newline="")
    submap = read_cloud(tmp_path / f"a.{suffix}")
    assert np.array_equal(submap.points, POINTS)
    assert submap.intensity is None


def test_text_with_intensity(tmp_path):
    text = "# X Y Z R Intensity\n" + _lines(POINTS, INTENSITY * 0, INTENSITY)
    (tmp_path / "a.txt").write_text(text)
    submap = read_cloud(tmp_path / "a.txt")
    assert np.array_equal(submap.points, POINTS)
    assert np.array_equal(submap.intensity, INTENSITY)


@pytest.mark.parametrize("suffix", ["ply", "npy", "npz", "xyz"])
@pytest.mark.parametrize("points", [ground(), POINTS], ids=["small", "UTM"])
def test_write_and_read(tmp_path, suffix, points):
    write_cloud(tmp_path / f"a.{suffix}", points)
    again = read_cloud(tmp_path / f"a.{suffix}").points
    np.testing.assert_allclose(again, points, rtol=0, atol=0 if suffix[0] == "n" else 1e-6)


def test_written_ply_is_single_precision_where_that_is_enough(tmp_path):
    write_cloud(tmp_path / "a.ply", ground())
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert header.decode().split("\n")[:2] == ["ply", "format binary_little_endian 1.0"]
    assert np.array_equal(np.frombuffer(body, "<f4").reshape(-1, 3), SMALL)


def test_write_refuses_other_formats(tmp_path):
    with pytest.raises(TerrainLoopError, match=r"\.ply \.npy \.npz \.xyz"):
        write_cloud(tmp_path / "a.laz", POINTS)


def _npy_header(text):
    header = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def _npz(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def _saved(array, save=np.save):
    file = io.BytesIO()
    save(file, array)
    return file.getvalue()


def _las(suffix, point_format=3):
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=point_format))
    las.x, las.y, las.z = ground().T
    file = io.BytesIO()
    las.write(file, do_compress=suffix == "laz")
    return file.getvalue()


def _poked(data, offset, layout, value):
    data = bytearray(data)
    struct.pack_into(layout, data, offset, value)
    return bytes(data)


def _pcd(encoding):
    file = io.BytesIO()
    points = RASTER.astype(np.float32) if encoding == "binary_compressed" else SMALL
    PointCloud.from_xyz_points(points).save(file, Encoding(encoding))
    return file.getvalue()


HUGE = 10**15
DOUBLES = _properties("double")
LAZ_START = struct.unpack_from("<I", _las("laz"), 96)[0]
LAZ_TABLE = struct.unpack_from("<q", _las("laz"), LAZ_START)[0]
LAYERS_START = struct.unpack_from("<I", _las("laz", 6), 96)[0]
PACKED = _pcd("binary_compressed").index(b"DATA binary_compressed\n") + 23
DAMAGED = {
    "ply: no header": ("ply", b"\x00" * 100),
    "ply: endless header": ("ply", b"ply\n" + b"comment\n" * 20_000),
    "ply: header alone": ("ply", _ply("ascii", b"", DOUBLES)),
    "ply: unknown format": ("ply", _ply("binary_middle_endian", POINTS.tobytes(), DOUBLES)),
    "ply: not at the start": ("ply", b"\n \nformat ascii 1.0\nend_header\n"),
    "ply: huge count": ("ply", _ply("binary_little_endian", POINTS.tobytes(), DOUBLES, count=HUGE)),
    "ply: huge ascii count": ("ply", _ply("ascii", _lines(POINTS).encode(), DOUBLES, count=HUGE)),
    "ply: count beyond 64 bits": ("ply", _ply("binary_little_endian", b"", DOUBLES, count=10**30)),
    "ply: negative count": ("ply", _ply("binary_little_endian", POINTS.tobytes(), DOUBLES, count=-1)),
    "ply: cut short": ("ply", _ply("binary_little_endian", POINTS.tobytes()[:-1], DOUBLES)),
    "ply: ascii cut short": ("ply", _ply("ascii", _lines(POINTS)[:-30].encode(), DOUBLES)),
    "ply: words": ("ply", _ply("ascii", _lines(POINTS).replace("431236", "here").encode(), DOUBLES)),
    "ply: no vertices": ("ply", _ply("ascii", b"", "").replace(b"vertex", b"corner")),
    "ply: no z": ("ply", _ply("ascii", _lines(POINTS[:, :2]).encode(), _properties("double", "xy"))),
    "ply: unknown type": ("ply", _ply("ascii", _lines(POINTS).encode(), _properties("quad"))),
    "ply: ascii, more lines": ("ply", _ply("ascii", _lines(POINTS).encode(), DOUBLES, count=399)),
    "ply: more points": ("ply", _ply("binary_little_endian", POINTS.tobytes(), DOUBLES, count=200)),
    "ply: faces cut short": (
        "ply",
        _ply("binary_little_endian", POINTS.tobytes() + FACES[:4], DOUBLES, after=FACE_HEADER),
    ),
    "ply: x twice": ("ply", _ply("binary_little_endian", POINTS.tobytes() * 2, DOUBLES + DOUBLES)),
    "ply: ascii, x twice": ("ply", _ply("ascii", _lines(POINTS, POINTS).encode(), DOUBLES + DOUBLES)),
    "ply: X and x": (
        "ply",
        _ply("ascii", _lines(POINTS, POINTS).encode(), DOUBLES + _properties("double", "XYZ")),
    ),
    "ply: vertices twice": (
        "ply",
        _ply("ascii", _lines(POINTS, POINTS).encode(), DOUBLES, before="element vertex 400\n" + DOUBLES),
    ),
    "ply: two points in a line": ("ply", _ply("ascii", _lines(POINTS[::2], POINTS[1::2]).encode(), DOUBLES)),
    "ply: a count with underscores": ("ply", _ply("ascii", _lines(POINTS).encode(), DOUBLES, count="4_0_0")),
    "ply: numbers with underscores": (
        "ply",
        _ply("ascii", _lines(POINTS).replace("431236.", "431_236.").encode(), DOUBLES),
    ),
    "ply: a misspelt keyword": ("ply", _ply("ascii", _lines(POINTS).encode(), DOUBLES + "propertie int i\n")),
    "pcd: ascii, more lines": ("pcd", _pcd("ascii") + b"1 2 3\n"),
    "pcd: ascii, fewer values": ("pcd", _pcd("ascii")[:-20] + b"\n"),
    "pcd: more points": ("pcd", _pcd("binary") + SMALL[:1].tobytes()),
    "pcd: WIDTH and POINTS": ("pcd", _pcd("binary").replace(b"WIDTH 400", b"WIDTH 200")),
    "pcd: x twice": ("pcd", _pcd("binary").replace(b"FIELDS x y z", b"FIELDS x x z")),
    "pcd: no such type": ("pcd", _pcd("binary").replace(b"TYPE F", b"TYPE C")),
    "pcd: no such encoding": ("pcd", _pcd("binary").replace(b"DATA binary", b"DATA binary_zip")),
    "las: more points": ("las", _las("las") + _las("las")[-34:]),
    "npy: two arrays": ("npy", _saved(POINTS) + _saved(POINTS)),
    "npy: a raster": ("npy", _saved(np.zeros((150, 40)))),
    "npy: with fields": ("npy", _saved(np.zeros(400, "f8,f8,f8"))),
    "npy: a truth table": ("npy", _saved(np.ones((400, 3), bool))),
    "npz: a raster": ("npz", _npz(z=_saved(np.zeros((150, 140))), resolution=_saved(np.array(0.1)))),
    "pcd: no header": ("pcd", b"garbage " * 50),
    "pcd: header alone": ("pcd", _pcd("binary")[:-4800]),
    "pcd: cut short": ("pcd", _pcd("binary")[:-1]),
    "pcd: cut short by a point": ("pcd", _pcd("binary")[:-12]),
    "pcd: ascii cut short": ("pcd", _pcd("ascii")[:-60]),
    "pcd: packed cut short": ("pcd", _pcd("binary_compressed")[:-1]),
    "pcd: huge count": ("pcd", _pcd("binary").replace(b"POINTS 400", b"POINTS %d" % HUGE)),
    "pcd: huge ascii count": ("pcd", _pcd("ascii").replace(b"POINTS 400", b"POINTS %d" % HUGE)),
    "pcd: huge packed count": ("pcd", _pcd("binary_compressed").replace(b"POINTS 400", b"POINTS %d" % HUGE)),
    "pcd: huge unpacked size": ("pcd", _poked(_pcd("binary_compressed"), PACKED + 4, "<I", 2**32 - 1)),
    "pcd: no sizes": ("pcd", _pcd("ascii").replace(b"SIZE", b"SEIZE")),
    "las: no header": ("las", b"garbage " * 50),
    "las: short": ("las", b"LASF"),
    "las: cut short": ("las", _las("las")[:-1]),
    "las: cut short by a point": ("las", _las("las")[:-34]),
    "las: huge count": ("las", _poked(_las("las"), 247, "<Q", 2**62)),
    "las: four billion records": ("las", _poked(_las("las"), 100, "<I", 2**32 - 1)),
    "las: points beyond the end": ("las", _poked(_las("las"), 96, "<I", 2**32 - 1)),
    "laz: cut short": ("laz", _las("laz")[:-100]),
    "laz: huge count": ("laz", _poked(_las("laz"), 247, "<Q", 2**62)),
    "laz: four billion chunks": ("laz", _poked(_las("laz"), LAZ_TABLE + 4, "<I", 2**32 - 1)),
    "laz: chunks beyond the end": ("laz", _poked(_las("laz"), LAZ_START, "<q", 2**62)),
    "laz: a layer of 4 GB": ("laz", _poked(_las("laz", 6), LAYERS_START + 8 + 30 + 4, "<I", 2**32 - 1)),
    "npy: garbage": ("npy", b"garbage" * 50),
    "npy: cut short": ("npy", _saved(POINTS)[:-1]),
    "npy: pickled": ("npy", _saved(np.array([{}, {}]))),
    "npy: a pickle itself": ("npy", pickle.dumps(POINTS)),
    "npy: huge count": (
        "npy",
        _npy_header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({HUGE}, 3), }}") + bytes(99),
    ),
    "npy: header that is code": ("npy", _npy_header("__import__('os').getpid()")),
    "npy: transposed": ("npy", _saved(POINTS.T)),
    "npy: words": ("npy", _saved(np.full((400, 3), "a"))),
    "npy: really npz": ("npy", _npz(points=_saved(POINTS))),
    "npz: garbage": ("npz", b"PK\x03\x04garbage"),
    "npz: really npy": ("npz", _saved(POINTS)),
    "npz: cut short": ("npz", _npz(points=_saved(POINTS))[:-50]),
    "npz: no table": ("npz", _npz(a=_saved(np.zeros(5)))),
    "npz: two tables": ("npz", _npz(a=_saved(POINTS), b=_saved(POINTS))),
    "npz: pickled": ("npz", _npz(points=_saved(np.array([{}, {}])))),
    "npz: columns of different lengths": (
        "npz",
        _npz(x=_saved(POINTS[:, 0]), y=_saved(POINTS[:-1, 1]), z=_saved(POINTS[:, 2])),
    ),
    "npz: huge count": (
        "npz",
        _npz(points=_npy_header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({HUGE}, 3), }}")),
    ),
    "xyz: words": ("xyz", b"it was a dark\nand stormy night\n" * 99),
    "xyz: words in between": (
        "xyz",
        (_lines(POINTS[:200]) + "here be dragons\n" + _lines(POINTS[200:])).encode(),
    ),
    "xyz: two columns": ("xyz", _lines(POINTS[:, :2]).encode()),
    "xyz: fewer columns below": ("xyz", (_lines(POINTS) + "1 2\n").encode()),
    "xyz: decimal commas": ("xyz", _lines(ground()).replace(".", ",").encode()),
    "xyz: decimal commas, semicolons": ("xyz", _lines(ground(), separator=";").replace(".", ",").encode()),
    "xyz: an empty cell between tabs": ("xyz", (_lines(POINTS, separator="\t") + "1\t\t3\t4\n").encode()),
    "xyz: no text": ("xyz", b"\xff\xfe\x00" * 99),
    "xyz: comments alone": ("xyz", b"# nothing\n\n"),
    "csv: cloud of another kind": ("csv", PLY["little endian doubles"]),
    **{f"{suffix[1:]}: empty": (suffix[1:], b"") for suffix in CLOUD_SUFFIXES},
    "stl: unknown": ("stl", PLY["ascii doubles"]),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_files_are_named_in_one_line(tmp_path, case):
    suffix, content = DAMAGED[case]
    path = tmp_path / f"bad.{suffix}"
    path.write_bytes(content)
    with pytest.raises(TerrainLoopError, match=rf"^expected .*; found .*bad\.{suffix}.*; .*$"):
        read_cloud(path)


@pytest.mark.parametrize("name", ["absent.ply", "folder.ply", "absent.stl"])
def test_no_file(tmp_path, name):
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(TerrainLoopError, match=f"no file at .*{name}"):
        read_cloud(tmp_path / name)


WHOLE = {
    "binary.ply": _ply("binary_little_endian", SMALL.tobytes(), _properties("float")),
    "ascii.ply": _ply("ascii", _lines(SMALL).encode(), _properties("float")),
    "ascii.pcd": _pcd("ascii"),
    "binary.pcd": _pcd("binary"),
    "packed.pcd": _pcd("binary_compressed"),
    "plain.las": _las("las"),
    "pointwise.laz": _las("laz"),
    "layered.laz": _las("laz", 6),
    "plain.npy": _saved(SMALL),
    "plain.npz": _npz(points=_saved(SMALL)),
    "plain.xyz": _lines(SMALL).encode(),
    "header.csv": b"x,y,z\n" + _lines(SMALL, separator=",").encode(),
}


def _damage(content, rng):
    data = bytearray(content)
    start = int(rng.integers(len(data) if rng.random() < 0.5 else min(len(data), 400)))
    match rng.integers(4):
        case 0:
            del data[start:]
        case 1:
            del data[start : start + int(rng.integers(1, 40))]
        case 2:
            data[start : start + int(rng.integers(1, 8))] = bytes(
                rng.choice([0, 9, 10, 32, 57, 127, 255], 4).tolist()
            )
        case _:
            data[start : start + 20] = rng.bytes(20)
    return bytes(data)


@pytest.mark.parametrize("name", WHOLE)
def test_whatever_the_damage_only_our_error_comes_out(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(WHOLE[name])
    assert len(read_cloud(path)) == 400
    rng = np.random.default_rng(7)
    refused = []
    for _ in range(150):
        path.write_bytes(_damage(WHOLE[name], rng))
        try:
            read_cloud(path)
        except TerrainLoopError as error:
            refused.append(str(error))
    assert len(refused) > 20
    assert all(name in line and "\n" not in line for line in refused)


real = pytest.mark.skipif(not DATA.is_dir(), reason="real data absent")


@real
@pytest.mark.parametrize(("name", "count"), [("devon1", 62290), ("minnie2", 113700)])
def test_real_stereo_clouds(name, count):
    path = DATA / "stereo_clouds" / f"{name}.ply"
    submap = read_cloud(path)
    raw = np.frombuffer(path.read_bytes()[-12 * count :], "<f4").reshape(-1, 3)
    assert np.array_equal(submap.points, raw)
    assert submap.repairs == ()


@real
def test_real_airborne_lidar():
    path = next((DATA / "pozo_lidar").glob("*.laz"))
    submap = read_cloud(path)
    las = laspy.read(path)
    assert np.array_equal(submap.points.min(axis=0), las.header.mins)
    assert np.array_equal(submap.points.max(axis=0), las.header.maxs)
    assert len(submap) == len(np.unique(las.xyz, axis=0))
    assert set(np.unique(submap.intensity)) <= set(np.unique(las.intensity))
    assert len(submap.repairs) == 2


def test_a_raster_of_heights_is_no_cloud(tmp_path):
    path = tmp_path / "dem.csv"
    np.savetxt(path, np.random.default_rng(0).normal(size=(150, 200)), delimiter=",")
    with pytest.raises(TerrainLoopError, match="200 numbers per line and no header: a raster"):
        read_cloud(path)


@pytest.mark.parametrize("announced", [200, 401])
def test_laz_with_another_number_of_points_than_announced_is_refused(tmp_path, announced):
    (tmp_path / "a.laz").write_bytes(_poked(_las("laz", 6), 247, "<Q", announced))
    with pytest.raises(TerrainLoopError, match="400"):
        read_cloud(tmp_path / "a.laz")
