"""Registration of depth to colour as CUDA kernels, in the least favourable order of threads."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import GRIDS, Devices
from tests.cuda.scenarios import registered


@pytest.mark.cuda_check
def test_the_nearest_wins_in_any_order(devices: Devices) -> None:
    cpu, cuda = devices.both(registered.depth, GRIDS[-1].values[0])
    assert (cpu["depth_m"] > 0).mean() > 0.5
    assert (np.abs(cuda["depth_m"] - cpu["depth_m"]) > 1e-4).mean() < 2e-3  # a pixel may be on the other side of a rim
