"""A small synthetic world, known in closed form, that the tests from map to command line share."""

import logging
import sys
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from terrainloop.cli import main
from terrainloop.config import FeatureSettings, MapSettings, MatchSettings, Settings
from terrainloop.geometry import inverse, se3, transform
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gradient_map import GradientMap
from terrainloop.io.clouds import write_cloud
from terrainloop.io.trajectories import Trajectory, write_tum

SIDE = 5.0  # of a submap, metres

# Of the world below, near enough; given, not fitted, where the fit is not what is tested.
PARAMETERS = Hyperparameters(length_scale=0.4, variance=0.01, noise=0.011)
RESOLUTION = 0.1

# The tests' own thresholds, so that tuning the defaults does not move them.
STRICT = Settings(
    map=MapSettings(max_points=900, length_scale=0.4, noise=0.01, resolution=RESOLUTION),
    features=FeatureSettings(kind="sift", max_keypoints=300),
    match=MatchSettings(
        decision="evidence",
        max_false_loops=0.01,
        iterations=2000,
        inlier_radius=0.2,
        min_inliers=10,
        max_ssd_ratio=0.6,
    ),
)


def with_match(settings, **changes):
    """Settings that match in another way."""
    return settings.model_copy(update={"match": MatchSettings(**settings.match.model_dump() | changes)})


BY_INLIERS = with_match(STRICT, decision="inliers")


def with_pixels(gradient_map, pixels, **values):
    """The map with other values at some pixels."""
    images = {name: getattr(gradient_map, name).copy() for name in values}
    for name, image in images.items():
        image[pixels] = values[name]
    return replace(gradient_map, **images)


@dataclass(frozen=True, eq=False)
class World:
    """Ground that is a sum of round bumps of many sizes."""

    centres: np.ndarray
    sizes: np.ndarray
    heights: np.ndarray

    @classmethod
    @cache
    def of(cls, seed):
        rng = np.random.default_rng(seed)
        count, side = 700, 18.0
        centres = rng.uniform(-side / 2, side / 2, (count, 2))
        return cls(centres, rng.uniform(0.2, 0.5, count), rng.normal(0, 0.12, count))

    def height(self, xy):
        """Of world positions (N, 2), metres."""
        return self._height_and_slope(xy)[0]

    def slope(self, xy):
        """Along x and y at world positions (N, 2)."""
        return self._height_and_slope(xy)[1]

    def _height_and_slope(self, xy):
        xy = np.asarray(xy)
        reach = 6 * self.sizes[:, None]  # further away nothing is left of a bump in float32
        near = ((self.centres > xy.min(0) - reach) & (self.centres < xy.max(0) + reach)).all(1)
        squared_sizes = self.sizes[near] ** 2
        offset = xy.T[:, :, None] - self.centres[near].T[:, None]
        bump = self.heights[near] * np.exp(-(offset[0] ** 2 + offset[1] ** 2) / (2 * squared_sizes))
        slope = -np.einsum("dnk,nk->nd", offset, bump / squared_sizes)
        return bump.sum(1), slope

    def observe(self, T_world_submap, centre, *, seed, count=850, side=SIDE, noise=0.01):
        """Noisy points (count, 3) of a square about a world position, in the submap's frame."""
        rng = np.random.default_rng(seed)
        xy = rng.uniform(-side / 2, side / 2, (count, 2)) + centre
        return transform(inverse(T_world_submap), np.c_[xy, self.height(xy) + rng.normal(0, noise, count)])

    def map(self, T_planar=None, *, origin=(-2.0, -2.5), shape=(60, 50), resolution=0.08):
        """The gradient map of a frame with SE(2) pose `T_planar`, from the closed form: no GP, no noise."""
        return map_of(self._height_and_slope, T_planar, origin=origin, shape=shape, resolution=resolution)


