"""What the pose graph is made of: measured motions and seen planes, and gtsam's factors for them.

gtsam's variables are camera-to-world poses, perturbed on the right, T_wc <- T_wc exp(eta). Since that is the same as
T_cw <- exp(-eta) T_cw, and T_ji <- exp(xi) T_ji the same as T_ij <- T_ij exp(-xi), our information matrices, which
speak of left perturbations of T_cw and T_ji in the order (rotation, translation), are gtsam's as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from tgslam.config.graph_settings import SolvingSettings
from tgslam.errors import GraphError
from tgslam.geometry import hat, inverse
from tgslam.planes.estimate import PlaneEstimate
from tgslam.types import Matrix4, RelativePose

Vector = NDArray[np.float64]

_FIXED = 1e-6  # rad and m, of the first keyframe: it holds the graph
_LOOSE = np.diag([10.0**-2] * 3 + [1000.0**-2] * 3)  # rad, m: odometry that says nothing leaves the graph regular
_IDENTITY = np.eye(3)
_TURNS = np.stack([hat(axis) for axis in _IDENTITY])  # [3, 3, 3] generators of rotations


@dataclass(frozen=True)
class Edge:
    """A measured motion between two keyframes."""

    i: int
    j: int
    motion: RelativePose
    closure: bool  # not odometry
    robust: bool

    def check(self) -> None:
        """Raises GraphError where it is no motion."""
        name, motion = f"the motion from keyframe {self.i} to {self.j}", self.motion
        if not (np.isfinite(motion.T_ji).all() and np.isfinite(motion.information).all()):
            raise GraphError(f"{name} is not finite")
        eigenvalues = np.linalg.eigvalsh(motion.information)
        if eigenvalues[0] < -1e-6 * max(eigenvalues[-1], 1.0):
            raise GraphError(f"{name} has an information matrix with a negative eigenvalue")


@dataclass(frozen=True)
class Sighting:
    """A plane in the frame of the camera that saw it."""

    keyframe: int
    plane_id: int
    plane: PlaneEstimate


def pose_key(keyframe: int) -> int:
    """gtsam's name for a keyframe's pose."""
    key: int = gtsam.symbol("x", keyframe)
    return key


def plane_key(plane_id: int) -> int:
    """gtsam's name for a plane."""
    key: int = gtsam.symbol("p", plane_id)
    return key


def anchor_factor(keyframe: int, T_cw: Matrix4) -> gtsam.PriorFactorPose3:
    """Holds a keyframe at its pose [4, 4], and with it the graph."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
    return gtsam.PriorFactorPose3(pose_key(keyframe), gtsam.Pose3(inverse(T_cw)), noise)


class FactorMaker:
    """Factors of measurements, those that may be wrong with the config's robust noise model."""

    def __init__(self, config: SolvingSettings) -> None:
        self._config = config
        self._plane_noise = self._robust(gtsam.noiseModel.Unit.Create(3))

    def edge(self, edge: Edge) -> gtsam.BetweenFactorPose3:
        """Of a motion."""
        motion = edge.motion
        information = motion.information if edge.closure else motion.information + _LOOSE
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(_root(information), False)
        return gtsam.BetweenFactorPose3(
            pose_key(edge.i),
            pose_key(edge.j),
            gtsam.Pose3(inverse(motion.T_ji)),
            self._robust(noise) if edge.robust else noise,
        )

    def planes(self, sightings: Sequence[Sighting]) -> list[gtsam.CustomFactor]:
        """Of seen planes. Raises GraphError for one without a sound covariance."""
        try:
            whites = whitening(np.array([s.plane.covariance for s in sightings]).reshape(-1, 3, 3))
        except np.linalg.LinAlgError as bad:
            unsound = next(s for s in sightings if not _sound(s.plane.covariance))
            name = f"plane {unsound.plane_id} as keyframe {unsound.keyframe} saw it"
            raise GraphError(f"{name} has no sound covariance") from bad
        return [self._plane(sighting, white) for sighting, white in zip(sightings, whites, strict=True)]

    def _plane(self, sighting: Sighting, white: Vector) -> gtsam.CustomFactor:
        keys = pose_key(sighting.keyframe), plane_key(sighting.plane_id)
        return gtsam.CustomFactor(self._plane_noise, list(keys), PlaneError(keys, sighting.plane, white))

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


class PlaneError:
    """The error of a plane landmark in a view, in standard deviations: turns about the view's tangents and the shift
    at its centroid, as in its covariance.

    gtsam's own OrientedPlane3Factor takes the tangents from the predicted plane, where they jump by 90 degrees as the
    normal passes a tie of its two least components, such as the optical axis; with correlated errors that is wrong.
    Nor does it take robust noise models.
    """

    def __init__(self, keys: tuple[int, int], plane: PlaneEstimate, white: Vector) -> None:
        """keys: gtsam's, of the keyframe and of the plane. white: of `whitening` of the plane's covariance."""
        self._keys = keys
        first, second = plane.axes
        self._by_plane = np.empty((3, 4))  # of (n, d) in the camera's frame
        np.matmul(white, np.array([-second, first, -plane.centroid]), out=self._by_plane[:, :3])
        np.negative(white[:, 2], out=self._by_plane[:, 3])
        by_pose = np.empty((3, 3, 6))  # what each component of n adds to the jacobian
        by_pose[:, :, :3] = self._by_plane[:, :3] @ _TURNS
        by_pose[:, :, 3:] = self._by_plane[:, 3, None] * _IDENTITY[:, None]
        self._by_pose = by_pose.reshape(3, 18)

    def __call__(
        self, factor: gtsam.CustomFactor | None, values: gtsam.Values, jacobians: list[Vector] | None
    ) -> Vector:
        """The error [3] at gtsam's values; writes the jacobians [3, 6] and [3, 3] where they are asked for."""
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


def whitening(covariance: Vector) -> Vector:
    """[..., 3, 3] what turns errors of such covariances into standard deviations. Raises LinAlgError where unsound."""
    white: Vector = np.linalg.inv(np.linalg.cholesky(covariance))
    if not np.isfinite(white).all():
        raise np.linalg.LinAlgError
    return white


def _sound(covariance: Vector) -> bool:
    try:
        whitening(covariance)
    except np.linalg.LinAlgError:
        return False
    return True


def _root(information: NDArray[np.floating[Any]]) -> Vector:
    """R with R^T R = information, a symmetric matrix without negative eigenvalues but maybe with zeros."""
    eigenvalues, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T
