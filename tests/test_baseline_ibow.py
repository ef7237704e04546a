import cv2
import numpy as np
import pytest
from scipy import ndimage

from reproduce.baselines import ibow
from reproduce.baselines.ibow import (
    Features,
    Vocabulary,
    _islands,
    closures,
    epipolar_inliers,
    features_of,
    methods,
)
from reproduce.baselines.method import NOT_COMPARABLE, Observation, Scale
from terrainloop.submap import Submap


def _place(seed, size=(300, 400)):
    """A picture of speckled ground."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(size), 2.0)
    return np.clip(128 + 50 * noise / noise.std(), 0, 255).astype(np.uint8)


def _view(place, shift, seed):
    """The picture moved and turned a little, with noise."""
    rows, columns = place.shape
    turn = cv2.getRotationMatrix2D((columns / 2, rows / 2), 2.0 * shift, 1.0)
    turn[0, 2] += 5 * shift
    seen = cv2.warpAffine(place, turn, (columns, rows), borderMode=cv2.BORDER_REFLECT)
    return np.clip(seen + np.random.default_rng(seed).normal(0, 2, place.shape), 0, 255).astype(np.uint8)


def _descriptors(*rows):
    """Features whose descriptors have the given bytes set to ones, each alone."""
    descriptors = np.zeros((len(rows), 32), np.uint8)
    for i, places in enumerate(rows):
        descriptors[i, list(places)] = 255
    return Features(np.zeros((len(rows), 2), np.float32), descriptors)


def _submap():
    return Submap(np.random.default_rng(0).random((200, 3)), name="s")


def _observation(*images):
    return Observation(_submap(), images=tuple(images))


@pytest.fixture(scope="module")
def method():
    return methods(Scale(spacing=0.03, side=10.0))[0]


def test_views_of_one_place_agree_with_one_epipolar_geometry_and_others_do_not():
    first = features_of(_place(0))
    again, other = features_of(_view(_place(0), 2, 1)), features_of(_place(1))
    assert 300 < len(first.pixels) <= 1500
    assert epipolar_inliers(first, again) > 200
    assert epipolar_inliers(first, other) < 25
    assert epipolar_inliers(first, features_of(np.full((300, 400), 128, np.uint8))) == 0


def test_the_epipolar_check_does_not_hang_on_the_state_of_opencv():
    first, again = features_of(_place(0)), features_of(_view(_place(0), 6, 1))
    counts = []
    for seed in (1, 2):
        cv2.setRNGSeed(seed)
        counts.append(epipolar_inliers(first, again))
    assert counts[0] == counts[1]


def test_a_word_keeps_the_bits_of_all_that_matched_it():
    vocabulary = Vocabulary()
    vocabulary.add(_descriptors([0, 1, 2, 3], [10, 11, 12, 13]))
    assert len(vocabulary) == 2
    vocabulary.add(_descriptors([0, 1, 2, 20], [25, 26, 27, 28]))  # the first matches, the second is new
    assert len(vocabulary) == 3
    np.testing.assert_array_equal(vocabulary._words[0], _descriptors([0, 1, 2]).descriptors[0])


def test_similarity_is_term_frequency_times_inverse_document_frequency():
    a, b, c, d = ([8 * k, 8 * k + 1, 8 * k + 2, 8 * k + 3] for k in range(4))
    vocabulary = Vocabulary()
    for words in ((a, b), (a, a, c), (b, d)):
        vocabulary.add(_descriptors(*words))
    # Words a and b are in two of three images, c and d in one. In the second image a is two of three.
    expected = [
        0.5 * np.log(3 / 2),
        2 / 3 * np.log(3 / 2) + 1 / 3 * np.log(3),
        0.0,
    ]
    np.testing.assert_allclose(vocabulary.similarity(_descriptors(a, c)), expected)


def test_islands_group_images_close_in_time():
    scores = np.array([0, 0.9, 1.0, 0.2, 0, 0.5, 0, 0, 0, 0.4])
    islands = _islands(scores, 3, 0.3)
    assert [(i.first, i.last) for i in islands] == [(1, 3), (4, 6), (8, 9)]
    np.testing.assert_allclose([i.score for i in islands], [1.9 / 3, 0.5 / 3, 0.4 / 2])


def test_a_second_lap_closes_loops_with_the_first_and_nothing_else():
    places = [_place(seed) for seed in range(6)]
    lap = [features_of(_view(place, k, 10 * i + k)) for i, place in enumerate(places) for k in (0, 1)]
    again = [features_of(_view(place, k, 100 + 10 * i + k)) for i, place in enumerate(places) for k in (2, 3)]
    new = [features_of(_place(seed)) for seed in (20, 21)]
    found = closures([*lap, *again, *new], skip=4, island=3)
    assert all(closure.image == -1 for closure in found[:5])
    second = found[len(lap) : len(lap) + len(again)]
    assert [closure.image // 2 for closure in second] == [i for i in range(6) for _ in (0, 1)]
    assert min(closure.inliers for closure in second) > 2 * max(
        closure.inliers for closure in (*found[: len(lap)], *found[-2:])
    )


def test_images_just_before_are_no_loops():
    images = [features_of(_view(_place(0), k, k)) for k in range(6)]
    assert [closure.image for closure in closures(images, skip=6)] == [-1] * 6
    assert all(closure.image < max(i - 2, 0) for i, closure in enumerate(closures(images, skip=2)))


def test_the_method_tells_a_place_from_others_whatever_was_scored_before(method):
    target = method.describe(_observation(_place(5), _place(0), _place(6)))
    source = method.describe(_observation(_place(7), _view(_place(0), 2, 1)))
    other = method.describe(_observation(_place(8), _place(9)))
    right, wrong = method.score(source, target), method.score(other, target)
    assert right.score > 5 * wrong.score > 0
    assert np.isnan(right.T_target_source).all()
    assert method.score(source, target).score == right.score


def test_without_images_nothing_is_comparable(method):
    blind, seeing = method.describe(_observation()), method.describe(_observation(_place(0)))
    assert method.score(blind, seeing).score == method.score(seeing, blind).score == NOT_COMPARABLE


def test_a_large_vocabulary_is_searched_almost_as_well_and_always_alike(monkeypatch):
    places = [features_of(_place(seed)) for seed in range(4)]
    query = features_of(_view(_place(2), 1, 1))

    def similarity():
        vocabulary = Vocabulary()
        for place in places:
            vocabulary.add(place)
        return vocabulary.similarity(query)

    exhaustive = similarity()
    monkeypatch.setattr(ibow, "EXHAUSTIVE", 0)
    hashed = similarity()
    cv2.setRNGSeed(5)
    np.testing.assert_array_equal(hashed, similarity())
    assert hashed[2] == pytest.approx(exhaustive[2], rel=0.15)
    assert hashed[2] > 3 * np.delete(hashed, 2).max()
