"""Instance metrics in cases whose truth is known: perfect, renamed, split, merged, switched, noisy, void."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tgslam.errors import EvaluationError
from tgslam.evaluation.panoptic import IdentitySwitches, overlaps, panoptic, shown

LABELS = np.full((20, 40), -1, np.int32)
LABELS[:, :20] = 0  # 400 px
LABELS[:10, 20:] = 3  # 200 px
COUNTED = {0, 3}


def score(*ids: np.ndarray, labels: np.ndarray = LABELS, counted: set[int] = COUNTED):
    pixels = sum((overlaps(labels, one) for one in ids), Counter())
    return panoptic(pixels, counted, {id_ for _, id_ in pixels} - {-1})


def switches(*ids: np.ndarray, labels: np.ndarray = LABELS) -> IdentitySwitches:
    counter = IdentitySwitches()
    for one in ids:
        counter.add(overlaps(labels, one), COUNTED)
    return counter


def renamed(names: dict[int, int]) -> np.ndarray:
    ids = np.full(LABELS.shape, -1, np.int32)
    for label, id_ in names.items():
        ids[label == LABELS] = id_
    return ids


@pytest.mark.parametrize("names", [{0: 0, 3: 3}, {0: 3, 3: 0}, {0: 17, 3: 5}])
def test_ids_may_have_any_names(names: dict[int, int]) -> None:
    found = score(renamed(names))
    assert (found.quality, found.mean_iou, found.precision, found.recall) == (1, 1, 1, 1)
    assert found.matches == names
    assert switches(*[renamed(names)] * 3).per_100_frames == 0


def test_a_split_is_a_false_instance_and_a_smaller_match() -> None:
    ids = renamed({0: 1, 3: 2})
    ids[:, :5] = 9  # a quarter of label 0
    found = score(ids)
    assert found.quality == pytest.approx((0.75 + 1) / (2 + 0.5))
    assert (found.precision, found.recall) == (pytest.approx(2 / 3), 1)
    assert found.mean_iou == pytest.approx(0.875)
    assert found.matches == {0: 1, 3: 2}


def test_an_even_split_matches_nothing() -> None:
    ids = renamed({0: 1, 3: 2})
    ids[:, :10] = 9
    found = score(ids)
    assert found.matches == {3: 2}
    assert found.quality == pytest.approx(1 / (1 + 0.5 * 2 + 0.5))


def test_a_merge_leaves_the_smaller_one_without_a_match() -> None:
    found = score(renamed({0: 1, 3: 1}))
    assert found.matches == {0: 1}
    assert found.quality == pytest.approx((400 / 600) / 1.5)
    assert (found.precision, found.recall) == (1, 0.5)


def test_nothing_found_and_nothing_there() -> None:
    nothing = np.full_like(LABELS, -1)
    missed = score(nothing)
    assert (missed.quality, missed.recall, missed.precision, missed.mean_iou) == (0, 0, None, None)
    invented = score(renamed({0: 1}), labels=nothing)
    assert (invented.quality, invented.recall, invented.precision) == (0, None, 0)
    assert score(nothing, labels=nothing).quality is None


def test_noise_pixels_cost_their_share() -> None:
    ids = renamed({0: 1, 3: 2})
    ids[15:17, 5] = 2
    ids[15:17, 8] = -1
    found = score(ids)
    assert found.matches == {0: 1, 3: 2}
    assert found.mean_iou == pytest.approx((396 / 400 + 200 / 202) / 2)
    assert switches(renamed({0: 1, 3: 2}), ids).switches == 0


def test_small_planes_are_void() -> None:
    ids = renamed({0: 1, 3: 2})
    assert score(ids, counted={0}).quality == 1  # id 2 lies on void alone: no false instance
    ids[:10, 20:30] = 1  # pixels of void do not count against the one that claims them
    assert score(ids, counted={0}).quality == 1
    ids[10:, 20:] = 2  # but now more than half of id 2 is where no plane is
    found = score(ids, counted={0})
    assert found.quality == pytest.approx(1 / 1.5)
    assert found.precision == 0.5


def test_an_instance_is_all_its_pixels_of_the_sequence() -> None:
    one, other = renamed({0: 1, 3: 2}), renamed({0: 8, 3: 2})
    assert score(one).quality == score(other).quality == 1
    both = score(one, one, one, other)
    assert both.matches == {0: 1, 3: 2}
    assert both.quality == pytest.approx((0.75 + 1) / (2 + 0.5))
    assert score(one, other).matches == {3: 2}


def test_switches_are_counted_there_and_back() -> None:
    one, other = renamed({0: 1, 3: 2}), renamed({0: 8, 3: 2})
    counter = switches(one, one, other, one)
    assert counter.switches == 2
    assert counter.per_100_frames == 50
    hidden = np.full_like(LABELS, -1)
    assert switches(one, hidden, other).switches == 1  # remembered where nothing was recognised
    assert IdentitySwitches().per_100_frames is None


def test_changes_of_the_larger_part_of_a_split_plane_are_switches() -> None:
    frames = []
    for width in (18, 15, 8, 2):
        ids = renamed({0: 1, 3: 2})
        ids[:, width:20] = 9
        frames.append(ids)
    assert switches(*frames).switches == 1
    assert switches(*frames, *frames[::-1]).switches == 2


def test_what_covers_a_scrap_of_a_plane_is_not_its_identity() -> None:
    counter = switches(renamed({0: 1}))
    scrap = np.full_like(LABELS, -1)
    scrap[:4, :20] = 7  # a fifth of label 0
    counter.add(overlaps(LABELS, scrap), COUNTED)
    assert counter.switches == 0


def test_scraps_of_an_image_are_no_instances() -> None:
    labels = np.full((50, 40), -1, np.int32)
    labels[:, :20], labels[0, 30:34], labels[0, 35:38] = 0, 1, 2
    ids = np.where(labels == 0, np.int32(8), np.int32(-1))
    ids[10, 30:34], ids[20, 30:33] = 5, 6
    found = overlaps(labels, ids)
    assert shown(found) == ({0, 1}, {8, 5})
    assert panoptic(found, *shown(found)).quality == pytest.approx(1 / (1 + 0.5 + 0.5))
    assert panoptic(found, {0}, {8}).quality == 1


def test_images_of_two_sizes_are_an_error() -> None:
    with pytest.raises(EvaluationError, match=r"\(2, 3\)"):
        overlaps(LABELS, np.zeros((2, 3), np.int32))


small_images = st.lists(st.tuples(st.integers(-1, 3), st.integers(-1, 4)), min_size=1, max_size=60)


@given(small_images)
def test_scores_agree_with_sets_of_pixels(pixels: list[tuple[int, int]]) -> None:
    """Against the definition, with sets in place of counts; label 2 is void."""
    labels, ids = np.array(pixels, np.int32).T[:, None]
    found = panoptic(overlaps(labels, ids), {0, 1, 3}, range(5))
    void = {i for i, (label, _) in enumerate(pixels) if label == 2}
    true = {t: {i for i, p in enumerate(pixels) if p[0] == t} for t in (0, 1, 3)}
    predicted = {q: {i for i, p in enumerate(pixels) if p[1] == q} for q in range(5)}
    true = {t: s for t, s in true.items() if s}
    ious = {(t, q): len(a & b) / len(a | (b - void)) for t, a in true.items() for q, b in predicted.items() if a & b}
    matches = {pair: iou for pair, iou in ious.items() if iou > 0.5}
    false = {
        q
        for q, b in predicted.items()
        if b and 2 * len(b & void) <= len(b) and q not in {other for _, other in matches}
    }
    denominator = len(matches) + 0.5 * len(false) + 0.5 * (len(true) - len(matches))
    assert found.matches == dict(matches.keys())
    if denominator:
        assert found.quality == pytest.approx(sum(matches.values()) / denominator)
        assert 0 <= found.quality <= 1
    else:
        assert found.quality is None


@given(small_images, st.permutations(range(5)))
def test_renaming_ids_changes_nothing(pixels: list[tuple[int, int]], names: list[int]) -> None:
    labels, ids = np.array(pixels, np.int32).T[:, None]
    one = panoptic(overlaps(labels, ids), {0, 1, 3}, range(5))
    other = panoptic(overlaps(labels, np.append(names, -1)[ids].astype(np.int32)), {0, 1, 3}, range(5))
    assert other.quality == (None if one.quality is None else pytest.approx(one.quality))
    assert (one.precision, one.recall) == (other.precision, other.recall)
