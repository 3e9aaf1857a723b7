"""Image operations: luminance, pyramids, gradients, the texture gate, normals, flying pixels."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.ops import depth
from tgslam.ops import image as images
from tgslam.ops.normals import normals_of

_NOISE = SensorNoise(0.0015)


def _rgbd(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A textured scene of two noisy surfaces with holes."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:height, :width]
    depth_m = np.where(u + v > 0.6 * (height + width), 2.0 + 0.01 * u, 1.0 + 0.005 * v)
    depth_m = depth_m * (1.0 + 0.002 * rng.normal(size=depth_m.shape))
    depth_m[rng.random(depth_m.shape) < 0.1] = 0.0
    return rng.random((height, width, 3)), depth_m


def _on_host(**arrays: np.ndarray) -> dict[str, np.ndarray]:
    return {name: runtime.to_host(array) for name, array in arrays.items()}


@scenario
def colour(height: int = 37, width: int = 50) -> dict[str, np.ndarray]:
    """All that is made of a colour image; the size is no multiple of anything."""
    rgb = runtime.to_device(_rgbd(height, width)[0])
    grey = images.luminance(rgb)
    return _on_host(
        grey=grey,
        half_grey=images.halve(grey),
        half_colour=images.halve(rgb),
        magnitude=images.sobel_magnitude(grey),
        gate=images.texture_gate(grey),
    )


@scenario
def geometry(height: int = 37, width: int = 50) -> dict[str, np.ndarray]:
    """All that is made of a depth image."""
    depth_m = runtime.to_device(_rgbd(height, width)[1])
    camera = Camera(width, height, 45.0, 48.0, 24.3, 18.9)
    return _on_host(
        half=images.halve_depth(depth_m),
        supported=depth.without_flying_pixels(depth_m, _NOISE, camera.fx),
        normals=normals_of(depth_m, camera, _NOISE),
    )
