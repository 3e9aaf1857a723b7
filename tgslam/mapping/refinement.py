"""Refining the map and keyframe poses under the RGB-depth objective (Eqs. 12-14), one view at a time."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from tgslam import losses, runtime
from tgslam.config.schema import LossConfig, MappingConfig
from tgslam.gaussian_map import GaussianMap, MapGradient
from tgslam.geometry import orthonormalized, se3_exp
from tgslam.kernels import relaxation
from tgslam.mapping.keyframe import Keyframe
from tgslam.optim import Adam
from tgslam.render import ImageGradient, Rasterizer
from tgslam.types import Camera
from tgslam.vector_adam import VectorAdam

_GEOMETRY = {"mean": 3, "log_scale": 3, "quat_wxyz": 4, "opacity_logit": 0}


class Refiner:
    """One view at a time: render, compare, step. Colours relax, the rest moves by Adam."""

    def __init__(self, camera: Camera, config: MappingConfig, loss: LossConfig) -> None:
        self.config, self.loss = config, loss
        self.rasterizer = Rasterizer(camera)
        channels, rates = (
            dict(_GEOMETRY),
            {
                "mean": config.rate_mean_px / camera.fx,
                "log_scale": config.rate_scale,
                "quat_wxyz": config.rate_rotation,
                "opacity_logit": config.rate_opacity,
            },
        )
        if config.optimizer == "adam":
            channels["colour"], rates["colour"] = 3, config.rate_colour
        self.adam = Adam(channels, rates)
        self.contribution: NDArray[np.float32] = np.zeros(0, np.float32)  # [N] px, since birth the most of any view
        self.views: NDArray[np.int32] = np.zeros(0, np.int32)  # [N] views rendered with the Gaussian in sight
        self._gradient = MapGradient.zeros(1)
        self._workspace = losses.Workspace(camera.height, camera.width)
        self._observations: OrderedDict[int, losses.Observation] = OrderedDict()
        self._pose_steps: dict[int, VectorAdam] = {}

    def append(self, rows: int) -> None:
        """The map has grown by that many rows."""
        self.adam.append(rows)
        self.contribution = np.concatenate([self.contribution, np.zeros(rows, np.float32)])
        self.views = np.concatenate([self.views, np.zeros(rows, np.int32)])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """The map has lost the rows where the mask [N] is false."""
        self.adam.keep(mask)
        self.contribution, self.views = self.contribution[mask], self.views[mask]

    def step(self, gaussians: GaussianMap, keyframe: Keyframe, *, move_pose: bool) -> float:
        """Render the map at the keyframe, and move the map (and the keyframe's pose) downhill. Returns the loss."""
        observation = self._observation(keyframe)
        gain, bias = 1.0 / keyframe.exposure.gain, -keyframe.exposure.bias / keyframe.exposure.gain
        rendered = self.rasterizer.forward(gaussians, keyframe.T_cw)
        result = losses.rgbd_loss(
            rendered.colour, rendered.depth, rendered.opacity, observation, self.loss, gain, bias,
            workspace=self._workspace,
        )  # fmt: skip
        scale_colour = self.loss.weight_pho * self.loss.weight_l1 / (3.0 * max(result.parts["pixels"], 1.0))
        if self._gradient.mean.shape[0] != gaussians.capacity:
            self._gradient = MapGradient.zeros(gaussians.capacity)
        else:
            self._gradient.clear()
        g = ImageGradient(
            result.g_colour, result.g_depth, result.g_opacity,
            colour_weight=result.w_colour, depth_weight=result.w_depth,
        )  # fmt: skip
        g_pose = self.rasterizer.backward(gaussians, g, self._gradient)
        self._update_map(gaussians, scale_colour)
        if move_pose:
            adam = self._pose_steps.setdefault(keyframe.index, VectorAdam([self.config.rate_pose] * 6))
            keyframe.T_cw = orthonormalized(se3_exp(adam.step(g_pose)) @ keyframe.T_cw)
        return result.value

    def _update_map(self, gaussians: GaussianMap, scale_colour: float) -> None:
        n, gradient = gaussians.count, self._gradient
        names = list(self.adam.learning_rates)
        self.adam.step(
            {name: getattr(gaussians, name) for name in names},
            {name: getattr(gradient, name) for name in names},
            self.rasterizer.tile_count,
        )
        if self.config.optimizer == "relaxation":
            relaxation.relax(
                n, self.rasterizer.tile_count, gradient.colour, gradient.curvature, self.config.relaxation,
                scale_colour / self.loss.charbonnier_colour, gaussians.colour,
            )  # fmt: skip
        weight_px = runtime.to_host(gradient.curvature)[:n, 0] * (self.loss.charbonnier_colour / scale_colour)
        self.contribution = np.maximum(self.contribution, weight_px)
        self.views += self.rasterizer.visible(n)

    def _observation(self, keyframe: Keyframe) -> losses.Observation:
        """The keyframe's side of the loss; the most recently used are kept."""
        cached = self._observations.pop(keyframe.index, None)
        if cached is None:
            colour, depth_m = runtime.to_device(keyframe.colour()), runtime.to_device(keyframe.depth_m())
            cached = losses.observe(colour, depth_m, self.loss)
        self._observations[keyframe.index] = cached
        while len(self._observations) > self.config.window + self.config.window_random:
            self._observations.popitem(last=False)
        return cached
