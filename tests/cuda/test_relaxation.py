"""Relaxation under the CUDA check."""

from __future__ import annotations

import pytest

from tests.cuda.harness import GRIDS, Devices, assert_close
from tests.cuda.scenarios import relaxation
from tools.cudacheck.environment import Grid

pytestmark = pytest.mark.cuda_check


@pytest.mark.parametrize("grid", GRIDS)
def test_colours_match_the_cpu(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(relaxation.colours, grid)
    assert_close(cuda, cpu, atol=1e-6)
