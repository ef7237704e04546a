"""Our own pipeline, the default or the paper's, held to the interface of the others."""

from collections.abc import Sequence

from terrainloop import __version__
from terrainloop.config import Settings
from terrainloop.detection.detector import fit_database, map_submap
from terrainloop.entry import MapEntry
from terrainloop.evaluation.baselines.method import Match, Method, Observation
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.loop import LoopCandidate
from terrainloop.matching.register import compare
from terrainloop.submap import Submap

FITTED_SUBMAPS = 3  # the first of the mission, all that an online detector has seen


def parameters_for(settings: Settings, submaps: Sequence[Submap]) -> Hyperparameters | None:
    """Hyperparameters of a mission's maps, from its first submaps; None where every submap has its own."""
    if settings.map.fit == "submap":
        return None
    return fit_database(submaps[:FITTED_SUBMAPS], settings)


def method(name: str, settings: Settings, parameters: Hyperparameters | None = None) -> Method:
    """Our pipeline under some settings.

    By evidence the score is the candidate's. By the paper's decision it is n of Algorithm 1, the number
    of inliers, of a transform whose metric h is acceptable, and 0 where there is none: the paper's
    curves are drawn over n (section VI-A).

    Parameters
    ----------
    name : str
        As tables print it.
    settings : Settings
    parameters : Hyperparameters, optional
        As `parameters_for` finds them; without them they are fitted to every submap.
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
