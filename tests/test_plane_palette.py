"""The palette of plane ids: separation, stability and reading ids back from colours."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from tests.reference.palette import ids_of
from tgslam.planes.identity.palette import colours


@pytest.mark.parametrize(("count", "least"), [(8, 0.6), (16, 0.4), (64, 0.23), (256, 0.12)])
def test_the_first_colours_are_far_from_each_other_and_from_black(count: int, least: float) -> None:
    assert pdist(np.vstack([np.zeros(3), colours(np.arange(count))])).min() >= least


def test_a_colour_depends_on_the_id_alone() -> None:
    before = colours([3])
    colours(np.arange(1000))
    assert (colours([3]) == before).all()
    assert (colours(np.arange(100))[:64] == colours(np.arange(64))).all()
    assert len(np.unique(colours(np.arange(1000)), axis=0)) == 1000


def test_no_plane_is_black_and_colours_can_be_rendered_by_a_sigmoid() -> None:
    assert (colours(-1) == 0).all()
    image = colours(np.array([[0, -1], [5, 2]]))
    assert image.shape == (2, 2, 3)
    inside = colours(np.arange(500))
    assert inside.min() > 0.01
    assert inside.max() < 0.99


@given(st.lists(st.integers(0, 200), min_size=1, max_size=40, unique=True), st.integers(0, 1000))
def test_ids_are_read_back_from_colours(ids: list[int], seed: int) -> None:
    known = np.array(ids)
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((len(known), 3))
    direction *= 0.02 / np.linalg.norm(direction, axis=1, keepdims=True)
    assert (ids_of(colours(known) + direction, known, margin=0.02) == known).all()


def test_undecided_and_dark_colours_are_no_plane() -> None:
    known = np.array([0, 1, 2])
    middle = colours([0, 1]).mean(axis=0, keepdims=True)
    assert ids_of(middle, known) == [-1]
    assert ids_of(0.1 * colours([1]), known) == [-1]
    assert ids_of(np.ones((2, 3)), np.array([], int)).tolist() == [-1, -1]
