"""Messages of an MCAP file that was cut off, or not written by ROS 2, by the optional package mcap."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

_LARGEST_RECORD = 1 << 30  # bytes; chunks are a few MiB


@dataclass(frozen=True)
class _Connection:
    id: int
    topic: str
    msgtype: str
    msgcount: int = 0


def can_salvage() -> bool:
    """Whether the package mcap is installed."""
    return find_spec("mcap") is not None


class SalvagedMcap:
    """Reads a file from its start for as long as it makes sense.

    Attributes
    ----------
    connections : list
        One for each channel with messages in CDR, the encoding of ROS 2.
    last : dict
        The last message of each channel, by its number.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.connections: list[_Connection] = []
        self.last: dict[int, bytes] = {}

    def open(self) -> None:
        """Find out what there is, by reading all of it once."""
        channels: dict[int, _Connection] = {}
        counts: Counter[int] = Counter()
        for connection, _, raw in self._records():
            channels[connection.id] = connection
            counts[connection.id] += 1
            self.last[connection.id] = raw
        self.connections = [_Connection(c.id, c.topic, c.msgtype, counts[c.id]) for c in channels.values()]

    def messages(
        self, connections: Sequence[Any], start: int | None = None
    ) -> Iterator[tuple[_Connection, int, bytes]]:
        """Messages in the order of the file."""
        wanted = {connection.id for connection in connections}
        for connection, time, raw in self._records():
            if connection.id in wanted and (start is None or time >= start):
                yield connection, time, raw

    def _records(self) -> Iterator[tuple[_Connection, int, bytes]]:
        read = import_module("mcap.stream_reader").StreamReader
        records = import_module("mcap.records")
        schemas: dict[int, str] = {}
        channels: dict[int, _Connection] = {}
        with self._path.open("rb") as file:
            try:
                for record in read(file, record_size_limit=_LARGEST_RECORD).records:
                    if isinstance(record, records.Schema):
                        schemas[record.id] = record.name
                    elif isinstance(record, records.Channel) and record.message_encoding == "cdr":
                        name = schemas.get(record.schema_id, "")
                        channels[record.id] = _Connection(record.id, record.topic, name)
                    elif isinstance(record, records.Message) and record.channel_id in channels:
                        yield channels[record.channel_id], record.log_time, record.data
            except GeneratorExit:
                raise
            except Exception as error:  # where the file ends or its damage begins
                logger.info("%s is read up to: %s", self._path, str(error) or type(error).__name__)
