"""The one entry to matching: whether two submaps show the same place, and how they lie."""

from terrainloop.config import Settings
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.by_evidence import compare_by_evidence
from terrainloop.matching.by_inliers import compare_by_inliers
from terrainloop.matching.mapped import MappedSubmap


def register(
    source_map: GradientMap,
    target_map: GradientMap,
    settings: Settings | None = None,
    *,
    names: tuple[str, str] = ("source", "target"),
) -> LoopCandidate:
    """Decide whether two maps show the same place, and estimate the transform between them.

    Parameters
    ----------
    source_map, target_map : GradientMap
    settings : Settings, optional
    names : tuple of str
        Of source and target; with the seed they also fix the random draws.

    Returns
    -------
    LoopCandidate
        Falsy if rejected; ``.reason`` says why.
    """
    settings = settings or Settings()
    source, target = (
        MappedSubmap.of(name, gradient_map, settings)
        for name, gradient_map in zip(names, (source_map, target_map), strict=True)
    )
    return compare(source, target, settings)


def compare(
    source: MappedSubmap, target: MappedSubmap, settings: Settings, *, pairs: float = 1
) -> LoopCandidate:
    """As `register`, for submaps that are ready to be compared.

    Parameters
    ----------
    source, target : MappedSubmap
    settings : Settings
    pairs : float
        Compared in the mission; its `max_false_loops` is for all of them.
    """
    if settings.match.decision == "inliers":
        return compare_by_inliers(source, target, settings)
    return compare_by_evidence(source, target, settings, pairs)
