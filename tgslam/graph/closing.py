"""Keeps the pose graph in step with the keyframes: odometry, planes and closures go in, corrected poses come out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.graph_settings import ClosureConfig, LoopConfig
from tgslam.geometry import inverse, orthonormalized
from tgslam.graph.factors import Sighting
from tgslam.graph.findings import Closure
from tgslam.graph.pose_graph import PoseGraph
from tgslam.graph.structure.icp import View
from tgslam.graph.structure.search import ClosureSearch
from tgslam.graph.visual.loop_search import LoopSearch
from tgslam.map.keyframes import Keyframe
from tgslam.map.world import Map
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.registry import PlaneRegistry
from tgslam.types import Matrix4, RelativePose


@dataclass(frozen=True)
class Correction:
    """What a keyframe has changed in the graph."""

    motions: dict[int, Matrix4]  # p_w <- motion p_w, for the keyframes that have moved; empty = stay where you are
    closures: tuple[int, ...]  # earlier keyframes to which it has an edge now
    ties: tuple[tuple[int, int], ...]  # keyframes between which closures have moved something for the first time
    joined: int | None = None  # the first keyframe of a piece of the map that is tied to another one now

    @property
    def remarks(self) -> tuple[str, ...]:
        """For the log."""
        pieces = () if self.joined is None else (f"the piece of the map from keyframe {self.joined} on is joined",)
        edges = (f"closures with keyframes {', '.join(map(str, self.closures))}",) if self.closures else ()
        return pieces + edges


class GraphClosing:
    """Owns the pose graph.

    Where the map's keyframes are refined between corrections, the graph knows nothing of that, so what it says is told
    as a motion: of its estimate now against its own estimate when the map last followed, which it remembers for that.
    """

    def __init__(self, camera: Camera, noise: SensorNoise, config: ClosureConfig, loops: LoopConfig) -> None:
        self._config = config
        self._graph = PoseGraph(config.expert.solving)
        self._landmarks = config.enabled and config.formulation != "closures"
        by_planes = config.enabled and config.formulation != "landmarks"
        self._search = ClosureSearch(camera, noise, config) if by_planes else None
        self._loops = LoopSearch(loops) if loops.enabled else None
        self._followed: list[NDArray[np.float64]] = []  # T_cw by the graph's estimate when the map last followed it
        self._sighted: dict[int, tuple[int, int]] = {}  # PGI -> its revision and its latest keyframe in the graph
        self._untied: list[tuple[int, int]] = []  # keyframes between which closures have moved nothing yet

    @property
    def closure_count(self) -> int:
        """Edges of the graph besides odometry."""
        return self._graph.closure_count

    def close(self, world: Map, owners: Mapping[int, float]) -> Correction:
        """Take in the latest keyframe, mapped and, if there are planes, with them observed.

        owners: the earlier keyframes that it was tracked against, with their shares. Raises GraphError without a
        solution.
        """
        latest = len(world.keyframes) - 1
        self._add_odometry(world.keyframes[latest], latest, owners)
        if self._landmarks and world.planes:
            self._add_sightings(world.planes)
        T_cw = self._graph.optimise().T_cw
        by_planes, by_looks = self._structure_closures(world, T_cw), self._loop_closures(world, T_cw)
        joined = self._join(world, T_cw, by_looks)
        for closure, robust in [(c, True) for c in by_planes] + [(c, False) for c in by_looks]:
            self._graph.add_closure(closure.earlier, latest, closure.measured.motion, robust=robust)
        found = tuple(closure.earlier for closure in (*by_planes, *by_looks))
        if found:
            T_cw = self._graph.optimise().T_cw
        self._untied += [(earlier, latest) for earlier in found]
        motions = self._motions(T_cw)
        ties = tuple(self._untied) if motions else ()
        if motions:
            self._untied = []
        return Correction(motions, found, ties, joined)

    def _add_odometry(self, keyframe: Keyframe, latest: int, owners: Mapping[int, float]) -> None:
        """Tracking measures a pose against the map, that is, against the keyframes that its Gaussians were seeded from.

        Were it counted as a motion from the previous keyframe alone, what planes turn that one by would seem undone in
        each step that still sees the older map, and the graph would drift away from both.
        """
        T_cw = keyframe.T_cw
        self._followed.append(T_cw)
        if latest == 0:
            self._graph.add_first(0, T_cw)
            return
        sigmas = self._config.expert.evidence
        widened = RelativePose(T_cw, keyframe.information).widened(sigmas.odometry_sigma_rad, sigmas.odometry_sigma_m)
        odometry = {
            earlier: RelativePose(orthonormalized(T_cw @ inverse(self._followed[earlier])), share * widened.information)
            for earlier, share in owners.items()
        }
        self._graph.add_keyframe(latest, odometry)

    def _add_sightings(self, planes: PlaneRegistry) -> None:
        """What is new; of PGIs that have merged or split, whatever has changed."""
        instances, surface_m = planes.instances, self._config.expert.evidence.view_sigma_m
        for plane_id in self._sighted.keys() - instances.keys():
            self._graph.replace_plane(plane_id, {})
            del self._sighted[plane_id]
        news = []
        for plane_id, instance in instances.items():
            revision, latest = self._sighted.get(plane_id, (-1, -1))
            if revision != instance.lineage.revision:
                self._graph.replace_plane(plane_id, instance.views(surface_m))
            elif latest < instance.keyframes[-1]:
                view = instance.view(instance.keyframes[-1], surface_m)
                news += [] if view is None else [Sighting(instance.keyframes[-1], plane_id, view)]
            self._sighted[plane_id] = instance.lineage.revision, instance.keyframes[-1]
        self._graph.add_plane_observations(news)

    def _structure_closures(self, world: Map, T_cw: NDArray[np.float64]) -> tuple[Closure, ...]:
        """Of the latest keyframe with earlier ones that see the same planes."""
        latest, planes = len(world.keyframes) - 1, world.planes
        if self._search is None or planes is None or latest == 0 or latest % self._config.interval:
            return ()
        surface_m, seen = self._config.expert.evidence.view_sigma_m, range(latest + 1)
        sightings: dict[int, Mapping[int, PlaneEstimate]] = {k: planes.seen_from(k, surface_m) for k in seen}

        def view(number: int) -> View:
            labels = world.keyframes[number].labels
            assert labels is not None  # closures are looked for only where planes are
            ids = planes.table.resolved(labels.ids)[labels.places]
            return View(world.keyframes[number].depth_m(), ids)

        return self._search.find(sightings, dict(enumerate(T_cw)), self._graph.relative, view).closures

    def _loop_closures(self, world: Map, T_cw: NDArray[np.float64]) -> tuple[Closure, ...]:
        """Of the latest keyframe with earlier ones that look the same."""
        if self._loops is None:
            return ()
        apart = world.pieces.others(len(world.keyframes) - 1)
        return self._loops.find(world.looks, dict(enumerate(T_cw)), self._graph.relative, apart).closures

    def _join(self, world: Map, T_cw: NDArray[np.float64], closures: tuple[Closure, ...]) -> int | None:
        """Where a closure ties two pieces of the map, the later one goes where it says; returns its first keyframe.

        From where the piece has been, which is anywhere, solving would not find there.
        """
        latest = len(world.keyframes) - 1
        for closure in closures:
            if world.pieces.of(closure.earlier) == world.pieces.of(latest):
                continue
            moved = world.pieces.join(closure.earlier, latest)
            motion = inverse(closure.measured.T_ji @ T_cw[closure.earlier]) @ T_cw[latest]
            self._graph.carry(moved, motion if latest in moved else inverse(motion))
            return moved[0]
        return None

    def _motions(self, T_cw: NDArray[np.float64]) -> dict[int, Matrix4]:
        """Of all keyframes once one of them has moved enough to matter."""
        T_wc, followed = inverse(T_cw), np.array(self._followed)
        motions = T_wc @ followed
        shifts_m = np.linalg.norm(T_wc[:, :3, 3] - inverse(followed)[:, :3, 3], axis=1)
        turns_rad = np.linalg.norm(motions[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2.0)
        least = self._config.expert.follow
        if shifts_m.max() < least.least_shift_m and turns_rad.max() < least.least_turn_rad:
            return {}
        self._followed = list(T_cw.copy())
        return dict(enumerate(motions))
