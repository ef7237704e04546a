"""A submap at rest: its bytes bring back all of it, and damaged bytes are refused."""

import contextlib
import io
import tracemalloc
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest
from conftest import PARAMETERS

from terrainloop.config import FeatureSettings
from terrainloop.detection.detector import map_submap
from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import se3
from terrainloop.io.results import loop_to_dict
from terrainloop.matching.register import compare
from terrainloop.submap import Submap

POSE = se3(1.0, -2.0, 0.5, 0.01, -0.02, 2.0)


@pytest.fixture(scope="module")
def entries(world, strict):
    """Two submaps of one place."""
    frames = np.eye(4), se3(0.5, -0.3, 0.4, 0.02, -0.015, 3.0)
    submaps = [
        Submap(
            world(1).observe(frame, (0.2, 0.1), seed=seed), name=f"submap {seed}", session="näxt", stamp=seed
        )
        for seed, frame in enumerate(frames)
    ]
    return [map_submap(submap, strict, PARAMETERS, odometry=POSE) for submap in submaps]


def assert_same(one, other):
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape) == (b.dtype, b.shape)
            assert a.tobytes() == b.tobytes()
        else:
            assert type(a) is type(b)
            assert a == b


@pytest.mark.parametrize("kind", ["sift", "surf", "orb"])
def test_bytes_bring_back_all_of_an_entry(entries, strict, kind):
    settings = strict.model_copy(update={"features": FeatureSettings(kind=kind)})
    entry = MapEntry.of(entries[0].record, entries[0].gradient_map, settings)
    restored = MapEntry.from_bytes(entry.to_bytes())
    assert restored.id == "näxt/submap 0"
    for part in ("record", "gradient_map", "features", "field"):
        assert_same(getattr(entry, part), getattr(restored, part))
    assert restored.to_bytes() == entry.to_bytes()


def test_a_restored_entry_matches_as_the_first_did(entries, strict):
    restored = [MapEntry.from_bytes(entry.to_bytes()) for entry in entries]
    first, again = compare(*reversed(entries), strict), compare(*reversed(restored), strict)
    assert first.accepted
    np.testing.assert_equal(loop_to_dict(first), loop_to_dict(again))


def test_an_entry_without_keypoints(entries, strict):
    nothing = replace(entries[0].gradient_map, mask=np.zeros_like(entries[0].gradient_map.mask))
    entry = MapEntry.of(entries[0].record, nothing, strict)
    assert len(entry.features) == 0
    assert_same(entry.features, MapEntry.from_bytes(entry.to_bytes()).features)


def test_what_is_not_known_stays_unknown(entries):
    record = replace(entries[0].record, session="", odometry=None, hull=np.empty((0, 2)))
    restored = MapEntry.from_bytes(replace(entries[0], record=record).to_bytes())
    assert restored.id == "submap 0"
    assert restored.record.odometry is None
    assert restored.record.hull.shape == (0, 2)


# --- damage


@pytest.fixture(scope="module")
def data(entries):
    return entries[0].to_bytes()


def rewritten(data, **arrays):
    """The bytes with other arrays in it, or without those that are None."""
    with np.load(io.BytesIO(data)) as file:
        content = {name: file[name] for name in file.files} | arrays
    buffer = io.BytesIO()
    np.savez(buffer, **{name: array for name, array in content.items() if array is not None})
    return buffer.getvalue()


def test_any_truncation_is_refused(data):
    for length in [*range(0, 200, 7), *np.linspace(200, len(data) - 1, 60).astype(int)]:
        with pytest.raises(TerrainLoopError, match=r"map entry|gradient map"):
            MapEntry.from_bytes(data[:length])


@pytest.mark.parametrize("seed", range(3))
def test_flipped_bytes_are_refused_or_change_nothing(data, seed):
    """ZIP has fields that nobody reads, such as dates; everything else is under a checksum or checked."""
    rng = np.random.default_rng(seed)
    heads = [i for i in range(len(data)) if data[i : i + 2] == b"PK"]
    near_heads = [int(h + o) for h in heads for o in rng.integers(0, 200, 8) if h + o < len(data)]
    for position in [*near_heads, *rng.integers(0, len(data), 40)]:
        damaged = bytearray(data)
        damaged[position] ^= int(rng.integers(1, 256))
        with contextlib.suppress(TerrainLoopError):
            assert MapEntry.from_bytes(bytes(damaged)).to_bytes() == data


def npy(header):
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


@pytest.mark.parametrize(
    "foreign",
    [
        b"",
        b"PK\x05\x06" + bytes(18),  # a ZIP file of nothing
        b"SQLite format 3\x00",
        b"\x80\x04\x95" + bytes(20),  # a pickle
        npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (3,)}\n") + bytes(24),
        npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999,)}\n"),
    ],
    ids=["empty", "no files", "database", "pickle", "array", "announced"],
)
def test_foreign_bytes_are_refused(foreign):
    with pytest.raises(TerrainLoopError, match="map entry"):
        MapEntry.from_bytes(foreign)


@pytest.mark.parametrize("name", ["record", "map", "features.positions", "field.x", "field.origin"])
def test_a_missing_part_is_refused(data, name):
    with pytest.raises(TerrainLoopError, match="map entry"):
        MapEntry.from_bytes(rewritten(data, **{name: None}))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("record", np.frombuffer(b'{"name": 1}', np.uint8)),
        ("record", np.frombuffer(b"[" * 100_000, np.uint8)),
        ("record", np.zeros(3)),
        ("map", np.zeros(100, np.uint8)),
        ("features.positions", np.zeros((3, 2))),
        ("features.positions", np.zeros(7)),
        ("features.descriptors", np.zeros((2, 5), np.float32)),
        ("features.descriptors", np.array("text")),
        ("features.kind", np.array(3.0)),
        ("field.x", np.zeros((2, 3), np.float32)),
        ("field.valid", np.zeros(4)),
        ("field.spacing", np.array(0.0)),
        ("field.spacing", np.array(np.nan)),
        ("field.length_scale", np.array("long")),
        ("field.origin", np.zeros(3)),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value.dtype}{value.shape}",
)
def test_parts_that_do_not_fit_are_refused(data, name, value):
    with pytest.raises(TerrainLoopError, match=r"map entry|gradient map"):
        MapEntry.from_bytes(rewritten(data, **{name: value}))


def packed(data, name, content, compression=zipfile.ZIP_STORED):
    """The bytes with another content of one file in them."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(buffer, "w", compression) as new:
        for one in old.namelist():
            new.writestr(one, content if one == name else old.read(one))
    return buffer.getvalue()


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_what_is_announced_is_not_allocated(data, compression):
    """A header may promise any number of values, a compressed file unpack to any."""
    header = npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (50000, 2000)}\n")
    content = header + (bytes(100_000_000) if compression == zipfile.ZIP_DEFLATED else b"")
    hostile = packed(data, "features.positions.npy", content, compression)
    assert len(hostile) < 2e6
    tracemalloc.start()
    try:
        with pytest.raises(TerrainLoopError, match="map entry"):
            MapEntry.from_bytes(hostile)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()
