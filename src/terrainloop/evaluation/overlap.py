"""Which pairs of submaps truly share ground: bounding boxes of posed submaps (paper, section VI-A)."""

from collections.abc import Sequence

import numpy as np

from terrainloop.geometry import Array, transform


def world_boxes(hulls: Sequence[Array], poses: Array) -> Array:
    """Axis-aligned bounding boxes of submaps in the world.

    Parameters
    ----------
    hulls : sequence of (K, 2) arrays
        Convex hull of each submap's points in its own frame, metres.
    poses : array, (M, 4, 4)
        T_world_submap.

    Returns
    -------
    array, (M, 4)
        x_min, y_min, x_max, y_max, metres.
    """
    boxes = np.empty((len(hulls), 4))
    for box, hull, pose in zip(boxes, hulls, poses, strict=True):
        corners = transform(pose, np.c_[hull, np.zeros(len(hull))])[:, :2]
        box[:2], box[2:] = corners.min(axis=0), corners.max(axis=0)
    return boxes


def box_iou(boxes: Array) -> Array:
    """Intersection over union (M, M) of axis-aligned boxes (M, 4)."""
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=-1)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return shared / (area[:, None] + area - shared)
