"""A stored submap: what is kept of it to be compared with others, and its bytes."""

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from terrainloop.config import Settings
from terrainloop.errors import TerrainLoopError
from terrainloop.features import Features, extract_features
from terrainloop.field import Field, field_of, field_spacing
from terrainloop.gradient_map import GradientMap
from terrainloop.io.npz import pack, read_member
from terrainloop.record import SubmapRecord

_DESCRIPTORS = {"surf": (64, np.float32), "sift": (128, np.float32), "orb": (32, np.uint8)}
"""Width and type of the descriptors by kind of features."""


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
        Gradient field at the spacing at which the map is searched.
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

    def __repr__(self) -> str:
        return f"MapEntry({self.summary})"

    @property
    def name(self) -> str:
        """Name of the submap."""
        return self.record.name

    @property
    def id(self) -> str:
        """Unique among all sessions: ``session/name``, or the name where there is one session only."""
        return f"{self.record.session}/{self.name}" if self.record.session else self.name

    @property
    def summary(self) -> str:
        """Size of the map, hyperparameters and repairs, in one line."""
        p, (rows, columns) = self.gradient_map.parameters, self.gradient_map.mask.shape
        facts = [
            f"{self.record.points} points",
            f"{columns} x {rows} pixels of {self.gradient_map.resolution:.3g} m",
            f"{self.gradient_map.mask.mean():.0%} observed",
            f"{len(self.features)} keypoints",
            f"length scale {p.length_scale:.3g} m, relief {p.variance**0.5:.3g} m, noise {p.noise:.2g} m",
        ]
        repairs = f"; {self.record.notes}" if self.record.notes else ""
        return f"{self.name}: {', '.join(facts)}{repairs}"

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
        return pack(arrays, compress=False)

    @classmethod
    def from_bytes(cls, data: bytes) -> "MapEntry":
        """The entry that `to_bytes` wrote.

        Raises
        ------
        TerrainLoopError
            If the bytes are not such an entry.
        """
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as file:

                def array(name: str) -> np.ndarray[Any, Any]:
                    return read_member(file, name, len(data), kinds="fiuU")

                return cls(
                    _record(array("record").tobytes()),
                    GradientMap.from_bytes(array("map").tobytes()),
                    _checked_features(Features(**_part(array, "features", Features))),
                    _checked_field(Field(**_part(array, "field", Field))),
                )
        except TerrainLoopError:
            raise
        except Exception as error:  # what zipfile and NumPy raise on damaged data is not documented
            raise TerrainLoopError(
                expected="the bytes of a map entry",
                found=" ".join(str(error).split()) or type(error).__name__,
                mend="store the submap again",
            ) from error


def _record(data: bytes) -> SubmapRecord:
    content = json.loads(data)
    content["hull"] = np.array(content["hull"], dtype=float).reshape(-1, 2)
    if content["odometry"] is not None:
        content["odometry"] = np.array(content["odometry"], dtype=float).reshape(4, 4)
    record = SubmapRecord(**content)
    labels, numbers = (
        (record.name, record.status, record.notes, record.session),
        (record.stamp, record.points),
    )
    if not all(isinstance(label, str) for label in labels) or not all(
        isinstance(number, int | float) for number in numbers
    ):
        raise ValueError("a record of other types")
    return record


def _part(array: Callable[[str], Any], prefix: str, kind: type[Any]) -> dict[str, Any]:
    """Fields of a data class from their arrays; scalars, strings and pairs are unpacked."""
    values = {f.name: array(f"{prefix}.{f.name}") for f in fields(kind)}
    return {
        name: value.item() if value.ndim == 0 else tuple(value.tolist()) if name == "origin" else value
        for name, value in values.items()
    }


def _checked_features(features: Features) -> Features:
    """The features, if their arrays fit together: else the compiled core would read beyond them."""
    count = len(features.positions)
    width, kind_of_number = _DESCRIPTORS[features.kind]
    vectors = (features.scales, features.orientations, features.responses)
    if (
        features.positions.shape != (count, 2)
        or any(vector.shape != (count,) for vector in vectors)
        or any(array.dtype != np.float64 for array in (features.positions, *vectors))
        or features.descriptors.shape != (count, width)
        or features.descriptors.dtype != kind_of_number
    ):
        raise ValueError("features whose arrays do not fit together")
    return features


def _checked_field(field: Field) -> Field:
    images = (field.x, field.y, field.valid)
    if (
        field.x.ndim != 2
        or any(image.shape != field.x.shape or image.dtype != np.float32 for image in images)
        or not np.isfinite(field.origin).all()
        or np.shape(field.origin) != (2,)
        or not 0 < field.spacing < np.inf
        or not 0 < field.length_scale < np.inf
    ):
        raise ValueError("a field whose parts do not fit together")
    return field


def _text(text: str) -> np.ndarray[Any, Any]:
    return _raw(text.encode())


def _raw(data: bytes) -> np.ndarray[Any, Any]:
    return np.frombuffer(data, dtype=np.uint8)
