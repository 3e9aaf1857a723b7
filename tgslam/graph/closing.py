"""Keeps the pose graph in step with the keyframes: odometry, planes and closures go in, corrected poses come out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.graph_settings import ClosureConfig, LoopConfig
from tgslam.geometry import inverse
from tgslam.graph.pose_graph import PoseGraph
from tgslam.graph.structure.icp import View
from tgslam.graph.structure.search import Closure, ClosureSearch
from tgslam.graph.visual.loop_search import LoopSearch
from tgslam.map.keyframe import Keyframe
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.registry import PlaneRegistry
from tgslam.types import Matrix4, RelativePose


@dataclass(frozen=True)
class Correction:
    """What a keyframe has changed in the graph."""

    motions: dict[int, Matrix4]  # p_w <- motion p_w, for the keyframes that have moved; empty = stay where you are
    closures: tuple[int, ...]  # earlier keyframes to which it has an edge now


class GraphClosing:
    """Owns the pose graph.

    The map's keyframes are refined between corrections, so what the graph says is applied as a motion: of its estimate
    now against its estimate when the map last followed.
    """

    def __init__(self, camera: Camera, depth_sigma_per_m2: float, config: ClosureConfig, loops: LoopConfig) -> None:
        """depth_sigma_per_m2: the sensor's noise, sigma_z = this * z^2."""
        self._config = config
        self._graph = PoseGraph(config)
        self._landmarks = config.enabled and config.formulation != "closures"
        by_planes = config.enabled and config.formulation != "landmarks"
        self._search = ClosureSearch(camera, depth_sigma_per_m2, config) if by_planes else None
        self._loops = LoopSearch(camera, depth_sigma_per_m2, loops) if loops.enabled else None
        self._applied: list[NDArray[np.float64]] = []  # T_cw of the graph that the map follows
        self._sighted: dict[int, set[int]] = {}  # PGI -> keyframes whose sightings are in the graph

    @property
    def closure_count(self) -> int:
        """Edges of the graph besides odometry."""
        return self._graph.closure_count

    def add(self, keyframes: Sequence[Keyframe], planes: PlaneRegistry | None) -> Correction:
        """Take in the last keyframe, mapped and, if there are planes, with them observed.

        Raises GraphError without a solution.
        """
        self._add_odometry(keyframes)
        if self._landmarks and planes:
            self._add_sightings(planes)
        T_cw = self._graph.optimise().T_cw
        by_planes, by_looks = self._structure_closures(keyframes, planes, T_cw), self._loop_closures(keyframes, T_cw)
        for closure, robust in [(c, True) for c in by_planes] + [(c, False) for c in by_looks]:
            self._graph.add_closure(closure.earlier, len(keyframes) - 1, closure.measured.motion, robust=robust)
        found = (*by_planes, *by_looks)
        if found:
            T_cw = self._graph.optimise().T_cw
        return Correction(self._motions(T_cw), tuple(closure.earlier for closure in found))

    def _add_odometry(self, keyframes: Sequence[Keyframe]) -> None:
        """Tracking measures a pose against the map, that is, against the keyframes that its Gaussians were seeded from.

        Were it counted as a motion from the previous keyframe alone, what planes turn that one by would seem undone in
        each step that still sees the older map, and the graph would drift away from both.
        """
        latest, T_cw = len(keyframes) - 1, keyframes[-1].T_cw
        self._applied.append(T_cw.copy())
        if latest == 0:
            self._graph.add_first(0, T_cw)
            return
        config, information = self._config, keyframes[-1].information
        odometry = {}
        for earlier, share in keyframes[-1].seen.items():
            motion = RelativePose(T_cw @ inverse(self._applied[earlier]), information)
            motion = motion.widened(config.odometry_sigma_rad, config.odometry_sigma_m)
            odometry[earlier] = RelativePose(motion.T_ji, share * motion.information)
        self._graph.add_keyframe(latest, odometry)

    def _add_sightings(self, planes: PlaneRegistry) -> None:
        """What is new; everything anew where PGIs have merged, split or ended."""
        instances, surface_m = planes.instances, self._config.surface_sigma_m
        gone = self._sighted.keys() - instances.keys()
        split = any(i.split_from is not None for k, i in instances.items() if k not in self._sighted)
        if gone or split:
            self._sighted = {plane_id: set(instance.keyframes) for plane_id, instance in instances.items()}
            self._graph.replace_planes({k: planes.seen_from(k, surface_m) for k in range(len(self._applied))})
            return
        for plane_id, instance in instances.items():
            known = self._sighted.setdefault(plane_id, set())
            for keyframe in instance.keyframes:
                view = None if keyframe in known else instance.view(keyframe, surface_m)
                if view is not None:
                    self._graph.add_plane_observation(keyframe, plane_id, view)
            known.update(instance.keyframes)

    def _structure_closures(
        self, keyframes: Sequence[Keyframe], planes: PlaneRegistry | None, T_cw: NDArray[np.float64]
    ) -> tuple[Closure, ...]:
        """Of the latest keyframe with earlier ones that see the same planes."""
        latest = len(keyframes) - 1
        if self._search is None or planes is None or latest == 0 or latest % self._config.interval:
            return ()
        surface_m, seen = self._config.surface_sigma_m, range(latest + 1)
        sightings: dict[int, Mapping[int, PlaneEstimate]] = {k: planes.seen_from(k, surface_m) for k in seen}

        def view(keyframe: int) -> View:
            plane_ids = keyframes[keyframe].plane_ids
            assert plane_ids is not None  # closures are looked for only where planes are
            return View(keyframes[keyframe].depth_m(), planes.table.resolved(plane_ids))

        return self._search.find(sightings, dict(enumerate(T_cw)), self._graph.relative, view).closures

    def _loop_closures(self, keyframes: Sequence[Keyframe], T_cw: NDArray[np.float64]) -> tuple[Closure, ...]:
        """Of the latest keyframe with earlier ones that look the same."""
        if self._loops is None:
            return ()
        keyframe, latest = keyframes[-1], len(keyframes) - 1
        poses = dict(enumerate(T_cw))
        return self._loops.find(latest, keyframe.colour(), keyframe.depth_m(), poses, self._graph.relative).closures

    def _motions(self, T_cw: NDArray[np.float64]) -> dict[int, Matrix4]:
        """Of all keyframes once one of them has moved enough to matter."""
        motions = inverse(T_cw) @ np.stack(self._applied)
        shifts_m = np.linalg.norm(inverse(T_cw)[:, :3, 3] - inverse(np.stack(self._applied))[:, :3, 3], axis=1)
        turns_rad = np.linalg.norm(motions[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2.0)
        if shifts_m.max() < self._config.least_shift_m and turns_rad.max() < self._config.least_turn_rad:
            return {}
        self._applied = [T.copy() for T in T_cw]
        return dict(enumerate(motions))
