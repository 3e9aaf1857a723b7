"""What the benchmarks draw: one RGB-D frame, a Gaussian for each of its pixels or for every second one in each axis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource, synthetic_camera
from tgslam.datasets.image_files import read_colour, read_raw_depth
from tgslam.device import runtime
from tgslam.errors import FrameError
from tgslam.ops.rasterize import ImageGradient
from tgslam.pixels import colour_as_float
from tgslam.types import Frame, Gaussians

FRAME_STRIDE = 2  # px between the Gaussians of a frame from files
OPACITY = 0.7
STD_PER_SPACING = 0.7  # standard deviation of a Gaussian by the distance to its neighbour: alike at every density
_SEED = 0


@dataclass(frozen=True)
class Scene:
    """Gaussians in the camera's own frame, to be seen from the identity."""

    name: str
    camera: Camera
    gaussians: Gaussians

    def seen_by(self, camera: Camera) -> Scene:
        """The same Gaussians in another camera."""
        return replace(self, camera=camera)

    def with_area(self, factor: float) -> Scene:
        """The same Gaussians with so many times the area each."""
        log_scale = self.gaussians.log_scale + np.float32(0.5 * np.log(factor))
        return replace(self, gaussians=replace(self.gaussians, log_scale=log_scale))


def enlarged(camera: Camera, pixels: float) -> Camera:
    """The camera with that many times the pixels and the same field of view: (u + 1/2) / width stays."""
    width, height = round(camera.width * pixels**0.5), round(camera.height * pixels**0.5)
    sx, sy = width / camera.width, height / camera.height
    return Camera(
        width, height, sx * camera.fx, sy * camera.fy, sx * (camera.cx + 0.5) - 0.5, sy * (camera.cy + 0.5) - 0.5
    )


def room_frame(width: int, height: int) -> tuple[Camera, Frame]:
    """The first view of the built-in room, without noise: every pixel has depth."""
    source = SyntheticSource(SyntheticConfig(scene="room", width=width, height=height), seed=_SEED)
    return source.camera, source.clean(0)


def room_scene(width: int, height: int, count: int) -> Scene:
    """About `count` Gaussians, one a pixel of the room drawn at that many pixels; seen at width x height."""
    columns = round((count * width / height) ** 0.5)
    sampled, frame = room_frame(columns, round(count / columns))
    return Scene("room", synthetic_camera(width, height), back_projected(frame, sampled, stride=1))


def frame_scene(camera: Camera, frame: Frame) -> Scene:
    """A frame from files at its own size, every second pixel in each axis."""
    return Scene("frame", camera, back_projected(frame, camera, FRAME_STRIDE))


def read_frame(colour: Path, depth: Path, intrinsics: tuple[float, ...], depth_scale: float) -> tuple[Camera, Frame]:
    """A frame from a colour image and a 16-bit depth image. intrinsics: fx, fy, cx, cy in px.

    Raises FrameError for files that are no such images or do not fit each other.
    """
    rgb, raw = colour_as_float(read_colour(colour)), read_raw_depth(depth)
    if rgb.shape[:2] != raw.shape:
        raise FrameError(f"{depth}: is {_size(raw)}, but {colour} is {_size(rgb)}")
    if not raw.any():
        raise FrameError(f"{depth}: no pixel has depth")
    height, width = raw.shape
    return Camera(width, height, *intrinsics), Frame(0, 0.0, rgb, (raw / depth_scale).astype(np.float32))


def back_projected(frame: Frame, camera: Camera, stride: int) -> Gaussians:
    """A round Gaussian at every `stride`-th pixel with depth, as wide as the spacing asks for."""
    v, u = (axis.ravel() for axis in np.mgrid[0 : camera.height : stride, 0 : camera.width : stride])
    measured = frame.depth_m[v, u] > 0
    v, u = v[measured], u[measured]
    z = frame.depth_m[v, u]
    std_m = STD_PER_SPACING * stride * z / np.float32(camera.fx)
    n = len(z)
    return Gaussians(
        mean=camera.points_at(u, v, z).astype(np.float32),
        log_scale=np.repeat(np.log(std_m)[:, None], 3, 1).astype(np.float32),
        quat_wxyz=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (n, 1)),
        opacity_logit=np.full(n, np.log(OPACITY / (1.0 - OPACITY)), np.float32),
        colour=frame.colour[v, u],
        embedding=np.zeros((n, 3), np.float32),
        plane_id=np.full(n, -1, np.int32),
        birth_keyframe=np.zeros(n, np.int32),
    )


def image_gradient(camera: Camera) -> ImageGradient:
    """Fixed random numbers for dL/dcolour and dL/ddepth, so that no pair is without work; none for opacity."""
    g: NDArray[np.float32] = np.random.default_rng(_SEED).normal(size=(*camera.shape, 4)).astype(np.float32)
    return ImageGradient(runtime.to_device(g[..., :3]), runtime.to_device(g[..., 3]), runtime.zeros(camera.shape))


def _size(image: NDArray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
