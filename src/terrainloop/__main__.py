"""``python -m terrainloop``, as the command ``terrainloop``."""

from terrainloop.cli import main

main()
