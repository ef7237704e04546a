"""Keypoints and descriptors of a gradient map where it can be trusted: SURF (the paper's), SIFT, ORB."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from terrainloop import _core
from terrainloop.arrays import ReadOnlyArrays, read_only
from terrainloop.config import FeatureSettings
from terrainloop.gradient_map import GradientMap

# A map's contrast: the magnitude that all but its steepest hundredth stay below. Thresholds and grey
# levels are relative to it, so that flat ground gives as many keypoints as rough ground does.
CONTRAST_PERCENTILE = 99.0
# Below this part of the contrast a SURF response (the square of a curvature) is rounding, not shape.
SURF_NOISE = 1e-4
# OpenCV's defaults (0.04 and 20) are for photographs; a Gaussian-process map is smooth, so go down to what
# 8 bits resolve. The strongest keypoints are picked afterwards.
SIFT_CONTRAST_THRESHOLD = 0.005
ORB_FAST_THRESHOLD = 2

# Detected keypoints: x (column), y (row) and scale in pixels, orientation in radians, response; descriptors.
_Detected = tuple[NDArray[np.float64], NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Features(ReadOnlyArrays):
    """Keypoints of one gradient map and their descriptors, strongest first.

    Parameters
    ----------
    positions : array, (K, 2)
        (x, y) in the map's frame, metres.
    scales : array, (K,)
        Size of each keypoint, metres; comparable within a kind. SURF and SIFT: the sigma of the Gaussian
        at which it was found. ORB: the radius of its patch.
    orientations : array, (K,)
        Dominant direction, radians counter-clockwise from the map's x axis.
    responses : array, (K,)
        Strength of the detector; comparable within a kind.
    descriptors : array, (K, D)
        float32 (SURF: 64, SIFT: 128), to be compared by Euclidean distance; or uint8 (ORB: 32), strings of
        bits to be compared by Hamming distance.
    kind : str
        "surf", "sift" or "orb". Only features of one kind can be matched.
    """

    positions: NDArray[np.float64]
    scales: NDArray[np.float64]
    orientations: NDArray[np.float64]
    responses: NDArray[np.float64]
    descriptors: NDArray[np.float32] | NDArray[np.uint8]
    kind: str

    def __post_init__(self) -> None:
        for name in ("positions", "scales", "orientations", "responses", "descriptors"):
            object.__setattr__(self, name, read_only(np.asarray(getattr(self, name))))

    def __len__(self) -> int:
        return len(self.positions)


def extract_features(gradient_map: GradientMap, settings: FeatureSettings) -> Features:
    """Keypoints of a map's gradient magnitude within its observed area, and their descriptors.

    The filters extend beyond the mask; only the keypoints' centres are restricted to it. SURF is our own (Bay
    et al. 2008); SIFT (Lowe 2004) and ORB (Rublee et al. 2011) are OpenCV's.

    Parameters
    ----------
    gradient_map : GradientMap
    settings : FeatureSettings
        Kind and number: the strongest are kept; of equal ones those of smaller y, then x.
    """
    image, allowed = gradient_map.magnitude, gradient_map.mask
    contrast = float(np.percentile(image[allowed], CONTRAST_PERCENTILE)) if allowed.any() else 0.0
    keypoints, descriptors = _DETECTORS[settings.kind](image, allowed, contrast, settings.max_keypoints)
    return Features(
        positions=np.array(gradient_map.origin) + gradient_map.resolution * keypoints[:, :2],
        scales=gradient_map.resolution * keypoints[:, 2],
        # Rows run along +y, so the image's sense of rotation is the map's.
        orientations=keypoints[:, 3].copy(),
        responses=keypoints[:, 4].copy(),
        descriptors=descriptors,
        kind=settings.kind,
    )


def _surf(image: NDArray[np.float32], allowed: NDArray[np.bool_], contrast: float, count: int) -> _Detected:
    threshold = (SURF_NOISE * contrast) ** 2
    keypoints, descriptors = _core.surf(
        image, allowed.view(np.uint8), threshold=threshold, max_keypoints=count
    )
    return keypoints[:, :5], descriptors


def _sift(image: NDArray[np.float32], allowed: NDArray[np.bool_], contrast: float, count: int) -> _Detected:
    # Without the precise upscaling OpenCV's keypoints are shifted by a fraction of a pixel.
    sift = cv2.SIFT.create(contrastThreshold=SIFT_CONTRAST_THRESHOLD, enable_precise_upscale=True)
    found, descriptors = sift.detectAndCompute(_grey(image, contrast), allowed.view(np.uint8))
    if not found:
        return np.empty((0, 5)), np.empty((0, 128), dtype=np.float32)
    return _strongest(_from_opencv(found), descriptors, allowed, count)


def _orb(image: NDArray[np.float32], allowed: NDArray[np.bool_], contrast: float, count: int) -> _Detected:
    orb = cv2.ORB.create(nfeatures=count, fastThreshold=ORB_FAST_THRESHOLD)
    found: Sequence[cv2.KeyPoint] = ()
    if min(image.shape) > 2 * orb.getEdgeThreshold():  # OpenCV fails to shrink very small images
        found, descriptors = orb.detectAndCompute(_grey(image, contrast), allowed.view(np.uint8))
    if not found:
        return np.empty((0, 5)), np.empty((0, 32), dtype=np.uint8)
    keypoints = _from_opencv(found)
    # OpenCV scales the pixel indices of a shrunk image; pixel centres lie (shrinking - 1) / 2 further on.
    keypoints[:, :2] += keypoints[:, 2:3] / orb.getPatchSize() - 0.5
    return _strongest(keypoints, descriptors, allowed, count)


def _grey(image: NDArray[np.float32], contrast: float) -> NDArray[np.uint8]:
    """The image in 8 bits: flat is black, `contrast` and above white."""
    per_level = 255.0 / contrast if contrast > 0.0 else 0.0
    grey: NDArray[np.uint8] = np.rint(np.clip(image * per_level, 0.0, 255.0)).astype(np.uint8)
    return grey


def _from_opencv(found: Sequence[cv2.KeyPoint]) -> NDArray[np.float64]:
    """OpenCV's size is a diameter, its angle in degrees within [0, 360), in our sense of rotation."""
    x, y, size, angle, response = np.array([(*k.pt, k.size, k.angle, k.response) for k in found]).T
    return np.column_stack([x, y, size / 2.0, np.deg2rad((angle + 180.0) % 360.0 - 180.0), response])


def _strongest(
    keypoints: NDArray[np.float64], descriptors: NDArray[Any], allowed: NDArray[np.bool_], count: int
) -> _Detected:
    """The `count` keypoints of highest response within the mask, in an order that has no ties."""
    x, y, scale, orientation, response = keypoints.T
    order = np.lexsort((orientation, scale, x, y, -response))
    cols, rows = np.rint(keypoints[:, :2]).astype(int).T
    kept = order[allowed[rows, cols][order]][:count]
    return keypoints[kept], descriptors[kept]


_DETECTORS = {"surf": _surf, "sift": _sift, "orb": _orb}
