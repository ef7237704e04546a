"""The one family of errors that terrainloop raises on purpose."""

_LONGEST_QUOTE = 300  # characters of what was found


class TerrainLoopError(Exception):
    """Input that cannot be worked with: what was expected, what was found, how to mend it.

    Parameters
    ----------
    expected, found, mend : str
        Three short clauses, shown as one line. What was found may quote a file: its middle is cut out where
        it is long, and characters that a terminal would act upon are escaped.
    """

    def __init__(self, *, expected: str, found: str, mend: str) -> None:
        expected, found, mend = printable(expected), _shortened(printable(found)), printable(mend)
        super().__init__(f"expected {expected}; found {found}; {mend}")
        self.expected = expected
        self.found = found
        self.mend = mend

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.expected, self.found, self.mend)


def _rebuild(cls: type[TerrainLoopError], expected: str, found: str, mend: str) -> TerrainLoopError:
    return cls(expected=expected, found=found, mend=mend)


def _shortened(text: str) -> str:
    if len(text) <= _LONGEST_QUOTE:
        return text
    head = 2 * _LONGEST_QUOTE // 3
    return f"{text[:head]} ... {text[head + 5 - _LONGEST_QUOTE :]}"


def printable(text: str) -> str:
    """The text with what a terminal would act upon, or could not print, escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
