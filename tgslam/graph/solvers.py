"""How the pose graph is solved: through gtsam, step by step or all of it anew."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import gtsam
import numpy as np

from tgslam.config.graph_settings import SolvingSettings

_ROUNDS = 5  # updates at most of one call, until nothing has to be linearised anew; the next call goes on from there
_MAX_ITERATIONS = 50  # of the batch solver, which mostly ends long before by itself


@dataclass
class Change:
    """What is new in a graph and what is gone, since a solver was told last."""

    factors: dict[Hashable, gtsam.NonlinearFactor] = field(default_factory=dict)  # by names
    values: gtsam.Values = field(default_factory=gtsam.Values)  # first values of new variables
    gone: set[Hashable] = field(default_factory=set)  # names of factors; they go before the new ones come

    def add(self, name: Hashable, factor: gtsam.NonlinearFactor) -> None:
        """A factor, in the place of one of the same name that has been added since."""
        self.factors[name] = factor

    def remove(self, name: Hashable) -> None:
        """A factor that there is, be it new or not."""
        if self.factors.pop(name, None) is None:
            self.gone.add(name)


class Solver(Protocol):
    """How the graph is solved."""

    def update(self, change: Change) -> gtsam.Values:
        """Take in a change; returns all values."""
        ...

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        """Joint covariance of variables."""
        ...


class Incremental:
    """iSAM2. Variables that no factor is left of go by themselves."""

    def __init__(self, threshold: float, *, careful: bool) -> None:
        """careful: QR in place of Cholesky, whose squares may be too much for what is known a little in places.

        It then fails, and says so. QR takes up to four times as long.
        """
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        params.setFactorization("QR" if careful else "CHOLESKY")
        params.setRelinearizeThreshold(threshold)
        self._threshold = threshold
        self._isam = gtsam.ISAM2(params)
        self._slots: dict[Hashable, int] = {}  # of the factors, by their names

    def update(self, change: Change) -> gtsam.Values:
        """See `Solver.update`."""
        gone = [self._slots.pop(name) for name in change.gone]
        result = self._isam.update(_graph(change.factors.values()), change.values, gone)
        self._slots.update(zip(change.factors, result.getNewFactorsIndices(), strict=True))
        estimate = self._isam.calculateEstimate()
        for _ in range(_ROUNDS - 1):
            if not self._has_moved(estimate):
                break
            self._isam.update()
            estimate = self._isam.calculateEstimate()
        return estimate

    def _has_moved(self, estimate: gtsam.Values) -> bool:
        """Whether a keyframe is no longer where it was linearised. Planes alone wait for the next call."""
        there = gtsam.utilities.extractPose3(self._isam.getLinearizationPoint())
        return bool(np.abs(gtsam.utilities.extractPose3(estimate) - there).max(initial=0.0) > self._threshold)

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        """See `Solver.covariance`."""
        return self._isam.jointMarginalCovariance(list(keys))


class Batch:
    """Levenberg-Marquardt over everything, each time."""

    def __init__(self) -> None:
        self._factors: dict[Hashable, gtsam.NonlinearFactor] = {}
        self._values = gtsam.Values()

    def update(self, change: Change) -> gtsam.Values:
        """See `Solver.update`."""
        for name in change.gone:
            del self._factors[name]
        self._factors.update(change.factors)
        self._values.insert(change.values)
        graph = _graph(self._factors.values())
        for key in set(self._values.keys()) - set(graph.keyVector()):
            self._values.erase(key)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(_MAX_ITERATIONS)
        params.setLinearSolverType("MULTIFRONTAL_QR")
        self._values = gtsam.LevenbergMarquardtOptimizer(graph, self._values, params).optimize()
        return gtsam.Values(self._values)

    def covariance(self, keys: Sequence[int]) -> gtsam.JointMarginal:
        """See `Solver.covariance`."""
        return gtsam.Marginals(_graph(self._factors.values()), self._values).jointMarginalCovariance(list(keys))


def make_solver(config: SolvingSettings, *, careful: bool = False) -> Solver:
    """The one that the config names, empty. careful: for a graph that another one has taken for singular."""
    return Incremental(config.relinearise, careful=careful) if config.graph_solver == "incremental" else Batch()


def _graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph
