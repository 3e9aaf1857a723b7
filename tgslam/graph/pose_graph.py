"""The pose graph over keyframes, with planes as landmarks if wanted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from tgslam.config.graph_settings import SolvingSettings
from tgslam.errors import GraphError
from tgslam.geometry import adjoint, inverse
from tgslam.graph.factors import Edge, FactorMaker, Sighting, anchor_factor, plane_key, pose_key
from tgslam.graph.solvers import Batch, make_solver
from tgslam.planes.estimate import PlaneEstimate
from tgslam.types import RelativePose

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class GraphEstimate:
    """Where everything is."""

    keyframes: NDArray[np.int64]  # [K] ascending
    T_cw: Vector  # [K, 4, 4]
    plane_ids: NDArray[np.int64]  # [P] ascending
    planes: Vector  # [P, 4] unit normal, and d in m of n . x + d = 0, world


class PoseGraph:
    """Keyframes, the motions between them and the planes that they saw; `optimise` finds where they are.

    Nothing that is added takes effect before `optimise`. The first keyframe stays where it was added.
    """

    def __init__(self, config: SolvingSettings) -> None:
        self._config, self._factors = config, FactorMaker(config)
        self._keyframes: list[int] = []
        self._edges: list[Edge] = []
        self._sightings: list[Sighting] = []
        self._plane_ids: set[int] = set()  # of the sightings
        self._origin: tuple[int, Vector] | None = None
        self._values = gtsam.Values()  # the latest estimate, with a first guess of what is new
        self._fresh_factors = gtsam.NonlinearFactorGraph()
        self._fresh_values = gtsam.Values()
        self._solver = make_solver(config)

    @property
    def closure_count(self) -> int:
        """Edges other than odometry."""
        return sum(edge.closure for edge in self._edges)

    def add_first(self, keyframe: int, T_cw: Vector) -> None:
        """The keyframe that holds the graph: it stays at its pose [4, 4]. Raises GraphError if there is one already."""
        if self._origin is not None:
            raise GraphError(f"keyframe {keyframe} is not the first one: that is keyframe {self._origin[0]}")
        self._origin = (keyframe, T_cw)
        self._fresh_factors.push_back(anchor_factor(keyframe, T_cw))
        self._insert(pose_key(keyframe), gtsam.Pose3(inverse(T_cw)))
        self._keyframes.append(keyframe)

    def add_keyframe(self, keyframe: int, odometry: Mapping[int, RelativePose]) -> None:
        """A keyframe and its odometry: the motion to it from one or more earlier ones, the first of which places it.

        Raises GraphError without odometry, for an unknown earlier keyframe, or for one that is no motion.
        """
        if not odometry:
            raise GraphError(f"keyframe {keyframe} has no odometry")
        starts = [self._pose_of(earlier) for earlier in odometry]
        edges = [Edge(earlier, keyframe, motion, closure=False, robust=False) for earlier, motion in odometry.items()]
        for edge in edges:
            edge.check()
        self._insert(pose_key(keyframe), starts[0].compose(gtsam.Pose3(inverse(edges[0].motion.T_ji))))
        self._keyframes.append(keyframe)
        for edge in edges:
            self._add(edge)

    def add_closure(self, i: int, j: int, motion: RelativePose, *, robust: bool = True) -> None:
        """A motion from keyframe i to j measured otherwise; its information may be singular.

        robust: it may be wrong, and then gives way. What is certain must not: against the drift of a long way round it
        would look like an outlier. Raises GraphError for an unknown keyframe, or for one that is no motion.
        """
        for keyframe in (i, j):
            self._pose_of(keyframe)
        edge = Edge(i, j, motion, closure=True, robust=robust)
        edge.check()
        self._add(edge)

    def add_plane_observation(self, keyframe: int, plane_id: int, plane: PlaneEstimate) -> None:
        """A keyframe sees a plane; `plane` is that view's own, in its camera's frame.

        Raises GraphError for an unknown keyframe, or for a plane without a sound covariance.
        """
        pose, key = self._pose_of(keyframe), plane_key(plane_id)
        sighting = Sighting(keyframe, plane_id, plane)
        self._fresh_factors.push_back(self._factors.plane(sighting))
        self._sightings.append(sighting)
        self._plane_ids.add(plane_id)
        if not self._values.exists(key):
            world = plane.transformed(pose.matrix())
            self._insert(key, gtsam.OrientedPlane3(np.append(world.normal, world.offset_m)))

    def replace_planes(self, sightings: Mapping[int, Mapping[int, PlaneEstimate]]) -> None:
        """All sightings anew, by keyframe and plane: for when planes have merged, split or ended.

        Planes that stay begin where they are, new ones where they are first seen. Costs as much as a first `optimise`
        of everything.
        """
        kept = {plane_id for seen in sightings.values() for plane_id in seen}
        for plane_id in self._plane_ids - kept:
            self._values.erase(plane_key(plane_id))
        self._sightings, self._plane_ids = [], set()
        for keyframe, seen in sightings.items():
            for plane_id, plane in seen.items():
                self.add_plane_observation(keyframe, plane_id, plane)
        self._rebuild()

    def carry(self, keyframes: Iterable[int], motion: Vector) -> None:
        """Keyframes and the planes that they saw are elsewhere, p_w <- motion p_w [4, 4]: `optimise` starts there."""
        carried, pose = set(keyframes), gtsam.Pose3(motion)
        for keyframe in carried:
            self._values.update(pose_key(keyframe), pose.compose(self._pose_of(keyframe)))
        for plane_id, sighting in {s.plane_id: s for s in self._sightings if s.keyframe in carried}.items():
            world = sighting.plane.transformed(self._pose_of(sighting.keyframe).matrix())
            self._values.update(plane_key(plane_id), gtsam.OrientedPlane3(np.append(world.normal, world.offset_m)))
        self._rebuild()

    def optimise(self) -> GraphEstimate:
        """Take in what was added and solve.

        Raises GraphError when there is no solution; what was added since the last one is in the graph all the same.
        """
        factors, values = self._fresh_factors, self._fresh_values
        self._fresh_factors, self._fresh_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        try:
            self._values = self._solver.update(factors, values)
        except RuntimeError:  # gtsam's, of a singular system: damping from the last estimate may get past it
            self._restart()
        return self.estimate()

    def estimate(self) -> GraphEstimate:
        """As of the last `optimise`; what was added later is where it was guessed to be."""
        if self._origin is None:
            raise GraphError("the pose graph has no keyframes")
        flat = gtsam.utilities.extractPose3(self._values)
        T_wc = np.tile(np.eye(4), (len(flat), 1, 1))
        T_wc[:, :3, :3], T_wc[:, :3, 3] = flat[:, :9].reshape(-1, 3, 3), flat[:, 9:]
        keyframes, T_cw = np.array(sorted(self._keyframes), np.int64), inverse(T_wc)
        T_cw[keyframes == self._origin[0]] = self._origin[1]  # to the last bit
        plane_ids = sorted(self._plane_ids)
        planes = [self._values.atOrientedPlane3(plane_key(plane)).planeCoefficients() for plane in plane_ids]
        return GraphEstimate(
            keyframes,
            T_cw,
            np.array(plane_ids, np.int64),
            np.array(planes, np.float64).reshape(-1, 4),
        )

    def relative(self, i: int, j: int) -> tuple[Vector, Vector]:
        """T_ji [4, 4] between keyframes as of the last `optimise`, and the covariance [6, 6] of its left perturbation.

        Raises GraphError when the graph does not have such keyframes, or not yet.
        """
        T_wi, T_wj = (self._pose_of(keyframe).matrix() for keyframe in (i, j))
        keys = pose_key(i), pose_key(j)
        try:
            joint = self._solver.covariance(keys)
        except (RuntimeError, IndexError) as error:  # IndexError: not in the solver yet
            raise GraphError(f"the graph does not hold keyframes {i} and {j}: {_first_line(error)}") from error
        covariance = np.block([[joint.at(row, column) for column in keys] for row in keys])
        T_ji = inverse(T_wj) @ T_wi
        jacobian = np.hstack([adjoint(T_ji), -np.eye(6)])
        return T_ji, jacobian @ covariance @ jacobian.T

    def _pose_of(self, keyframe: int) -> gtsam.Pose3:
        if not self._values.exists(pose_key(keyframe)):
            raise GraphError(f"the pose graph does not have keyframe {keyframe}")
        return self._values.atPose3(pose_key(keyframe))

    def _insert(self, key: int, value: Any) -> None:
        for values in (self._values, self._fresh_values):
            values.insert(key, value)

    def _add(self, edge: Edge) -> None:
        self._edges.append(edge)
        self._fresh_factors.push_back(self._factors.edge(edge))

    def _rebuild(self) -> None:
        """A new solver that is to start from the present values with all there is."""
        self._solver = make_solver(self._config)
        self._fresh_factors, self._fresh_values = self._all_factors(), gtsam.Values(self._values)

    def _restart(self) -> None:
        """Solve everything anew, damped, and hand the result to a new solver."""
        try:
            self._values = Batch().update(self._all_factors(), self._values)
            self._rebuild()
            self._values = self._solver.update(self._fresh_factors, self._fresh_values)
        except RuntimeError as error:
            self._rebuild()
            raise GraphError(f"the pose graph has no solution: {_first_line(error)}") from error
        self._fresh_factors, self._fresh_values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def _all_factors(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        if self._origin is not None:
            graph.push_back(anchor_factor(*self._origin))
        for edge in self._edges:
            graph.push_back(self._factors.edge(edge))
        for sighting in self._sightings:
            graph.push_back(self._factors.plane(sighting))
        return graph


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "unknown error")
