"""LAS and LAZ by laspy, after checks of what laspy and lazrs take on trust."""

import re
import struct
from pathlib import Path
from typing import IO, Any

import laspy  # type: ignore[import-untyped]
import lazrs  # type: ignore[import-untyped]
import numpy as np

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds.table import Table, check_count, check_points

_NOISE = (7, 18)  # ASPRS: low noise, high noise
_CHUNK = 1 << 26  # bytes of points in memory at a time
_VLR_HEADER = 54  # bytes
_COMPRESSED = 0x80  # bit of the point format
_LAYERED = 6  # first point format that LAZ compresses in layers

# Keys of OGC GeoTIFF 1.1 and their values
_MODEL_TYPE, _PROJECTED, _UNITS, _VERTICAL_UNITS = 1024, 3072, 3076, 4099
_NOT_PROJECTED = (2, 3)  # geographic, geocentric
_FEET = (9002, 9003)
_USER_DEFINED = 32767


def read_las(path: Path) -> Table:
    """Read coordinates and intensity; points withheld or classified as noise are dropped."""
    try:
        with _open(path) as reader:
            header = reader.header
            _check_metres(header)
            size = path.stat().st_size
            check_points(header.point_count, size)
            if header.are_points_compressed:
                _check_chunks(path, header)
            else:
                _check_size(header, size)
            at_once = max(1, _CHUNK // header.point_format.size)
            chunks = [_columns(points) for points in reader.chunk_iterator(at_once)]
    except BaseException as error:
        if type(error).__name__ == "PanicException":  # of lazrs, and no Exception
            raise ValueError(str(error)) from error
        raise
    check_count(header.point_count, sum(len(chunk["x"]) for chunk in chunks))
    columns = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    withheld = columns.pop("withheld") != 0
    noise = np.isin(columns.pop("classification"), _NOISE) & ~withheld
    dropped = {"withheld": withheld.sum(), f"classified as noise {_NOISE}": noise.sum()}
    repairs = [f"dropped {n} of {len(noise)} points: {reason}" for reason, n in dropped.items() if n]
    keep = ~(withheld | noise)
    return Table({name: values[keep] for name, values in columns.items()}, tuple(repairs))


def crs_of(path: Path) -> int | str | None:
    """EPSG code where the file states one, else WKT, else None."""
    with _open(path) as reader:
        wkt, keys = _wkt(reader.header), _geo_keys(reader.header)
    # The authority of a system is its last entry, at the end of the text or before the vertical system.
    epsg = r'(?:AUTHORITY\["EPSG",\s*"|ID\["EPSG",\s*)(\d+)"?\s*\]\s*\]\s*(?:$|,\s*VERT)'
    authority = re.search(epsg, wkt)
    if authority:
        return int(authority[1])
    code = keys.get(_PROJECTED, 0)
    return wkt or (code if 0 < code < _USER_DEFINED else None)


def _open(path: Path) -> Any:
    _check_header(path)
    selection = laspy.DecompressionSelection
    wanted = selection.XY_RETURNS_CHANNEL | selection.Z | selection.INTENSITY
    return laspy.open(
        path,
        laz_backend=laspy.LazBackend.Lazrs,  # on one thread
        decompression_selection=wanted | selection.CLASSIFICATION | selection.FLAGS,
        read_evlrs=False,
    )


def _check_header(path: Path) -> None:
    """Refuse what is not a LAS file, and record counts on which laspy would loop forever."""
    with path.open("rb") as file:
        header = file.read(104)
    start, records = struct.unpack_from("<II", header, 96)
    if header[:4] != b"LASF" or start > path.stat().st_size or _VLR_HEADER * records > start:
        raise ValueError("not a LAS header")


def _check_size(header: Any, size: int) -> None:
    """Refuse uncompressed points that are fewer than announced, or more where nothing else may follow."""
    left, point = size - header.offset_to_point_data, header.point_format.size
    more_may_follow = header.number_of_evlrs or header.start_of_waveform_data_packet_record
    if left < header.point_count * point or (
        not more_may_follow and left >= (header.point_count + 1) * point
    ):
        raise ValueError(f"{header.point_count} points of {point} bytes announced, {left} bytes follow")


def _check_chunks(path: Path, header: Any) -> None:
    """Refuse chunks that do not fill the file: lazrs would allocate what they announce, or abort."""
    size, start = path.stat().st_size, header.offset_to_point_data
    laszip = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
    with path.open("rb") as file:
        table = _chunk_table_start(file, start, size)
        file.seek(table)
        _, count = struct.unpack("<II", file.read(8))
        if count > size:
            raise ValueError(f"{count} chunks announced in {size} bytes")
        file.seek(start)
        chunks = [chunk_size for _, chunk_size in lazrs.read_chunk_table(file, laszip)]
        start += 8  # behind the position of the table
        whole, points = start + sum(chunks) == table, 0
        layered = header.point_format.id >= _LAYERED
        for chunk in chunks if layered else []:
            file.seek(start + laszip.item_size())  # behind the first point: a count, nine layer sizes
            count, *layers = struct.unpack("<10I", file.read(40))
            whole, points = whole and sum(layers) <= chunk, points + count
            start += chunk
    if not whole:
        raise ValueError("chunks that do not fit their layers or the file")
    if layered:
        check_count(header.point_count, points)


def _chunk_table_start(file: IO[bytes], start: int, size: int) -> int:
    """Where the table of chunks is: streamed files have -1 there and the position in their last 8 bytes."""
    file.seek(start)
    (position,) = struct.unpack("<q", file.read(8))
    if position == -1:
        file.seek(-8, 2)
        (position,) = struct.unpack("<q", file.read(8))
    if not start < position <= size - 8:
        raise ValueError("no table of chunks")
    return int(position)


def _columns(points: Any) -> dict[str, Any]:
    return {
        name: np.array(points[name]) for name in ("x", "y", "z", "intensity", "classification", "withheld")
    }


def _check_metres(header: Any) -> None:
    """Refuse files that state coordinates in degrees, geocentric coordinates or feet."""
    wkt, keys = _wkt(header), _geo_keys(header)
    geographic = re.match(r'\s*(?:COMP\w+\["[^"]*",\s*)?(?:GEOG|GEOC|GEOD)', wkt)
    feet = re.search(r'UNIT\["[^"]*(?:foot|feet)', wkt, re.IGNORECASE)
    if geographic or (not wkt and keys.get(_MODEL_TYPE) in _NOT_PROJECTED):
        found = "geographic or geocentric coordinates"
    elif feet or (not wkt and {keys.get(_UNITS), keys.get(_VERTICAL_UNITS)} & set(_FEET)):
        found = "coordinates in feet"
    else:
        return
    raise TerrainLoopError(
        expected="projected coordinates in metres", found=found, mend="reproject the cloud, e.g. to UTM"
    )


def _wkt(header: Any) -> str:
    """The coordinate system as WKT, empty where there is none."""
    records = header.vlrs.get("WktCoordinateSystemVlr")
    return records[0].string.strip("\0 \n") if records else ""


def _geo_keys(header: Any) -> dict[int, int]:
    """GeoTIFF keys with numeric values."""
    records = header.vlrs.get("GeoKeyDirectoryVlr")
    return {k.id: k.value_offset for r in records[:1] for k in r.geo_keys if k.tiff_tag_location == 0}
