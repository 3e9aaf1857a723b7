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
from tgslam.tracking.brightness import KeyframeExposures, Ratio, Tie, gain_ratio, solve
from tgslam.types import Exposure


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", frames=150, width=160, height=120), seed=0)


def keyframe(source: SyntheticSource, number: int, brightness: float, turn: NDArray | None = None) -> Keyframe:
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


def test_errors_smaller_than_the_systematic_one_do_not_add_up() -> None:
    """As a camera goes on, each view is a little brighter than the one before; far ones tell that none was."""
    ties = [Tie(k, k - 1, -0.008, 0.03) for k in range(1, 100)]
    ties += [Tie(k, k - back, 0.0, 0.05) for back in (8, 16) for k in range(back, 100)]
    chained = -0.008 * np.arange(100)
    assert np.abs(solve(ties, chained, 1)).max() < 0.02


def test_a_wrong_tie_does_not_count() -> None:
    truth = np.where(np.arange(30) < 15, 0.0, 0.25)
    ties = [Tie(k, k - back, float(truth[k] - truth[k - back]), 0.03) for back in (1, 2, 4) for k in range(back, 30)]
    assert_allclose(solve([*ties, Tie(29, 3, -1.0, 0.03)], truth, 1), truth[1:], atol=0.01)


def test_a_keyframe_that_shares_nothing_has_the_gain_of_tracking(source: SyntheticSource) -> None:
    keyframes, exposures = Keyframes(source.camera, SensorNoise(0.0015)), KeyframeExposures(source.camera)
    the_other_way = np.diag([-1.0, 1.0, -1.0, 1.0])
    for each in (keyframe(source, 20, 1.0), keyframe(source, 20, 0.7, the_other_way)):
        keyframes.add(each)
        each.expose(Exposure(1.0 if len(keyframes) == 1 else 1.4))
        exposures.add(keyframes)
    assert keyframes[1].exposure.gain == pytest.approx(1.4, rel=0.02)


def test_gains_before_the_window_stay() -> None:
    ties = [Tie(k, k - 1, 0.2, 0.03) for k in range(6, 10)] + [Tie(9, 2, 0.5, 0.03), Tie(8, 2, 0.3, 0.03)]
    before = np.array([0.0, 0.0, 0.1, 0.0, 0.0, -0.2, 0.0, 0.2, 0.4, 0.6])
    assert_allclose(solve(ties, before, 6), before[6:], atol=0.01)
