"""Our own pipeline by the names that the reproduction gives its settings."""

from collections.abc import Mapping

from reproduce.missions import Drive
from terrainloop.config import MapSettings, Settings
from terrainloop.evaluation.baselines import ours
from terrainloop.evaluation.baselines.method import Method

PAPER = Settings.preset("paper")
# The dense solve takes minutes a map. On the same points the spline has the same posterior (docs/solver.md).
PAPER_SPLINE = PAPER.model_copy(update={"map": MapSettings(**PAPER.map.model_dump() | {"solver": "spline"})})
DEFAULT, PAPER_PRESET, PAPER_DENSE = "terrainloop", "paper preset", "paper preset, dense"  # in the tables
SETTINGS: Mapping[str, tuple[str, Settings]] = {
    "default": (DEFAULT, Settings()),
    "paper": (PAPER_PRESET, PAPER_SPLINE),
    "paper_dense": (PAPER_DENSE, PAPER),
}


def method(key: str, drive: Drive) -> Method:
    """One of `SETTINGS`; hyperparameters of a database are those of the mission's first submaps."""
    name, settings = SETTINGS[key]
    return ours.method(name, settings, ours.parameters_for(settings, drive.submaps))
