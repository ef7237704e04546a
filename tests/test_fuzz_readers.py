"""Whatever a file holds, a cloud or one TerrainLoopError comes out, soon and in little memory."""

import io
import os
import struct
import subprocess
import sys
import zipfile

import laspy
import numpy as np
import pytest
from clouds_util import ground
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pypcd4 import Encoding, PointCloud

from terrainloop.errors import TerrainLoopError
from terrainloop.io import CLOUD_SUFFIXES, read_cloud

POINTS = ground().astype(np.float32)
LONGEST_ERROR = 1000  # characters
fuzz = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def _saved(save):
    file = io.BytesIO()
    save(file)
    return file.getvalue()


def _rows(points=POINTS, separator=" "):
    return "".join(separator.join(map(repr, row)) + "\n" for row in np.asarray(points, float).tolist())


def _ply_header(encoding, elements):
    return f"ply\nformat {encoding} 1.0\n{elements}end_header\n".encode()


def _vertices(count=400, more=""):
    return f"element vertex {count}\n{more}" + "".join(f"property float {axis}\n" for axis in "xyz")


def _pcd(encoding):
    points = POINTS
    if encoding is Encoding.BINARY_COMPRESSED:  # on a grid, since LZF finds nothing in random numbers
        points = np.indices((20, 20), dtype=np.float32).reshape(2, -1).T
        points = np.c_[points, np.round(POINTS[:, 2], 1)]
    return _saved(lambda file: PointCloud.from_xyz_points(points).save(file, encoding))


def _pcd_header(points=400, count="1 1 1", encoding="ascii", fields="x y z", size="4 4 4", kind="F F F"):
    return (
        f"VERSION .7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\n"
        f"WIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA {encoding}\n"
    ).encode()


def _las(points=POINTS, *, compress=False, point_format=3):
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=point_format))
    las.x, las.y, las.z = points.T
    return _saved(lambda file: las.write(file, do_compress=compress))


def _npy_header(descr, shape):
    header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def _npz(method, **members):
    def save(file):
        with zipfile.ZipFile(file, "w", method) as archive:
            for name, content in members.items():
                archive.writestr(f"{name}.npy", content)

    return _saved(save)


FACES = "element face 2\nproperty list uchar int vertex_indices\n"
FACE_BYTES = struct.pack("<B3iB3i", 3, 0, 1, 2, 3, 1, 2, 3)
VALID = {
    "ascii.ply": _ply_header("ascii", _vertices()) + _rows().encode(),
    "binary.ply": _ply_header("binary_big_endian", _vertices()) + POINTS.astype(">f4").tobytes(),
    "lists.ply": _ply_header("binary_little_endian", FACES + _vertices(more="property list uchar uchar n\n"))
    + FACE_BYTES
    + b"".join(b"\x02ab" + row.tobytes() for row in POINTS),
    "ascii.pcd": _pcd(Encoding.ASCII),
    "binary.pcd": _pcd(Encoding.BINARY),
    "packed.pcd": _pcd(Encoding.BINARY_COMPRESSED),
    "plain.las": _las(),
    "pointwise.laz": _las(compress=True),
    "layered.laz": _las(compress=True, point_format=6),
    "plain.npy": _saved(lambda file: np.save(file, POINTS)),
    "plain.npz": _saved(lambda file: np.savez(file, points=POINTS)),
    "packed.npz": _saved(
        lambda file: np.savez_compressed(file, x=POINTS[:, 0], y=POINTS[:, 1], z=POINTS[:, 2])
    ),
    "plain.xyz": _rows().encode(),
    "header.csv": b"id,x [m],y [m],z [m]\n" + _rows(np.c_[np.arange(400), POINTS], ",").encode(),
    "comment.txt": b"# t x y z\n" + _rows(np.c_[np.arange(400), POINTS]).encode(),
}


def _reads_or_refuses(path):
    """Read a file; whatever else than a cloud or one short line comes out fails the test."""
    try:
        found = read_cloud(path)
    except TerrainLoopError as error:
        found = error
    if isinstance(found, TerrainLoopError):
        assert path.name in str(found)
        assert "\n" not in str(found)
        assert len(str(found)) < LONGEST_ERROR
    else:
        assert np.isfinite(found.points).all()


@pytest.mark.parametrize("name", VALID)
def test_undamaged(tmp_path, name):
    (tmp_path / name).write_bytes(VALID[name])
    assert len(read_cloud(tmp_path / name)) == 400


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
@fuzz
@given(content=st.binary(max_size=300))
def test_any_bytes(tmp_path, suffix, content):
    (tmp_path / f"a{suffix}").write_bytes(content)
    _reads_or_refuses(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".xyz", ".csv"])
@fuzz
@given(header=st.text(alphabet="xyzXYZt mft[](),;#/%:.-_\"'0123\t\r\n\ufeffé", max_size=60))
def test_any_header(tmp_path, suffix, header):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(header.encode() + b"\n" + _rows(POINTS[:150]).encode())
    _reads_or_refuses(path)


