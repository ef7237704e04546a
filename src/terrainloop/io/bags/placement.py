"""Where the sensor of a bag is at a time: odometry and the frames between it and the sensor."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, transform
from terrainloop.io.bags.choice import Scans, child_frame_of
from terrainloop.io.bags.depth import IMAGE
from terrainloop.io.bags.frames import Frames, Link
from terrainloop.io.bags.poses import TrackBuilder, pose_of
from terrainloop.io.bags.reader import TF, Bag, Topic
from terrainloop.io.gravity import T_BODY_OPTICAL, is_optical, is_planar, why_not_upright
from terrainloop.io.pose_track import PoseTrack
from terrainloop.io.recordings import Missing
from terrainloop.scan import PosedScan, Scan

Array = NDArray[np.float64]

_ALIGN = "publish odometry in a world with z up (with an IMU, in the frames of REP 105)"
_OTHER_FRAME = "in a frame that TF does not join to the odometry's"
_OUTSIDE = "outside the time span of the odometry, or in a gap of it"


@dataclass(frozen=True, eq=False)
class Placement:
    """Poses of the sensor over time, and what was assumed about them.

    Attributes
    ----------
    world, body : str
        Frames of the odometry, empty where they are not named.
    track : PoseTrack or None
        T_world_body; None where the pose comes from TF alone.
    frames : Frames
    sensor_frame : str
        As asked for: "auto", "optical", "body" or the name of a frame.
    optical_without_tf : bool
        Whether scans of a frame that TF does not know are in that of a camera.
    remarks : list of str
    missing : list of Missing
    """

    world: str
    body: str
    track: PoseTrack | None
    frames: Frames
    sensor_frame: str
    optical_without_tf: bool
    remarks: list[str] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)
    _mounts: dict[str, "Mount | None"] = field(default_factory=dict)

    @property
    def span(self) -> tuple[float, float] | None:
        """First and last stamp of the odometry; None where it comes from TF."""
        return None if self.track is None else self.track.span

    def mount(self, frame: str) -> "Mount | None":
        """How scans of a frame are mounted on the body; None where that is not known."""
        if frame not in self._mounts:
            self._mounts[frame] = self._found_mount(frame)
        return self._mounts[frame]

    def place(self, scan: Scan, frame: str, dropped: Counter[str]) -> PosedScan | None:
        """The scan with its pose; None, and counted, where that is not known."""
        mount = self.mount(frame)
        if mount is None:
            dropped[_OTHER_FRAME] += 1
            return None
        T_body_sensor = mount.link.at(scan.stamp)
        T_world_body = np.eye(4) if self.track is None else self.track.at(scan.stamp)
        if T_body_sensor is None or T_world_body is None:
            dropped[_OUTSIDE] += 1
            return None
        covariance = None if self.track is None else self.track.covariance_at(scan.stamp)
        if not mount.registered:
            return PosedScan(scan, T_world_body @ T_body_sensor @ mount.T_frame_points, covariance)
        T_body_points = inverse(T_world_body) if mount.link == Link() else T_body_sensor
        points = transform(T_body_points, scan.points)
        return PosedScan(Scan(points, scan.stamp, scan.intensity), T_world_body, covariance)

    def _found_mount(self, frame: str) -> "Mount | None":
        named = frame if self.sensor_frame == "auto" else self.sensor_frame
        if self.sensor_frame in ("body", "optical"):
            named = self.body
        T_frame_points = T_BODY_OPTICAL if self.sensor_frame == "optical" else np.eye(4)
        if self.track is None:
            link = self.frames.link(self.world, named)
            return None if link is None else Mount(link, T_frame_points)
        if self.world and named == self.world:
            return Mount(Link(), registered=True)
        link = self.frames.link(self.body, named)
        if link is not None:  # a frame above the body, in which it moves, is that of a map
            return Mount(link, T_frame_points, registered=not link.from_source and not link.constant)
        if self.sensor_frame != "auto" or len(self.frames):
            return None
        return Mount(Link(), T_BODY_OPTICAL if self.optical_without_tf else np.eye(4))


@dataclass(frozen=True, eq=False)
class Mount:
    """The pose of the points of a scan on the body.

    Attributes
    ----------
    link : Link
        From the frame of the points to that of the body, or to the world where TF is the odometry.
    T_frame_points : array, (4, 4)
        The turn out of an optical frame that TF does not know.
    registered : bool
        Whether the points are in the world of the odometry, or that of a map, already.
    """

    link: Link
    T_frame_points: Array = field(default_factory=lambda: np.eye(4))
    registered: bool = False


def placement_of(bag: Bag, scans: Scans, poses: Topic | None, sensor_frame: str) -> Placement | None:
    """Read the odometry and the frames of a bag; None where there is neither.

    Raises
    ------
    TerrainLoopError
        If the frame that was named is not in TF.
    """
    tf = [topic for topic in bag.topics if topic.type == TF and topic.count]
    frames = _read_frames(bag, tf)
    named = scans.frame if sensor_frame in ("auto", "optical", "body") else sensor_frame
    if sensor_frame == named and named not in frames.names():
        raise TerrainLoopError(
            expected="'auto', 'optical', 'body' or a frame of TF as the sensor's frame",
            found=f"{sensor_frame!r}, and TF has {', '.join(frames.names()) or 'no frames'}",
            mend="name one of them",
        )
    if poses is None:
        return _from_tf(frames, named, sensor_frame)
    world, body = child_frame_of(bag, poses)
    remarks: list[str] = []
    track = _read_track(bag, poses, world, body, remarks)
    optical = is_optical(named) or scans.topic.type == IMAGE
    placement = Placement(world, body, track, frames, sensor_frame, optical, remarks)
    if track is None:
        placement.missing.append(Missing(f"{poses.name} holds no pose that can be used", "record it again"))
        return placement
    if not body and sensor_frame not in ("optical", "body"):
        body = _unnamed_body(frames, named, track)
        remarks.append(
            f"{poses.name} names no frame that it is the pose of: taken as that of "
            f"{body or 'a body with z up'!r}"
        )
        placement = replace(placement, body=body)
    _check(placement, scans.frame, poses, track)
    return placement


def _unnamed_body(frames: Frames, sensor: str, track: PoseTrack) -> str:
    """The frame of poses that name none: the body that TF has the sensor on, else the sensor itself.

    Empty if the sensor is a camera by its name, and the poses those of a body with z up by their tilt.
    """
    body = frames.body_of(sensor)
    upright = not why_not_upright(track.rotations, "")
    tilted_camera = is_optical(body) and bool(why_not_upright(track.rotations, body))
    return "" if upright and tilted_camera else body


def _check(placement: Placement, frame: str, poses: Topic, track: PoseTrack) -> None:
    """Say what was assumed of the frames, and what of them makes the odometry useless."""
    mount = placement.mount(frame)
    body = placement.body
    if mount is None:
        placement.missing.append(
            Missing(
                f"no TF that joins the frame {frame!r} of the scans to {body!r} of {poses.name}",
                "record /tf_static, or give --sensor-frame body (scans in that frame) or optical (a camera)",
            )
        )
    elif mount.registered:
        placement.remarks.append(f"the scans are in the fixed frame {frame!r}: taken back into {body!r}")
    elif mount.T_frame_points is T_BODY_OPTICAL and placement.sensor_frame == "auto":
        placement.remarks.append(
            f"no TF from {frame!r} to {body!r}: turned out of the optical frame, taken as mounted level at "
            "its origin"
        )
    elif placement.sensor_frame == "auto" and mount.link == Link() and frame != body:
        placement.remarks.append(
            f"no TF from {frame!r} to {body!r}: taken as the same frame; where the sensor is mounted with a "
            "tilt, record /tf_static"
        )
    if is_planar(track.positions, track.rotations):
        placement.remarks.append(
            f"{poses.name} is planar (level, at one height): on slopes its world is not gravity-aligned; "
            "better use odometry in three dimensions"
        )
    if why := why_not_upright(track.rotations, body):
        placement.missing.append(Missing(f"{poses.name} is not gravity-aligned: {why}", _ALIGN))


def _from_tf(frames: Frames, frame: str, sensor_frame: str) -> Placement | None:
    world = frames.world_of(frame)
    if world is None:
        return None
    body = frames.body_of(frame)
    placement = Placement(world, body, None, frames, sensor_frame, optical_without_tf=False)
    placement.remarks.append(f"no topic with poses: taken from TF, {body!r} in {world!r}")
    link = frames.link(world, body)
    moving = [] if link is None else [edge for edge in link.from_source if not edge.constant]
    stamps: Sequence[float] = moving[0].track.stamps.tolist() if moving else []
    poses = [T for stamp in stamps if link is not None and (T := link.at(stamp)) is not None]
    if poses and (why := why_not_upright(np.array(poses)[:, :3, :3], body)):
        what = f"{body!r} in {world!r} of TF is not gravity-aligned: {why}"
        placement.missing.append(Missing(what, _ALIGN))
    return placement


def _read_frames(bag: Bag, topics: Sequence[Topic]) -> Frames:
    frames = Frames()
    for topic, _, raw in bag.messages(topics):
        message = bag.decode(topic, raw)
        if message is not None:
            frames.add(message, static=topic.name.endswith("tf_static"))
    return frames


def _read_track(bag: Bag, topic: Topic, world: str, child: str, remarks: list[str]) -> PoseTrack | None:
    """All poses of a topic in the frames of its first; None where none can be used."""
    builder = TrackBuilder()
    for _, _, raw in bag.messages([topic]):
        message = bag.decode(topic, raw)
        pose = None if message is None else pose_of(message, topic.type)
        if pose is None:
            builder.dropped["are damaged"] += 1
        elif pose.stamp <= 0:
            builder.dropped["have no stamp"] += 1
        elif pose.frame != world or pose.child not in ("", child):
            builder.dropped["are of other frames"] += 1
        else:
            builder.add(pose.stamp, pose.position, pose.quaternion, pose.covariance)
    remarks += [f"{count} poses of {topic.name} {why}: left out" for why, count in builder.dropped.items()]
    return builder.track() if len(builder) else None
