"""What needs the kernels, imported at first use: `--help` and errors in arguments do not wait for it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.schema import Config
from tgslam.device.quick_import import quick_import
from tgslam.evaluation.held_out import Show
from tgslam.pipeline import System
from tgslam.types import Gaussians, Matrix4, Plane, Rendering

Render = Callable[[Gaussians, Matrix4], Rendering]  # the map seen from T_cw


def add_device_option(parser: argparse.ArgumentParser) -> None:
    """`--device`, the same for every command that runs kernels."""
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="where the kernels run (default: auto)"
    )


def start_device(name: str, threads: int = 0) -> str:
    """Start the kernels on device `name` and return the one in use; 0 threads = all cores. Raises DeviceError."""
    with quick_import():
        from tgslam.device.runtime import Device, start

    return start(Device(name), threads).value


def make_system(camera: Camera, config: Config) -> System:
    """The SLAM system for frames of `camera`."""
    with quick_import():
        from tgslam.adaptation import Slam

    return Slam(camera, config)


def make_render(camera: Camera) -> Render:
    """The function that renders a map for `camera`."""
    from tgslam.ops.rasterize import Rasterizer

    return Rasterizer(camera).render


def make_show(camera: Camera, gaussians: Gaussians, planes: Sequence[Plane], config: Config) -> Show:
    """The function that renders the map for `camera` and reads which of the planes it shows, off the same rendering."""
    from tgslam.ops.rasterize import Rasterizer
    from tgslam.ops.splats import FixedSplats
    from tgslam.planes.identity.reading import PlaneReader

    rasterizer, splats = Rasterizer(camera), FixedSplats.of(gaussians)
    reader = PlaneReader(camera, planes, config.structure, config.loss.noise) if planes else None

    def show(T_cw: Matrix4) -> tuple[Rendering, NDArray[np.int32] | None]:
        images = rasterizer.forward(splats, T_cw, with_embedding=reader is not None)
        return images.rendering(), None if reader is None else reader.read(images, T_cw)

    return show
