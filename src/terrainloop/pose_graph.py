"""The pose graph: odometry, gravity and loop closures, solved by GTSAM so that wrong loops do no harm.

The poses of the graph are those of the submaps' local origins, which are their frames' origins unless those
are far away (UTM): covariances of loops refer to them. Wrong loops are found by graduated non-convexity with
truncated least squares (Yang et al., RA-L 2020) and left out.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array, adjoint_se3, inverse, tangent_covariance, translation
from terrainloop.gradient_map import FAR
from terrainloop.io.graphs import Edge, write_g2o
from terrainloop.io.trajectories import Trajectory
from terrainloop.loop import LoopCandidate
from terrainloop.record import SubmapRecord

DRIFT = 0.02  # of the way: standard deviation of each of x, y, z of a step of odometry
DRIFT_YAW_DEG = 0.2  # degrees a metre
LEAST_DRIFT = 0.01  # metres: that of a step of any length
LEAST_DRIFT_YAW_DEG = 0.1
GRAVITY_DEG = 0.5  # degrees: of the direction of gravity in a submap, and of roll and pitch of a step
ANCHOR = 1e-3  # metres and radians: the first pose of each component stays where it is
CONFIDENCE = 0.99  # of the squared residual of a right loop: beyond it, truncated least squares drops it


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Submaps with odometry in the order of their sessions, and the loop closures among them.

    Attributes
    ----------
    names, sessions : tuple of str, (M,)
        Of the submaps.
    stamps : array, (M,)
        Seconds, or the index within the mission.
    odometry : array, (M, 4, 4)
        T_world_submap by odometry; each session has a world of its own.
    origins : array, (M, 3)
        Local origin of each submap in its frame, metres.
    steps : array, (M, 6, 6)
        Covariance of the step of odometry from the submap before, as of a tangent vector in GTSAM's order;
        that of the first submap of a session is not used.
    loops : tuple of LoopCandidate, (L,)
        Accepted, between submaps that have odometry.
    """

    names: tuple[str, ...]
    sessions: tuple[str, ...]
    stamps: Array
    odometry: Array
    origins: Array
    steps: Array
    loops: tuple[LoopCandidate, ...]

    @classmethod
    def of(
        cls,
        records: Iterable[SubmapRecord],
        loops: Iterable[LoopCandidate],
        steps: Array | None = None,
    ) -> "PoseGraph":
        """The graph of submaps; those without odometry are not part of it, nor are their loops.

        Parameters
        ----------
        records : iterable of SubmapRecord
            In the order in which they were driven, by session.
        loops : iterable of LoopCandidate
        steps : array, (M, 6, 6), optional
            As the attribute; by default those of a drift of 2 % of the way and 0.2 degrees a metre.
        """
        placed = [record for record in records if record.odometry is not None]
        index = {record.name: k for k, record in enumerate(placed)}
        loops = tuple(
            loop
            for loop in loops
            if loop and {loop.source, loop.target} <= index.keys() and _positive_definite(loop.covariance)
        )
        known = {loop.source: loop.source_origin for loop in loops}
        known |= {loop.target: loop.target_origin for loop in loops}
        height = float(np.median([origin[2] for origin in known.values()])) if known else 0.0
        origins = np.array([known.get(record.name, _origin_of(record, height)) for record in placed])
        origins = origins.reshape(-1, 3)
        odometry = np.array([record.odometry for record in placed]).reshape(-1, 4, 4)
        return cls(
            names=tuple(index),
            sessions=tuple(record.session for record in placed),
            stamps=np.array([record.stamp for record in placed], dtype=float),
            odometry=odometry,
            origins=origins,
            steps=step_covariances(odometry @ _translations(origins)) if steps is None else steps,
            loops=loops,
        )

    def solve(self) -> "Solution":
        """Poses that agree best with odometry, gravity and those loops that agree with each other.

        Raises
        ------
        TerrainLoopError
            If GTSAM is not installed, or cannot solve the graph.
        """
        everything = np.ones(len(self.loops), dtype=bool)
        if not _positive_definite(self.steps[self.chained]):
            raise _unsolvable("covariances of the steps that are not positive definite")  # GTSAM does not say
        if not self.loops:
            return Solution(self, self.odometry, everything, np.empty(0), self.components(everything))
        problem = _Problem.of(self)
        try:
            kept, estimate = problem.without_wrong_loops()
            components = self.components(kept)
            poses, squares = problem.solved(kept, components, estimate)
        except RuntimeError as error:  # GTSAM's own
            raise _unsolvable(str(error)) from error
        return Solution(self, poses, kept, squares, components)

    @cached_property
    def edges(self) -> NDArray[np.intp]:
        """Indices (L, 2) of target and source of each loop."""
        index = {name: k for k, name in enumerate(self.names)}
        pairs = [(index[loop.target], index[loop.source]) for loop in self.loops]
        return np.array(pairs, dtype=np.intp).reshape(-1, 2)

    @cached_property
    def chained(self) -> NDArray[np.bool_]:
        """Whether odometry joins a submap to the one before, (M,)."""
        same = [a == b for a, b in zip(self.sessions, self.sessions[1:], strict=False)]
        return np.array([False, *same][: len(self.names)], dtype=bool)

    @cached_property
    def step_edges(self) -> list[Edge]:
        """Odometry between the local origins of consecutive submaps of a session."""
        local = self.local(self.odometry)
        return [
            Edge(k - 1, k, inverse(local[k - 1]) @ local[k], self.steps[k])
            for k in np.flatnonzero(self.chained).tolist()
        ]

    @cached_property
    def loop_edges(self) -> list[Edge]:
        """Loops between the local origins of their submaps."""
        covariances = [tangent_covariance(loop.T_local, loop.covariance, "gtsam") for loop in self.loops]
        return [
            Edge(target, source, loop.T_local, (covariance + covariance.T) / 2)
            for (target, source), loop, covariance in zip(
                self.edges.tolist(), self.loops, covariances, strict=True
            )
        ]

    def local(self, poses: Array) -> Array:
        """Poses (M, 4, 4) of the local origins, in a world that begins at the first submap."""
        return np.asarray(translation(-self.odometry[0, :3, 3]) @ poses @ _translations(self.origins))

    def in_world(self, local: Array) -> Array:
        """Poses (M, 4, 4) of submaps, from those of their local origins: the inverse of `local`."""
        return np.asarray(translation(self.odometry[0, :3, 3]) @ local @ _translations(-self.origins))

    def components(self, kept: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Number (M,) of the component that each submap is in, by odometry and the loops that are kept."""
        after = np.flatnonzero(self.chained)
        pairs = np.vstack([np.c_[after - 1, after], self.edges[kept]]).astype(int)
        size = (len(self.names), len(self.names))
        _, labels = connected_components(
            coo_array((np.ones(len(pairs)), pairs.T), shape=size), directed=False
        )
        return np.asarray(labels)


def step_covariances(poses: Array) -> Array:
    """Covariance (M, 6, 6) of the steps to each of M poses (M, 4, 4) by the stated model of odometry.

    Of a tangent vector in GTSAM's order, rotation first. Position drifts by 2 % of the way and yaw by 0.2
    degrees a metre; roll and pitch are those of gravity.
    """
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1)
    sigmas = np.empty((len(poses), 6))
    sigmas[:, :2] = np.radians(GRAVITY_DEG)
    sigmas[:, 2] = np.radians(np.hypot(DRIFT_YAW_DEG * lengths, LEAST_DRIFT_YAW_DEG))
    sigmas[:, 3:] = np.hypot(DRIFT * lengths, LEAST_DRIFT)[:, None]
    return np.asarray(np.einsum("ij,jk->ijk", sigmas**2, np.eye(6)))


def _origin_of(record: SubmapRecord, height: float) -> Array:
    """The local origin of a submap without loops: as that of its map, but at a height of others."""
    if not len(record.hull):
        return np.zeros(3)
    low, high = record.hull.min(axis=0), record.hull.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    return np.zeros(3) if np.hypot(*middle) <= FAR * np.hypot(*half) else np.append(np.round(middle), height)


def _positive_definite(covariances: Array) -> bool:
    return bool(np.isfinite(covariances).all() and (np.linalg.eigvalsh(covariances) > 0).all())


def _translations(offsets: Array) -> Array:
    """SE(3) transforms (M, 4, 4) from offsets (M, 3)."""
    return np.array([translation(offset) for offset in offsets]).reshape(-1, 4, 4)


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved pose graph.

    Attributes
    ----------
    graph : PoseGraph
    poses : array, (M, 4, 4)
        T_world_submap.
    kept : array, (L,)
        Whether each loop was kept; the others disagree with odometry and the rest.
    squares : array, (L,)
        Squared Mahalanobis residual of each loop, 6 degrees of freedom; also of those that were left out.
    components : array, (M,)
        Number of the connected component of each submap, 0 for that of the first.
    """

    graph: PoseGraph
    poses: Array
    kept: NDArray[np.bool_]
    squares: Array
    components: NDArray[np.intp]

    @property
    def trajectory(self) -> Trajectory:
        """The poses with their stamps."""
        return Trajectory(self.graph.stamps, self.poses)

    @property
    def loops(self) -> list[LoopCandidate]:
        """The loops that were kept."""
        return [loop for loop, kept in zip(self.graph.loops, self.kept, strict=True) if kept]

    @property
    def loop_ends(self) -> Array:
        """Positions (L, 2, 2) of target and source of each loop that was kept: (x, y), metres."""
        return np.asarray(self.poses[self.graph.edges[self.kept], :2, 3])

    def write_g2o(self, path: str | Path) -> None:
        """Write the poses, the steps of odometry and the loops that were kept, as a g2o file.

        Vertices are numbered as the submaps, and are the poses of their local origins. Gravity cannot be
        written in this format.
        """
        loops = [edge for edge, kept in zip(self.graph.loop_edges, self.kept, strict=True) if kept]
        write_g2o(path, self.poses @ _translations(self.graph.origins), [*self.graph.step_edges, *loops])

    @property
    def left_out(self) -> list[LoopCandidate]:
        """The loops that disagree, as rejected pairs that say so."""
        return [
            loop.rejected(
                f"it disagrees with odometry and other loops (chi-squared {square:.3g}): {loop.reason}"
            )
            for loop, kept, square in zip(self.graph.loops, self.kept, self.squares, strict=True)
            if not kept
        ]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Loops that were left out and submaps that nothing ties to the first, in words."""
        words = []
        if not self.kept.all():
            names = ", ".join(f"{loop.source} to {loop.target}" for loop in self.left_out[:3])
            more = ", ..." if len(self.left_out) > 3 else ""
            words.append(
                f"{len(self.left_out)} of {len(self.kept)} loops disagree with odometry and the others, and "
                f"were left out of the pose graph: {names}{more}"
            )
        loose = [name for name, of in zip(self.graph.names, self.components, strict=True) if of != 0]
        if loose:
            words.append(
                f"nothing ties {len(loose)} of {len(self.components)} submaps to the first ones: "
                f"{loose[0]} to {loose[-1]}"
            )
        return tuple(words)

    def relative(self, target: int, source: int) -> tuple[Array, Array]:
        """T_target_source (4, 4) between the local origins of two submaps, and its covariance (6, 6).

        The covariance is that of a tangent vector in GTSAM's order, by the joint marginal of the two.

        Raises
        ------
        TerrainLoopError
            If nothing ties one to the other.
        """
        if self.components[target] != self.components[source]:
            raise TerrainLoopError(
                expected="two submaps that odometry or loops join",
                found=f"{self.graph.names[target]} and {self.graph.names[source]}, which nothing joins",
                mend="ask for submaps of one component",
            )
        poses = self.graph.local(self.poses)
        T = inverse(poses[target]) @ poses[source]
        try:
            joint = self._marginals.jointMarginalCovariance(self._problem.gtsam.KeyVector([target, source]))
        except RuntimeError as error:
            raise _unsolvable(str(error)) from error
        blocks = [[joint.at(a, b) for b in (target, source)] for a in (target, source)]
        jacobian = np.hstack([-adjoint_se3(inverse(T)), np.eye(6)])
        return T, jacobian @ np.block(blocks) @ jacobian.T

    @cached_property
    def _problem(self) -> "_Problem":
        return _Problem.of(self.graph)

    @cached_property
    def _marginals(self) -> Any:
        problem = self._problem
        factors = problem.graph_of(self.kept, self.components)
        return problem.gtsam.Marginals(factors, problem.values_of(self.poses))


@dataclass(frozen=True, eq=False)
class _Problem:
    """A pose graph in GTSAM's terms, about the position of the first submap, which may be far from zero."""

    gtsam: ModuleType
    graph: PoseGraph
    gravity: list[Any]
    steps: list[Any]
    loops: list[Any]

    @classmethod
    def of(cls, graph: PoseGraph) -> "_Problem":
        gtsam = require_gtsam()
        up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
        level = gtsam.noiseModel.Isotropic.Sigma(2, np.radians(GRAVITY_DEG))

        def between(edge: Edge) -> Any:
            noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
            return gtsam.BetweenFactorPose3(
                edge.target, edge.source, gtsam.Pose3(edge.T_target_source), noise
            )

        gravity = [  # the world's vertical as the odometry saw it in the frame of each submap
            gtsam.AttitudeFactorPose3(k, up, level, gtsam.Unit3(pose[2, :3]))
            for k, pose in enumerate(graph.local(graph.odometry))
        ]
        steps, loops = ([between(edge) for edge in edges] for edges in (graph.step_edges, graph.loop_edges))
        return cls(gtsam, graph, gravity, steps, loops)

    def without_wrong_loops(self) -> tuple[NDArray[np.bool_], Any]:
        """Which loops agree, and the values of the poses, by graduated non-convexity."""
        gtsam, everything = self.gtsam, np.ones(len(self.loops), dtype=bool)
        factors = self.graph_of(everything, self.graph.components(everything))
        params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
        params.setLossType(gtsam.GncLossType.TLS)
        params.setKnownInliers(list(range(factors.size() - len(self.loops))))
        params.setScheduler(gtsam.GncScheduler.SuperLinear)
        optimizer = gtsam.GncLMOptimizer(factors, self.values_of(self.graph.odometry), params)
        optimizer.setInlierCostThresholdsAtProbability(CONFIDENCE)
        values = optimizer.optimize()
        weights = np.asarray(optimizer.getWeights())[-len(self.loops) :]
        return weights > 0.5, values

    def solved(
        self, kept: NDArray[np.bool_], components: NDArray[np.intp], start: Any
    ) -> tuple[Array, Array]:
        """Poses (M, 4, 4) with the loops that are kept, and the squared residuals (L,) of all loops."""
        factors = self.graph_of(kept, components)
        values = self.gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()
        local = np.array([values.atPose3(k).matrix() for k in range(len(self.graph.names))])
        squares = np.array([2.0 * factor.error(values) for factor in self.loops])
        return self.graph.in_world(local), squares

    def graph_of(self, kept: NDArray[np.bool_], components: NDArray[np.intp]) -> Any:
        """All factors; those of the loops, where they are kept, come last."""
        factors = self.gtsam.NonlinearFactorGraph()
        anchor = self.gtsam.noiseModel.Isotropic.Sigma(6, ANCHOR)
        local = self.graph.local(self.graph.odometry)
        for first in np.unique(components, return_index=True)[1].tolist():
            factors.add(self.gtsam.PriorFactorPose3(first, self.gtsam.Pose3(local[first]), anchor))
        for factor in [
            *self.gravity,
            *self.steps,
            *(f for f, keep in zip(self.loops, kept, strict=True) if keep),
        ]:
            factors.add(factor)
        return factors

    def values_of(self, poses: Array) -> Any:
        """GTSAM's values of poses (M, 4, 4) of the submaps."""
        values = self.gtsam.Values()
        for k, pose in enumerate(self.graph.local(poses)):
            values.insert(k, self.gtsam.Pose3(pose))
        return values


def require_gtsam() -> ModuleType:
    """GTSAM, or a TerrainLoopError where it is not installed."""
    try:
        import gtsam
    except ImportError as error:
        raise TerrainLoopError(
            expected="GTSAM 4.3 or later, which solves pose graphs",
            found=str(error),
            mend="pip install 'gtsam>=4.3' (Linux and macOS)",
        ) from error
    module: ModuleType = gtsam
    return module


def _unsolvable(found: str) -> TerrainLoopError:
    return TerrainLoopError(
        expected="a pose graph that can be solved",
        found=found.strip().partition("\n")[0],
        mend="check the odometry and the covariances of its steps",
    )