def map_of(height_and_slope, T_planar=None, *, origin=(-2.0, -2.5), shape=(60, 50), resolution=0.08):
    """The gradient map of ground whose heights (N,) and slopes (N, 2) are a function of positions (N, 2)."""
    T = np.eye(3) if T_planar is None else T_planar
    rows, columns = np.indices(shape)
    local = np.stack([columns, rows], axis=-1).reshape(-1, 2) * resolution + origin
    height, slope = height_and_slope(transform(T, local))
    slope = slope @ T[:2, :2]  # T's inverse rotation, from the right
    images = [v.reshape(shape).astype(np.float32) for v in (height, *slope.T)]
    variance = np.full(shape, 1e-4, np.float32)
    return GradientMap(
        *images, variance, 6 * variance, np.ones(shape, bool), tuple(origin), resolution, PARAMETERS
    )


def flat(xy):
    return 0.1 * xy[:, 0], np.full(xy.shape, (0.1, 0.0))


def ridges(seed):
    """Crests along y of many sizes: x is plain to see, y is not."""
    rng = np.random.default_rng(seed)
    centres, sizes, heights = rng.uniform(-9, 9, 60), rng.uniform(0.2, 0.5, 60), rng.normal(0, 0.12, 60)

    def ground(xy):
        offset = xy[:, :1] - centres
        bumps = heights * np.exp(-0.5 * (offset / sizes) ** 2)
        return bumps.sum(1), np.c_[-(offset / sizes**2 * bumps).sum(1), 0 * xy[:, 0]]

    return ground


@pytest.fixture(scope="session")
def world():
    """Worlds by seed: ``world(0)``."""
    return World.of


@pytest.fixture(scope="session")
def strict():
    return STRICT


@pytest.fixture(scope="session")
def by_inliers():
    """The tests' own thresholds for the paper's decision."""
    return BY_INLIERS


@pytest.fixture(scope="session")
def gp_map():
    """The Gaussian-process map of points under the tests' own hyperparameters."""

    def make(points):
        p = PARAMETERS
        return GradientMap.from_points(points, p.length_scale, p.variance, p.noise, RESOLUTION)

    return make


@dataclass(frozen=True)
class Place:
    """Where a cloud of the mission was taken."""

    T_world_submap: np.ndarray
    centre: tuple[float, float]


PLACES = {
    "000000": Place(se3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0)),
    "000001": Place(se3(4.0, 4.5, 0.2, 0.0, 0.0, 0.8), (5.5, 5.5)),
    "000002": Place(se3(5.0, -3.0, 0.1, 0.0, 0.0, 2.0), (5.0, -4.0)),  # its file is broken
    "000003": Place(se3(0.5, -0.3, 0.4, 0.02, -0.015, np.radians(170.0)), (0.7, 0.5)),  # sees 000000 again
    "000004": Place(se3(-5.0, -4.0, 0.0, 0.0, 0.01, -1.0), (-5.5, -5.5)),
}
BROKEN = "000002"


@pytest.fixture(scope="session")
def mission_folder(tmp_path_factory):
    """Five clouds with odometry and truth: one is broken, the fourth shows the first one's place."""
    folder = tmp_path_factory.mktemp("mission")
    (folder / "clouds").mkdir()
    for seed, (name, place) in enumerate(PLACES.items()):
        cloud = World.of(1).observe(place.T_world_submap, place.centre, seed=seed)
        write_cloud(folder / "clouds" / f"{name}.ply", cloud)
    (folder / "clouds" / f"{BROKEN}.ply").write_bytes(b"ply\nthis is no cloud\n")
    poses = np.array([place.T_world_submap for place in PLACES.values()])
    for name in ("odometry.tum", "truth.tum"):
        write_tum(folder / name, Trajectory(np.arange(5.0), poses))
    return folder


@pytest.fixture(scope="session")
def true_loop():
    """T_target_source of the mission's one loop, 000003 to 000000."""
    return inverse(PLACES["000000"].T_world_submap) @ PLACES["000003"].T_world_submap


@pytest.fixture
def cli(monkeypatch, capsys):
    """Runs ``terrainloop`` with arguments; gives exit code, stdout and stderr."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["terrainloop", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    yield run
    root.handlers[:] = handlers
    root.setLevel(level)
