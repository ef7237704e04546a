"""The tree of frames in TF messages, static and moving, and transforms along it."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import inverse
from terrainloop.io.bags.poses import TrackBuilder, frame_of, stamp_of
from terrainloop.io.pose_track import PoseTrack

Array = NDArray[np.float64]

_BODIES = ("base_link", "base_footprint", "base", "body")  # REP 105 and common usage
_WORLDS = ("odom", "map", "world", "earth")


@dataclass(frozen=True, eq=False)
class Edge:
    """The pose of a frame in its parent over time."""

    parent: str
    track: PoseTrack
    constant: bool

    def at(self, stamp: float) -> Array | None:
        """T_parent_child at a stamp, None where it is not known."""
        return self.track.at(self.track.span[1]) if self.constant else self.track.at(stamp)


@dataclass(frozen=True)
class Link:
    """The path between two frames: up from each to the frame they share."""

    from_source: tuple[Edge, ...] = ()
    from_target: tuple[Edge, ...] = ()

    @property
    def constant(self) -> bool:
        """Whether the two frames are fixed to each other."""
        return all(edge.constant for edge in (*self.from_source, *self.from_target))

    def at(self, stamp: float) -> Array | None:
        """T_target_source at a stamp, None where it is not known."""
        target, source = (_product(edges, stamp) for edges in (self.from_target, self.from_source))
        return None if target is None or source is None else inverse(target) @ source


class Frames:
    """Frames that TF messages put together."""

    def __init__(self) -> None:
        self._builders: dict[tuple[str, str], TrackBuilder] = defaultdict(TrackBuilder)
        self._static: set[tuple[str, str]] = set()
        self._edges: dict[str, Edge] = {}

    def __len__(self) -> int:
        return len(self.names())

    def add(self, message: Any, static: bool) -> None:
        """Add the transforms of a message."""
        for each in message.transforms:
            pair = frame_of(each.child_frame_id), frame_of(each.header.frame_id)
            if pair[0] and pair[1] and pair[0] != pair[1]:
                stamp = float(len(self._builders[pair])) if static else stamp_of(each.header)
                self._builders[pair].add(stamp, each.transform.translation, each.transform.rotation)
                if static:
                    self._static.add(pair)
        self._edges = {}

    def names(self) -> tuple[str, ...]:
        """All frames, by name."""
        return tuple(sorted({frame for pair in self._builders for frame in pair}))

    def link(self, target: str, source: str) -> Link | None:
        """The path from source to target; None where there is none."""
        if target == source:
            return Link()
        up, down = self._ancestry(source), self._ancestry(target)
        shared = next((frame for frame in up if frame in down), None)
        if shared is None:
            return None
        edges = self._tree()
        return Link(*(tuple(edges[f] for f in _until(line, shared)) for line in (up, down)))

    def body_of(self, frame: str) -> str:
        """The frame of the body that a sensor is on: by its name, else the last one fixed to the sensor."""
        line = self._ancestry(frame)
        named = next((each for name in _BODIES for each in line if _is(each, name)), None)
        if named is not None:
            return named
        fixed = [frame]
        for each in line[:-1]:
            if not self._tree()[each].constant:
                break
            fixed.append(self._tree()[each].parent)
        return next((each for each in reversed(fixed) if not any(_is(each, name) for name in _WORLDS)), frame)

    def world_of(self, frame: str) -> str | None:
        """The frame of an odometry in which a sensor moves; None where TF tells of no motion of it."""
        line = self._ancestry(frame)
        edges = self._tree()
        if any(_is(frame, name) for name in _WORLDS):
            return None
        moving = [i for i, each in enumerate(line[:-1]) if not edges[each].constant]
        if not moving:
            return None
        beyond = line[moving[0] + 1 :]
        return next((each for name in _WORLDS for each in beyond if _is(each, name)), beyond[-1])

    def _tree(self) -> dict[str, Edge]:
        """The edge of each frame to its parent; where there are several, to the one sent most often."""
        if not self._edges:
            # A frame may have been sent with several parents: the last one here counts, sent most often.
            pairs = sorted(self._builders, key=lambda pair: len(self._builders[pair]))
            for child, parent in pairs:
                builder = self._builders[child, parent]
                if len(builder):
                    track = builder.track()
                    constant = (child, parent) in self._static or track.still
                    self._edges[child] = Edge(parent, track, constant)
        return self._edges

    def _ancestry(self, frame: str) -> list[str]:
        """The frame, its parent, and so on, up to the root or where it would repeat."""
        line, edges = [frame], self._tree()
        while line[-1] in edges and (parent := edges[line[-1]].parent) not in line:
            line.append(parent)
        return line


def _is(frame: str, name: str) -> bool:
    """Whether a frame has that name, after the prefix of a robot."""
    return frame.rpartition("/")[2].lower() == name


def _until(line: list[str], end: str) -> list[str]:
    return line[: line.index(end)]


def _product(edges: tuple[Edge, ...], stamp: float) -> Array | None:
    """T_shared_frame of a frame from its edges up to the shared one."""
    T = np.eye(4)
    for edge in edges:
        step = edge.at(stamp)
        if step is None:
            return None
        T = step @ T
    return T
