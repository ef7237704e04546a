"""Points of depth images, by the model of their camera."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Type of a pixel and metres per unit, by encoding (REP 118)."""

_LARGEST_SIDE = 1 << 16  # pixels


@dataclass(frozen=True)
class Camera:
    """Pinhole camera of rectified images: focal lengths and principal point in pixels.

    Attributes
    ----------
    fx, fy, cx, cy : float
    width, height : int
        Of the image that these hold for; zero if it is not known.
    distorted : bool
        Whether the images of this camera are distorted, which is then ignored.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distorted: bool

    @classmethod
    def of(cls, message: Any) -> "Camera | None":
        """The camera of a CameraInfo message; None where it is not calibrated."""
        P, K = _matrix(message, "p"), _matrix(message, "k")
        distorted = bool(np.any(_matrix(message, "d")))
        rectified = P.shape == (12,) and P[0] > 0
        fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified else (K[0], K[4], K[2], K[5])
        if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
            return None
        size = int(message.width), int(message.height)
        return cls(float(fx), float(fy), float(cx), float(cy), *size, distorted and not rectified)

    def scaled_to(self, width: int, height: int) -> "Camera":
        """The camera of the same images at another resolution.

        Raises
        ------
        ValueError
            If it has other proportions, so that it must be a part of the image.
        """
        if (width, height) == (self.width, self.height) or not (self.width and self.height):
            return self
        across, down = width / self.width, height / self.height
        if abs(across - down) > 0.01 * across:
            raise ValueError(f"{width} x {height} pixels, the CameraInfo is for {self.width} x {self.height}")
        fx, cx, fy, cy = self.fx * across, self.cx * across, self.fy * down, self.cy * down
        return Camera(fx, fy, cx, cy, width, height, self.distorted)


def is_depth(message: Any) -> bool:
    """Whether an image holds depths, by its encoding."""
    return message.encoding in ENCODINGS


def depth_points(message: Any, camera: Camera) -> NDArray[np.float64]:
    """Points (N, 3) of the pixels with a depth, in the optical frame: x right, y down, z forward.

    Raises
    ------
    ValueError
        If the size that the message declares does not fit its data or the camera.
    """
    width, height, row = int(message.width), int(message.height), int(message.step)
    pixel, unit = ENCODINGS[message.encoding]
    kind = np.dtype((">" if message.is_bigendian else "<") + pixel)
    data = np.asarray(message.data, dtype=np.uint8)
    row = max(row, width * kind.itemsize) if height == 1 else row
    sizes = 0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE
    if not sizes or row < width * kind.itemsize or height * row > len(data):
        raise ValueError(f"{height} rows of {width} pixels, {row} bytes each, in {len(data)} bytes")
    rows = data[: height * row].reshape(height, row)[:, : width * kind.itemsize]
    with np.errstate(invalid="ignore"):  # signalling NaNs
        depth = np.ascontiguousarray(rows).view(kind).reshape(height, width).astype(np.float64) * unit
    camera = camera.scaled_to(width, height)
    v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[v, u]
    return np.column_stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])


def _matrix(message: Any, name: str) -> NDArray[np.float64]:
    """A matrix of a CameraInfo, which has capital names in ROS 1."""
    return np.asarray(getattr(message, name, getattr(message, name.upper(), ())), dtype=np.float64)
