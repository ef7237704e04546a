"""Visual loop closures, image by image (paper, Fig. 7): the images of the same drives, in a bag of words."""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from csv import DictReader
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.provenance import fingerprint
from reproduce.baselines.ibow import closures, features_of
from reproduce.kept import code_key, is_current
from reproduce.missions import FRAMES_FILE, Drive
from terrainloop.geometry import yaw_of
from terrainloop.io.files import write_whole_text

SKIPPED = 14  # images just before one: two submaps of 7 m, as pairs of neighbours are left out
NEAR = 2.0  # metres between two cameras at the same place
ALIKE = np.radians(30.0)  # between two headings with the same view


@dataclass(frozen=True, eq=False)
class Frames:
    """Loop closures of the images of a drive, and the ground truth.

    Attributes
    ----------
    name : str
        Name of the mission.
    closed : array, (N,) int
        Earlier image that is considered the same place, -1 for none.
    inliers : array, (N,)
        Inliers of the epipolar check: the score.
    near, alike : array, (N, N) bool
        Whether an earlier image, but not one just before, is of the same place; with a similar heading.
    """

    name: str
    closed: np.ndarray
    inliers: np.ndarray
    near: np.ndarray
    alike: np.ndarray

    @classmethod
    def of(cls, drive: Drive, file: Path, skipped: int = SKIPPED) -> "Frames":
        """Read the loops of a drive from a file; detect them first if it is missing or out of date."""
        key = fingerprint(code=code_key(), mission=drive.key, skipped=skipped)
        record = file.with_suffix(".json")
        if not (file.exists() and is_current(record, key)):
            _write(drive, file, skipped)
            write_whole_text(record, lambda output: json.dump({"key": key}, output))
        with file.open(newline="", encoding="utf-8") as lines:
            rows = list(DictReader(lines))
        closed, inliers = (np.array([int(row[key]) for row in rows]) for key in ("closed", "inliers"))
        poses = np.load(drive.path / FRAMES_FILE).reshape(-1, 4, 4)
        order = np.arange(len(poses))
        distance = np.linalg.norm(poses[:, None, :2, 3] - poses[None, :, :2, 3], axis=-1)
        yaw = np.array([yaw_of(pose) for pose in poses])
        turned = np.abs(np.angle(np.exp(1j * (yaw[:, None] - yaw[None, :]))))
        near = (distance < NEAR) & (order[:, None] - order[None, :] > skipped)
        return cls(drive.name, closed, inliers, near, near & (turned < ALIKE))

    def judged(self, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Score, whether there is a true loop, whether it was found; for each image."""
        scores = np.where(self.closed >= 0, self.inliers, -np.inf)
        found = (self.closed >= 0) & truth[np.arange(len(truth)), self.closed]
        return scores, truth.any(axis=1), found


def frames_of(drives: Sequence[Drive], out: Path, workers: int) -> tuple[list[Frames], list[Frames]]:
    """Loop closures of drives with images, and of a control in which the images just before are included.

    The control checks that the bag of words works at all: the preceding image was taken one metre earlier.
    """

    def one(drive: Drive, stem: str, skipped: int) -> Frames:
        return Frames.of(drive, out / drive.name / f"{stem}.csv", skipped)

    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(lambda drive: one(drive, "frames", SKIPPED), drives))
        control = list(pool.map(lambda drive: one(drive, "frames_control", 0), drives))
    return found, control


def _write(drive: Drive, file: Path, skipped: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    features = [features_of(image) for name in drive.mission.names for image in drive.images(name)]
    found = closures(features, skipped)
    lines = ["image,closed,inliers", *(f"{i},{one.image},{one.inliers}" for i, one in enumerate(found))]
    write_whole_text(file, lambda output: output.write("\n".join(lines) + "\n"))
