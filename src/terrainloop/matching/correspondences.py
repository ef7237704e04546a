"""Keypoint associations between two gradient maps, by brute force over descriptors."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrainloop.features import Features
from terrainloop.geometry import Array


@dataclass(frozen=True, eq=False)
class Associations:
    """The set A of the paper: row i of `source` and of `target` may be the same point of the ground.

    Both are (A, 2), metres, each in the frame of its own map.
    """

    source: Array
    target: Array

    def __len__(self) -> int:
        return len(self.source)


def associate(source: Features, target: Features) -> Associations:
    """Pair the keypoints of two maps that are each other's nearest by descriptor.

    Parameters
    ----------
    source, target : Features
        Both of the same kind. Distances are L2 for real and Hamming for binary (uint8) descriptors.
    """
    if not len(source.positions) or not len(target.positions):
        return Associations(np.empty((0, 2)), np.empty((0, 2)))
    norm = cv2.NORM_HAMMING if source.descriptors.dtype == np.uint8 else cv2.NORM_L2
    matches = cv2.BFMatcher(norm, crossCheck=True).match(source.descriptors, target.descriptors)
    pairs = np.array([(m.queryIdx, m.trainIdx) for m in matches], dtype=int).reshape(-1, 2)
    # A keypoint with two orientations is listed twice; it counts once.
    ends = np.hstack([source.positions[pairs[:, 0]], target.positions[pairs[:, 1]]])
    _, first = np.unique(ends, axis=0, return_index=True)
    ends = ends[np.sort(first)]
    return Associations(ends[:, :2], ends[:, 2:])
