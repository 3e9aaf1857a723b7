"""Iterations of mapping give under CUDA what they give on the CPU."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import Devices
from tests.cuda.scenarios import refinement
from tgslam.map.gaussians import PARAMETERS
from tools.cudacheck.environment import Grid

pytestmark = pytest.mark.cuda_check


@pytest.mark.parametrize(
    "grid", [grid if grid is Grid.DEFAULT else pytest.param(grid, marks=pytest.mark.long) for grid in Grid]
)
def test_the_map_and_the_pose_move_alike(devices: Devices, grid: Grid) -> None:
    """With planes: then the kernels of the others take part as well."""
    _compare(devices, grid, "relaxation", planes=True)


@pytest.mark.parametrize("optimizer", ["relaxation", "adam"])
def test_they_do_without_planes(devices: Devices, optimizer: str) -> None:
    _compare(devices, Grid.DEFAULT, optimizer, planes=False)


def _compare(devices: Devices, grid: Grid, optimizer: str, *, planes: bool) -> None:
    cpu, cuda = devices.both(refinement.steps, grid, optimizer=optimizer, planes=planes)
    np.testing.assert_array_equal(cuda["views"], cpu["views"])
    assert 0.5 < (cpu["views"] == 3).mean() < 0.95
    np.testing.assert_allclose(cuda["values"], cpu["values"], rtol=1e-4)
    assert cpu["values"][-1] < 0.97 * cpu["values"][0]
    np.testing.assert_allclose(cuda["pose"], cpu["pose"], atol=2e-6)
    scale = cpu["contribution"].max()
    np.testing.assert_allclose(cuda["contribution"], cpu["contribution"], rtol=1e-3, atol=1e-4 * scale)
    assert cpu["embedding"].any() == planes
    for name in PARAMETERS:
        # Adam's first steps have the rate's length whatever the gradient: where it is about 0, rounding decides
        off = np.abs(cuda[name] - cpu[name]).reshape(len(cpu[name]), -1).max(axis=1)
        assert (off > 2e-4).mean() < 0.01, name
