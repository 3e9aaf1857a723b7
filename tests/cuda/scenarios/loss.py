"""The RGB-D objective and its gradient."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tests.test_loss_kernels import BIAS, CONFIG, GAIN, scene
from tgslam.device import runtime
from tgslam.ops import loss as losses

MIN_OPACITY = 0.4


@scenario
def objective(height: int = 48, width: int = 64, masked: bool = True) -> dict[str, np.ndarray]:
    """Means, sums, derivatives and curvatures; the workspace has been used before, for another image."""
    rendering, observed = scene(height, width, masked=masked)
    other, _ = scene(height, width, seed=9, masked=masked)
    colour_gt, depth_gt, mask = (runtime.to_device(image) for image in observed)
    observation = losses.observe(colour_gt, depth_gt, CONFIG, mask)
    workspace = losses.Workspace(height, width)
    for images in (other, rendering):
        device = [runtime.to_device(image) for image in images]
        result = losses.rgbd_loss(*device, observation, CONFIG, GAIN, BIAS, MIN_OPACITY, workspace)
    arrays = {name: getattr(result, name) for name in ("g_colour", "g_depth", "g_opacity", "w_colour", "w_depth")}
    numbers = {"value": result.value, "g_gain": result.g_gain, "g_bias": result.g_bias, **result.parts}
    return {name: runtime.to_host(array) for name, array in {**arrays, "gate": observation.gate}.items()} | {
        name: np.array(number) for name, number in numbers.items()
    }
