"""A tracked frame's kernels under CUDA give what they give on the CPU."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import GRIDS, Devices, assert_close
from tests.cuda.scenarios import tracking
from tgslam.kernels import alignment
from tools.cudacheck.environment import Grid

pytestmark = [pytest.mark.cuda_check, pytest.mark.parametrize("grid", GRIDS)]


@pytest.mark.parametrize("first", [0, 1])
def test_levels(devices: Devices, grid: Grid, first: int) -> None:
    cpu, cuda = devices.both(tracking.levels, grid, first=first)
    assert 0.2 < (cpu["surface_0"][..., :3] != 0).any(axis=2).mean() < 1.0
    assert all(0.1 < (cpu[f"surface_{k}"][..., alignment.MODEL_DEPTH] < 0).mean() < 0.6 for k in range(2))  # rims
    assert_close(cuda, cpu, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("size", [(37, 50), (9, 40), (3, 40)])
def test_normal_equations(devices: Devices, grid: Grid, size: tuple[int, int]) -> None:
    cpu, cuda = devices.both(tracking.normal_equations, grid, height=size[0], width=size[1])
    scale = np.sqrt(np.diag(cpu["A"])).max()
    np.testing.assert_array_equal(cuda["counts"], cpu["counts"])
    np.testing.assert_allclose(cuda["A"], cpu["A"], atol=1e-5 * scale**2)
    np.testing.assert_allclose(cuda["b"], cpu["b"], atol=1e-5 * scale * np.sqrt(max(cpu["counts"][1], 1)))
    for name in ("residuals", "moments"):
        np.testing.assert_allclose(cuda[name], cpu[name], rtol=1e-5, atol=1e-5, err_msg=name)
    assert (cpu["counts"] > 0).all() == (size[0] > 3)
    assert (cpu["moments"][0] > 0) == (size[0] > 3)  # colour has a say
