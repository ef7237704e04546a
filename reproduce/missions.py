"""The missions: simulated stand-ins for the paper's, further simulated ones, and real ones if given."""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import yaml

from benchmarks.provenance import fingerprint
from reproduce.appearance.rendering import colours_of, images_of
from reproduce.baselines.method import Observation, Scale
from reproduce.kept import code_key, is_current
from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.overlap import ground_cell, observed_iou
from terrainloop.io.missions import Mission, load_mission, read_sessions
from terrainloop.io.trajectories import Trajectory, write_tum
from terrainloop.record import SubmapRecord
from terrainloop.simulation.missions import SimulatedMission, simulate_mission, write_mission
from terrainloop.submap import Submap

SUBMAPS, SUBMAPS_QUICK = 16, 8  # the paper's datasets have about 15


@dataclass(frozen=True)
class StandIn:
    """A simulated mission; a true match shares more than `min_overlap` (bounding-box IoU)."""

    name: str
    world: str
    seed: int
    sensor: str
    min_overlap: float


# The paper asks for 0.3 on Etna and for 0.1 on Morocco. No setting was chosen on these seeds.
PAPER = (
    StandIn("Etna1", "etna", 201, "stereo", 0.3),
    StandIn("Etna2", "etna", 202, "stereo", 0.3),
    StandIn("Etna3", "etna", 203, "stereo", 0.3),
    StandIn("Etna4", "etna", 204, "stereo", 0.3),
    StandIn("Morocco", "morocco", 205, "stereo", 0.1),
)
BEYOND = (
    StandIn("Mars", "mars", 206, "stereo", 0.3),
    StandIn("EtnaLidar", "etna", 207, "lidar", 0.3),
)
QUICK = (PAPER[0], PAPER[4])
REAL_MIN_OVERLAP = 0.3
REAL_SUBMAPS = 30  # of a real mission: every pair is scored by every method
SESSIONS_FILE = "passes.csv"
RECORD_FILE = "made_by.json"  # key of the code that simulated the mission
FRAMES_FILE = "frames.npy"  # T_world_body at each image, (submaps, images, 4, 4)
EVERY = 2  # frames from image to image: 1 m


@dataclass(frozen=True, eq=False)
class Drive:
    """A mission on disk, and the overlap of a true match."""

    name: str
    path: Path
    min_overlap: float

    @cached_property
    def key(self) -> str:
        """Fingerprint of every file in its folder."""
        return fingerprint(self.path)

    @cached_property
    def mission(self) -> Mission:
        return load_mission(self.path)

    @cached_property
    def sessions(self) -> dict[str, str] | None:
        """Session of each submap by name, if a file beside the clouds lists them."""
        file = self.path / SESSIONS_FILE
        return read_sessions(file) if file.exists() else None

    @cached_property
    def poses(self) -> np.ndarray:
        """True T_world_submap, (M, 4, 4)."""
        if self.mission.truth is None:
            raise TerrainLoopError(
                expected=f"truth.tum in {self.path}",
                found="none",
                mend="give the true pose of each submap, one line per cloud",
            )
        return self.mission.truth.poses

    @cached_property
    def submaps(self) -> list[Submap]:
        return [self.mission.read(i) for i in range(len(self.mission))]

    @cached_property
    def records(self) -> list[SubmapRecord]:
        return [SubmapRecord.of(submap) for submap in self.submaps]

    @cached_property
    def scale(self) -> Scale:
        return Scale.of(self.submaps)

    @cached_property
    def observed_iou(self) -> np.ndarray:
        """Ground observed by both of two submaps over ground observed by either, (M, M)."""
        clouds = [submap.points for submap in self.submaps]
        return observed_iou(clouds, self.poses, ground_cell(clouds))

    def observations(self) -> Iterator[Observation]:
        """The data of each submap that a method has access to, in chronological order."""
        odometry = self.mission.odometry
        for i, (name, submap) in enumerate(zip(self.mission.names, self.submaps, strict=True)):
            yield Observation(
                submap,
                None if odometry is None else odometry.poses[i],
                _colours(self.path / "colours" / f"{name}.npy"),
                tuple(self.images(name)),
            )

    @property
    def filmed(self) -> bool:
        """Whether there are camera images with known poses."""
        return (self.path / FRAMES_FILE).exists() and any((self.path / "images").iterdir())

    def images(self, name: str) -> list[np.ndarray]:
        """Grey camera images of a submap in chronological order."""
        files = sorted((self.path / "images").glob(f"{name}_*.png"))
        return [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]

    def pairs(self) -> list[tuple[int, int]]:
        """Every (source, target) that is evaluated: source later, not consecutive, of another session."""
        return pairs_of(self.mission.names, self.sessions)


