"""One mapping iteration by stage: a keyframe rendered, compared, differentiated, and the map moved."""

from __future__ import annotations

from typing import Any

import numpy as np

from tgslam.bench.timing import Samples
from tgslam.bench.workloads import Scene
from tgslam.config.map_settings import LossConfig, MappingConfig
from tgslam.device.stopwatch import Stopwatch
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.mapping.refinement import Refiner
from tgslam.types import Exposure, Frame

WARM_UP = 2  # iterations: the first one compiles


def measure(scene: Scene, frame: Frame, repeats: int) -> dict[str, Any]:
    """Refine the scene's Gaussians on the frame that they come from, with the default settings.

    The map moves a little in every iteration, as it does in a run.
    """
    stopwatch = Stopwatch()
    gaussians = GaussianMap.from_gaussians(scene.gaussians)
    refiner = Refiner(gaussians, scene.camera, MappingConfig(), LossConfig(), stopwatch=stopwatch)
    keyframe = Keyframe(frame, np.eye(4), Exposure(), np.eye(6))
    samples = Samples(stopwatch)
    for number in range(WARM_UP + repeats):
        if number == WARM_UP:
            samples.clear()
        samples.take(lambda: refiner.step(keyframe))
    return {
        "scene": scene.name,
        "width": scene.camera.width,
        "height": scene.camera.height,
        "gaussians": gaussians.count,
        "pairs": refiner.rasterizer.pair_count,
        **samples.report(),
    }
