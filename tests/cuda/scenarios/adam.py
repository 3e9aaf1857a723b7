"""Adam over rows."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.device import runtime
from tgslam.ops.adam import Adam


@scenario
def steps(rows: int = 300, steps: int = 3) -> dict[str, np.ndarray]:
    """Some steps of a group of vectors and one of scalars; a third of the rows is hidden, another one each time."""
    rng = np.random.default_rng(0)
    optimiser = Adam({"mean": 3, "logit": 0}, {"mean": 0.01, "logit": 0.1})
    moments, counts = runtime.zeros((rows, optimiser.moment_width)), runtime.zeros((rows,), np.int32)
    parameters = {
        "mean": runtime.to_device(rng.normal(size=(rows, 3))),
        "logit": runtime.to_device(rng.normal(size=rows)),
    }
    for _ in range(steps):
        gradients = {name: runtime.to_device(rng.normal(size=array.shape)) for name, array in parameters.items()}
        visible = runtime.to_device(rng.integers(0, 3, rows), np.int32)
        optimiser.step(rows, parameters, gradients, moments, counts, visible)
    by_name = {f"{name}_{k}": m for name in parameters for k, m in enumerate(optimiser.moments_of(name, moments))}
    return {name: runtime.to_host(array) for name, array in parameters.items()} | {
        "steps": runtime.to_host(counts),
        **by_name,
    }
