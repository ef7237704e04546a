"""A submap at rest: what is kept of it to be compared with others, and its bytes."""

import io
import json
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from terrainloop.config import Settings
from terrainloop.errors import TerrainLoopError
from terrainloop.features import Features, extract_features
from terrainloop.field import Field, field_of, field_spacing
from terrainloop.gradient_map import GradientMap
from terrainloop.record import SubmapRecord


@dataclass(frozen=True, eq=False)
class MapEntry:
    """A submap that can be compared: its record, gradient map, keypoints and gradient field.

    Attributes
    ----------
    record : SubmapRecord
    gradient_map : GradientMap
    features : Features
        Keypoints of the gradient magnitude in the observed area.
    field : Field
        At the spacing at which the map is searched.
    """

    record: SubmapRecord
    gradient_map: GradientMap
    features: Features
    field: Field

    @classmethod
    def of(cls, record: SubmapRecord, gradient_map: GradientMap, settings: Settings) -> "MapEntry":
        """Extract the keypoints and the field of a submap's gradient map."""
        spacing = field_spacing(gradient_map, settings.calibration)
        return cls(
            record=record,
            gradient_map=gradient_map,
            features=extract_features(gradient_map, settings.features),
            field=field_of(gradient_map, spacing, settings.calibration),
        )

    @property
    def name(self) -> str:
        """Name of the submap."""
        return self.record.name

    @property
    def id(self) -> str:
        """Unique among all sessions: ``session/name``, or the name where there is one session only."""
        return f"{self.record.session}/{self.name}" if self.record.session else self.name

    def field_at(self, spacing: float, settings: Settings) -> Field:
        """The field at `spacing` metres per pixel; the stored one where that is its spacing."""
        if spacing == self.field.spacing:
            return self.field
        return field_of(self.gradient_map, spacing, settings.calibration)

    def to_bytes(self) -> bytes:
        """The entry as bytes that `from_bytes` reads back without loss."""
        record = asdict(self.record)
        record["hull"] = self.record.hull.tolist()
        record["odometry"] = None if self.record.odometry is None else self.record.odometry.tolist()
        arrays = {"record": _text(json.dumps(record)), "map": _raw(self.gradient_map.to_bytes())}
        for prefix, part in (("features", self.features), ("field", self.field)):
            arrays |= {f"{prefix}.{f.name}": np.asarray(getattr(part, f.name)) for f in fields(part)}
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> "MapEntry":
        """The entry that `to_bytes` wrote.

        Raises
        ------
        TerrainLoopError
            If the bytes are no such entry.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                record = json.loads(arrays["record"].tobytes())
                record["hull"] = np.array(record["hull"], dtype=float).reshape(-1, 2)
                if record["odometry"] is not None:
                    record["odometry"] = np.array(record["odometry"], dtype=float).reshape(4, 4)
                return cls(
                    SubmapRecord(**record),
                    GradientMap.from_bytes(arrays["map"].tobytes()),
                    Features(**_part(arrays, "features", Features)),
                    Field(**_part(arrays, "field", Field)),
                )
        except TerrainLoopError:
            raise
        except Exception as error:  # what NumPy and zipfile raise on damaged data is not documented
            raise TerrainLoopError(
                expected="the bytes of a map entry",
                found=" ".join(str(error).split()) or type(error).__name__,
                mend="store the submap again",
            ) from error


def _part(arrays: Any, prefix: str, kind: type[Any]) -> dict[str, Any]:
    """Fields of a data class from their arrays; scalars, strings and pairs as such."""
    values = {f.name: arrays[f"{prefix}.{f.name}"] for f in fields(kind)}
    return {
        name: value.item() if value.ndim == 0 else tuple(value.tolist()) if name == "origin" else value
        for name, value in values.items()
    }


def _text(text: str) -> np.ndarray[Any, Any]:
    return _raw(text.encode())


def _raw(data: bytes) -> np.ndarray[Any, Any]:
    return np.frombuffer(data, dtype=np.uint8)
