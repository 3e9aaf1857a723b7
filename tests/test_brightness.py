"""Exposures of keyframes, on scenes where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from tgslam.camera import SensorNoise
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse
from tgslam.map.keyframes import Keyframe, Keyframes
from tgslam.tracking.brightness import KeyframeExposures, Ratio, gain_ratio
from tgslam.tracking.exposure_steps import MAP, Course, Courses, Tie
from tgslam.types import Exposure


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", frames=150, width=160, height=120), seed=0)


def keyframe(
    source: SyntheticSource, number: int, brightness: float | NDArray, turn: NDArray | None = None
) -> Keyframe:
    """turn: [4, 4] of its camera, which its images know nothing of."""
    frame = source.read(number)
    frame = replace(frame, colour=np.clip(brightness * frame.colour, 0.0, 1.0).astype(np.float32))
    T_cw = inverse(source.pose(number))
    return Keyframe(frame, T_cw if turn is None else turn @ T_cw, Exposure(), np.eye(6))


def ratio(
    source: SyntheticSource, one: tuple[int, float], other: tuple[int, float], turn: NDArray | None = None
) -> Ratio | None:
    """one, other: number and brightness."""
    return gain_ratio(keyframe(source, *one, turn), keyframe(source, *other), source.camera)


def gains_found(source: SyntheticSource, numbers: Sequence[int], brightness: Sequence[float]) -> NDArray[np.float64]:
    """[K] as they are after the last keyframe."""
    keyframes, exposures = Keyframes(source.camera, SensorNoise(0.0015)), KeyframeExposures(source.camera)
    for number, factor in zip(numbers, brightness, strict=True):
        keyframes.add(keyframe(source, number, factor))
        exposures.add(keyframes)
    return np.array([each.exposure.gain for each in keyframes])


@pytest.mark.parametrize("brightness", [0.7, 1.0, 1.2])
@pytest.mark.parametrize("index", [10, 100])
def test_the_ratio_undoes_a_change_of_exposure(source: SyntheticSource, index: int, brightness: float) -> None:
    found = ratio(source, (index + 8, brightness), (index, 1.0))
    assert found is not None
    assert found.log_gain == pytest.approx(-np.log(brightness), abs=0.01)


def test_the_way_back_is_the_inverse(source: SyntheticSource) -> None:
    there, back = ratio(source, (20, 1.0), (28, 0.8)), ratio(source, (28, 0.8), (20, 1.0))
    assert there is not None and back is not None
    assert back.log_gain == pytest.approx(-there.log_gain, abs=0.01)


def test_views_that_share_no_surface_say_nothing(source: SyntheticSource) -> None:
    the_other_way = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert ratio(source, (20, 1.0), (20, 1.0), turn=the_other_way) is None
    assert ratio(source, (20, 10.0), (20, 1.0)) is None  # all is overexposed


def test_steps_of_the_exposure_are_followed(source: SyntheticSource) -> None:
    brightness = [1.0, 1.0, 1.0, 0.8, 0.8, 0.8, 0.85, 0.9, 0.95, 1.0, 1.0, 1.0]
    assert_allclose(gains_found(source, range(0, 120, 10), brightness), 1.0 / np.array(brightness), rtol=0.02)


def test_a_constant_exposure_stays(source: SyntheticSource) -> None:
    assert_allclose(gains_found(source, range(0, 150, 6), [1.0] * 25), 1.0, atol=0.005)


def followed(ties: Sequence[Tie], count: int) -> NDArray[np.float64]:
    """[count] log gains as keyframes come one by one, the first of which is 0."""
    course = Course(np.zeros(0), np.zeros(0, bool))
    nearest = np.array([next((tie.log_gain for tie in ties if tie[:2] == (k, k - 1)), 0.0) for k in range(1, count)])
    for latest in range(1, count):
        course = Course(np.append(course.log_gains, 0.0), np.append(course.moves, False))
        known = [tie for tie in ties if tie.keyframe <= latest]
        course = Courses(known, np.zeros(1)).best(course, nearest[:latest])
    return np.append(0.0, course.log_gains)


def ties_of(truth: NDArray[np.float64], errors: NDArray[np.float64], sigma: float = 0.03) -> list[Tie]:
    """With errors [N] of the views that add up from each to the next, as those by vignetting do."""
    seen, numbers = truth + errors, range(len(truth))
    pairs = [(k, k - back) for k in numbers for back in (1, 2, 4, 8, 16) if back <= k]
    return [Tie(k, other, float(seen[k] - seen[other]), sigma) for k, other in pairs]


def test_errors_smaller_than_the_systematic_one_do_not_add_up() -> None:
    """As a camera goes on, each view is a little brighter than the one before; far ones tell that none was."""
    ties = [Tie(k, k - 1, -0.008, 0.03) for k in range(1, 100)]
    ties += [Tie(k, k - back, 0.0, 0.05) for back in (8, 16) for k in range(back, 100)]
    assert_allclose(followed(ties, 100), 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_constant_exposure_is_told_from_what_views_differ_by(seed: int) -> None:
    errors = np.random.default_rng(seed).normal(0.0, 0.01, 80)
    assert_allclose(followed(ties_of(np.zeros(80), errors), 80), 0.0, atol=1e-9)


@pytest.mark.parametrize("step", [0.05, -0.05, 0.2])
@pytest.mark.parametrize("seed", range(3))
def test_a_single_step_is_found_among_what_views_differ_by(seed: int, step: float) -> None:
    truth = np.where(np.arange(80) < 40, 0.0, step)
    errors = np.random.default_rng(seed).normal(0.0, 0.01, 80)
    found = followed(ties_of(truth, errors), 80)
    assert_allclose(found, truth, atol=0.02)
    assert len(np.unique(found.round(9))) <= 3


def test_a_ramp_between_two_holds_is_followed() -> None:
    truth = np.interp(np.arange(80), [30, 50], [0.0, -0.4])
    errors = np.random.default_rng(0).normal(0.0, 0.005, 80)
    found = followed(ties_of(truth, errors), 80)
    assert_allclose(found, truth, atol=0.02)
    assert len(np.unique(found.round(9))) < 40  # before and after it holds


def test_a_wrong_tie_does_not_count() -> None:
    truth = np.where(np.arange(30) < 15, 0.0, 0.25)
    ties = [Tie(k, k - back, float(truth[k] - truth[k - back]), 0.03) for back in (1, 2, 4) for k in range(back, 30)]
    assert_allclose(followed([*ties, Tie(29, 3, -1.0, 0.03)], 30), truth, atol=0.01)


def test_a_keyframe_that_shares_nothing_has_the_gain_of_tracking(source: SyntheticSource) -> None:
    keyframes, exposures = Keyframes(source.camera, SensorNoise(0.0015)), KeyframeExposures(source.camera)
    the_other_way = np.diag([-1.0, 1.0, -1.0, 1.0])
    for each in (keyframe(source, 20, 1.0), keyframe(source, 20, 0.7, the_other_way)):
        keyframes.add(each)
        each.expose(Exposure(1.0 if len(keyframes) == 1 else 1.4))
        exposures.add(keyframes)
    assert keyframes[1].exposure.gain == pytest.approx(1.4, rel=0.02)


def test_gains_before_the_window_stay() -> None:
    before = np.array([0.0, 0.0, 0.1, 0.0, 0.0, -0.2])
    ties = [Tie(k, k - 1, 0.2, 0.03) for k in range(6, 10)] + [Tie(9, 2, 0.5, 0.03), Tie(8, 2, 0.3, 0.03)]
    course = Course(np.array([0.0, 0.2, 0.4, 0.6]), np.ones(4, bool))
    assert_allclose(Courses(ties, before).best(course, np.full(4, 0.2)).log_gains, [0.0, 0.2, 0.4, 0.6], atol=0.01)


def test_the_map_ties_a_keyframe_that_nothing_else_does() -> None:
    held = Course(np.zeros(1), np.zeros(1, bool))
    found = Courses([Tie(1, MAP, 0.4, 0.05)], np.array([0.1])).best(held, np.array([0.3]))
    assert_allclose(found.log_gains, 0.4)


def test_white_balance_is_followed_and_nothing_else_is_taken_for_it(source: SyntheticSource) -> None:
    """Two keyframes as they are, three with another balance; alone, steps of the gain leave the balance as it is."""
    tint, white = np.array([0.7, 1.0, 1.35]), np.ones(3)
    for factors in ([white, white, tint, tint, tint], [white, 0.7 * white, 0.7 * white, white, white]):
        keyframes, exposures = Keyframes(source.camera, SensorNoise(0.0015)), KeyframeExposures(source.camera)
        for number, factor in zip(range(0, 40, 8), factors, strict=True):
            keyframes.add(keyframe(source, number, factor))
            exposures.add(keyframes)
        found = np.array([each.exposure.gain * np.array(each.exposure.balance) for each in keyframes])
        assert_allclose(found, 1.0 / np.array(factors), rtol=0.02)
        assert np.allclose([each.exposure.balance for each in keyframes], 1.0) == (factors[2] is not tint)
