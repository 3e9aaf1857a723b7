"""How the pose graph is solved: through gtsam, step by step or all of it anew."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import gtsam

from tgslam.config.graph_settings import SolvingSettings

_ROUNDS = 5  # updates at most of one call, until nothing has to be linearised anew; the next call goes on from there
_MAX_ITERATIONS = 50  # of the batch solver, which mostly ends long before by itself


class Solver(Protocol):
    """How the graph is solved."""

    def update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """Take in new factors and first values of new variables; returns all values."""
        ...

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        """Joint covariance of variables."""
        ...


class Incremental:
    """iSAM2."""

    def __init__(self, threshold: float) -> None:
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = 1
        params.setFactorization("QR")  # the squares of Cholesky's are too much for what is known a little in places
        params.setRelinearizeThreshold(threshold)
        self._isam = gtsam.ISAM2(params)

    def update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """See `Solver.update`."""
        self._isam.update(factors, values)
        for _ in range(_ROUNDS - 1):
            if self._isam.update().getVariablesRelinearized() == 0:
                break
        return self._isam.calculateEstimate()

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        """See `Solver.covariance`."""
        return self._isam.jointMarginalCovariance(list(keys))


class Batch:
    """Levenberg-Marquardt over everything, each time."""

    def __init__(self) -> None:
        self._graph = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()

    def update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """See `Solver.update`."""
        self._graph.push_back(factors)
        self._values.insert(values)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(_MAX_ITERATIONS)
        params.setLinearSolverType("MULTIFRONTAL_QR")
        self._values = gtsam.LevenbergMarquardtOptimizer(self._graph, self._values, params).optimize()
        return gtsam.Values(self._values)

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        """See `Solver.covariance`."""
        return gtsam.Marginals(self._graph, self._values).jointMarginalCovariance(list(keys))


def make_solver(config: SolvingSettings) -> Solver:
    """The one that the config names, empty."""
    return Incremental(config.relinearise) if config.graph_solver == "incremental" else Batch()
