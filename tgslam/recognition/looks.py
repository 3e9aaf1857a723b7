"""What is kept of the keyframes to recognise them by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.graph_settings import LoopConfig
from tgslam.device import runtime
from tgslam.recognition.depth_agreement import DepthGrid
from tgslam.recognition.features import Detector
from tgslam.recognition.retrieval import Retrieval
from tgslam.recognition.verification import Look, Verification
from tgslam.types import FloatImage


class Looks:
    """The looks of all keyframes by number, and how new ones are made and compared."""

    def __init__(self, camera: Camera, noise: SensorNoise, config: LoopConfig) -> None:
        self._camera = camera
        self._detector = Detector(config.features, config.expert.matching.corner_contrast)
        self._retrieval = Retrieval()
        self._all: list[Look] = []
        self.verification = Verification(camera, noise, config)

    def __len__(self) -> int:
        return len(self._all)

    def __getitem__(self, number: int) -> Look:
        return self._all[number]

    def of(self, colour: FloatImage, depth_m: FloatImage) -> Look:
        """Of an image, on the host or on the device: colour [H, W, 3] in [0, 1], depth [H, W] m, 0 = none."""
        colour, depth_m = runtime.to_host(colour), runtime.to_host(depth_m)
        return Look(self._detector.detect(colour, depth_m), DepthGrid.of(depth_m, self._camera))

    def add(self, look: Look) -> None:
        """Of the next keyframe."""
        self._retrieval.add(self._retrieval.words(look.features.descriptors))
        self._all.append(look)

    def scores(self, look: Look) -> NDArray[np.float64]:
        """[K] how much each keyframe resembles it."""
        return self._retrieval.scores(self._retrieval.words(look.features.descriptors))
