"""A motion between two views from whatever measures it, in the directions that this fixes.

The unknown is the left perturbation xi = (rotation rad, translation m) of T_ji. Whatever is free stays at the prior, to
the digit, and gets no information: an edge freezes nothing that nothing has measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from tgslam.config.graph_settings import AcceptanceSettings
from tgslam.geometry import so3_exp
from tgslam.types import RelativePose

Vector = NDArray[np.float64]
Lineariser = Callable[[Vector], "Quadratic"]

_ITERATIONS = 10  # at most: where it converges at all, steps become none before
_SETTLED = 1e-5  # rad and m: a smaller step is none


@dataclass(frozen=True)
class Quadratic:
    """Half a sum of squared residuals near a motion: value / 2 + b . xi + xi . A xi / 2."""

    A: Vector  # [6, 6]
    b: Vector  # [6]
    value: float  # chi-square there
    count: int  # residuals

    def __add__(self, other: Quadratic) -> Quadratic:
        return Quadratic(self.A + other.A, self.b + other.b, self.value + other.value, self.count + other.count)


@dataclass(frozen=True)
class Measurement:
    """A measured motion with what is known of it."""

    T_ji: Vector  # [4, 4]
    directions: Vector  # [R, 6] what was measured of a left perturbation xi: directions @ xi
    variance: Vector  # [R] of each, independent of the others
    chi_square: float  # of the planes' residuals
    freedom: int  # what it should be on average

    @property
    def rank(self) -> int:
        """How many directions were measured."""
        return len(self.directions)

    @property
    def motion(self) -> RelativePose:
        """As an edge for the graph: without information in the free directions."""
        return RelativePose(self.T_ji, (self.directions.T / self.variance) @ self.directions)

    def consistent(self, probability: float) -> bool:
        """Whether the planes agree on one motion: a chi-square test that right matches pass with that probability."""
        return self.freedom == 0 or self.chi_square <= float(chi2.ppf(probability, self.freedom))


def solve(
    linearise: Lineariser, prior_T_ji: Vector, limits: AcceptanceSettings, iterations: int = _ITERATIONS
) -> Measurement:
    """Gauss-Newton over the measured directions: steps have no part in the others."""
    unit, T_ji = _unit(limits), prior_T_ji
    for _ in range(iterations):
        quadratic = linearise(T_ji)
        vectors, information = _measured(quadratic.A, unit)
        step = -unit * (vectors @ ((vectors.T @ (unit * quadratic.b)) / information))
        T_ji = _moved(T_ji, step)
        if np.abs(step).max() < _SETTLED:
            break
    quadratic = linearise(T_ji)
    vectors, information = _measured(quadratic.A, unit)
    freedom = max(quadratic.count - len(information), 0)
    return Measurement(T_ji, vectors.T / unit, 1.0 / information, quadratic.value, freedom)


def information_gain(quadratic: Quadratic, limits: AcceptanceSettings) -> float:
    """How much it says of the motion to one who knows this to the limits: in nats."""
    unit = _unit(limits)
    return 0.5 * float(np.linalg.slogdet(np.eye(6) + quadratic.A * unit[:, None] * unit)[1])


def _moved(T_ji: Vector, step: Vector) -> Vector:
    """Shifted, then turned about camera j: along a line that steps have no part in, the camera stays in its place."""
    moved = T_ji.copy()
    moved[:3, 3] += step[3:]
    moved[:3] = so3_exp(step[:3]) @ moved[:3]
    return moved


def _measured(A: Vector, unit: Vector) -> tuple[Vector, Vector]:
    """Orthonormal directions [6, R], in units of the limits, in which the information A [6, 6] is more than
    those ask; and how much that is [R].
    """
    eigenvalues, vectors = np.linalg.eigh(A * unit[:, None] * unit)
    known = eigenvalues > 1.0
    return vectors[:, known], eigenvalues[known]


def _unit(limits: AcceptanceSettings) -> Vector:
    """[6] the limits `known_rad` and `known_m`."""
    return np.array([limits.known_rad] * 3 + [limits.known_m] * 3)
