"""Pose graphs as g2o files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terrainloop.io.files import write_whole_text

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured relative pose.

    Attributes
    ----------
    target, source : int
        Numbers of the vertices.
    T_target_source : array, (4, 4)
    covariance : array, (6, 6)
        Of the tangent vector xi in T_target_source exp(xi), rotation first as in GTSAM.
    """

    target: int
    source: int
    T_target_source: Array
    covariance: Array


def write_g2o(path: str | Path, poses: Array, edges: Sequence[Edge]) -> None:
    """Write a graph of SE(3) poses, with every digit; the file is whole or not there.

    Parameters
    ----------
    path : str or Path
    poses : array, (M, 4, 4)
        Of the vertices 0 to M - 1.
    edges : sequence of Edge
        Their information is written in g2o's order, translation first.
    """
    vertices = (["VERTEX_SE3:QUAT", k, *_seven(pose)] for k, pose in enumerate(poses))
    measured = (
        ["EDGE_SE3:QUAT", edge.target, edge.source, *_seven(edge.T_target_source), *_information(edge)]
        for edge in edges
    )
    text = "".join(" ".join(map(str, row)) + "\n" for row in (*vertices, *measured))
    write_whole_text(path, lambda file: file.write(text))


def _seven(T: Array) -> list[float]:
    """Translation and quaternion, w last."""
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return [*T[:3, 3].tolist(), *quaternion.tolist()]


def _information(edge: Edge) -> list[float]:
    """The upper triangle (21,) of the information matrix, row by row."""
    information = np.roll(np.linalg.inv(edge.covariance), (3, 3), axis=(0, 1))
    upper: list[float] = information[np.triu_indices(6)].tolist()
    return upper
