"""Output of the runner, read back and evaluated."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from reproduce.missions import Drive
from reproduce.runner import Task, read_pairs
from terrainloop.evaluation.criteria import Criterion, criteria
from terrainloop.evaluation.pairs import EvaluatedPair, evaluate_pairs
from terrainloop.evaluation.precision_recall import Metrics
from terrainloop.evaluation.truth import GroundTruth

CRITERIA = ("overlap", "overlap and pose", "pose")  # the paper's; the strictest; see `evaluation.criteria`
GROUNDS = ("boxes", "observed")  # the paper's: bounding boxes; ground that was actually observed


@dataclass(frozen=True, eq=False)
class Result:
    """One method with one choice of settings on one mission, evaluated.

    Attributes
    ----------
    drive : Drive
    module, method : str
        Module that it comes from, and its name in tables.
    variant : int
        Number of the choice of settings.
    record : mapping
        Settings, software and times, as written by the runner.
    pairs : list of EvaluatedPair
    """

    drive: Drive
    module: str
    method: str
    variant: int
    record: Mapping[str, Any]
    pairs: Sequence[EvaluatedPair]
    _measured: dict[tuple[str, str], Metrics] = field(default_factory=dict, init=False)

    @classmethod
    def of(cls, task: Task) -> "Result":
        drive = task.drive
        record = json.loads(task.json.read_text(encoding="utf-8"))
        truth = GroundTruth(drive.records, drive.poses, drive.sessions, drive.observed_iou)
        pairs = evaluate_pairs(read_pairs(task.csv), truth)
        return cls(drive, task.short_module, task.method.name, task.variant, record, pairs)

    @property
    def settings(self) -> str:
        return " ".join(f"{key}={value}" for key, value in self.record["settings"].items())

    @cached_property
    def criteria(self) -> dict[str, dict[str, Criterion]]:
        """Criteria by the kind of overlap, then by what counts as right."""
        return {
            ground: criteria(self.pairs, self.drive.min_overlap, observed=ground == "observed")
            for ground in GROUNDS
        }

    def metrics(self, criterion: str, ground: str = "boxes") -> Metrics:
        """Recall at full precision, largest F1, average precision, with intervals."""
        key = (criterion, ground)
        if key not in self._measured:
            self._measured[key] = self.criteria[ground][criterion].metrics()
        return self._measured[key]

    @cached_property
    def registered(self) -> list[EvaluatedPair]:
        """The true pairs with the right pose, whatever their score."""
        true = self.criteria["boxes"]["overlap"].is_true
        return [
            pair for pair, is_true in zip(self.pairs, true, strict=True) if is_true and pair.pose_is_right
        ]


def best_of_each(results: Iterable[Result], criterion: str) -> list[Result]:
    """The variant of each method with the highest recall at full precision, then average precision.

    Methods that could compare no pair are left out.
    """
    best: dict[str, tuple[tuple[float, float], Result]] = {}
    for result in results:
        if all(pair.candidate.score == -np.inf for pair in result.pairs):
            continue
        metrics = result.metrics(criterion)
        key = (metrics.recall_at_full_precision.value, metrics.average_precision.value)
        key = tuple(np.nan_to_num(key, nan=-1.0))
        if result.method not in best or key > best[result.method][0]:
            best[result.method] = (key, result)
    return [result for _, result in best.values()]
