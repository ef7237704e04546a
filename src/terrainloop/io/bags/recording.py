"""A bag as a recording: what is in it, what is used of it, and the scans."""

import heapq
import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from terrainloop.io.bags.choice import Scans, choose_poses, choose_scans, first_whole
from terrainloop.io.bags.clouds import CLOUD, points_of, sensor_of
from terrainloop.io.bags.depth import depth_points
from terrainloop.io.bags.hints import no_clouds, no_poses
from terrainloop.io.bags.placement import Placement, placement_of
from terrainloop.io.bags.poses import POSE_TYPES, frame_of, pose_of, stamp_of
from terrainloop.io.bags.reader import TF, Bag, Topic
from terrainloop.io.recordings import Description, Missing, Recording, Stream, no_scans
from terrainloop.scan import PosedScan, Scan

logger = logging.getLogger(__name__)

_LOOK_AHEAD = 16  # scans that wait for one with an earlier stamp; drivers and networks disorder a few
_LONGEST_LIST = 3  # topics that a remark names


def open_bag_recording(
    paths: Sequence[Path], cloud_topic: str | None, odometry_topic: str | None, sensor_frame: str
) -> Recording:
    """Open bags of one recording; see `terrainloop.io.recordings.open_recording`."""
    with Bag(paths) as bag:
        scans, other_scans = choose_scans(bag, cloud_topic)
        poses, other_poses = choose_poses(bag, odometry_topic)
        placement = None if scans is None else placement_of(bag, scans, poses, sensor_frame)
        remarks = list(bag.remarks)
        if scans is not None:
            remarks += _choices("scans", scans.topic, other_scans, "--cloud-topic")
        if poses is not None:
            remarks += _choices("odometry", poses, other_poses, "--odometry-topic")
        uses = _uses(scans, poses)
        streams = tuple(_stream_of(bag, topic, uses.get(topic, "")) for topic in bag.topics)
        missing = _missing(bag, scans, poses, placement, streams)
        remarks += [] if placement is None else placement.remarks
        if scans is not None and scans.camera is not None and scans.camera.distorted:
            remarks.append(f"{scans.topic.name} is taken as rectified, although its camera is distorted")
        description = Description(
            bag.kind, ", ".join(map(str, paths)), streams, tuple(remarks), tuple(missing)
        )
    if scans is None:
        return Recording(description, "unknown", 0, no_scans)
    sensor = sensor_of(scans.first, scans.topic.name) if scans.topic.type == CLOUD else "stereo"
    read = no_scans if placement is None else partial(_posed_scans, paths, scans, placement)
    return Recording(description, sensor, scans.topic.count, read)


def _choices(what: str, chosen: Topic, others: Sequence[Topic], option: str) -> list[str]:
    if not others:
        return []
    names = [topic.name for topic in others]
    listed = ", ".join(names[:_LONGEST_LIST]) + (", ..." if len(names) > _LONGEST_LIST else "")
    return [f"{chosen.name} is used as {what}, not {listed}: choose with {option}"]


def _uses(scans: Scans | None, poses: Topic | None) -> dict[Topic, str]:
    uses: dict[Topic, str] = {}
    if scans is not None:
        uses[scans.topic] = "scans"
        if scans.camera_topic is not None:
            uses[scans.camera_topic] = "camera of the scans"
    if poses is not None:
        uses[poses] = "odometry"
    return uses


def _missing(
    bag: Bag,
    scans: Scans | None,
    poses: Topic | None,
    placement: Placement | None,
    streams: Sequence[Stream],
) -> list[Missing]:
    """What keeps the bag from being used, and what to do about it."""
    missing = []
    if scans is None:
        missing.append(no_clouds(bag.topics))
        if poses is None and not any(topic.type == TF for topic in bag.topics):
            missing.append(no_poses(bag.topics))
        return missing
    if scans.topic.type != CLOUD and scans.camera is None:
        what = f"no CameraInfo with a calibration for {scans.topic.name}"
        missing.append(Missing(what, "record it beside the images"))
    if placement is None:
        return [*missing, no_poses(bag.topics)]
    stream = next(s for s in streams if (s.name, s.type) == (scans.topic.name, scans.topic.type))
    return [*missing, *placement.missing, *_clock_trouble(stream, placement)]


