"""A folder of scans with a trajectory, or a mission of submaps, as a recording."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, is_rigid
from terrainloop.io.clouds import SCAN_SUFFIXES, read_scan
from terrainloop.io.gravity import T_BODY_OPTICAL, why_not_upright
from terrainloop.io.missions import CLOUDS, load_mission
from terrainloop.io.ordering import order_of_names, times_in_names
from terrainloop.io.pose_track import PoseTrack
from terrainloop.io.recordings import (
    MISSION_KIND,
    Description,
    Missing,
    Recording,
    Sensor,
    Stream,
    no_scans,
)
from terrainloop.io.trajectories import Trajectory, read_trajectory
from terrainloop.scan import PosedScan, Scan

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_FOLDERS = (CLOUDS, "scans", "velodyne", "velodyne_points/data", "lidar", ".")
_TRAJECTORIES = ("poses.tum", "odometry.tum", "poses.txt", "odometry.txt")
_TEXTS = (".txt", ".csv")  # in the folder itself these hold trajectories and notes
_TIMES, _CALIBRATION = "times.txt", "calib.txt"
_SHORTEST_STEP = 1e-3  # seconds between two scans
_LARGEST_TEXT = 64 << 20  # bytes
_NO_ODOMETRY = Missing("no odometry.tum, which 'terrainloop slam' needs", "write one pose for each submap")
_OUTSIDE = "outside the time span of the poses, or in a gap of them"


@dataclass(frozen=True, eq=False)
class _Posed:
    """Files in order, the stamp of each, and its pose where that is known."""

    files: tuple[Path, ...]
    stamps: Array
    poses: tuple[Array | None, ...]


def open_folder_recording(folder: Path, sensor_frame: str) -> Recording:
    """Open a folder of scans or a mission; see `terrainloop.io.recordings.open_recording`.

    Raises
    ------
    TerrainLoopError
        If there are no scans, or the poses cannot be read or do not fit to them.
    """
    if sensor_frame not in ("auto", "body", "optical"):
        raise TerrainLoopError(
            expected="'auto', 'body' or 'optical' as the frame of scans in files",
            found=f"{sensor_frame!r}",
            mend="only bags know frames by name",
        )
    mission = _mission_of(folder)
    return mission if mission is not None else _scans_of(folder, sensor_frame)


def _mission_of(folder: Path) -> Recording | None:
    """The folder as a mission of submaps; None where it is not one by its trajectories."""
    if any((folder / f"poses{suffix}").is_file() for suffix in (".tum", ".txt")):
        return None
    try:
        mission = load_mission(folder)
    except TerrainLoopError as error:
        logger.info("%s is not a mission of submaps: %s", folder, error)
        return None
    known = {"odometry": mission.odometry, "truth": mission.truth}
    trajectories = {name: trajectory for name, trajectory in known.items() if trajectory is not None}
    if not trajectories:
        return None
    poses = mission.odometry.poses if mission.odometry is not None else [None] * len(mission)
    posed = _Posed(mission.files, next(iter(trajectories.values())).stamps, tuple(poses))
    streams = (_clouds_stream(posed, "submaps"), *(_poses_stream(*item) for item in trajectories.items()))
    remarks = ("every cloud is a submap: 'terrainloop detect' takes it as it is",)
    missing = () if mission.odometry is not None else (_NO_ODOMETRY,)
    description = Description(MISSION_KIND, str(folder), streams, remarks, missing)
    return Recording(description, "unknown", len(mission), partial(_posed_scans, posed, np.eye(4)))


def _scans_of(folder: Path, sensor_frame: str) -> Recording:
    files = _files_in(folder)
    kitti = files[0].suffix.lower() == ".bin"
    kind = f"folder of scans ({'KITTI' if kitti else 'cloud files'})"
    sensor: Sensor = "lidar" if kitti else "unknown"
    source = _trajectory_file(folder, files[0].parent)
    if source is None:
        clouds = Stream(files[0].parent.name, _suffixes(files), len(files), use="scans")
        description = Description(kind, str(folder), (clouds,), missing=(_no_poses(folder),))
        return Recording(description, sensor, len(files), no_scans)
    trajectory, remarks = _calibrated(read_trajectory(source), source, files[0].parent)
    posed = _posed(files, trajectory, source)
    T_frame_points = T_BODY_OPTICAL if sensor_frame == "optical" else np.eye(4)
    missing = _tilted(trajectory, source)
    streams = (_clouds_stream(posed, "scans"), _poses_stream(source.name, trajectory))
    description = Description(kind, str(folder), streams, remarks, missing)
    return Recording(description, sensor, len(files), partial(_posed_scans, posed, T_frame_points))


def _no_poses(folder: Path) -> Missing:
    return Missing(
        "no poses of the scans",
        f"put one of {', '.join(_TRAJECTORIES)} (TUM or KITTI) into {folder}, one line for each scan in the "
        "order of the names; an odometry such as KISS-ICP makes them",
    )


def _posed_scans(posed: _Posed, T_frame_points: Array, dropped: Counter[str]) -> Iterator[PosedScan]:
    """Scans in the order of their stamps; broken files are left out and counted."""
    for index in np.argsort(posed.stamps, kind="stable"):
        pose = posed.poses[index]
        if pose is None:
            dropped[_OUTSIDE] += 1
            continue
        scan = _read(posed.files[index], float(posed.stamps[index]))
        if scan is None or len(scan) == 0:
            dropped["damaged" if scan is None else "without points"] += 1
            continue
        yield PosedScan(scan, pose @ T_frame_points)


def _read(file: Path, stamp: float) -> Scan | None:
    try:
        return read_scan(file, stamp)
    except TerrainLoopError as error:
        logger.warning("left out %s: %s", file.name, error)
        return None


def _files_in(folder: Path) -> list[Path]:
    """Scans of a folder, by name.

    Raises
    ------
    TerrainLoopError
        If there are none, or it cannot be read.
    """
    try:
        for name in _FOLDERS:
            suffixes = [s for s in SCAN_SUFFIXES if name != "." or s not in _TEXTS]
            place = folder / name
            inside = sorted(place.iterdir()) if place.is_dir() else []
            visible = [file for file in inside if not file.name.startswith(".") and file.is_file()]
            if files := [file for file in visible if file.suffix.lower() in suffixes]:
                return files
    except OSError as error:
        raise TerrainLoopError(
            expected=f"to read the folder {folder}", found=str(error.strerror), mend="check its permissions"
        ) from error
    raise TerrainLoopError(
        expected=f"a bag, or scans ({' '.join('*' + s for s in SCAN_SUFFIXES)}), in {folder}",
        found="neither there nor in " + ", ".join(_FOLDERS[:-1]),
        mend="give the folder of the scans or of the bag",
    )


def _trajectory_file(folder: Path, scans: Path) -> Path | None:
    """The trajectory beside the scans, above them, or in the folder that was given."""
    places = dict.fromkeys([folder, scans, scans.parent] if scans != folder else [folder, folder.parent])
    files = (place / name for place in places for name in _TRAJECTORIES)
    return next((file for file in files if file.is_file()), None)


def _calibrated(trajectory: Trajectory, source: Path, scans: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """Poses of the scanner where they are those of KITTI's camera, and its times.

    KITTI's poses are those of the camera, in the world of its first frame; calib.txt holds Tr, which takes
    points of the scanner into the camera's frame.
    """
    remarks: list[str] = []
    stamps, poses = trajectory.stamps, trajectory.poses
    indices = bool((stamps == np.arange(len(stamps))).all())
    times = _numbers_of(_beside(_TIMES, source, scans)) if indices else None
    if times is not None and len(times) == len(stamps):
        stamps = times
        remarks.append(f"stamps from {_TIMES}")
    calibration = _beside(_CALIBRATION, source, scans) if indices and source.suffix == ".txt" else None
    T_camera_scanner = None if calibration is None else _tr_of(calibration)
    if T_camera_scanner is not None:
        poses = inverse(T_camera_scanner) @ poses @ T_camera_scanner
        remarks.append(f"the poses are those of the camera: taken to the scanner by Tr of {_CALIBRATION}")
    return Trajectory(stamps, poses), tuple(remarks)


def _beside(name: str, source: Path, scans: Path) -> Path | None:
    places = (source.parent, scans, scans.parent)
    return next((place / name for place in places if (place / name).is_file()), None)


def _text_of(path: Path) -> str:
    try:
        return path.read_text(errors="replace") if path.stat().st_size <= _LARGEST_TEXT else ""
    except OSError:
        return ""


def _numbers_of(path: Path | None) -> Array | None:
    """The numbers of a text; None where there is something else in it."""
    try:
        numbers = None if path is None else np.array(_text_of(path).split(), dtype=np.float64)
    except ValueError:
        return None
    return numbers if numbers is not None and np.isfinite(numbers).all() else None


def _tr_of(calibration: Path) -> Array | None:
    """T_camera_scanner of KITTI's odometry calibration; None where there is none."""
    for line in _text_of(calibration).splitlines():
        name, _, rest = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
            try:
                T = np.vstack([np.array(rest.split(), dtype=np.float64).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
            except ValueError:
                return None
            return T if is_rigid(T) else None
    return None


def _posed(files: Sequence[Path], trajectory: Trajectory, source: Path) -> _Posed:
    """A pose for each scan: one each in the order of names, else interpolated at the stamps in the names."""
    names = [file.stem for file in files]
    if len(trajectory) == len(files):
        ordered = tuple(files[i] for i in order_of_names(names, [trajectory.stamps]))
        return _Posed(ordered, trajectory.stamps, tuple(trajectory.poses))
    track = PoseTrack.of(trajectory)
    first, last = track.span
    readings = [times for times, surely in times_in_names(names) if surely and _is_rate(times)]
    inside = [int(((times >= first) & (times <= last)).sum()) for times in readings]
    if not any(inside):
        raise TerrainLoopError(
            expected=f"{len(files)} poses, one for each scan, or stamps in the names of the scans within "
            f"{first:.15g} to {last:.15g} s",
            found=f"{len(trajectory)} poses in {source}, and scans such as {files[0].name}",
            mend="give one line for each scan in the order of the names, or name the scans by their stamps",
        )
    stamps = readings[int(np.argmax(inside))]
    return _Posed(tuple(files), stamps, tuple(track.at(float(stamp)) for stamp in stamps))


def _is_rate(times: Array) -> bool:
    """Whether scans could be taken at these times; not so if they are counters."""
    return len(times) < 2 or float(np.median(np.diff(np.sort(times)))) > _SHORTEST_STEP


def _tilted(trajectory: Trajectory, source: Path) -> tuple[Missing, ...]:
    """Why the poses are of no use, if neither a body nor a camera is upright in their world."""
    rotations = trajectory.poses[:, :3, :3]
    why = why_not_upright(rotations, "")
    if not why or not why_not_upright(rotations, "optical"):
        return ()
    calibrate = f", or put KITTI's {_CALIBRATION} (Tr) beside them" if "y axis" in why else ""
    words = f"the poses in {source.name} are not gravity-aligned: {why}"
    return (Missing(words, f"give them in a world with z up{calibrate}"),)


def _clouds_stream(posed: _Posed, use: str) -> Stream:
    start, end = float(posed.stamps.min()), float(posed.stamps.max())
    folder = posed.files[0].parent.name
    return Stream(folder, _suffixes(posed.files), len(posed.files), start=start, end=end, use=use)


def _poses_stream(name: str, trajectory: Trajectory) -> Stream:
    start, end = float(trajectory.stamps.min()), float(trajectory.stamps.max())
    use = "evaluation" if name == "truth" else "odometry"
    return Stream(name, "poses", len(trajectory), start=start, end=end, use=use)


def _suffixes(files: Sequence[Path]) -> str:
    return " ".join(sorted({file.suffix.lower() for file in files}))
