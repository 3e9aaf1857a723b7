"""Brightness of a keyframe relative to the one before it, on scenes whose exposure is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse
from tgslam.map.keyframe import Keyframe
from tgslam.mapping.brightness import relative_gain
from tgslam.types import Exposure


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", frames=150, width=160, height=120), seed=0)


def keyframe(source: SyntheticSource, index: int, brightness: float = 1.0) -> Keyframe:
    frame = source.read(index)
    frame = replace(frame, colour=np.clip(brightness * frame.colour, 0.0, 1.0).astype(np.float32))
    return Keyframe.from_frame(frame, inverse(source.pose(index)), Exposure(), np.eye(6))


@pytest.mark.parametrize("brightness", [0.7, 1.0, 1.2])
@pytest.mark.parametrize("index", [10, 100])
def test_the_gain_undoes_a_change_of_exposure(source: SyntheticSource, index: int, brightness: float) -> None:
    gain = relative_gain(keyframe(source, index + 8, brightness), keyframe(source, index), source.camera)
    assert gain == pytest.approx(1.0 / brightness, rel=0.01)


def test_the_way_back_is_the_inverse(source: SyntheticSource) -> None:
    one, other = keyframe(source, 20), keyframe(source, 28, 0.8)
    there, back = relative_gain(one, other, source.camera), relative_gain(other, one, source.camera)
    assert there is not None
    assert back == pytest.approx(1.0 / there, rel=0.01)


def test_views_that_share_no_surface_say_nothing(source: SyntheticSource) -> None:
    one, other = keyframe(source, 20), keyframe(source, 20)
    other.T_cw = np.diag([-1.0, 1.0, -1.0, 1.0]) @ one.T_cw  # looks the other way
    assert relative_gain(other, one, source.camera) is None
    assert relative_gain(keyframe(source, 20, 10.0), one, source.camera) is None  # all is overexposed
