"""The pose graph over keyframes, with planes as landmarks if wanted."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from tgslam.config.graph_settings import SolvingSettings
from tgslam.errors import GraphError
from tgslam.geometry import adjoint, inverse
from tgslam.graph.factors import Edge, FactorMaker, Sighting, anchor_factor, plane_key, pose_key
from tgslam.graph.solvers import Batch, Change, make_solver
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
        self._config, self._maker = config, FactorMaker(config)
        self._keyframes: list[int] = []
        self._edges: list[Edge] = []
        self._sightings: dict[int, dict[int, PlaneEstimate]] = {}  # by plane, then by keyframe
        self._origin: tuple[int, Vector] | None = None
        self._factors: dict[Hashable, gtsam.NonlinearFactor] = {}  # sightings' by (keyframe, plane), edges' by number
        self._values = gtsam.Values()  # the latest estimate, with a first guess of what is new
        self._change = Change()  # that the solver has not been told yet
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
        self._add(anchor_factor(keyframe, T_cw), None)
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
            self._add_edge(edge)

    def add_closure(self, i: int, j: int, motion: RelativePose, *, robust: bool = True) -> None:
        """A motion from keyframe i to j measured otherwise; its information may be singular.

        robust: it may be wrong, and then gives way. What is certain must not: against the drift of a long way round it
        would look like an outlier. Raises GraphError for an unknown keyframe, or for one that is no motion.
        """
        for keyframe in (i, j):
            self._pose_of(keyframe)
        edge = Edge(i, j, motion, closure=True, robust=robust)
        edge.check()
        self._add_edge(edge)

    def add_plane_observations(self, sightings: Sequence[Sighting]) -> None:
        """Keyframes see planes: each sighting is that view's own, in its camera's frame.

        One of a plane that the keyframe has seen already takes the place of the other. Raises GraphError for an unknown
        keyframe, or for a plane without a sound covariance.
        """
        poses = {keyframe: self._pose_of(keyframe) for keyframe in {sighting.keyframe for sighting in sightings}}
        for sighting, factor in zip(sightings, self._maker.planes(sightings), strict=True):
            self._forget(sighting.keyframe, sighting.plane_id)
            self._sightings.setdefault(sighting.plane_id, {})[sighting.keyframe] = sighting.plane
            self._add(factor, (sighting.keyframe, sighting.plane_id))
            key = plane_key(sighting.plane_id)
            if not self._values.exists(key):
                world = sighting.plane.transformed(poses[sighting.keyframe].matrix())
                self._insert(key, gtsam.OrientedPlane3(np.append(world.normal, world.offset_m)))

    def replace_plane(self, plane_id: int, views: Mapping[int, PlaneEstimate]) -> None:
        """All sightings of a plane anew, by keyframe, for when it has merged or split: without any, it ends.

        It begins where it is, a new one where it is first seen. Sightings that stay as they were cost nothing.
        """
        known = self._sightings.get(plane_id, {})
        same = {keyframe for keyframe, plane in views.items() if keyframe in known and _equal(known[keyframe], plane)}
        for keyframe in known.keys() - same:
            self._forget(keyframe, plane_id)
        if not views and self._sightings.pop(plane_id, None) is not None:
            for values in (self._values, self._change.values):
                if values.exists(plane_key(plane_id)):
                    values.erase(plane_key(plane_id))
        self.add_plane_observations([Sighting(k, plane_id, plane) for k, plane in views.items() if k not in same])

    def carry(self, keyframes: Iterable[int], motion: Vector) -> None:
        """Keyframes and the planes that they saw are elsewhere, p_w <- motion p_w [4, 4]: `optimise` starts there."""
        carried, pose = set(keyframes), gtsam.Pose3(motion)
        for keyframe in carried:
            self._values.update(pose_key(keyframe), pose.compose(self._pose_of(keyframe)))
        for plane_id, views in self._sightings.items():
            for keyframe in [k for k in views if k in carried][-1:]:
                world = views[keyframe].transformed(self._pose_of(keyframe).matrix())
                self._values.update(plane_key(plane_id), gtsam.OrientedPlane3(np.append(world.normal, world.offset_m)))
        self._solver, self._change = make_solver(self._config), self._everything()

    def optimise(self) -> GraphEstimate:
        """Take in what was added and solve.

        Raises GraphError when there is no solution; what was added since the last one is in the graph all the same.
        """
        change, self._change = self._change, Change()
        try:
            self._values = self._solver.update(change)
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
        plane_ids = sorted(self._sightings)
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
        for values in (self._values, self._change.values):
            values.insert(key, value)

    def _add_edge(self, edge: Edge) -> None:
        self._edges.append(edge)
        self._add(self._maker.edge(edge), len(self._edges))

    def _add(self, factor: gtsam.NonlinearFactor, name: Hashable) -> None:
        self._factors[name] = factor
        self._change.add(name, factor)

    def _forget(self, keyframe: int, plane_id: int) -> None:
        """A sighting, if there is one."""
        if self._sightings.get(plane_id, {}).pop(keyframe, None) is not None:
            del self._factors[keyframe, plane_id]
            self._change.remove((keyframe, plane_id))

    def _restart(self) -> None:
        """Solve everything anew, damped, and hand the result to a new solver, a careful one."""
        self._solver = make_solver(self._config, careful=True)
        try:
            self._values = Batch().update(self._everything())
            self._values = self._solver.update(self._everything())
        except RuntimeError as error:
            self._solver, self._change = make_solver(self._config, careful=True), self._everything()
            raise GraphError(f"the pose graph has no solution: {_first_line(error)}") from error

    def _everything(self) -> Change:
        """What a new solver that is to start from the present values has to be told."""
        return Change(dict(self._factors), gtsam.Values(self._values))


def _equal(first: PlaneEstimate, second: PlaneEstimate) -> bool:
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "unknown error")
