"""The pose graph over keyframes, with planes as landmarks if wanted. The only module that knows gtsam.

gtsam's variables are camera-to-world poses, perturbed on the right, T_wc <- T_wc exp(eta). Since that is the same as
T_cw <- exp(-eta) T_cw, and T_ji <- exp(xi) T_ji the same as T_ij <- T_ij exp(-xi), our information matrices, which
speak of left perturbations of T_cw and T_ji in the order (rotation, translation), are gtsam's as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from tgslam.config.graph_settings import ClosureConfig
from tgslam.errors import GraphError
from tgslam.geometry import adjoint, hat, inverse
from tgslam.planes.estimate import PlaneEstimate
from tgslam.types import RelativePose

Vector = NDArray[np.float64]

_FIXED = 1e-6  # rad and m, of the first keyframe: it holds the graph
_LOOSE = np.diag([10.0**-2] * 3 + [1000.0**-2] * 3)  # rad, m: odometry that says nothing leaves the graph regular
_ROUNDS = 5  # updates at most of one call, until nothing has to be linearised anew
_MAX_ITERATIONS = 50  # of the batch solver
_TURNS = np.stack([hat(axis) for axis in np.eye(3)])  # [3, 3, 3] generators of rotations


@dataclass(frozen=True)
class GraphEstimate:
    """Where everything is."""

    keyframes: NDArray[np.int64]  # [K] ascending
    T_cw: Vector  # [K, 4, 4]
    plane_ids: NDArray[np.int64]  # [P] ascending
    planes: Vector  # [P, 4] unit normal, and d in m of n . x + d = 0, world


@dataclass(frozen=True)
class _Edge:
    """A measured motion between two keyframes."""

    i: int
    j: int
    motion: RelativePose
    closure: bool  # not odometry
    robust: bool


@dataclass(frozen=True)
class _Sighting:
    """A plane in the frame of the camera that saw it."""

    keyframe: int
    plane_id: int
    plane: PlaneEstimate


class PoseGraph:
    """Keyframes, the motions between them and the planes that they saw; `optimise` finds where they are.

    Nothing that is added takes effect before `optimise`. The first keyframe stays where it was added.
    """

    def __init__(self, config: ClosureConfig) -> None:
        self._config = config
        self._keyframes: list[int] = []
        self._edges: list[_Edge] = []
        self._sightings: list[_Sighting] = []
        self._plane_ids: set[int] = set()  # of the sightings
        self._origin: tuple[int, Vector] | None = None
        self._values = gtsam.Values()  # the latest estimate, with a first guess of what is new
        self._fresh_factors = gtsam.NonlinearFactorGraph()
        self._fresh_values = gtsam.Values()
        self._solver = self._new_solver()

    @property
    def closure_count(self) -> int:
        """Edges other than odometry."""
        return sum(edge.closure for edge in self._edges)

    def add_first(self, keyframe: int, T_cw: Vector) -> None:
        """The keyframe that holds the graph: it stays at its pose [4, 4]. Raises GraphError if there is one already."""
        if self._origin is not None:
            raise GraphError(f"keyframe {keyframe} is not the first one: that is keyframe {self._origin[0]}")
        self._origin = (keyframe, T_cw)
        self._fresh_factors.push_back(self._anchor())
        self._insert(_pose(keyframe), gtsam.Pose3(inverse(T_cw)))
        self._keyframes.append(keyframe)

    def add_keyframe(self, keyframe: int, odometry: Mapping[int, RelativePose]) -> None:
        """A keyframe and its odometry: the motion to it from one or more earlier ones, the first of which places it.

        Raises GraphError without odometry, for an unknown earlier keyframe, or for one that is no motion.
        """
        if not odometry:
            raise GraphError(f"keyframe {keyframe} has no odometry")
        starts = [self._pose_of(earlier) for earlier in odometry]
        edges = [_Edge(earlier, keyframe, motion, closure=False, robust=False) for earlier, motion in odometry.items()]
        for edge in edges:
            _check(edge)
        self._insert(_pose(keyframe), starts[0].compose(gtsam.Pose3(inverse(edges[0].motion.T_ji))))
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
        edge = _Edge(i, j, motion, closure=True, robust=robust)
        _check(edge)
        self._add(edge)

    def add_plane_observation(self, keyframe: int, plane_id: int, plane: PlaneEstimate) -> None:
        """A keyframe sees a plane; `plane` is that view's own, in its camera's frame.

        Raises GraphError for an unknown keyframe, or for a plane without a sound covariance.
        """
        pose, key = self._pose_of(keyframe), _landmark(plane_id)
        sighting = _Sighting(keyframe, plane_id, plane)
        self._fresh_factors.push_back(self._plane_factor(sighting))
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
            self._values.erase(_landmark(plane_id))
        self._sightings, self._plane_ids = [], set()
        for keyframe, seen in sightings.items():
            for plane_id, plane in seen.items():
                self.add_plane_observation(keyframe, plane_id, plane)
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
        if not self._keyframes:
            raise GraphError("the pose graph has no keyframes")
        flat = gtsam.utilities.extractPose3(self._values)
        T_wc = np.tile(np.eye(4), (len(flat), 1, 1))
        T_wc[:, :3, :3], T_wc[:, :3, 3] = flat[:, :9].reshape(-1, 3, 3), flat[:, 9:]
        plane_ids = sorted(self._plane_ids)
        planes = [self._values.atOrientedPlane3(_landmark(plane)).planeCoefficients() for plane in plane_ids]
        return GraphEstimate(
            np.array(sorted(self._keyframes), np.int64),
            inverse(T_wc),
            np.array(plane_ids, np.int64),
            np.array(planes, np.float64).reshape(-1, 4),
        )

    def relative(self, i: int, j: int) -> tuple[Vector, Vector]:
        """T_ji [4, 4] between keyframes as of the last `optimise`, and the covariance [6, 6] of its left perturbation.

        Raises GraphError when the graph does not have such keyframes, or not yet.
        """
        T_wi, T_wj = (self._pose_of(keyframe).matrix() for keyframe in (i, j))
        keys = _pose(i), _pose(j)
        try:
            joint = self._solver.covariance(keys)
        except (RuntimeError, IndexError) as error:  # IndexError: not in the solver yet
            raise GraphError(f"the graph does not hold keyframes {i} and {j}: {_first_line(error)}") from error
        covariance = np.block([[joint.at(row, column) for column in keys] for row in keys])
        T_ji = inverse(T_wj) @ T_wi
        jacobian = np.hstack([adjoint(T_ji), -np.eye(6)])
        return T_ji, jacobian @ covariance @ jacobian.T

    def _pose_of(self, keyframe: int) -> gtsam.Pose3:
        if not self._values.exists(_pose(keyframe)):
            raise GraphError(f"the pose graph does not have keyframe {keyframe}")
        return self._values.atPose3(_pose(keyframe))

    def _insert(self, key: int, value: Any) -> None:
        for values in (self._values, self._fresh_values):
            values.insert(key, value)

    def _add(self, edge: _Edge) -> None:
        self._edges.append(edge)
        self._fresh_factors.push_back(self._edge_factor(edge))

    def _rebuild(self) -> None:
        """A new solver that is to start from the present values with all there is."""
        self._solver = self._new_solver()
        self._fresh_factors, self._fresh_values = self._all_factors(), gtsam.Values(self._values)

    def _restart(self) -> None:
        """Solve everything anew, damped, and hand the result to a new solver."""
        try:
            self._values = _Batch().update(self._all_factors(), self._values)
            self._rebuild()
            self._values = self._solver.update(self._fresh_factors, self._fresh_values)
        except RuntimeError as error:
            self._rebuild()
            raise GraphError(f"the pose graph has no solution: {_first_line(error)}") from error
        self._fresh_factors, self._fresh_values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def _all_factors(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._anchor())
        for edge in self._edges:
            graph.push_back(self._edge_factor(edge))
        for sighting in self._sightings:
            graph.push_back(self._plane_factor(sighting))
        return graph

    def _anchor(self) -> gtsam.PriorFactorPose3:
        assert self._origin is not None
        keyframe, T_cw = self._origin
        noise = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
        return gtsam.PriorFactorPose3(_pose(keyframe), gtsam.Pose3(inverse(T_cw)), noise)

    def _edge_factor(self, edge: _Edge) -> gtsam.BetweenFactorPose3:
        motion = edge.motion
        information = motion.information if edge.closure else motion.information + _LOOSE
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(_root(information), False)
        return gtsam.BetweenFactorPose3(
            _pose(edge.i),
            _pose(edge.j),
            gtsam.Pose3(inverse(motion.T_ji)),
            self._robust(noise) if edge.robust else noise,
        )

    def _plane_factor(self, sighting: _Sighting) -> gtsam.CustomFactor:
        keys = _pose(sighting.keyframe), _landmark(sighting.plane_id)
        try:
            error = _PlaneError(keys, sighting.plane)
        except np.linalg.LinAlgError as bad:
            name = f"plane {sighting.plane_id} as keyframe {sighting.keyframe} saw it"
            raise GraphError(f"{name} has no sound covariance") from bad
        return gtsam.CustomFactor(self._robust(gtsam.noiseModel.Unit.Create(3)), list(keys), error)

    def _robust(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        scale = self._config.robust_sigmas
        estimators: dict[str, Any] = {
            "huber": gtsam.noiseModel.mEstimator.Huber,
            "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
            "dcs": gtsam.noiseModel.mEstimator.DCS,
        }
        if self._config.robust == "none":
            return noise
        # DCS is given the square of where it begins
        bound = scale**2 if self._config.robust == "dcs" else scale
        return gtsam.noiseModel.Robust.Create(estimators[self._config.robust].Create(bound), noise)

    def _new_solver(self) -> _Solver:
        return _Incremental(self._config.relinearise) if self._config.solver == "incremental" else _Batch()


class _PlaneError:
    """The error of a plane landmark in a view, in standard deviations: turns about the view's tangents and the shift
    at its centroid, as in its covariance.

    gtsam's own OrientedPlane3Factor takes the tangents from the predicted plane, where they jump by 90 degrees as the
    normal passes a tie of its two least components, such as the optical axis; with correlated errors that is wrong.
    Nor does it take robust noise models.
    """

    def __init__(self, keys: tuple[int, int], plane: PlaneEstimate) -> None:
        """keys: gtsam's, of the keyframe and of the plane. Raises LinAlgError without a sound covariance."""
        self._keys = keys
        first, second = plane.axes
        white = np.linalg.inv(np.linalg.cholesky(plane.covariance))
        if not np.isfinite(white).all():
            raise np.linalg.LinAlgError
        self._by_plane = np.empty((3, 4))  # of (n, d) in the camera's frame
        np.matmul(white, np.array([-second, first, -plane.centroid]), out=self._by_plane[:, :3])
        np.negative(white[:, 2], out=self._by_plane[:, 3])
        by_pose = np.empty((3, 3, 6))  # what each component of n adds to the jacobian
        by_pose[:, :, :3] = self._by_plane[:, :3] @ _TURNS
        by_pose[:, :, 3:] = self._by_plane[:, 3, None] * np.eye(3)[:, None]
        self._by_pose = by_pose.reshape(3, 18)

    def __call__(
        self, factor: gtsam.CustomFactor | None, values: gtsam.Values, jacobians: list[Vector] | None
    ) -> Vector:
        T_wc = values.atPose3(self._keys[0]).matrix()
        plane_w = values.atOrientedPlane3(self._keys[1])
        coefficients = plane_w.planeCoefficients()
        by_normal_w, by_offset = self._by_plane @ T_wc[:3].T, self._by_plane[:, 3]
        if jacobians is not None:
            jacobians[0] = (coefficients[:3] @ T_wc[:3, :3] @ self._by_pose).reshape(3, 6)
            of_plane = np.empty((3, 3))
            of_plane[:, :2], of_plane[:, 2] = by_normal_w @ plane_w.normal().basis(), by_offset
            jacobians[1] = of_plane
        error: Vector = by_normal_w @ coefficients[:3] + by_offset * coefficients[3]
        return error


