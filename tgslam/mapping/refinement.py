"""Refining the map and keyframe poses under the total objective (Eq. 14), one view at a time."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig, MappingConfig
from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.device.stopwatch import Stopwatch, stage
from tgslam.geometry import orthonormalized, se3_exp
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframe import Keyframe
from tgslam.mapping.sightings import Sightings
from tgslam.mapping.structure_terms import StructureTerms
from tgslam.ops import loss as losses
from tgslam.ops import relaxation
from tgslam.ops.adam import Adam
from tgslam.ops.instance_field import InstanceGradient
from tgslam.ops.rasterize import ImageGradient, Rasterizer
from tgslam.ops.splats import MapGradient
from tgslam.ops.vector_adam import VectorAdam
from tgslam.planes.instances.plane_table import PlaneTable

_GEOMETRY = {"mean": 3, "log_scale": 3, "quat_wxyz": 4, "opacity_logit": 0}


class Refiner:
    """One view at a time: render, compare, step. Colours and embeddings relax, the rest moves by Adam."""

    def __init__(
        self,
        camera: Camera,
        config: MappingConfig,
        loss: LossConfig,
        stopwatch: Stopwatch | None = None,
        structure: StructureConfig | None = None,
    ) -> None:
        """stopwatch: takes the seconds of the stages forward, loss, backward and update, for benchmarks.

        structure: of the terms that planes add (`set_planes`, `Keyframe.plane_ids`); None = planes play no part.
        """
        self.config, self.loss, self.stopwatch = config, loss, stopwatch
        self.structure = StructureTerms(camera, structure, config.window + config.anchor_count) if structure else None
        self.rasterizer = Rasterizer(camera)
        self.adam = _optimiser(config, camera)
        self._sightings = Sightings()
        self._gradient = MapGradient.zeros(1)
        self._workspace = losses.Workspace(camera.height, camera.width)
        self._observations: OrderedDict[int, losses.Observation] = OrderedDict()
        self._pose_steps: dict[int, VectorAdam] = {}

    @property
    def contribution(self) -> NDArray[np.float32]:
        """[N] px, since birth the most blend weight of each Gaussian in any view."""
        return self._sightings.contribution

    @property
    def views(self) -> NDArray[np.int32]:
        """[N] views rendered with the Gaussian in sight."""
        return self._sightings.views

    def append(self, rows: int) -> None:
        """The map has grown by that many rows."""
        self.adam.append(rows)
        self._sightings.append(rows)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """The map has lost the rows where the mask [N] is false."""
        self.adam.keep(mask)
        self._sightings.keep(mask)

    def set_planes(self, planes: PlaneTable) -> None:
        """The planes as they are now; without terms of structure they do not matter."""
        if self.structure:
            self.structure.set_planes(planes)

    def step(
        self,
        gaussians: GaussianMap,
        keyframe: Keyframe,
        *,
        move_pose: bool,
        pace: float = 1.0,
        colour_pace: float = 1.0,
    ) -> losses.LossResult:
        """Render the map at the keyframe, and move the map (and the keyframe's pose) downhill.

        pace: what the map's steps are multiplied by, but for those of embeddings.
        colour_pace: and those of colours besides.

        Returns the loss before the step; its numbers can be read until the next step. Only the pose's gradient goes to
        the host by itself.
        """
        observation = self._observation(keyframe)
        target = self.structure.due(keyframe) if self.structure else None
        gain, bias = 1.0 / keyframe.exposure.gain, -keyframe.exposure.bias / keyframe.exposure.gain
        with stage(self.stopwatch, "forward"):
            rendered = self.rasterizer.forward(gaussians, keyframe.T_cw, with_embedding=target is not None)
        with stage(self.stopwatch, "loss"):
            loss = losses.rgbd_loss(
                rendered.colour, rendered.depth, rendered.opacity, observation, self.loss, gain, bias,
                workspace=self._workspace,
            )  # fmt: skip
            pgi = self.structure.pgi(rendered, target, loss.g_opacity) if self.structure and target else None
        with stage(self.stopwatch, "backward"):
            g_pose = self._backward(gaussians, loss, pgi)
        with stage(self.stopwatch, "update"):
            self._update_map(gaussians, loss, pgi, pace, pace * colour_pace)
            if move_pose:
                self._update_pose(keyframe, g_pose)
        return loss

    def _backward(
        self, gaussians: GaussianMap, loss: losses.LossResult, pgi: InstanceGradient | None
    ) -> NDArray[np.float64]:
        """Fill the map's gradient; returns the pose's [6].

        Nothing here moves by the curvature of depth, so that E_pgi's takes its place where there is one.
        """
        if self._gradient.mean.shape[0] != gaussians.capacity:
            self._gradient = MapGradient.zeros(gaussians.capacity)
        else:
            self._gradient.clear()
        g = ImageGradient(
            loss.g_colour, loss.g_depth, loss.g_opacity, pgi.embedding if pgi else None,
            colour_weight=loss.w_colour, depth_weight=pgi.weight if pgi else loss.w_depth,
        )  # fmt: skip
        return self.rasterizer.backward(gaussians, g, self._gradient)

    def _update_map(
        self,
        gaussians: GaussianMap,
        loss: losses.LossResult,
        pgi: InstanceGradient | None,
        pace: float,
        colour_pace: float,
    ) -> None:
        gradient, visible = self._gradient, self.rasterizer.tile_count
        if self.structure:
            self.structure.regularise(gaussians, visible, gradient)
            if pgi:
                self.structure.move_embeddings(gaussians, visible, gradient, self._sightings, pgi.target)
        names = list(self.adam.learning_rates)
        self.adam.step(
            {name: getattr(gaussians, name) for name in names},
            {name: getattr(gradient, name) for name in names},
            visible,
            pace,
        )
        weight = self.loss.weight_pho * self.loss.weight_l1 / (3.0 * self.loss.charbonnier_colour)
        if self.config.optimizer == "relaxation":
            relaxation.relax(
                gaussians.count, visible, gradient.colour, gradient.curvature, loss.totals,
                colour_pace * self.config.relaxation, weight, gaussians.colour,
            )  # fmt: skip
        self._sightings.record(visible, gradient.curvature, loss.totals, weight)

    def _update_pose(self, keyframe: Keyframe, g_pose: NDArray[np.float64]) -> None:
        adam = self._pose_steps.setdefault(keyframe.index, VectorAdam([self.config.rate_pose] * 6))
        keyframe.T_cw = orthonormalized(se3_exp(adam.step(g_pose)) @ keyframe.T_cw)

    def _observation(self, keyframe: Keyframe) -> losses.Observation:
        """The keyframe's side of the loss; the most recently used are kept."""
        cached = self._observations.pop(keyframe.index, None)
        if cached is None:
            colour, depth_m = runtime.to_device(keyframe.colour()), runtime.to_device(keyframe.depth_m())
            cached = losses.observe(colour, depth_m, self.loss)
        self._observations[keyframe.index] = cached
        while len(self._observations) > self.config.window + self.config.anchor_count:
            self._observations.popitem(last=False)
        return cached


def _optimiser(config: MappingConfig, camera: Camera) -> Adam:
    """Adam for the geometry, and for colours unless they relax."""
    channels = dict(_GEOMETRY)
    rates = {
        "mean": config.rate_mean_px / camera.fx,
        "log_scale": config.rate_scale,
        "quat_wxyz": config.rate_rotation,
        "opacity_logit": config.rate_opacity,
    }
    if config.optimizer == "adam":
        channels["colour"], rates["colour"] = 3, config.rate_colour
    return Adam(channels, rates)