@pytest.mark.parametrize("name", VALID)
@fuzz
@given(data=st.data())
def test_damaged_files(tmp_path, name, data):
    content = bytearray(VALID[name])
    # The header is where damage does most, so that every other place is there.
    place = st.one_of(st.integers(0, min(len(content), 500) - 1), st.integers(0, len(content) - 1))
    for _ in range(data.draw(st.integers(1, 4))):
        start = min(data.draw(place), len(content))
        match data.draw(st.sampled_from(["cut", "remove", "insert", "replace", "flip"])):
            case "cut":
                del content[start:]
            case "remove":
                del content[start : start + data.draw(st.integers(1, 40))]
            case "insert":
                content[start:start] = data.draw(st.binary(min_size=1, max_size=12))
            case "replace":
                new = data.draw(
                    st.sampled_from([b"\xff" * 8, bytes(8), b"-1 ", b"9" * 18, b"\r", b"\n\n", b"nan "])
                )
                content[start : start + len(new)] = new
            case "flip" if start < len(content):
                content[start] ^= 1 << data.draw(st.integers(0, 7))
    (tmp_path / name).write_bytes(content)
    _reads_or_refuses(tmp_path / name)


def _text(content):
    return content.encode() + b"\n" + _rows().encode()


def _bomb(count):
    """LAZ that packs equal points into next to nothing."""
    return _las(np.zeros((count, 3)), compress=True, point_format=6)


