"""Pictures of maps, matches and missions. They need matplotlib, the extra ``terrainloop[figures]``."""

from importlib.util import find_spec

INSTALL_FIGURES = 'pip install "terrainloop[figures]"'


def can_draw() -> bool:
    """Whether matplotlib is installed; without it, importing `terrainloop.report.figures` raises."""
    return find_spec("matplotlib") is not None
