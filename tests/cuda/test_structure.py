"""The instance field and the regularisers of planar Gaussians give under CUDA what they give on the CPU."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import GRIDS, Devices, assert_close
from tests.cuda.scenarios import structure
from tools.cudacheck.environment import Grid

pytestmark = [pytest.mark.cuda_check, pytest.mark.parametrize("grid", GRIDS)]


@pytest.mark.parametrize("size", [(48, 64), (37, 50), (9, 33)])
def test_instance_field(devices: Devices, grid: Grid, size: tuple[int, int]) -> None:
    cpu, cuda = devices.both(structure.field, grid, height=size[0], width=size[1])
    assert (cuda["ids"] != cpu["ids"]).mean() < 2e-3  # rounding, at the margin
    for name in cpu.keys() - {"ids"}:
        expected = cpu[name]
        np.testing.assert_allclose(cuda[name], expected, rtol=1e-4, atol=1e-5 * abs(expected).max(), err_msg=name)


def test_relaxation_of_embeddings(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(structure.relaxed, grid)
    assert_close(cuda, cpu, rtol=1e-4, atol=1e-4)


def test_regularisers(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(structure.regularisers, grid)
    assert cpu["count"] > 50
    for name, expected in cpu.items():
        np.testing.assert_allclose(cuda[name], expected, rtol=1e-4, atol=2e-5 * abs(expected).max(), err_msg=name)