class _Solver(Protocol):
    """How the graph is solved."""

    def update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """Take in new factors and first values of new variables; returns all values."""
        ...

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        """Joint covariance of variables."""
        ...


class _Incremental:
    """iSAM2."""

    def __init__(self, threshold: float) -> None:
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = 1
        params.setFactorization("QR")  # the squares of Cholesky's are too much for what is known a little in places
        params.setRelinearizeThreshold(threshold)
        self._isam = gtsam.ISAM2(params)

    def update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        self._isam.update(factors, values)
        for _ in range(_ROUNDS - 1):
            if self._isam.update().getVariablesRelinearized() == 0:
                break
        return self._isam.calculateEstimate()

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        return self._isam.jointMarginalCovariance(list(keys))


class _Batch:
    """Levenberg-Marquardt over everything, each time."""

    def __init__(self) -> None:
        self._graph = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()

    def update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        self._graph.push_back(factors)
        self._values.insert(values)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(_MAX_ITERATIONS)
        params.setLinearSolverType("MULTIFRONTAL_QR")
        self._values = gtsam.LevenbergMarquardtOptimizer(self._graph, self._values, params).optimize()
        return gtsam.Values(self._values)

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        return gtsam.Marginals(self._graph, self._values).jointMarginalCovariance(list(keys))


def _pose(keyframe: int) -> int:
    key: int = gtsam.symbol("x", keyframe)
    return key


def _landmark(plane_id: int) -> int:
    key: int = gtsam.symbol("p", plane_id)
    return key


def _root(information: NDArray[np.floating[Any]]) -> Vector:
    """R with R^T R = information, a symmetric matrix without negative eigenvalues but maybe with zeros."""
    eigenvalues, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T


def _check(edge: _Edge) -> None:
    name, motion = f"the motion from keyframe {edge.i} to {edge.j}", edge.motion
    if not (np.isfinite(motion.T_ji).all() and np.isfinite(motion.information).all()):
        raise GraphError(f"{name} is not finite")
    eigenvalues = np.linalg.eigvalsh(motion.information)
    if eigenvalues[0] < -1e-6 * max(eigenvalues[-1], 1.0):
        raise GraphError(f"{name} has an information matrix with a negative eigenvalue")


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "unknown error")
