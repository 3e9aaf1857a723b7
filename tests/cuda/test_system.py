"""A whole run under CUDA finds the trajectory and the map that it finds on the CPU."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import Devices
from tests.cuda.scenarios import system
from tools.cudacheck.environment import Grid

pytestmark = pytest.mark.cuda_check


@pytest.mark.parametrize("grid", [Grid.DEFAULT])
def test_a_short_run(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(system.run, grid)
    assert len(cpu["keyframes"]) >= 2 and len(cpu["T_wc"]) > len(cpu["keyframes"])
    np.testing.assert_array_equal(cuda["keyframes"], cpu["keyframes"])
    np.testing.assert_allclose(cuda["T_wc"], cpu["T_wc"], atol=1e-5)
    assert cuda["mean"].shape == cpu["mean"].shape
    for name in ("mean", "colour"):
        # Adam's first steps have the rate's length whatever the gradient: where that is about 0, rounding decides
        assert np.median(np.abs(cuda[name] - cpu[name])) < 1e-5, name
        np.testing.assert_allclose(cuda[name], cpu[name], atol=0.02, err_msg=name)
