"""The one family of errors that terrainloop raises on purpose."""


class TerrainLoopError(Exception):
    """Input that cannot be worked with: what was expected, what was found, how to mend it.

    Parameters
    ----------
    expected, found, mend : str
        Three short clauses, shown as one line.
    """

    def __init__(self, *, expected: str, found: str, mend: str) -> None:
        super().__init__(f"expected {expected}; found {found}; {mend}")
        self.expected = expected
        self.found = found
        self.mend = mend

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.expected, self.found, self.mend)


def _rebuild(cls: type[TerrainLoopError], expected: str, found: str, mend: str) -> TerrainLoopError:
    return cls(expected=expected, found=found, mend=mend)
