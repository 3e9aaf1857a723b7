"""The parts of the system that a config may leave out, imported only where they are used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tgslam.camera import Camera
from tgslam.config.schema import SystemConfig

if TYPE_CHECKING:
    from tgslam.graph.closing import GraphClosing
    from tgslam.mapping.plane_observation import PlaneObserver


def plane_observer(camera: Camera, config: SystemConfig) -> PlaneObserver | None:
    """What looks for planes, None = nothing does. Its import takes 0.3 s, for SciPy."""
    if not config.planes.enabled:
        return None
    from tgslam.mapping.plane_observation import PlaneObserver

    return PlaneObserver(camera, config.planes, config.loss.noise)


def graph_closing(camera: Camera, config: SystemConfig) -> GraphClosing | None:
    """The pose graph with its closures, None = nothing would ever close."""
    if not (config.loops.enabled or (config.closures.enabled and config.planes.enabled)):
        return None
    from tgslam.graph.closing import GraphClosing

    return GraphClosing(camera, config.loss.noise, config.closures, config.loops)
