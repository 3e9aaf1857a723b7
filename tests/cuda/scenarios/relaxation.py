"""Relaxation of colours."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.device import runtime
from tgslam.kernels import relaxation
from tgslam.kernels.objective import TOTALS


@scenario
def colours(count: int = 300) -> dict[str, np.ndarray]:
    """One step for gradients of both signs; a third of the rows is hidden."""
    rng = np.random.default_rng(0)
    gradient = 10.0 ** rng.uniform(-2, 3, (count, 1)) * rng.normal(size=(count, 3))
    colour = runtime.to_device(rng.random((count, 3)))
    relaxation.relax(
        count, runtime.to_device(rng.integers(0, 3, count), np.int32), runtime.to_device(gradient),
        runtime.to_device(10.0 ** rng.uniform(-1, 3, (count, 2))), runtime.to_device(np.full(TOTALS, 300.0)),
        0.7, 600.0, colour,
    )  # fmt: skip
    return {"colour": runtime.to_host(colour)}