def pairs_of(names: Sequence[str], sessions: Mapping[str, str] | None) -> list[tuple[int, int]]:
    return [
        (i, j)
        for i in range(len(names))
        for j in range(i - 1)
        if sessions is None or sessions[names[i]] != sessions[names[j]]
    ]


def _colours(file: Path) -> np.ndarray | None:
    return np.load(file) if file.exists() else None


def simulated(stand_in: StandIn, folder: Path, submaps: int) -> Drive:
    """The stand-in as a mission folder; simulated unless already there from the same code."""
    path = folder / stand_in.name
    asked = {
        "world": stand_in.world,
        "seed": stand_in.seed,
        "submaps": submaps,
        "sensor": stand_in.sensor,
    }
    if path.exists():
        _check_same(path, asked)
    if not is_current(path / RECORD_FILE, code_key()):
        print(f"simulating {stand_in.name}: {stand_in.world}, seed {stand_in.seed}, {stand_in.sensor}")
        aside = folder / f".{stand_in.name}"
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        mission = simulate_mission(**asked)
        write_mission(mission, aside)
        _write_appearance(mission, aside)
        (aside / RECORD_FILE).write_text(json.dumps({"key": code_key()}))
        shutil.rmtree(path, ignore_errors=True)
        aside.rename(path)
    return Drive(stand_in.name, path, stand_in.min_overlap)


def _write_appearance(mission: SimulatedMission, folder: Path) -> None:
    """Camera images, the true pose of the rover at each, and the colours of the points."""
    for name in ("images", "colours"):
        (folder / name).mkdir(exist_ok=True)
    for i, (images, colours) in enumerate(zip(images_of(mission, EVERY), colours_of(mission), strict=True)):
        np.save(folder / "colours" / f"{i:06d}.npy", colours)
        for k, image in enumerate(images):
            cv2.imwrite(str(folder / "images" / f"{i:06d}_{k:02d}.png"), image)
    np.save(folder / FRAMES_FILE, mission.frames[:, ::EVERY])


def _check_same(path: Path, asked: Mapping[str, object]) -> None:
    there = yaml.safe_load((path / "simulation.yaml").read_text(encoding="utf-8"))
    if {key: there[key] for key in asked} != asked:
        raise TerrainLoopError(
            expected=f"{asked} in {path}",
            found=str({key: there[key] for key in asked}),
            mend="name another output folder with -o",
        )


def real(path: Path, folder: Path) -> Drive:
    """A real mission; of a large one, the submaps nearest its middle, as links in the folder."""
    drive = Drive(path.name, path, REAL_MIN_OVERLAP)
    if len(drive.poses) <= REAL_SUBMAPS:
        return drive
    print(f"{drive.name}: of {len(drive.mission)} submaps the {REAL_SUBMAPS} nearest the middle")
    part = folder / path.name
    shutil.rmtree(
        part, ignore_errors=True
    )  # links and two tables are cheap enough to be rewritten every time
    _write_part(drive, part)
    return Drive(path.name, part, REAL_MIN_OVERLAP)


def _write_part(drive: Drive, folder: Path) -> None:
    places = drive.poses[:, :2, 3]
    distances = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    chosen = np.sort(np.argsort(distances, kind="stable")[:REAL_SUBMAPS])
    (folder / "clouds").mkdir(parents=True)
    for file in (drive.mission.files[i] for i in chosen):
        (folder / "clouds" / file.name).symlink_to(file.resolve())
    for name in ("odometry", "truth"):
        trajectory = getattr(drive.mission, name)
        if trajectory is not None:
            part = Trajectory(trajectory.stamps[chosen], trajectory.poses[chosen])
            write_tum(folder / f"{name}.tum", part)
    if drive.sessions is not None:
        shutil.copy(drive.path / SESSIONS_FILE, folder)
