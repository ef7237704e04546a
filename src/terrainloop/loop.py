"""What is known about one pair of submaps: the transform between them, the evidence, the decision."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from terrainloop.arrays import ReadOnlyArrays, read_only
from terrainloop.geometry import TangentOrder, tangent_covariance, translation

NO_EVIDENCE = -10.0
"""Score of a pair for which no hypothesis could be weighed."""


def _frame_origin() -> NDArray[np.float64]:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class Warp(ReadOnlyArrays):
    """How far from rigid two submaps are, and what that adds to the covariance of their loop.

    Attributes
    ----------
    squares, noise : array, (3,)
        Samples of the variance of the warp of one submap, dimensionless, and the parts of them that noise
        accounts for.
    rigid : array, (6, 6)
        Covariance of the loop if the submaps are rigid.
    by_variance : array, (6, 6)
        What is added to it per unit of the variance of the warp.
    """

    squares: NDArray[np.float64]
    noise: NDArray[np.float64]
    rigid: NDArray[np.float64]
    by_variance: NDArray[np.float64]

    def covariance(self, variance: float) -> NDArray[np.float64]:
        """Covariance (6, 6) of the loop, for a variance of the warp."""
        return self.rigid + variance * self.by_variance


@dataclass(frozen=True, eq=False, repr=False)
class LoopCandidate(ReadOnlyArrays):
    """A pair of submaps that was compared; truthy where it was accepted as a loop closure.

    Attributes
    ----------
    source, target : str
        Names of the two submaps; source is the later one.
    T_target_source : array, (4, 4)
        Takes points of source into the frame of target, metres.
    covariance : array, (6, 6)
        Covariance of (x, y, z, roll, pitch, yaw), the parameters of `T_local`, in metres and radians. NaN
        where no transform could be estimated. `information` converts it for GTSAM and g2o.
    inliers : int
        Associations that agree with the transform (n of Algorithm 1).
    ssd : float
        Weighted sum of squared gradient differences (h of Algorithm 1), m^-4.
    ssd_ratio : float
        `ssd` over what unrelated ground would give on the same overlap: 0 identical, 1 unrelated.
    overlap : float
        Intersection over union of the two maps' observed areas at this transform, 0 to 1.
    score : float
        Higher is more certain; comparable across the pairs of a run. ``-log_nfa`` where a run decides by
        evidence (`NO_EVIDENCE` where no hypothesis could be weighed), `inlier_score` where by inliers.
    accepted : bool
    reason : str
        Why it was accepted or rejected, in words.
    found_by : {"dense", "sparse", "second look", ""}
        What proposed the pose: the search of all poses, keypoints (Algorithm 1), or a search where the
        corrected trajectory lays the two upon each other.
    correlation : float
        Correlation of the two gradient fields over the shared ground, -1 to 1; NaN if not computed.
    log_nfa : float
        Decimal logarithm of the number of false alarms (NFA): how many matches at least as good a pair of
        unrelated submaps yields by chance. NaN where the run decides by inliers.
    inlier_score : float
        Inliers, discounted by the share of the gradients that they leave unexplained, n (1 - ssd_ratio).
    source_origin, target_origin : array, (3,)
        Points of the two frames, metres, that `T_local` and the covariance refer to: zero, or a point near
        the submap where its frame's origin is far away (UTM).
    warp : Warp or None
        Of a loop closure: what its covariance is made of. None where the run decides by inliers, and in a run
        that was read from a file.
    """

    source: str
    target: str
    T_target_source: NDArray[np.float64]
    covariance: NDArray[np.float64]
    inliers: int
    ssd: float
    ssd_ratio: float
    overlap: float
    score: float
    accepted: bool
    reason: str
    found_by: str = ""
    correlation: float = np.nan
    log_nfa: float = np.nan
    inlier_score: float = np.nan
    source_origin: NDArray[np.float64] = field(default_factory=_frame_origin)
    target_origin: NDArray[np.float64] = field(default_factory=_frame_origin)
    warp: Warp | None = None

    def __post_init__(self) -> None:
        for name in ("T_target_source", "covariance", "source_origin", "target_origin"):
            object.__setattr__(self, name, read_only(np.asarray(getattr(self, name))))

    @classmethod
    def without_transform(
        cls, source: str, target: str, reason: str, score: float = NO_EVIDENCE
    ) -> "LoopCandidate":
        """A pair that was rejected before a transform could be estimated."""
        return cls(
            source=source,
            target=target,
            T_target_source=np.full((4, 4), np.nan),
            covariance=np.full((6, 6), np.nan),
            inliers=0,
            ssd=np.nan,
            ssd_ratio=np.nan,
            overlap=0.0,
            score=score,
            accepted=False,
            reason=reason,
        )

    def rejected(self, reason: str) -> "LoopCandidate":
        """The candidate as no loop closure, for a reason; nothing is said of how sure its pose is."""
        unknown = np.full((6, 6), np.nan)
        return replace(self, accepted=False, covariance=unknown, warp=None, reason=reason)

    def __bool__(self) -> bool:
        return self.accepted

    def __repr__(self) -> str:
        verdict = "accepted" if self.accepted else "rejected"
        return f"LoopCandidate({self.source!r} to {self.target!r}, {verdict}: {self.reason})"

    @property
    def T_local(self) -> NDArray[np.float64]:
        """`T_target_source` (4, 4) between the frames moved to `source_origin` and `target_origin`.

        It takes (points of source - source_origin) to (points of target - target_origin). Where the origins
        are zero, it is `T_target_source` itself.
        """
        return translation(-self.target_origin) @ self.T_target_source @ translation(self.source_origin)

    def information(self, order: TangentOrder = "gtsam") -> NDArray[np.float64]:
        """Information matrix (6, 6) of the tangent vector xi in T_local exp(xi).

        Parameters
        ----------
        order : {"gtsam", "g2o"}
            Rotation first, for ``gtsam.noiseModel.Gaussian.Information`` of a ``BetweenFactorPose3`` that
            joins target to source and measures `T_local`; or translation first, as in g2o files.

        Returns
        -------
        array, (6, 6)
            NaN where there is no covariance.

        Raises
        ------
        TerrainLoopError
            For another order.
        """
        covariance = tangent_covariance(self.T_local, self.covariance, order)
        unknown = np.isnan(covariance).any()
        return np.full((6, 6), np.nan) if unknown else np.asarray(np.linalg.inv(covariance), dtype=float)
