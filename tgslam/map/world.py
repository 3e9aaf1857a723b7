"""The state of the world in one place: keyframes, Gaussians and planes. All else are verbs over it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tgslam.camera import Camera, SensorNoise
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframes
from tgslam.map.pieces import Pieces
from tgslam.recognition.looks import Looks
from tgslam.types import Matrix4, Plane

if TYPE_CHECKING:
    from tgslam.config.graph_settings import LoopConfig
    from tgslam.config.plane_settings import PlanesConfig
    from tgslam.planes.instances.instance import PlanarInstance
    from tgslam.planes.instances.registry import PlaneRegistry


class Map:
    """Owns what is known of the world. The first keyframe's camera is the world frame."""

    def __init__(
        self, camera: Camera, noise: SensorNoise, loops: LoopConfig, planes: PlanesConfig | None = None
    ) -> None:
        """loops: how places are recognised. planes: how persistent planes are kept; None, or not enabled = the map
        knows nothing of planes.
        """
        self.camera, self.noise = camera, noise
        self.keyframes, self.looks = Keyframes(camera, noise), Looks(camera, noise, loops)
        self.gaussians, self.pieces = GaussianMap(), Pieces()
        self.planes = _registry(planes, noise, self.keyframes.T_wc) if planes and planes.enabled else None

    def move(self, motions: Mapping[int, Matrix4], *, carry: bool = True) -> None:
        """Keyframes have moved in the world, p_w <- motions[number] p_w, [4, 4] each; the others stay.

        Their planes go with them and, but where refinement has moved those already (carry = False), their Gaussians.
        """
        self.keyframes.move(motions)
        if carry:
            every = np.tile(np.eye(4), (len(self.keyframes), 1, 1))
            for number, motion in motions.items():
                every[number] = motion
            self.gaussians.move(every)
        if self.planes:
            self.planes.follow(motions)

    def gather(self) -> None:
        """Pieces that nothing ties to the first one go where the camera was led, which is the best that is known."""
        motions = self.pieces.led(self.keyframes.T_wc)
        if motions:
            self.move(motions)

    def planes_seen_from(self, number: int) -> list[PlanarInstance]:
        """The persistent planes that a keyframe saw."""
        if not self.planes:
            return []
        instances = self.planes.instances
        return [instances[plane_id] for plane_id in self.planes.seen_from(number)]

    def exported_planes(self) -> tuple[Plane, ...]:
        """The persistent planes by id, as plain data."""
        if not self.planes:
            return ()
        from tgslam.planes.instances.export import planes_of  # here, as in `_registry`

        return planes_of(self.planes)


def _registry(config: PlanesConfig, noise: SensorNoise, T_wc: Mapping[int, Matrix4]) -> PlaneRegistry:
    """Imported only where planes are looked for: what it needs of SciPy takes 0.3 s to load."""
    from tgslam.planes.instances.registry import PlaneRegistry

    return PlaneRegistry(config, noise, T_wc)
