"""The steps of mapping in the order of `Slam`, without tracking: keyframes come with their poses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.graph_settings import LoopConfig
from tgslam.config.map_settings import LossConfig, MappingConfig, SeedingConfig
from tgslam.config.plane_settings import PlanesConfig, StructureConfig
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframe, Keyframes
from tgslam.map.world import Map
from tgslam.mapping.growth import Growth
from tgslam.mapping.plane_observation import PlaneObserver
from tgslam.mapping.window import WindowRefinement
from tgslam.types import Exposure, Frame, Matrix4


class Mapper:
    """A map and what makes it grow."""

    def __init__(
        self,
        camera: Camera,
        mapping: MappingConfig | None = None,
        planes: PlanesConfig | None = None,
        structure: StructureConfig | None = None,
        *,
        loss: LossConfig | None = None,
        seeding: SeedingConfig | None = None,
    ) -> None:
        mapping, loss, seeding = mapping or MappingConfig(), loss or LossConfig(), seeding or SeedingConfig()
        rng = np.random.default_rng(0)
        self.camera, self.map = camera, Map(camera, loss.noise, LoopConfig(), planes)
        structure = structure if self.map.planes else None
        self._planes = PlaneObserver(camera, planes, loss.noise) if planes and self.map.planes else None
        self.refinement = WindowRefinement(self.map, camera, mapping, loss, rng, structure)
        self.growth = Growth(camera, mapping, seeding, loss.noise, rng.spawn(1)[0], structure)

    @property
    def gaussians(self) -> GaussianMap:
        return self.map.gaussians

    @property
    def keyframes(self) -> Keyframes:
        return self.map.keyframes

    def known(self, column: str) -> NDArray[Any]:
        """What the map knows of each Gaussian."""
        return self.map.gaussians.host(column).copy()

    def add(self, frame: Frame, T_cw: Matrix4, exposure: Exposure | None = None) -> None:
        self.map.keyframes.add(Keyframe(frame, T_cw, exposure or Exposure(), np.eye(6)))
        surface, _ = self.growth.weigh(self.map)
        planes = self._planes.observe(self.map) if self._planes else None
        self.growth.grow(self.map, surface, planes)
        if self._planes and planes:
            self._planes.label(self.map, planes)
        self.refinement.refine()

    def follow(self, motions: Mapping[int, Matrix4]) -> None:
        self.map.move(motions)
        self.refinement.settle(motions, ())

    def finish(self) -> None:
        if self._planes:
            self._planes.complete(self.map)
        self.refinement.finish()
