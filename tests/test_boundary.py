"""What programs may hand over as a frame, and what they are told of anything else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tgslam.boundary import FrameCheck
from tgslam.camera import Camera
from tgslam.errors import FrameError
from tgslam.types import Frame

CAMERA = Camera(16, 12, 14.0, 14.0, 7.5, 5.5)


def frame(**changes: Any) -> Frame:
    rng = np.random.default_rng(0)
    colour = rng.random((*CAMERA.shape, 3)).astype(np.float32)
    depth_m = rng.uniform(0.5, 4.0, CAMERA.shape).astype(np.float32)
    return replace(Frame(5, 2.0, colour, depth_m), **changes)


def test_float_images_pass_as_they_are() -> None:
    given_frame = frame()
    found = FrameCheck(CAMERA)(given_frame)
    assert (found.index, found.timestamp_s, found.depth_scale) == (5, 2.0, 1.0)
    np.testing.assert_array_equal(found.colour, given_frame.colour)
    np.testing.assert_array_equal(found.depth_m, given_frame.depth_m)


@given(st.sampled_from([1000.0, 5000.0, 256.0]))
def test_what_sensors_give_becomes_float(scale: float) -> None:
    exact = frame()
    colour = np.rint(exact.colour * 255).astype(np.uint8)
    raw = np.rint(exact.depth_m * scale).astype(np.uint16)
    found = FrameCheck(CAMERA)(frame(colour=colour, depth_m=raw, depth_scale=scale))
    assert found.colour.dtype == found.depth_m.dtype == np.float32
    np.testing.assert_allclose(found.colour, exact.colour, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.depth_m, exact.depth_m, atol=0.51 / scale)


def test_double_precision_views_and_scaled_floats_are_taken() -> None:
    exact = frame()
    wide = np.repeat(exact.colour.astype(np.float64), 2, axis=1)[:, ::2]
    found = FrameCheck(CAMERA)(frame(colour=wide, depth_m=1000.0 * exact.depth_m, depth_scale=1000.0))
    np.testing.assert_array_equal(found.colour, exact.colour)
    np.testing.assert_allclose(found.depth_m, exact.depth_m, rtol=1e-6)
    assert found.colour.flags.c_contiguous


def test_what_is_no_measurement_is_zero() -> None:
    depth_m = frame().depth_m.copy()
    depth_m[0, :4] = np.nan, np.inf, -1.0, -np.inf
    found = FrameCheck(CAMERA)(frame(depth_m=depth_m)).depth_m
    assert not found[0, :4].any()
    np.testing.assert_array_equal(found[1:], depth_m[1:])
    assert np.isnan(depth_m[0, 0])  # the program's own array stays


WRONG = {
    "8-bit values as float": ({"colour": 255.0 * np.ones((12, 16, 3))}, "divide by 255"),
    "no number": ({"colour": np.full((12, 16, 3), np.nan)}, "colour goes from nan"),
    "grey": (
        {"colour": np.zeros((12, 16), np.uint8)},
        r"colour must be .* shape \[12, 16, 3\], but is \[12, 16\]",
    ),
    "transposed": ({"depth_m": np.ones((16, 12))}, r"depth_m must be an array of shape \[12, 16\], but is \[16, 12\]"),
    "a list": ({"depth_m": [[1.0] * 16] * 12}, "depth_m must be an array .* but is list"),
    "integers": ({"colour": np.zeros((12, 16, 3), np.int32)}, "colour of int32 is not known"),
    "bits": ({"depth_m": np.ones((12, 16), bool)}, "depth_m of bool is not known"),
    "16 bits without scale": ({"depth_m": np.ones((12, 16), np.uint16)}, "needs depth_scale.*1000 for millimetres"),
    "millimetres": ({"depth_m": np.full((12, 16), 1500.0)}, "1,500 m in the median.*depth_scale=1000"),
    "scale of nothing": ({"depth_scale": 0.0}, "depth_scale is 0.0"),
    "no time": ({"timestamp_s": float("nan")}, "its time, nan s, is not after"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_anything_else_is_told_with_the_way_out(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FrameError, match=f"frame 5: .*{message}"):
        FrameCheck(CAMERA)(frame(**changes))


def test_frames_come_in_order_of_time() -> None:
    check = FrameCheck(CAMERA)
    check.accept(check(frame()))
    for timestamp_s in (2.0, 1.9):
        with pytest.raises(FrameError, match=r"its time, .* is not after the last frame's, 2\.0 s"):
            check(frame(timestamp_s=timestamp_s))
    check(frame(timestamp_s=2.1))  # one that was not taken does not count
    check(frame(timestamp_s=2.05))
