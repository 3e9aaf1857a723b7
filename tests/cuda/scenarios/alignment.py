"""Normal equations of RGB-D alignment."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np

from tests.cuda.harness import scenario
from tests.reference.alignment import Settings
from tgslam import images, runtime
from tgslam.geometry import se3_exp
from tgslam.kernels import alignment


def _view(rng: np.random.Generator, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Noisy depth of a slanted surface with a step and holes, and luminance."""
    v, u = np.mgrid[:height, :width]
    depth_m = 2.0 + 0.01 * u - 0.006 * v + 0.3 * (u > 0.7 * width) + 0.004 * rng.normal(size=(height, width))
    depth_m[rng.random(depth_m.shape) < 0.15] = 0.0
    grey = 0.5 + 0.2 * np.sin(0.5 * u + 0.3) * np.cos(0.4 * v) + 0.03 * rng.normal(size=(height, width))
    return runtime.to_device(depth_m), runtime.to_device(grey)


@scenario
def normal_equations(height: int = 23, width: int = 37) -> dict[str, np.ndarray]:
    """The sums of all rows of partial sums: how they are split may differ between devices."""
    rng = np.random.default_rng(0)
    (live_depth, live_grey), (model_depth, model_grey) = _view(rng, height, width), _view(rng, height, width)
    normal = np.array([0.3, -0.2, -1.0]) + 0.2 * rng.normal(size=(height, width, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[rng.random((height, width)) < 0.15] = 0.0
    gate = np.where(rng.random((height, width)) < 0.3, 1.0, rng.random((height, width)))
    gx, gy = images.sobel(model_grey)
    gxx, gxy = images.sobel(gx)
    _, gyy = images.sobel(gy)
    settings = Settings(43.0, 45.0, 18.2, 10.7, gain=1.1, bias=-0.04, gate_depth_boost=1.5)
    pose = se3_exp([0.02, -0.03, 0.015, 0.02, -0.015, 0.03])[:3].reshape(12)
    partial = runtime.empty((height * alignment.SPLIT, alignment.PARTIAL))
    alignment.normal_equations(
        runtime.to_device(astuple(settings)), runtime.to_device(pose),
        live_depth, live_grey, *images.sobel(live_grey), runtime.to_device(gate),
        model_depth, runtime.to_device(normal), model_grey, gx, gy, gxx, gxy, gyy, partial,
    )  # fmt: skip
    return {"sums": runtime.to_host(partial).sum(0, dtype=np.float64)}
