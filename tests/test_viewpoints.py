"""Sparse Global Viewpoints: the paper's three rules, in their order."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tgslam.mapping.viewpoints import Viewpoints

WINDOW = [20, 21, 22, 23]


def viewpoints(seed: int = 0) -> Viewpoints:
    return Viewpoints(np.random.default_rng(seed))


def test_ends_of_closures_come_first_and_those_of_the_window_before_others() -> None:
    chosen = viewpoints()
    chosen.link(3, 21)
    chosen.link(9, 5)
    shares_two = {0: [7, 20], 1: [7, 22]}
    assert chosen.choose(1, WINDOW, shares_two) == [3]
    assert chosen.choose(3, WINDOW, shares_two) == [3, 5, 9]
    assert chosen.choose(4, WINDOW, shares_two) == [3, 5, 7, 9]


def test_keyframes_that_share_two_planes_with_the_window_come_before_those_that_share_one() -> None:
    seen_by = {0: [4, 11, 20], 1: [11, 4, 23], 2: [6, 22], 3: [8, 9], 4: [8, 9]}
    for seed in range(5):
        assert viewpoints(seed).choose(2, WINDOW, seen_by) == [4, 11]


def test_the_most_connected_keyframes_are_what_is_left_to_choose_by() -> None:
    chosen = viewpoints()
    for other in (1, 5, 9):
        chosen.link(2, other)
    assert chosen.choose(1, WINDOW, {}) == [2]


def test_of_equals_all_take_their_turn_and_the_seed_repeats_them() -> None:
    chosen = viewpoints()
    drawn = [chosen.choose(2, WINDOW, {}) for _ in range(60)]
    assert {k for pair in drawn for k in pair} == set(range(20))
    again = viewpoints()
    assert [again.choose(2, WINDOW, {}) for _ in range(60)] == drawn


@given(st.integers(0, 30), st.integers(1, 12), st.lists(st.tuples(st.integers(0, 15), st.integers(0, 15)), max_size=9))
def test_they_are_distinct_and_before_the_window(count: int, first: int, links: list[tuple[int, int]]) -> None:
    chosen = viewpoints()
    for pair in links:
        chosen.link(*pair)
    found = chosen.choose(count, range(first, first + 4), {0: range(16), 1: range(8)})
    assert len(found) == len(set(found)) == min(count, first)
    assert all(0 <= k < first for k in found)
