"""Keyframe selection: each cue on its own, at its threshold, and which comes first."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.config.tracking_settings import KeyframeConfig
from tgslam.geometry import se3_exp
from tgslam.keyframing.covisibility import KeyframeSelector
from tgslam.types import Frame

CONFIG = KeyframeConfig(min_covisibility=0.8, max_unexplained=0.1, max_translation=0.1, max_interval=20)
DEPTH_M = np.array([[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 2.0, 9.0]], np.float32)  # median of the measured: 2 m
HERE = se3_exp([0.3, -0.2, 0.1, 1.0, -2.0, 0.5])


def frame(index: int) -> Frame:
    return Frame(index, 0.1 * index, np.zeros((*DEPTH_M.shape, 3), np.float32), DEPTH_M)


def seen(first: int, stop: int, count: int = 200) -> np.ndarray:
    mask = np.zeros(count, bool)
    mask[first:stop] = True
    return mask


@pytest.fixture
def fresh() -> KeyframeSelector:
    """Frame 5 has just become a keyframe."""
    selector = KeyframeSelector(CONFIG)
    selector.reset(frame(5), HERE, seen(0, 100))
    return selector


@pytest.fixture
def selector(fresh: KeyframeSelector) -> KeyframeSelector:
    """Two frames later, which were no keyframes."""
    for _ in range(2):
        assert fresh.cue(frame(5), HERE, seen(0, 100), unexplained=0.0) == ""
    return fresh


def test_the_same_view_is_no_keyframe(selector: KeyframeSelector) -> None:
    assert selector.cue(frame(6), HERE, seen(0, 100), unexplained=0.0) == ""


@pytest.mark.parametrize(
    ("view", "overlap"),
    [
        (seen(0, 79), "0.79"),  # nearer: the frame sees less
        (seen(0, 127), "0.79"),  # farther: it sees more
        (seen(12, 112), "0.79"),  # aside
        (seen(100, 200), "0.00"),
        (seen(0, 0), "0.00"),
    ],
)
def test_seeing_other_gaussians_makes_a_keyframe(selector: KeyframeSelector, view: np.ndarray, overlap: str) -> None:
    assert selector.cue(frame(6), HERE, view, unexplained=0.0) == f"co-visibility: overlap {overlap}"


@pytest.mark.parametrize("view", [seen(0, 80), seen(0, 125), seen(11, 111)])
def test_overlap_at_the_limit_is_enough(selector: KeyframeSelector, view: np.ndarray) -> None:
    assert selector.cue(frame(6), HERE, view, unexplained=0.0) == ""


def test_what_the_map_leaves_open_makes_a_keyframe(selector: KeyframeSelector) -> None:
    assert selector.cue(frame(6), HERE, seen(0, 100), unexplained=0.1) == ""
    assert (
        selector.cue(frame(6), HERE, seen(0, 100), unexplained=0.12)
        == "co-visibility: 12% of the frame is not in the map"
    )


def test_the_interval_is_counted_in_frame_indices_from_the_last_keyframe(selector: KeyframeSelector) -> None:
    assert selector.cue(frame(24), HERE, seen(0, 100), unexplained=0.0) == ""
    assert selector.cue(frame(25), HERE, seen(0, 100), unexplained=0.0) == "interval"
    assert selector.cue(frame(90), HERE, seen(0, 100), unexplained=0.0) == "interval"
    selector.reset(frame(25), HERE, seen(0, 100))
    assert selector.cue(frame(26), HERE, seen(0, 100), unexplained=0.0) == ""


def test_a_new_keyframe_is_what_later_frames_are_compared_with(selector: KeyframeSelector) -> None:
    selector.reset(frame(8), HERE, seen(50, 150, count=300))
    assert selector.cue(frame(9), HERE, seen(50, 150, count=300), unexplained=0.0) == ""
    assert selector.cue(frame(9), HERE, seen(0, 100, count=300), unexplained=0.0) == "co-visibility: overlap 0.33"


def test_asking_again_changes_nothing(selector: KeyframeSelector) -> None:
    for _ in range(2):
        assert selector.cue(frame(6), HERE, seen(60, 160), unexplained=0.5).startswith("co-visibility: overlap")
        assert selector.cue(frame(30), HERE, seen(0, 100), unexplained=0.0) == "interval"


@pytest.mark.parametrize(
    ("view", "unexplained", "shift_m"),
    [(seen(0, 65), 0.0, 0.0), (seen(0, 100), 0.3, 0.0), (seen(0, 100), 0.0, 0.5)],
)
def test_right_after_a_keyframe_it_takes_more(
    fresh: KeyframeSelector, view: np.ndarray, unexplained: float, shift_m: float
) -> None:
    T_cw = se3_exp([0, 0, 0, 0, shift_m, 0]) @ HERE
    assert fresh.cue(frame(6), T_cw, view, unexplained) == ""
    assert fresh.cue(frame(7), T_cw, view, unexplained) == ""
    assert fresh.cue(frame(8), T_cw, view, unexplained) != ""


@pytest.mark.parametrize(
    ("view", "unexplained", "shift_m"),
    [(seen(0, 30), 0.0, 0.0), (seen(0, 100), 0.4, 0.0), (seen(0, 100), 0.0, 0.7)],
)
def test_but_far_more_is_enough_even_then(
    fresh: KeyframeSelector, view: np.ndarray, unexplained: float, shift_m: float
) -> None:
    assert fresh.cue(frame(6), se3_exp([0, 0, 0, 0, shift_m, 0]) @ HERE, view, unexplained) != ""


def test_an_empty_map_does_not_divide_by_zero() -> None:
    nothing = np.zeros(0, bool)
    selector = KeyframeSelector(CONFIG)
    selector.reset(frame(0), HERE, nothing)
    assert selector.cue(frame(1), HERE, nothing, unexplained=1.0) == "co-visibility: overlap 0.00"


def test_moving_by_a_part_of_the_depth_makes_a_keyframe(selector: KeyframeSelector) -> None:
    near, far = (se3_exp([0, 0, 0, 0, shift_m, 0]) @ HERE for shift_m in (0.19, 0.21))
    turned = se3_exp([0.5, 0, 0, 0, 0, 0]) @ HERE  # on the spot
    for T_cw in (near, turned):
        assert selector.cue(frame(6), T_cw, seen(0, 100), unexplained=0.0) == ""
    assert selector.cue(frame(6), far, seen(0, 100), unexplained=0.0) == "baseline: 0.21 m"
    selector.reset(frame(6), far, seen(0, 100))
    assert selector.cue(frame(7), far, seen(0, 100), unexplained=0.0) == ""
