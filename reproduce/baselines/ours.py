"""Our own pipeline, with default settings and the paper's, behind the interface of the baselines.

Everything that the reproduction calls of terrainloop's matching is called here.
"""

from collections.abc import Mapping, Sequence

from reproduce.baselines.method import Match, Method, Observation
from terrainloop import __version__
from terrainloop.config import MapSettings, Settings
from terrainloop.detection.detector import fit_database, map_submap
from terrainloop.entry import MapEntry
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.loop import LoopCandidate
from terrainloop.matching.register import compare
from terrainloop.submap import Submap

FITTED_SUBMAPS = 3  # the first of the mission, as for an online detector
PAPER = Settings.preset("paper")
# The dense solve takes minutes per map; on the same points the spline has the same posterior (docs/solver.md)
PAPER_SPLINE = PAPER.model_copy(update={"map": MapSettings(**PAPER.map.model_dump() | {"solver": "spline"})})
DEFAULT, PAPER_PRESET, PAPER_DENSE = "terrainloop", "paper preset", "paper preset, dense"  # in the tables
SETTINGS: Mapping[str, tuple[str, Settings]] = {
    "default": (DEFAULT, Settings()),
    "paper": (PAPER_PRESET, PAPER_SPLINE),
    "paper_dense": (PAPER_DENSE, PAPER),
}


def method_of(key: str, submaps: Sequence[Submap]) -> Method:
    """Our pipeline under one of `SETTINGS`, its hyperparameters fitted to the first submaps of a mission."""
    name, settings = SETTINGS[key]
    return method(name, settings, parameters_for(settings, submaps))


def parameters_for(settings: Settings, submaps: Sequence[Submap]) -> Hyperparameters | None:
    """Hyperparameters for all maps of a mission; None where they are fitted to each submap."""
    if settings.map.fit == "submap":
        return None
    return fit_database(submaps[:FITTED_SUBMAPS], settings)


def method(name: str, settings: Settings, parameters: Hyperparameters | None = None) -> Method:
    """Our pipeline under any settings.

    Where evidence decides, the score is that of the candidate. Under the paper's decision it is n of
    Algorithm 1, the number of inliers, if the metric h of the transform is acceptable, and 0 otherwise:
    the paper's curves are drawn over n (section VI-A).

    Parameters
    ----------
    name : str
        Name in the tables.
    settings : Settings
    parameters : Hyperparameters, optional
        As returned by `parameters_for`; fitted to every submap if None.
    """

    def describe(observation: Observation) -> MapEntry:
        return map_submap(observation.submap, settings, parameters)

    def score(source: MapEntry, target: MapEntry) -> Match:
        candidate = compare(source, target, settings)
        return Match(_score(candidate, settings), candidate.T_target_source)

    shown = {
        "solver": settings.map.solver,
        "keypoints": settings.features.kind,
        "decision": settings.match.decision,
    }
    return Method(name, shown, f"terrainloop {__version__}", describe, score)


def _score(candidate: LoopCandidate, settings: Settings) -> float:
    if settings.match.decision == "evidence":
        return candidate.score
    return float(candidate.inliers) if candidate.ssd_ratio <= settings.match.max_ssd_ratio else 0.0
