"""Overlap of submaps: of their bounding boxes (paper, section VI-A), and of the ground they observed."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from terrainloop.geometry import Array, transform

CELLS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # metres
SAME_GROUND = 0.95  # IoU of two halves of a cloud that counts as the same ground
SAMPLED_CLOUDS = 10  # clouds of a mission from which the cell size is chosen


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
    union = area[:, None] + area - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def observed_iou(clouds: Sequence[Array], poses: Array, cell: float) -> Array:
    """Ground of which both of two submaps have points, over ground of which either has.

    Ground is counted in square cells of the world's x-y plane; one point makes a cell observed. Shadows,
    and corners of the bounding box that were never seen, are not shared.

    Parameters
    ----------
    clouds : sequence of (N, 3) arrays
        Each in its own frame, metres; a cloud without points shares nothing.
    poses : array, (M, 4, 4)
        T_world_submap.
    cell : float
        Side of a cell, metres; see `ground_cell`.

    Returns
    -------
    array, (M, M)
        Intersection over union, 0 to 1.
    """
    seen = [_cells(transform(pose, cloud), cell) for cloud, pose in zip(clouds, poses, strict=True)]
    sizes = [len(cells) for cells in seen]
    _, columns = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *seen]), return_inverse=True)
    rows = np.repeat(np.arange(len(seen)), sizes)
    shape = (len(seen), int(columns.max(initial=-1)) + 1)
    incidence = csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)
    shared = (incidence @ incidence.T).toarray()
    either = np.add.outer(sizes, sizes) - shared
    return np.divide(shared, either, out=np.zeros_like(shared), where=either > 0)


def ground_cell(clouds: Sequence[Array]) -> float:
    """Side of the cells in which the ground of these clouds is counted, metres.

    The smallest of 0.25, 0.5, 1, 2, 4 and 8 m at which two random halves of a cloud observe the same
    ground (IoU at least 0.95 in the median cloud). Smaller cells leave holes between the points, so that
    two scans of one place share too little; larger ones blur the border. Halves are sparser than clouds,
    so the choice is conservative. Some ten clouds are sampled, and halved with a fixed seed.
    """
    whole = [cloud for cloud in clouds if len(cloud)]
    some = whole[:: max(1, len(whole) // SAMPLED_CLOUDS)]
    rng = np.random.default_rng(0)
    halves = [(cloud[chosen], cloud[~chosen]) for cloud in some for chosen in [rng.random(len(cloud)) < 0.5]]
    still = np.broadcast_to(np.eye(4), (2, 4, 4))

    def agree(cell: float) -> bool:
        return bool(np.median([observed_iou(pair, still, cell)[0, 1] for pair in halves]) >= SAME_GROUND)

    return next((cell for cell in CELLS[:-1] if halves and agree(cell)), CELLS[-1])


def _cells(points: Array, cell: float) -> NDArray[np.int64]:
    """Cells that hold points, each as one number."""
    column, row = np.floor(points[:, :2] / cell).astype(np.int64).T
    return np.unique((column << 32) + row)
