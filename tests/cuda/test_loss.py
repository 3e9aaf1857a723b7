"""The objective's CUDA kernels against its CPU kernels and the float64 twin."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import GRIDS, Devices
from tests.cuda.scenarios import loss as scenarios
from tests.reference import loss as reference
from tests.test_loss_kernels import BIAS, CONFIG, GAIN, PARTS, scene
from tools.cudacheck.environment import Grid

pytestmark = [pytest.mark.cuda_check, pytest.mark.parametrize("grid", GRIDS)]

# One with whole warps, one that is no multiple of anything, one narrower than a warp, one smaller than the window
SIZES = [(48, 64), (37, 50), (23, 17), (9, 14)]


@pytest.mark.parametrize("size", SIZES)
def test_gradients_are_those_of_the_cpu(devices: Devices, grid: Grid, size: tuple[int, int]) -> None:
    cpu, cuda = devices.both(scenarios.objective, grid, height=size[0], width=size[1])
    for name, expected in cpu.items():
        scale = np.abs(expected).max()
        assert cuda[name].shape == expected.shape
        # A rounding of depth is 1e-4 of the sensor's standard deviation, and so of a derivative
        np.testing.assert_allclose(cuda[name], expected, rtol=1e-4, atol=5e-5 * scale, err_msg=name)


@pytest.mark.parametrize("masked", [False, True])
def test_values_match_the_twin(devices: Devices, grid: Grid, masked: bool) -> None:
    cuda = devices.cuda(scenarios.objective, grid, masked=masked)
    rendering, (colour, depth, mask) = scene(48, 64, masked=masked)
    observed = {"colour": colour, "depth": depth, "mask": mask, "gate": cuda["gate"].astype(float)}
    expected = reference.parts(*rendering, observed, GAIN, BIAS, CONFIG, scenarios.MIN_OPACITY)
    for part in PARTS:
        assert cuda[part] == pytest.approx(expected[part], rel=1e-4), part
