"""Appearance-based place recognition: an incremental bag of binary words over ORB features.

E. Garcia-Fidalgo and A. Ortiz, iBoW-LCD: An Appearance-Based Loop-Closure Detection Approach Using
Incremental Bags of Binary Words, IEEE Robotics and Automation Letters 3(4), 2018. Reimplemented from the
publication, whose full text was not available: the rules for islands and scores were not checked against it
line by line. The authors' program is under the GPL and was not read, except for the settings of its published
runs. Known differences:

- a small vocabulary is searched exhaustively and a large one in FLANN's hash tables (LSH, its settings for
  ORB), theirs in trees: all but the exhaustive search are approximate;
- words seen once are kept, as in their runs without purging;
- every loop has to pass the epipolar check, also within a sequence of loops, since its inliers are the score.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from reproduce.baselines.method import NOT_COMPARABLE, Match, Method, Observation, Scale
from terrainloop.geometry import Array

Gray = NDArray[np.uint8]

FEATURES = 1500  # ORB features of an image, as the paper of the gradient maps has it
RATIO = 0.8  # of the distances to the nearest and the second nearest; matches above it are ambiguous
EPIPOLAR_PX, CONFIDENCE = 3.0, 0.99
EXHAUSTIVE = 5000  # size of a vocabulary up to which it is searched exhaustively
LSH: dict[str, bool | int | float | str] = {
    "algorithm": 6,
    "table_number": 6,
    "key_size": 12,
    "multi_probe_level": 1,
}


@dataclass(frozen=True, eq=False)
class Features:
    """ORB features of an image.

    Attributes
    ----------
    pixels : array, (N, 2) float32
        Column and row.
    descriptors : array, (N, 32) uint8
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def features_of(image: Gray, fast_threshold: int = 20) -> Features:
    """The strongest ORB features of a grey image, at most `FEATURES`; other settings as in OpenCV."""
    orb = cv2.ORB_create(nfeatures=FEATURES, fastThreshold=fast_threshold)  # type: ignore[attr-defined]
    keypoints, descriptors = orb.detectAndCompute(image, None)
    if descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))
    return Features(np.array([keypoint.pt for keypoint in keypoints], np.float32), descriptors)


def epipolar_inliers(a: Features, b: Features) -> int:
    """Number of matches of two images consistent with one fundamental matrix; 0 if too few to estimate it.

    OpenCV's RANSAC is reseeded in every call.
    """
    in_b, in_a = _clear_matches(_matcher(a.descriptors), b.descriptors)
    if len(in_b) < 8:
        return 0
    _, inliers = cv2.findFundamentalMat(
        b.pixels[in_b], a.pixels[in_a], cv2.FM_RANSAC, EPIPOLAR_PX, CONFIDENCE
    )
    return 0 if inliers is None else int(inliers.sum())


def _matcher(stored: NDArray[np.uint8]) -> cv2.DescriptorMatcher:
    """Finds the nearest of some descriptors (N, 32)."""
    cv2.setRNGSeed(0)  # LSH draws its bits from it
    large = len(stored) > EXHAUSTIVE
    matcher = cv2.FlannBasedMatcher(LSH, {}) if large else cv2.BFMatcher(cv2.NORM_HAMMING)
    if len(stored):
        matcher.add([stored])
        matcher.train()
    return matcher


