"""Does a measured motion agree with the graph, in the directions that it has measured?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from tgslam.geometry import inverse, se3_log
from tgslam.relative_motion import Measurement

Vector = NDArray[np.float64]


def innovation_sigmas2(measured: Measurement, T_ji: Vector, covariance: Vector) -> float:
    """Squared Mahalanobis distance of a measurement from the graph's motion [4, 4] with its covariance [6, 6]."""
    error = measured.directions @ se3_log(measured.T_ji @ inverse(T_ji))
    spread = measured.directions @ covariance @ measured.directions.T + np.diag(measured.variance)
    return float(error @ np.linalg.solve(spread, error))


def passes(measured: Measurement, T_ji: Vector, covariance: Vector, probability: float) -> bool:
    """A chi-square test that right measurements pass with that probability; one that says nothing does not."""
    if measured.rank == 0:
        return False
    return innovation_sigmas2(measured, T_ji, covariance) <= float(chi2.ppf(probability, measured.rank))