def _clock_trouble(scans: Stream, placement: Placement) -> list[Missing]:
    """Why no scan would have a pose, by the stamps alone."""
    stamps = [stamp for stamp in (scans.start, scans.end) if stamp is not None and stamp > 0]
    if not stamps:
        return [Missing(f"no stamps in the headers of {scans.name}", "set header.stamp when recording")]
    if placement.span is None:
        return []
    first, last = placement.span
    if max(stamps) < first or last < min(stamps):
        what = (
            f"the stamps of {scans.name} ({min(stamps):.3f} to {max(stamps):.3f} s) and of the odometry "
            f"({first:.3f} to {last:.3f} s) do not meet"
        )
        return [Missing(what, "stamp both by one clock (use_sim_time, or PTP)")]
    return []


def _stream_of(bag: Bag, topic: Topic, use: str) -> Stream:
    """A topic with the frame and the stamps of its first and last message, where they can be decoded."""
    stream = Stream(topic.name, topic.type, topic.count, use=use)
    if topic.type == TF:
        return replace(stream, use="frames" if topic.count else "")
    if not topic.count or not bag.has_header(topic):
        return stream
    first, raw = first_whole(bag, topic), bag.last(topic)
    last = None if raw is None else bag.decode(topic, raw)
    if first is None:
        return stream
    frame, end = frame_of(first.header.frame_id), None if last is None else stamp_of(last.header)
    if topic.type in POSE_TYPES and (child := pose_of(first, topic.type).child):
        frame = f"{child} in {frame}"
    return replace(stream, frame=frame, start=stamp_of(first.header), end=end)


def _posed_scans(
    paths: Sequence[Path], scans: Scans, placement: Placement, dropped: Counter[str]
) -> Iterator[PosedScan]:
    """The scans of a bag with their poses, in the order of their stamps."""
    with Bag(paths) as bag:
        for stamp, _, message in _in_order(bag, scans.topic, dropped):
            try:
                scan = _scan_of(message, stamp, scans)
            except ValueError as error:
                logger.info("%s: a scan at %.3f s is damaged: %s", scans.topic.name, stamp, error)
                dropped["damaged"] += 1
                continue
            if len(scan) == 0:
                dropped["without points"] += 1
                continue
            posed = placement.place(scan, frame_of(message.header.frame_id), dropped)
            if posed is not None:
                yield posed


def _in_order(bag: Bag, topic: Topic, dropped: Counter[str]) -> Iterator[tuple[float, int, Any]]:
    """Stamps and messages of a topic in the order of stamps, which bags keep only roughly."""
    waiting: list[tuple[float, int, Any]] = []
    latest = -np.inf
    for number, (_, _, raw) in enumerate(bag.messages([topic])):
        message = bag.decode(topic, raw)
        stamp = 0.0 if message is None else stamp_of(message.header)
        if message is None:
            dropped["damaged"] += 1
        elif stamp <= 0:
            dropped["without a stamp"] += 1
        elif stamp < latest:
            dropped[f"later than {_LOOK_AHEAD} scans that follow it"] += 1
        else:
            heapq.heappush(waiting, (stamp, number, message))
        if len(waiting) > _LOOK_AHEAD:
            earliest = heapq.heappop(waiting)
            latest = earliest[0]
            yield earliest
    while waiting:
        yield heapq.heappop(waiting)


def _scan_of(message: Any, stamp: float, scans: Scans) -> Scan:
    if scans.camera is not None:
        return Scan(depth_points(message, scans.camera), stamp)
    points, intensity = points_of(message)
    return Scan(points, stamp, intensity)
