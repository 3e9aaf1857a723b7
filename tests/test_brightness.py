"""Brightness of a keyframe relative to the one before it, on scenes whose exposure is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tgslam.camera import SensorNoise
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse
from tgslam.map.keyframes import Keyframe, Keyframes
from tgslam.tracking.brightness import relative_gain
from tgslam.types import Exposure


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", frames=150, width=160, height=120), seed=0)


def gain_between(
    source: SyntheticSource,
    index: int,
    previous: int,
    brightness: tuple[float, float] = (1.0, 1.0),
    turn: NDArray | None = None,
) -> float | None:
    """Of the first frame relative to the other one. turn: [4, 4] of its camera, which its images know nothing of."""
    keyframes = Keyframes(source.camera, SensorNoise(0.0015))
    for number, factor in zip((previous, index), brightness[::-1], strict=True):
        frame = source.read(number)
        frame = replace(frame, colour=np.clip(factor * frame.colour, 0.0, 1.0).astype(np.float32))
        keyframes.add(Keyframe(frame, inverse(source.pose(number)), Exposure(), np.eye(6)))
    T_pk = keyframes[0].T_cw @ inverse((np.eye(4) if turn is None else turn) @ keyframes[1].T_cw)
    return relative_gain(keyframes[1], keyframes[0], T_pk, source.camera)


@pytest.mark.parametrize("brightness", [0.7, 1.0, 1.2])
@pytest.mark.parametrize("index", [10, 100])
def test_the_gain_undoes_a_change_of_exposure(source: SyntheticSource, index: int, brightness: float) -> None:
    gain = gain_between(source, index + 8, index, (brightness, 1.0))
    assert gain == pytest.approx(1.0 / brightness, rel=0.01)


def test_the_way_back_is_the_inverse(source: SyntheticSource) -> None:
    there, back = gain_between(source, 20, 28, (1.0, 0.8)), gain_between(source, 28, 20, (0.8, 1.0))
    assert there is not None
    assert back == pytest.approx(1.0 / there, rel=0.01)


def test_views_that_share_no_surface_say_nothing(source: SyntheticSource) -> None:
    the_other_way = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert gain_between(source, 20, 20, turn=the_other_way) is None
    assert gain_between(source, 20, 20, (10.0, 1.0)) is None  # all is overexposed