ZEROS = bytes(75_000_000)
ARRAY = _npy_header("<f4", (100_000, 3)) + ZEROS[:1_200_000]
MEGABYTE = 1_000_000
HOSTILE = {
    "count.pcd": lambda: _pcd_header(count="1 1 1000000000") + _rows().encode(),
    "count18.pcd": lambda: _pcd_header(count="1 1 " + "9" * 18, encoding="binary") + bytes(999),
    "points.pcd": lambda: _pcd_header(points="9" * 18) + _rows().encode(),
    "points_packed.pcd": lambda: (
        _pcd_header(points=2**28, encoding="binary_compressed")
        + struct.pack("<II", 900, 2**32 - 1)
        + bytes(900)
    ),
    "no_size.pcd": lambda: _pcd_header(points=10**17, size="0 0 0", encoding="binary"),
    "no_fields.pcd": lambda: _pcd_header(points=10**17, fields="", size="", kind="", count=""),
    "many_fields.pcd": lambda: _pcd_header(
        fields="x " * 9999, size="4 " * 9999, kind="F " * 9999, count="1 " * 9999, encoding="binary"
    ),
    "vertices.ply": lambda: _ply_header("ascii", _vertices(10**18 - 1)) + _rows().encode(),
    "bare.ply": lambda: _ply_header("ascii", f"element vertex {10**17}\n"),
    "bare_before.ply": lambda: _ply_header("binary_little_endian", f"element a {10**17}\n" + _vertices()),
    "endless_list.ply": lambda: (
        _ply_header("binary_little_endian", "element a 9\nproperty list uint double n\n" + _vertices())
        + b"\xff" * 9999
    ),
    "backward_list.ply": lambda: (
        _ply_header(
            "binary_little_endian", f"element a {MEGABYTE}\nproperty list char double n\n" + _vertices()
        )
        + b"\x80" * MEGABYTE
    ),
    "empty_lists.ply": lambda: (
        _ply_header(
            "binary_little_endian", f"element a {MEGABYTE}\nproperty list char double n\n" + _vertices()
        )
        + bytes(MEGABYTE)
    ),
    "list_of_floats.ply": lambda: (
        _ply_header("binary_little_endian", "element a 9\nproperty list float double n\n" + _vertices())
        + bytes(9999)
    ),
    "list.ply": lambda: (
        _ply_header("ascii", _vertices(more="property list int int n\n")) + b"9999999999 1\n" * 400
    ),
    "elements.ply": lambda: _ply_header(
        "ascii", f"element a {10**17}\nproperty int b\n" * 1300 + _vertices()
    ),
    "plain.las": lambda: _poked(_las(), 247, "<Q", 2**63),
    "wide.las": lambda: _poked(_poked(_las(), 105, "<H", 65535), 247, "<Q", 2**20),
    "streamed.laz": lambda: _streamed(_las(compress=True), 2**62),
    "chunks.laz": lambda: _poked(_las(compress=True), -8, "<I", 2**31),
    "bomb.laz": lambda: _bomb(3_000_000),
    "small_bomb.laz": lambda: _bomb(900_000),
    "object.npy": lambda: _npy_header("|O", (10**9,)),
    "wide_text.npy": lambda: _npy_header("<U500000000", (1, 3)),
    "wide_void.npy": lambda: _npy_header("|V2000000000", (1, 3)),
    "no_bytes.npy": lambda: _npy_header("|V0", (10**18, 3)),
    "no_text.npy": lambda: _npy_header("<U0", (10**18, 3)),
    "no_rows.npy": lambda: _npy_header("<f8", (0, 10**18)),
    "fields.npy": lambda: _npy_header([("x", "<f8", (10**8,)), ("y", "<f8"), ("z", "<f8")], (10,)),
    "shape.npy": lambda: _npy_header("<f8", (10**9, 3)),
    "negative.npy": lambda: _npy_header("<f8", (-400, -3)) + bytes(9600),
    "nested.npy": lambda: _npy_header("<f8", "(" * 40 + ")" * 40) + bytes(9600),
    "bzip2.npz": lambda: _npz(zipfile.ZIP_BZIP2, points=ARRAY),
    "lzma.npz": lambda: _npz(zipfile.ZIP_LZMA, points=ARRAY),
    "deflate.npz": lambda: _npz(zipfile.ZIP_DEFLATED, points=_npy_header("<f4", (6_250_000, 3)) + ZEROS),
    "small_types.npz": lambda: _npz(
        zipfile.ZIP_DEFLATED, points=_npy_header("|i1", (22_000_000, 3)) + ZEROS[:66_000_000]
    ),
    "axes.npz": lambda: _npz(
        zipfile.ZIP_DEFLATED, **{a: _npy_header("<f8", (4_000_000,)) + ZEROS[:32_000_000] for a in "xyz"}
    ),
    "digits.xyz": lambda: b"1" * MEGABYTE,
    "blanks.xyz": lambda: _text("x" + " " * MEGABYTE + "m"),
    "commas.csv": lambda: _text("," * MEGABYTE),
    "quotes.csv": lambda: _text('"' * MEGABYTE),
    "open_quote.csv": lambda: _text('"x,y,z') + b'"' * 99,
    "hashes.xyz": lambda: _text("#" * MEGABYTE),
    "brackets.xyz": lambda: _text("# " + "x [m" * (MEGABYTE // 4)),
    "names.csv": lambda: _text("x,y,z" + ",a" * (MEGABYTE // 2)),
    "numbers.csv": lambda: b"1," * (MEGABYTE // 2) + b"1\n",
    "letters.xyz": lambda: b"a\n" * (MEGABYTE // 2),
    "titles.xyz": lambda: _text("a\n" * (MEGABYTE // 2)),
    "comments.xyz": lambda: _text("# x y\n" * (MEGABYTE // 6)),
    "nan.xyz": lambda: _rows().encode() + b"1 2 nan(" + b"(" * MEGABYTE + b"\n",
    "dashes.xyz": lambda: _rows().encode() + b"1 2 " + b"-" * MEGABYTE + b"x\n",
    "escapes.csv": lambda: _text("\x1b[2J\x07,a,b,c"),
    "header.ply": lambda: b"ply\nformat ascii 1.0\nelement " + b"a" * 60_000 + b"\nend_header\n",
    "line.pcd": lambda: _pcd_header(kind="F F " + "F" * 60_000) + _rows().encode(),
}
READ_ALL = """
import sys, time
from pathlib import Path
from terrainloop.errors import TerrainLoopError
from terrainloop.io import read_cloud
import laspy
for path in sorted(Path(sys.argv[1]).iterdir()):
    start = time.process_time()
    try:
        found = f"{len(read_cloud(path))} points"
    except TerrainLoopError as error:
        found = str(error)
    status = Path("/proc/self/status").read_text()  # ru_maxrss would include that of the parent
    peak = int(status.split("VmHWM:")[1].split()[0]) // 1024
    print(path.name, round(time.process_time() - start, 2), peak, found, sep="\\t")
"""


def _poked(data, offset, layout, value):
    data = bytearray(data)
    struct.pack_into(layout, data, offset % len(data), value)
    return bytes(data)


def _streamed(laz, table):
    (start,) = struct.unpack_from("<I", laz, 96)
    return _poked(laz, start, "<q", -1) + struct.pack("<q", table)


def test_hostile_files_take_neither_time_nor_memory(tmp_path):
    for name, content in HOSTILE.items():
        (tmp_path / name).write_bytes(content())
        assert (tmp_path / name).stat().st_size < 3 * MEGABYTE
    run = subprocess.run(
        [sys.executable, "-c", READ_ALL, tmp_path], capture_output=True, text=True, timeout=120, check=True
    )
    lines = [line.split("\t") for line in run.stdout.splitlines()]
    assert len(lines) == len(HOSTILE)
    for name, seconds, megabytes, found in lines:
        assert float(seconds) < 10, name
        assert int(megabytes) < 1000, name
        assert found.startswith("expected"), name
        assert len(found) < LONGEST_ERROR, name


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_only_regular_files_are_opened(tmp_path, suffix):
    os.mkfifo(tmp_path / f"fifo{suffix}")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    (tmp_path / f"loop{suffix}").symlink_to(tmp_path / f"loop{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    for stem in ("fifo", "zero", "loop", "folder", "a" * 300, "a\0b"):
        with pytest.raises(TerrainLoopError, match="no file"):
            read_cloud(tmp_path / f"{stem}{suffix}")
