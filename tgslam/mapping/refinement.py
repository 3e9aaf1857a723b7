"""A step of refining the map under the total objective (Eq. 14), on one view."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig, MappingConfig
from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.device.stopwatch import Stopwatch, stage
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.map.table import Column
from tgslam.mapping.structure_terms import StructureTerms
from tgslam.ops import loss as losses
from tgslam.ops import relaxation, rows
from tgslam.ops.adam import Adam
from tgslam.ops.instance_field import InstanceGradient
from tgslam.ops.rasterize import ImageGradient, Rasterizer
from tgslam.ops.splats import MapGradient
from tgslam.types import Matrix4

_GEOMETRY = {"mean": 3, "log_scale": 3, "quat_wxyz": 4, "opacity_logit": 0}
Balance = tuple[float, float, float]
_MOMENTS, _STEPS = "adam_moments", "adam_steps"


@dataclass(frozen=True)
class Step:
    """What a step has found before it moved the map."""

    loss: losses.LossResult  # its numbers can be read until the next step
    g_pose: NDArray[np.float64]  # [6] derivative by a left perturbation of the view's pose


class Refiner:
    """One view at a time: render, compare, step. Colours and embeddings relax, the rest moves by Adam."""

    def __init__(
        self,
        gaussians: GaussianMap,
        camera: Camera,
        config: MappingConfig,
        loss: LossConfig,
        structure: StructureConfig | None = None,
        stopwatch: Stopwatch | None = None,
    ) -> None:
        """gaussians: the map that is refined; it gets columns for what the optimiser remembers.

        structure: of the terms that planes add; None = planes play no part. stopwatch: takes the seconds of the stages
        forward, loss, backward and update, for benchmarks.
        """
        self.gaussians, self.config, self.loss, self.stopwatch = gaussians, config, loss, stopwatch
        self.structure = StructureTerms(camera, structure, config.window + config.anchor_count) if structure else None
        self.rasterizer = Rasterizer(camera)
        self._adam, self._final_adam = _optimiser(config, camera), _optimiser(config, camera, final=True)
        gaussians.add_columns((Column(_MOMENTS, self._adam.moment_width), Column(_STEPS, dtype=np.int32)))
        self._gradient = MapGradient.zeros(1)
        self._workspace = losses.Workspace(camera.height, camera.width)
        self._observations: OrderedDict[tuple[int, Balance], losses.Observation] = OrderedDict()

    def step(
        self,
        keyframe: Keyframe,
        T_cw: Matrix4 | None = None,
        *,
        pace: float = 1.0,
        colour_pace: float = 1.0,
        final: bool = False,
    ) -> Step:
        """Render the map at the keyframe and move it downhill.

        T_cw: [4, 4] where the keyframe is believed to be, by default its pose. pace: what the map's steps are
        multiplied by, but for those of embeddings; colour_pace: and those of colours besides. final: a step of the
        final pass. Only the pose's gradient goes to the host by itself.
        """
        observation = self._observation(keyframe)
        target = self.structure.due(keyframe) if self.structure else None
        gain, bias = 1.0 / keyframe.exposure.gain, -keyframe.exposure.bias / keyframe.exposure.gain
        with stage(self.stopwatch, "forward"):
            pose = keyframe.T_cw if T_cw is None else T_cw
            rendered = self.rasterizer.forward(self.gaussians, pose, with_embedding=target is not None)
        with stage(self.stopwatch, "loss"):
            loss = losses.rgbd_loss(
                rendered.colour, rendered.depth, rendered.opacity, observation, self.loss, gain, bias,
                workspace=self._workspace,
            )  # fmt: skip
            pgi = self.structure.pgi(rendered, target, loss.g_opacity) if self.structure and target else None
        with stage(self.stopwatch, "backward"):
            g_pose = self._backward(loss, pgi)
        with stage(self.stopwatch, "update"):
            self._update(self._final_adam if final else self._adam, loss, pgi, pace, pace * colour_pace)
        return Step(loss, g_pose)

    def _backward(self, loss: losses.LossResult, pgi: InstanceGradient | None) -> NDArray[np.float64]:
        """Fill the map's gradient; returns the pose's [6].

        Nothing here moves by the curvature of depth, so that E_pgi's takes its place where there is one.
        """
        if self._gradient.mean.shape[0] != self.gaussians.capacity:
            self._gradient = MapGradient.zeros(self.gaussians.capacity)
        else:
            self._gradient.clear()
        g = ImageGradient(
            loss.g_colour, loss.g_depth, loss.g_opacity, pgi.embedding if pgi else None,
            colour_weight=loss.w_colour, depth_weight=pgi.weight if pgi else loss.w_depth,
        )  # fmt: skip
        return self.rasterizer.backward(self.gaussians, g, self._gradient)

    def _update(
        self, adam: Adam, loss: losses.LossResult, pgi: InstanceGradient | None, pace: float, colour_pace: float
    ) -> None:
        gaussians, gradient, visible = self.gaussians, self._gradient, self.rasterizer.tile_count
        if self.structure:
            self.structure.regularise(gaussians, visible, gradient)
            if pgi:
                self.structure.move_embeddings(gaussians, visible, gradient, pgi.target)
        names = list(adam.learning_rates)
        adam.step(
            gaussians.count,
            {name: gaussians.array(name) for name in names},
            {name: getattr(gradient, name) for name in names},
            gaussians.array(_MOMENTS),
            gaussians.array(_STEPS),
            visible,
            pace,
        )
        weight = self.loss.weight_pho * self.loss.weight_l1 / (3.0 * self.loss.expert.penalties.charbonnier_colour)
        if self.config.optimizer == "relaxation":
            relaxation.relax(
                gaussians.count, visible, gradient.colour, gradient.curvature, loss.totals,
                colour_pace * self.config.expert.step_sizes.colour_relaxation, weight, gaussians.colour,
            )  # fmt: skip
        rows.record_view(
            gaussians.count, visible, gradient.curvature, loss.totals, weight, gaussians.array("contribution"),
            gaussians.array("views"),
        )  # fmt: skip

    def _observation(self, keyframe: Keyframe) -> losses.Observation:
        """The keyframe's side of the loss; the most recently used are kept."""
        key = keyframe.index, keyframe.exposure.balance
        cached = self._observations.pop(key, None)
        if cached is None:
            colour, depth_m = keyframe.exposure.balanced(keyframe.colour()), keyframe.depth_m()
            left_out = keyframe.left_out
            mask = None if left_out is None else runtime.to_device((~left_out).astype(np.float32))
            cached = losses.observe(runtime.to_device(colour), runtime.to_device(depth_m), self.loss, mask)
        self._observations[key] = cached
        while len(self._observations) > self.config.window + self.config.anchor_count:
            self._observations.popitem(last=False)
        return cached


def _optimiser(config: MappingConfig, camera: Camera, *, final: bool = False) -> Adam:
    """Adam for the geometry, and for colours unless they relax."""
    channels, sizes, last = dict(_GEOMETRY), config.expert.step_sizes, config.expert.final_step_sizes
    rates = {
        "mean": sizes.rate_mean_px / camera.fx,
        "log_scale": last.final_rate_scale if final else sizes.rate_scale,
        "quat_wxyz": last.final_rate_rotation if final else sizes.rate_rotation,
        "opacity_logit": last.final_rate_opacity if final else sizes.rate_opacity,
    }
    if config.optimizer == "adam":
        channels["colour"], rates["colour"] = 3, sizes.rate_colour
    return Adam(channels, rates)
