"""SHOT + RANSAC and CSHOT + RANSAC, the paper's own baselines, by the Point Cloud Library itself.

As in the paper (section VI-C): keypoints of high curvature, matched by their descriptors, outliers removed
by PCL's RANSAC, which continues until an outlier-free sample was drawn with probability 0.99. Descriptors:
Tombari, Salti and Di Stefano, "Unique signatures of histograms for local surface description" (ECCV 2010),
and with colours "A combined texture-shape descriptor for enhanced 3D feature matching" (ICIP 2011).

PCL has no Python package: the small program `pcl/shot.cpp` is compiled on first use.
"""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from os import environ
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reproduce.baselines.method import NOT_COMPARABLE, Match, Method, Observation, Scale
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array

SUPPORT_RADII = (0.075, 0.1)  # tried, in sides of a submap

_SOURCES = tuple(Path(__file__).parent / "pcl" / name for name in ("CMakeLists.txt", "shot.cpp"))
_INSTALL = "apt install libpcl-dev cmake g++"
_DESCRIPTOR_SIZE = {"shot": 352, "cshot": 1344}
_FEWEST_MATCHES = 3  # that determine a pose


@dataclass(frozen=True)
class Settings:
    """How submaps are described and matched; lengths in metres.

    Attributes
    ----------
    kind : str
        "shot", or "cshot" with colours.
    leaf : float
        Side of the cubes within which points are averaged first.
    normal_radius : float
        Radius of the neighbourhood for normal and curvature of a point.
    support_radius : float
        Radius of the neighbourhood that a descriptor describes.
    separation : float
        Minimum distance between keypoints.
    share : float
        Share of the points, those of highest curvature, that are keypoint candidates.
    keypoints : int
        Maximum number of keypoints per submap.
    inlier_radius : float
        Inlier threshold of RANSAC.
    iterations : int
        Maximum number of RANSAC iterations.
    """

    kind: str
    leaf: float
    normal_radius: float
    support_radius: float
    separation: float
    share: float
    keypoints: int
    inlier_radius: float
    iterations: int


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Description of a submap.

    Attributes
    ----------
    points : array, (K, 3)
        Positions in the submap's frame, metres.
    descriptors : array, (K, 352) or (K, 1344)
        Descriptors, each of length 1.
    """

    points: Array
    descriptors: NDArray[np.float32]


def methods(scale: Scale) -> tuple[Method, ...]:
    """SHOT + RANSAC, then CSHOT + RANSAC, each with every choice of support radius.

    Every reciprocal match is taken: a ratio rule of 0.9 was worse on stereo and on LiDAR submaps.

    The score is the number of inliers; pairs with fewer than three matches score 0. CSHOT cannot compare
    submaps without colours. The same input gives the same output.

    Raises
    ------
    TerrainLoopError
        If PCL, CMake or a compiler is missing.
    """
    program = built_program()
    software = f"PCL {_run(program, 'version').decode().strip()}"
    return tuple(
        Method(
            name=f"{kind.upper()} + RANSAC",
            settings={"support_radius_m": round(settings.support_radius, 3)},
            software=software,
            describe=partial(_describe, program, settings),
            score=partial(_score, program, settings),
        )
        for kind in _DESCRIPTOR_SIZE
        for radius in SUPPORT_RADII
        for settings in [_settings(scale, kind, radius * scale.side)]
    )


def built_program() -> Path:
    """The program that calls PCL, compiled into the user's cache folder unless it is there already.

    Raises
    ------
    TerrainLoopError
        If PCL, CMake or a compiler is missing.
    """
    cache = Path(environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "terrainloop"
    key = sha256(b"".join(source.read_bytes() for source in _SOURCES)).hexdigest()[:16]
    program = cache / f"shot-{key}"
    if not program.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as build:
            _build(Path(build))
            (Path(build) / "shot").replace(program)  # atomically: another process may be compiling, too
    return program


def _build(folder: Path) -> None:
    cmake = shutil.which("cmake")
    if cmake is None:
        raise _missing("no cmake on the PATH")
    for words in (["-S", str(_SOURCES[0].parent), "-B", str(folder)], ["--build", str(folder)]):
        done = subprocess.run([cmake, *words], capture_output=True, text=True, check=False)
        if done.returncode:
            lines = [line.strip() for line in (done.stderr + done.stdout).splitlines() if line.strip()]
            raise _missing("; ".join(lines[:2]) or f"cmake ended with {done.returncode}")


def _missing(found: str) -> TerrainLoopError:
    return TerrainLoopError(
        expected="PCL 1.12 or newer with CMake and a C++ compiler, to build the baselines SHOT and CSHOT",
        found=found,
        mend=_INSTALL,
    )


def _run(program: Path, *words: object, rows: NDArray[np.float32] | None = None) -> bytes:
    """Output of the program, given rows of six floats."""
    given = b"" if rows is None else rows.tobytes()
    done = subprocess.run([program, *map(str, words)], input=given, capture_output=True, check=False)
    if done.returncode:
        raise TerrainLoopError(
            expected=f"{program} to {words[0]}",
            found=done.stderr.decode(errors="replace").strip() or f"it ended with {done.returncode}",
            mend="remove it to have it built anew",
        )
    return done.stdout


def _settings(scale: Scale, kind: str, support_radius: float) -> Settings:
    return Settings(
        kind=kind,
        leaf=max(0.01 * scale.side, 1.5 * scale.spacing),
        normal_radius=0.1 * scale.side,
        support_radius=support_radius,
        separation=0.01 * scale.side,
        share=0.5,
        keypoints=1000,
        inlier_radius=0.02 * scale.side,
        iterations=50000,
    )


def _describe(program: Path, settings: Settings, observation: Observation) -> Keypoints | None:
    """Keypoints of a submap; None where the descriptor needs colours and there are none."""
    points, colours = observation.submap.points, observation.colours
    if settings.kind == "cshot" and colours is None:
        return None
    centre = points.mean(axis=0)  # the program's floats have seven digits only
    rows = np.zeros((len(points), 6), dtype=np.float32)
    rows[:, :3] = points - centre
    if colours is not None:
        rows[:, 3:] = colours
    s = settings
    words = (s.kind, s.leaf, s.normal_radius, s.support_radius, s.separation, s.share, s.keypoints)
    out = np.frombuffer(_run(program, "describe", *words, rows=rows), dtype=np.float32)
    out = out.reshape(-1, 3 + _DESCRIPTOR_SIZE[s.kind])
    return Keypoints(points=out[:, :3] + centre, descriptors=out[:, 3:])


def _score(program: Path, settings: Settings, source: Keypoints | None, target: Keypoints | None) -> Match:
    if source is None or target is None:
        return Match(score=NOT_COMPARABLE)
    i, j = _matches(source.descriptors, target.descriptors)
    if len(i) < _FEWEST_MATCHES:
        return Match(score=0.0)
    from_source, to_target = source.points[i].mean(axis=0), target.points[j].mean(axis=0)
    rows = np.hstack([source.points[i] - from_source, target.points[j] - to_target]).astype(np.float32)
    words = (settings.inlier_radius, settings.iterations)
    count, *T = np.frombuffer(_run(program, "ransac", *words, rows=rows), dtype=np.float32).astype(float)
    if count < _FEWEST_MATCHES:
        return Match(score=0.0)
    T_target_source = np.reshape(T, (4, 4))
    T_target_source[:3, 3] += to_target - T_target_source[:3, :3] @ from_source
    return Match(score=count, T_target_source=T_target_source)


def _matches(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.intp]:
    """Rows (2, M) of source and target that are each other's nearest neighbours."""
    if not len(source) or not len(target):
        return np.empty((2, 0), dtype=np.intp)
    cosine = source @ target.T  # all have length 1, so that the squared distance is 2 - 2 cosine
    nearest = cosine.argmax(axis=1)
    i = np.flatnonzero(cosine.argmax(axis=0)[nearest] == np.arange(len(source)))
    return np.stack([i, nearest[i]])
