"""Which views the map is refined on: the window with its SGVs (section 3.4), the seams of a motion, all in the end."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig, MappingConfig
from tgslam.config.plane_settings import StructureConfig
from tgslam.device.stopwatch import Stopwatch
from tgslam.geometry import inverse, orthonormalized, se3_exp, transform_points
from tgslam.map.world import Map
from tgslam.mapping.pruning import prune
from tgslam.mapping.refinement import Refiner
from tgslam.mapping.viewpoints import Viewpoints
from tgslam.ops.vector_adam import VectorAdam
from tgslam.types import Matrix4

_NOTICED_M = 0.005  # by which keyframes have moved against each other, for the map between them to be refined
_FINAL_PACE = 0.05  # in the final pass steps of colours do, or the map would have the brightness of the last views
_LAST_PACE = 0.3  # after a motion, steps get smaller down to this share


class WindowRefinement:
    """Spends the steps of refinement on views, and clears up after them."""

    def __init__(
        self,
        world: Map,
        camera: Camera,
        config: MappingConfig,
        loss: LossConfig,
        rng: np.random.Generator,
        structure: StructureConfig | None = None,
        stopwatch: Stopwatch | None = None,
    ) -> None:
        """world: the map that is refined. structure: what planes ask of it; None = nothing."""
        self.refiner = Refiner(world.gaussians, camera, config, loss, structure, stopwatch)
        self._world, self._config, self._rng = world, config, rng
        self._viewpoints = Viewpoints(rng)
        self._pose_steps: dict[int, VectorAdam] = {}  # by keyframe

    def refine(self) -> None:
        """The window of latest keyframes in turn, newest first, and earlier ones that keep the map where it was."""
        self._know_planes()
        window = self._window()
        poses: dict[int, Matrix4] = {}
        for view in _in_turn([*window, *self._anchors(window)], self._steps(self._config.iterations)):
            self._step(view, poses)
        self._move(poses)
        prune(self._world.gaussians, self._config.expert.pruning)

    def settle(self, motions: Mapping[int, Matrix4], ties: Iterable[tuple[int, int]]) -> None:
        """The map has followed keyframes that moved: where they have moved against each other, refine its seams.

        motions: p_w <- motions[number] p_w, [4, 4] each. ties: keyframes between which closures have asked for it; they
        are refined together from now on, as the map may tear between them.

        What the keyframes share cannot fit all of them. Full steps would leave it where the views of the window, which
        outnumber the anchors, have pushed it: steps get smaller and smaller. The anchors come first, since momentum
        carries on with the steps that are taken while the tear is new.
        """
        for tie in ties:
            self._viewpoints.link(*tie)
        self._know_planes()
        if _bend_m(motions, self._world.keyframes.T_cw()) <= _NOTICED_M:
            return
        window = self._window()
        poses: dict[int, Matrix4] = {}
        views = _in_turn([*self._anchors(window), *window], self._steps(self._config.iterations))
        for view, pace in zip(views, np.linspace(1.0, _LAST_PACE, len(views)), strict=True):
            self._step(view, poses, float(pace))
        self._move(poses)
        prune(self._world.gaussians, self._config.expert.pruning)

    def finish(self) -> None:
        """The final pass: every keyframe in turn, in random order, poses fixed, until colours are the mean of views."""
        keyframes, config = self._world.keyframes, self._config
        least = config.final_rounds * len(keyframes) if config.final_iterations else 0
        rounds = range(0, self._steps(max(config.final_iterations, least)), max(len(keyframes), 1))
        views = [k for _ in rounds for k in self._rng.permutation(len(keyframes))]
        for view, pace in zip(views, np.linspace(1.0, _FINAL_PACE, len(views)), strict=True):
            self.refiner.step(keyframes[view], colour_pace=float(pace), final=True)
        prune(self._world.gaussians, self._config.expert.pruning)

    def _steps(self, count: int) -> int:
        """Of these steps, so many as there is time for."""
        return round(self._config.budget * count)

    def _know_planes(self) -> None:
        if self.refiner.structure and self._world.planes:
            self.refiner.structure.know(self._world.planes.table, self._world.planes.version)

    def _step(self, view: int, poses: dict[int, Matrix4], pace: float = 1.0) -> None:
        """A step on a view, of the pose that it has got so far in `poses` if that may move at all."""
        keyframe = self._world.keyframes[view]
        T_cw = poses.get(view, keyframe.T_cw)
        g_pose = self.refiner.step(keyframe, T_cw, pace=pace).g_pose
        if self._may_move(view):
            adam = self._pose_steps.setdefault(view, VectorAdam([self._config.expert.step_sizes.rate_pose] * 6))
            poses[view] = orthonormalized(se3_exp(adam.step(g_pose)) @ T_cw)

    def _move(self, poses: Mapping[int, Matrix4]) -> None:
        """Take over refined poses; the Gaussians are where refinement has them already."""
        if poses:
            keyframes = self._world.keyframes
            self._world.move({k: inverse(T_cw) @ keyframes[k].T_cw for k, T_cw in poses.items()}, carry=False)

    def _may_move(self, number: int) -> bool:
        """The first keyframe holds the world frame; earlier ones outside the window are anchors."""
        return self._config.refine_poses and number > 0 and number in self._window()

    def _window(self) -> list[int]:
        """The latest keyframes, newest first."""
        return list(range(len(self._world.keyframes)))[-self._config.window :][::-1]

    def _anchors(self, window: Sequence[int]) -> list[int]:
        """Earlier keyframes to refine with a window, so that it does not leave them behind."""
        earlier = min(window)
        count = 0 if self._config.anchors == "none" else min(self._config.anchor_count, earlier)
        if not count:
            return []
        if self._config.anchors == "random" or not self._world.planes:
            return [int(k) for k in self._rng.choice(earlier, count, replace=False)]
        instances = self._world.planes.instances
        seen_by = {plane_id: instance.keyframes for plane_id, instance in instances.items()}
        return self._viewpoints.choose(count, window, seen_by)


def _in_turn(numbers: Sequence[int], count: int) -> list[int]:
    """So many of these numbers, over and over in their order."""
    return [numbers[i % len(numbers)] for i in range(count)]


def _bend_m(motions: Mapping[int, Matrix4], T_cw: NDArray[np.float64]) -> float:
    """By how much motions of keyframes, now at T_cw [K, 4, 4], differ at most from that of the last one, where each
    camera is.
    """
    every = np.tile(np.eye(4), (len(T_cw), 1, 1))
    for number, motion in motions.items():
        every[number] = motion
    places, back = inverse(T_cw)[:, :3, 3], inverse(every)
    before = np.einsum("kij,kj->ki", back[:, :3, :3], places) + back[:, :3, 3]
    return float(np.linalg.norm(transform_points(every[-1], before) - places, axis=1).max())
