"""What a tracked frame takes: the levels of the frame and of the model, and the equations between them."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig
from tgslam.config.tracking_settings import ModelSettings, ResidualSettings
from tgslam.device import runtime
from tgslam.geometry import se3_exp
from tgslam.kernels import alignment
from tgslam.ops.rasterize import RenderImages
from tgslam.tracking.linearisation import Lineariser
from tgslam.tracking.pyramid import LivePyramid, ModelPyramid
from tgslam.types import Exposure, Frame

_LOSS = LossConfig()
_MODEL = ModelSettings(min_opacity=0.5, rim_opacity=0.9)


def _view(height: int, width: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Colour and noisy depth of a slanted surface with a step and holes."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    depth_m = 2.0 + 0.01 * u - 0.006 * v + 0.3 * (u > 0.7 * width) + 0.002 * rng.normal(size=(height, width))
    depth_m[rng.random(depth_m.shape) < 0.05] = 0.0
    grey = 0.5 + 0.2 * np.sin(0.5 * u + 0.3) * np.cos(0.4 * v) + 0.03 * rng.normal(size=(height, width))
    return (grey[..., None] * np.array([1.0, 0.9, 0.8])).astype(np.float32), depth_m.astype(np.float32)


def _saturated(height: int, width: int) -> Frame:
    """A view with a corner that is."""
    colour, depth_m = _view(height, width, seed=0)
    colour[: height // 2, : width // 3] = 1.0
    return Frame(0, 0.0, colour, depth_m)


def _camera(height: int, width: int) -> Camera:
    return Camera(width, height, 0.9 * width, 0.95 * width, 0.5 * width - 0.3, 0.5 * height - 0.8)


def _slanted(camera: Camera) -> np.ndarray:
    """Normal towards the camera that the surface of `_view` has near the middle of the image."""
    normal = np.array([0.005 * camera.fx, -0.003 * camera.fy, -1.0])
    return normal / np.linalg.norm(normal)


def _rendering(height: int, width: int) -> RenderImages:
    """Of a map that covers the right third of the image in part only."""
    colour, depth_m = _view(height, width, seed=1)
    least = np.where(np.arange(width) < 2 * width // 3, 0.92, 0.45)
    opacity = np.random.default_rng(2).uniform(least, 1.0, depth_m.shape)
    arrays = (colour, depth_m * opacity, opacity, np.zeros_like(colour))
    return RenderImages(*(runtime.to_device(array) for array in arrays))


@scenario
def levels(height: int = 37, width: int = 50, first: int = 1) -> dict[str, np.ndarray]:
    """Everything that alignment reads, at two resolutions."""
    camera = _camera(height, width)
    live = LivePyramid(camera, first, 2, _LOSS).update(_saturated(height, width))
    planes_c = np.array([[*facing, 1.95] for facing in (_slanted(camera), -np.eye(3)[2])])
    model = ModelPyramid(camera, first, 2, _LOSS.noise, _MODEL).update(_rendering(height, width), planes_c)
    result = {}
    for k in range(2):
        result[f"gate_{k}"] = np.array([live[k].gate_low, live[k].gate_inverse_range])
        result[f"pixels_{k}"] = runtime.to_host(live[k].pixels)
        result[f"surface_{k}"] = runtime.to_host(model[k].surface)
        result[f"texture_{k}"] = runtime.to_host(model[k].texture)[..., : alignment.GYY + 1]
    return result


@scenario
def normal_equations(height: int = 37, width: int = 50) -> dict[str, np.ndarray]:
    """The equations at a pose and an exposure off the true ones."""
    camera = _camera(height, width)
    (live,) = LivePyramid(camera, 0, 1, _LOSS).update(_saturated(height, width))
    (model,) = ModelPyramid(camera, 0, 1, _LOSS.noise, _MODEL).update(_rendering(height, width))
    T_ml = se3_exp([0.02, -0.03, 0.015, 0.02, -0.015, 0.03])
    found = Lineariser(camera, ResidualSettings(), _LOSS)(live, model, T_ml, Exposure(1.1, -0.04))
    intensity = found.intensity
    return {
        "A": found.A,
        "b": found.b,
        "counts": np.array([found.live_pixels, found.candidates, found.matched, found.inliers]),
        "residuals": np.array([found.depth_residual, found.colour_residual]),
        "moments": np.array([intensity.w, intensity.l, intensity.m, intensity.ll, intensity.lm]),
    }
