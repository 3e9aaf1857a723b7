"""The map's life: seed from a keyframe what the map does not explain, prune, refine the window."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam import images, runtime
from tgslam.config.schema import LossConfig, MappingConfig, SeedingConfig
from tgslam.depth import filled
from tgslam.gaussian_map import GaussianMap
from tgslam.geometry import transform_points
from tgslam.mapping.keyframe import Keyframe
from tgslam.mapping.refinement import Refiner
from tgslam.mapping.seeding import quadtree, seed
from tgslam.types import Camera

_MIN_VIEWS = 3  # a Gaussian is judged invisible only after so many views


class Mapper:
    """Owns the Gaussians and the keyframes."""

    def __init__(
        self, camera: Camera, mapping: MappingConfig, seeding: SeedingConfig, loss: LossConfig, rng: np.random.Generator
    ) -> None:
        self.camera, self.config, self.seeding, self.loss, self.rng = camera, mapping, seeding, loss, rng
        self.gaussians = GaussianMap()
        self.keyframes: list[Keyframe] = []
        self.refiner = Refiner(camera, mapping, loss)
        self.support = np.zeros(0, np.int32)  # [N] keyframes whose depth agrees with the Gaussian
        self.conflict = np.zeros(0, np.int32)  # [N] keyframes that see through it

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Take in a keyframe: insert, weigh the evidence, prune, refine."""
        self.keyframes.append(keyframe)
        self._insert(keyframe)
        self._weigh(keyframe)
        self._prune()
        for view in self._schedule(self.config.iterations):
            self.refiner.step(self.gaussians, view, move_pose=self._may_move(view))

    def finish(self) -> None:
        """The final pass: every keyframe in turn, in random order, poses fixed."""
        for _ in range(0, self.config.final_iterations, max(len(self.keyframes), 1)):
            for k in self.rng.permutation(len(self.keyframes)):
                self.refiner.step(self.gaussians, self.keyframes[k], move_pose=False)
        self._prune()

    def _insert(self, keyframe: Keyframe) -> None:
        """Seed Gaussians where the map is open; where no depth was measured, at a guessed one."""
        colour, measured_m = keyframe.colour(), keyframe.depth_m()
        wanted = self._unexplained(keyframe, measured_m)
        depth_m = filled(measured_m)
        exposure = keyframe.exposure
        cells = quadtree(
            exposure.gain * colour + exposure.bias, depth_m, wanted, self.seeding, self.loss.depth_sigma_per_m2
        )
        normals = images.normals(runtime.to_device(depth_m), self.camera, sigma_per_m2=self.loss.depth_sigma_per_m2)
        born = len(self.keyframes) - 1
        new = seed(cells, runtime.to_host(normals), self.camera, keyframe.T_cw, born, self.seeding)
        self.gaussians.append(new)
        self.refiner.append(len(new))
        self.support = np.concatenate([self.support, np.zeros(len(new), np.int32)])
        self.conflict = np.concatenate([self.conflict, np.zeros(len(new), np.int32)])

    def _unexplained(self, keyframe: Keyframe, depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """[H, W] pixels that the map leaves open, or in front of whose surface the camera sees another one."""
        rendered = self.refiner.rasterizer.render(self.gaussians, keyframe.T_cw)
        sigma_m = self.loss.depth_sigma_per_m2 * depth_m**2
        both = (rendered.depth_m > 0) & (depth_m > 0)
        in_front = both & (depth_m < rendered.depth_m - self.config.insert_sigmas * sigma_m)
        return (rendered.opacity < self.config.insert_opacity) | in_front

    def _weigh(self, keyframe: Keyframe) -> None:
        """Count for each Gaussian whether the keyframe's depth supports it or looks through it."""
        depth_m = keyframe.depth_m()
        # The nearest measurement around decides, so that an edge pixel off by one does not speak against a surface
        nearest = cv2.erode(np.where(depth_m > 0, depth_m, np.inf), np.ones((3, 3)), borderValue=np.inf)
        x = transform_points(keyframe.T_cw, self.gaussians.host("mean"))
        z = np.maximum(x[:, 2], 1e-3)
        u = np.rint(self.camera.fx * x[:, 0] / z + self.camera.cx)
        v = np.rint(self.camera.fy * x[:, 1] / z + self.camera.cy)
        inside = (x[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u < self.camera.width) & (v < self.camera.height)
        surface = np.full(len(x), np.inf)
        surface[inside] = nearest[v[inside].astype(int), u[inside].astype(int)]
        known = np.isfinite(surface)
        margin = self.config.insert_sigmas * self.loss.depth_sigma_per_m2 * np.where(known, surface, 0.0) ** 2
        self.conflict += known & (z < surface - margin)
        self.support += known & (np.abs(z - surface) <= margin)

    def _prune(self) -> None:
        """Remove the transparent, the floaters that keyframes see through, and what never shows."""
        opacity = 1.0 / (1.0 + np.exp(-self.gaussians.host("opacity_logit")))
        hidden = (self.refiner.views >= _MIN_VIEWS) & (self.refiner.contribution < self.config.prune_weight_px)
        floating = (self.conflict >= 2) & (self.conflict > self.support)
        keep = (opacity >= self.config.prune_opacity) & ~hidden & ~floating
        keep &= np.isfinite(self.gaussians.host("mean")).all(-1)
        if keep.all():
            return
        self.gaussians.keep(keep)
        self.refiner.keep(keep)
        self.support, self.conflict = self.support[keep], self.conflict[keep]

    def _schedule(self, iterations: int) -> list[Keyframe]:
        """The views to refine: the latest keyframes in turn, newest first, mixed with random earlier ones."""
        recent = self.keyframes[-self.config.window :][::-1]
        earlier = self.keyframes[: -len(recent)]
        count = min(self.config.window_random, len(earlier))
        drawn = [earlier[k] for k in self.rng.choice(len(earlier), count, replace=False)] if count else []
        window = recent + drawn
        return [window[i % len(window)] for i in range(iterations)]

    def _may_move(self, keyframe: Keyframe) -> bool:
        """The first keyframe holds the world frame; earlier ones outside the window are anchors."""
        window = self.keyframes[-self.config.window :]
        return self.config.refine_poses and keyframe is not self.keyframes[0] and any(keyframe is k for k in window)
