"""What is known about one pair of submaps: the transform between them, the evidence, the decision."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class LoopCandidate:
    """A pair of submaps that was compared; truthy where it was accepted as a loop closure.

    Attributes
    ----------
    source, target : str
        Names of the two submaps; source is the later one.
    T_target_source : array, (4, 4)
        Takes points of source into the frame of target, metres.
    covariance : array, (6, 6)
        Of (x, y, z, roll, pitch, yaw), the parameters of `T_target_source`, in metres and radians.
        NaN where no transform could be estimated.
    inliers : int
        Associations that agree with the transform (n of Algorithm 1).
    ssd : float
        Weighted sum of squared gradient differences (h of Algorithm 1), m^-4.
    ssd_ratio : float
        `ssd` over what unrelated ground would give on the same overlap: 0 identical, 1 unrelated.
    overlap : float
        Shared part of the two maps' known ground, intersection over union, 0 to 1.
    score : float
        Higher is surer; comparable across pairs. By evidence: minus the decimal logarithm of the false
        alarms that one pair would yield by chance. By inliers: these, discounted by the share of the
        gradients that they leave unexplained, n (1 - ssd_ratio).
    accepted : bool
    reason : str
        In words, why it was accepted or not.
    found_by : {"dense", "sparse", ""}
        What proposed the pose: the search of all poses, or the keypoints.
    correlation : float
        Of the two gradient fields over the shared ground, -1 to 1; NaN where it was not computed.
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

    @classmethod
    def without_transform(cls, source: str, target: str, reason: str, score: float = 0.0) -> "LoopCandidate":
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

    def __bool__(self) -> bool:
        return self.accepted
