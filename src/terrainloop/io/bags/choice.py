"""Which topics of a bag hold the scans and the poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from terrainloop.errors import TerrainLoopError
from terrainloop.io.bags.clouds import CLOUD
from terrainloop.io.bags.depth import CAMERA_INFO, ENCODINGS, IMAGE, Camera
from terrainloop.io.bags.poses import POSE_TYPES, frame_of, pose_of
from terrainloop.io.bags.reader import Bag, Topic

_NO_ODOMETRY = ("goal", "initialpose", "setpoint", "target", "clicked", "waypoint", "command")  # in names
_TRUTH = ("truth", "gt_", "_gt", "vicon", "optitrack", "mocap")  # in names; taken if there is nothing else
_DERIVED = (
    "map",
    "filtered",
    "ground",
    "obstacle",
    "downsample",
    "voxel",
    "cluster",
    "feature",
    "corner",
    "surf",
)


@dataclass(frozen=True)
class Scans:
    """The topic with the scans, its first message, and the camera of depth images."""

    topic: Topic
    first: Any
    camera: Camera | None = None
    camera_topic: Topic | None = None

    @property
    def frame(self) -> str:
        """The frame of the first scan."""
        return frame_of(self.first.header.frame_id)


def choose_scans(bag: Bag, name: str | None) -> tuple[Scans | None, list[Topic]]:
    """The topic with the scans, None where there is none, and others that could have been it.

    Clouds come before depth images, clouds of a sensor before those that were made of them (by their names),
    then those with the most points.

    Raises
    ------
    TerrainLoopError
        If a topic was named that is not there or holds none.
    """
    topics = (
        [named(bag, name, (CLOUD, IMAGE))] if name else [t for t in bag.topics if t.type in (CLOUD, IMAGE)]
    )
    found = [scans for topic in topics if topic.count and (scans := _scans_of(bag, topic)) is not None]
    if name and not found:
        raise TerrainLoopError(
            expected=f"point clouds or depth images in {name}",
            found="images of another encoding, or no whole message",
            mend="name another topic",
        )
    found.sort(key=_worth, reverse=True)
    return (found[0] if found else None), [scans.topic for scans in found[1:]]


def choose_poses(bag: Bag, name: str | None) -> tuple[Topic | None, list[Topic]]:
    """The topic with the poses, None where there is none, and others that could have been it.

    Raises
    ------
    TerrainLoopError
        If a topic was named that is not there or holds none.
    """
    if name:
        return named(bag, name, POSE_TYPES), []
    found = [t for t in bag.topics if t.type in POSE_TYPES and t.count > 1 and not _has(t.name, _NO_ODOMETRY)]
    found.sort(key=lambda t: (_has(t.name, _TRUTH), POSE_TYPES.index(t.type), -t.count, t.name))
    return (found[0] if found else None), found[1:]


def named(bag: Bag, name: str, types: Sequence[str]) -> Topic:
    """The topic of that name with one of the types.

    Raises
    ------
    TerrainLoopError
        If there is none.
    """
    slashless = [topic for topic in bag.topics if topic.name.lstrip("/") == name.lstrip("/")]
    found = [topic for topic in slashless if topic.type in types]
    if found:
        return found[0]
    possible = [topic.name for topic in bag.topics if topic.type in types]
    raise TerrainLoopError(
        expected=f"a topic {name} of type {' or '.join(types)}",
        found=f"{slashless[0].type} there" if slashless else f"no such topic in {bag.path}",
        mend=f"name one of {', '.join(possible)}" if possible else "see 'terrainloop info' for what is there",
    )


def first_whole(bag: Bag, topic: Topic) -> Any:
    """The first message that is not damaged; None where there is none."""
    decoded = (bag.decode(topic, raw) for _, _, raw in bag.messages([topic]))
    return next((message for message in decoded if message is not None), None)


def child_frame_of(bag: Bag, topic: Topic) -> tuple[str, str]:
    """The frames of a topic with poses: world, and body (empty where the type names none)."""
    message = first_whole(bag, topic)
    if message is None:
        return "", ""
    pose = pose_of(message, topic.type)
    return pose.frame, pose.child


def _scans_of(bag: Bag, topic: Topic) -> Scans | None:
    message = first_whole(bag, topic)
    if message is None or topic.type == CLOUD:
        return None if message is None else Scans(topic, message)
    if message.encoding not in ENCODINGS or (
        message.encoding == "mono16" and "depth" not in topic.name.lower()
    ):
        return None
    info = _camera_topic(bag, topic, message.header.frame_id)
    found = None if info is None else first_whole(bag, info)
    return Scans(topic, message, None if found is None else Camera.of(found), info)


def _camera_topic(bag: Bag, image: Topic, frame: str) -> Topic | None:
    """The CameraInfo beside an image, else one of its frame, else the only one."""
    infos = [topic for topic in bag.topics if topic.type == CAMERA_INFO and topic.count]
    beside = f"{image.name.rpartition('/')[0]}/camera_info"
    by_name = [topic for topic in infos if topic.name == beside]
    by_frame = [topic for topic in infos if _frame(bag, topic) == frame_of(frame)] if not by_name else []
    chosen = by_name or by_frame or (infos if len(infos) == 1 else [])
    return chosen[0] if chosen else None


def _frame(bag: Bag, topic: Topic) -> str | None:
    message = first_whole(bag, topic)
    return None if message is None else frame_of(message.header.frame_id)


def _worth(scans: Scans) -> tuple[bool, bool, int]:
    points = int(scans.first.width) * int(scans.first.height)
    return scans.topic.type == CLOUD, not _has(scans.topic.name, _DERIVED), scans.topic.count * points


def _has(name: str, words: Sequence[str]) -> bool:
    return any(word in name.lower() for word in words)
