"""Points of PointCloud2 messages, whatever their layout."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainloop.io.recordings import Sensor

CLOUD = "sensor_msgs/msg/PointCloud2"

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.datatype
_INTENSITY = ("intensity", "intensities", "reflectivity", "reflectance")
_OF_LIDAR = {
    "ring",
    "line",
    "channel",
    "laser_id",
    "return_type",
    "t",
    "time",
    "timestamp",
    "offset_time",
    "range",
}
_OF_CAMERA = {"rgb", "rgba"}
_LIDAR_NAMES = ("lidar", "laser", "velodyne", "ouster", "hesai", "pandar", "livox", "rslidar", "os_sensor")
_CAMERA_NAMES = ("optical", "camera", "stereo", "depth", "realsense", "zed")


def points_of(message: Any) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Points (N, 3) and, where there is one, the intensity (N,), without the returns that are none.

    Points at the very origin of the sensor are how drivers mark beams without a return.

    Raises
    ------
    ValueError
        If the layout that the message declares does not fit its data, or x, y or z is missing.
    """
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    data = np.asarray(message.data, dtype=np.uint8)
    row = int(message.row_step) if height > 1 else width * step
    if height > 1 and height * width * step == len(data):
        row = width * step  # some drivers leave row_step zero
    if width * height == 0:
        return np.empty((0, 3)), None
    if step <= 0 or row < width * step or (height - 1) * row + width * step > len(data):
        raise ValueError(f"{height} rows of {width} points of {step} bytes in {len(data)} bytes")
    columns = _columns(message, step)
    data = np.pad(data, (0, max(0, height * row - len(data))))  # the last row may end with its last point
    rows = data[: height * row].reshape(height, row)[:, : width * step]
    table = np.ascontiguousarray(rows).reshape(-1).view(columns)
    with np.errstate(invalid="ignore"):  # signalling NaNs
        numbers = {name: table[name].astype(np.float64) for name in columns.names or ()}
    points = np.column_stack([numbers[axis] for axis in "xyz"])
    returned = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
    return points[returned], numbers["intensity"][returned] if "intensity" in numbers else None


def sensor_of(message: Any, topic: str) -> Sensor:
    """What made a cloud, by its fields and names."""
    fields = {field.name for field in message.fields}
    names = f"{topic} {message.header.frame_id}".lower()
    if fields & _OF_CAMERA or any(name in names for name in _CAMERA_NAMES):
        return "stereo"
    if fields & _OF_LIDAR or any(name in names for name in _LIDAR_NAMES):
        return "lidar"
    return "unknown"


def _columns(message: Any, step: int) -> np.dtype[Any]:
    """The type of one point, of which only the fields that are used are named."""
    fields = {}
    for field in message.fields:
        name = "intensity" if field.name.lower() in _INTENSITY else field.name.lower()
        kind = np.dtype((">" if message.is_bigendian else "<") + _NUMBERS.get(field.datatype, "V0"))
        if name in ("x", "y", "z", "intensity") and kind.itemsize and name not in fields:
            fields[name] = (kind, int(field.offset))
    if not {"x", "y", "z"} <= fields.keys():
        raise ValueError(
            f"the fields {', '.join(field.name for field in message.fields)[:100]}, without x, y, z"
        )
    if any(offset < 0 or offset + kind.itemsize > step for kind, offset in fields.values()):
        raise ValueError(f"fields beyond the {step} bytes of a point")
    kinds, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": kinds, "offsets": offsets, "itemsize": step})