def _clear_matches(
    matcher: cv2.DescriptorMatcher, queries: NDArray[np.uint8]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of the queries that are clearly nearest to one of those stored, and of that one."""
    found = [] if matcher.empty() or not len(queries) else matcher.knnMatch(queries, k=2)
    clear = [
        (two[0].queryIdx, two[0].trainIdx)
        for two in found
        if len(two) == 2 and two[0].distance < RATIO * two[1].distance
    ]
    pairs = np.array(clear, dtype=np.intp).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


class Vocabulary:
    """Binary words that grow with the images, and which image has which of them."""

    def __init__(self) -> None:
        self._words = np.zeros((0, 32), np.uint8)
        self._matcher = _matcher(self._words)
        self._images: list[tuple[NDArray[np.intp], NDArray[np.int64]]] = []  # words and their counts

    def __len__(self) -> int:
        return len(self._words)

    def add(self, features: Features) -> None:
        """Index an image: features that match a word update it, the others become new words."""
        matched, words = _clear_matches(self._matcher, features.descriptors)
        np.bitwise_and.at(self._words, words, features.descriptors[matched])
        new = np.setdiff1d(np.arange(len(features.descriptors)), matched)
        added = np.arange(len(self._words), len(self._words) + len(new))
        self._words = np.concatenate([self._words, features.descriptors[new]])
        self._matcher = _matcher(self._words)
        self._images.append(np.unique(np.concatenate([words, added]), return_counts=True))

    def similarity(self, features: Features) -> Array:
        """TF-IDF score (N,) of each image indexed, in the order added; higher is more alike.

        Each matched feature gives the image its word's term frequency there times the logarithm of the
        number of images over that of images with the word.
        """
        _, words = _clear_matches(self._matcher, features.descriptors)
        images_with = np.zeros(len(self._words))
        for known, _ in self._images:
            images_with[known] += 1
        weight = np.bincount(words, minlength=len(self._words)).astype(float)
        weight[words] *= np.log(len(self._images) / images_with[words])
        return np.array([weight[known] @ counts / max(counts.sum(), 1) for known, counts in self._images])


@dataclass(frozen=True)
class Closure:
    """The loop closure of an image, if any.

    Attributes
    ----------
    image : int
        Index of the earlier image of the same place; -1 if none is similar.
    inliers : int
        Inliers of the epipolar check: the score.
    """

    image: int
    inliers: int


@dataclass(frozen=True)
class _Island:
    """Similar images close in time: from the first to the last, with the mean of their scores."""

    first: int
    last: int
    score: float

    def overlaps(self, other: "_Island | None") -> bool:
        return other is not None and self.first <= other.last and other.first <= self.last


def closures(images: Sequence[Features], skip: int, island: int = 7, min_score: float = 0.3) -> list[Closure]:
    """Loop closures along a sequence of images, each compared with those before it.

    Parameters
    ----------
    images : sequence of Features
        Features of the images in chronological order.
    skip : int
        Number of directly preceding images that are excluded.
    island : int
        Initial size of an island, in images; 7 to 11 in the published runs.
    min_score : float
        Minimum score of an image, rescaled to 0-1; 0.3 in the published runs.

    Returns
    -------
    list of Closure
        The best earlier image for each image.
    """
    vocabulary, previous, found = Vocabulary(), None, []
    for i, features in enumerate(images):
        if i > skip:
            vocabulary.add(images[i - skip - 1])
        scores = _rescaled(vocabulary.similarity(features))
        islands = _islands(scores, island, min_score)
        # Islands that continue that of the previous image take precedence.
        chosen = max(
            [known for known in islands if known.overlaps(previous)] or islands,
            key=lambda known: known.score,
            default=None,
        )
        previous = chosen
        if chosen is None:
            found.append(Closure(-1, 0))
        else:
            best = chosen.first + int(np.argmax(scores[chosen.first : chosen.last + 1]))
            found.append(Closure(best, epipolar_inliers(images[best], features)))
    return found


def _rescaled(scores: Array) -> Array:
    """Scores (N,) rescaled to 0-1; all 0 if they are equal."""
    span = float(np.ptp(scores)) if len(scores) else 0.0
    return (scores - scores.min()) / span if span > 0 else np.zeros(len(scores))


def _islands(scores: Array, size: int, min_score: float) -> list[_Island]:
    """Group the images in descending order of score: each joins the island it is in or starts another.

    An island is ``size`` images wide, fewer where it meets its neighbours, and its score is the mean
    over its images.
    """
    half, bounds = size // 2, list[tuple[int, int]]()
    for image in np.argsort(-scores, kind="stable"):
        if scores[image] < min_score or scores[image] <= 0:
            break
        if any(first <= image <= last for first, last in bounds):
            continue
        first = max([0, image - half, *(last + 1 for _, last in bounds if last < image)])
        last = min([len(scores) - 1, image + half, *(first - 1 for first, _ in bounds if first > image)])
        bounds.append((int(first), int(last)))
    kept = np.where(scores < min_score, 0, scores)
    return [_Island(first, last, float(kept[first : last + 1].mean())) for first, last in bounds]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Images of a submap and their vocabulary."""

    images: tuple[Features, ...]
    vocabulary: Vocabulary


def methods(scale: Scale) -> list[Method]:
    """Recognise submaps by their images: the same words and check, for each pair of submaps separately.

    For each image of the source the most similar image is looked up in the vocabulary of the target, and
    the score is the maximum number of epipolar inliers of these pairs of images. There is no transform,
    as a single camera does not observe the scale of its motion. The sweep is over the minimum contrast of
    an ORB corner: OpenCV's 20 grey levels, and 7, to which ORB-SLAM falls back on ground of low contrast.
    Nothing depends on the scale of the terrain.
    """
    return [
        Method(
            name="iBoW (ORB)",
            settings={"features": FEATURES, "fast_threshold": threshold},
            software=f"OpenCV {cv2.__version__}; Garcia-Fidalgo & Ortiz 2018",
            describe=partial(_describe, fast_threshold=threshold),
            score=_score,
        )
        for threshold in (20, 7)
    ]


def _describe(seen: Observation, fast_threshold: int) -> _Seen:
    images = tuple(features_of(image, fast_threshold) for image in seen.images)
    vocabulary = Vocabulary()
    for features in images:
        vocabulary.add(features)
    return _Seen(images, vocabulary)


def _score(source: _Seen, target: _Seen) -> Match:
    if not source.images or not target.images:
        return Match(NOT_COMPARABLE)
    likeliest = (int(np.argmax(target.vocabulary.similarity(image))) for image in source.images)
    pairs = zip(source.images, likeliest, strict=True)
    return Match(float(max(epipolar_inliers(target.images[found], image) for image, found in pairs)))
