"""Agglomeration: what belongs to one plane grows together, the pair that costs least first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.ops.plane_fit import Floats, Indices
from tgslam.planes.segmentation.cells import CellGraph
from tgslam.planes.segmentation.moments import NOISE, Joints, summed

_OVER_MEDIAN = 2.0  # three standard deviations: the median of chi-square of 3 degrees is 2.4, its 99 % quantile 11.3
_LEAST_JOINING = 0.25  # nodes of the edges between mutual partners: fewer only where most costs are equal
_SCATTER = 0x9E3779B1  # odd, 2^32 over the golden ratio: multiples of it are spread out modulo 2^32
_ABSORBED = 4.0  # a set of so many times the points hardly changes by what it takes in


@dataclass(frozen=True)
class Agreement:
    """When one plane may serve two sets of points."""

    sigma: float  # 1/m, standard deviation of inverse depth at a pixel
    sigmas: float  # allowed for the noise of the two fits
    shift_sigmas: float  # allowed beyond it, root mean square over the smaller set: sensors bend planes
    shift_m: float = 0.0  # likewise, of depth: real surfaces are not quite planes
    common: float = 0.0  # 1/m^2, allowed however large the sets are: neighbouring measurements err alike

    @classmethod
    def seen_among(
        cls, cells: CellGraph, squares: CellGraph, sigma: float, sigmas: float, most_shift_sigmas: float
    ) -> Agreement:
        """As much shift as the sensor itself shows, at most `most_shift_sigmas`.

        Most neighbours lie on one surface: how far apart their planes are in the median is the sensor's own error.
        What several pixels have in common shifts cells, but hardly squares of many cells; a real sensor's steps and
        waves shift both, and so they may shift larger sets.
        """
        near = cls._median_shift(cells, sigma, most_shift_sigmas)
        far = min(near, cls._median_shift(squares, sigma, most_shift_sigmas))
        a_cell = float(np.median(cells.moments[:, 0])) if len(cells.moments) else 0.0
        return cls(sigma, sigmas, far, common=(near**2 - far**2) * sigma**2 * a_cell)

    @staticmethod
    def _median_shift(graph: CellGraph, sigma: float, most: float) -> float:
        """Three standard deviations of the shift between neighbours in sigmas; `most` if it is more or not known."""
        if not len(graph.edges):
            return most
        median = float(np.median(graph.joints.cost / graph.joints.fewer))
        return min(_OVER_MEDIAN * float(np.sqrt(median)) / sigma, most)

    def admits(self, joints: Joints) -> NDArray[np.bool_]:
        """Which pairs of sets [E] one plane may serve: those that it costs little enough."""
        count = np.maximum(joints.moments[:, 0], 1.0)
        shift = (self.shift_sigmas * self.sigma) ** 2 + (self.shift_m * (joints.moments[:, 6] / count) ** 2) ** 2
        variance = joints.moments[:, NOISE] / count
        return joints.cost <= self.sigmas**2 * variance + self.common + shift * joints.fewer


def agglomerate(moments: Floats, edges: Indices, agreement: Agreement) -> tuple[Indices, Floats]:
    """Join neighbouring sets of points while they agree, cheapest first; fit anew after every join.

    Each round joins all the pairs that are each other's cheapest partner, which is what a queue of single joins arrives
    at: joining never makes a third set cheaper than it was for both (Ward's criterion is reducible). A set also joins
    its cheapest partner if that is very much larger, so that large planes do not take in their rims one by one.
    moments: [N, 11] of the sets; edges: [E, 2]. Returns the group of each set [N], and the groups' moments [G, 11].
    """
    group = np.arange(len(moments))
    while len(edges):
        partner = _partners(moments, edges, agreement)
        stays = partner == np.arange(len(moments))
        if stays.all():
            break
        number = (np.cumsum(stays) - 1)[_roots(partner)]
        moments = summed(moments, number, int(np.count_nonzero(stays)))
        group, edges = number[group], _distinct(number[edges], len(moments))
    return group, moments


def _partners(moments: Floats, edges: Indices, agreement: Agreement) -> Indices:
    """[N] the set that each one joins, or itself: no circles, for partners are larger, or earlier and stay."""
    size = moments[:, 0]
    first, second = edges.T
    joints = Joints.of(moments, first, second)
    allowed = agreement.admits(joints)
    low, high, cost = first[allowed], second[allowed], joints.cost[allowed]
    least = np.full(len(moments), np.inf)  # cost of the cheapest edge at each set
    np.minimum.at(least, low, cost)
    np.minimum.at(least, high, cost)
    partner = np.arange(len(moments))
    for small, large in ((low, high), (high, low)):
        absorbed = (cost == least[small]) & (size[large] >= _ABSORBED * size[small])
        partner[small[absorbed]] = large[absorbed]
    mutual = np.flatnonzero((cost == least[low]) & (cost == least[high]))
    mutual = mutual[_matching(low[mutual], high[mutual], len(moments))]
    partner[high[mutual]] = low[mutual]
    partner[low[mutual]] = low[mutual]
    return partner


def _matching(low: Indices, high: Indices, nodes: int) -> NDArray[np.bool_]:
    """Which of the edges [E] between mutual partners to join in this round.

    A node has several where costs are equal, and then the later node joins the earlier one. Without noise all costs are
    zero: of a whole plane only the last node would join in a round, for all others are the earlier one somewhere. Then
    those edges are taken that come first at both ends, in an arbitrary order.
    """
    joining = np.zeros(nodes, np.bool_)
    joining[high] = True
    joining[low] = False
    if _LEAST_JOINING * len(low) <= np.count_nonzero(joining):
        return np.ones(len(low), np.bool_)
    order = np.arange(len(low), dtype=np.int64) * _SCATTER % (1 << 32)
    first = np.full(nodes, 1 << 32)
    np.minimum.at(first, low, order)
    np.minimum.at(first, high, order)
    kept: NDArray[np.bool_] = (order == first[low]) & (order == first[high])
    return kept


def _roots(partner: Indices) -> Indices:
    """[N] where each chain of partners ends."""
    while (partner[partner] != partner).any():
        partner = partner[partner]
    return partner


def _distinct(edges: Indices, nodes: int) -> Indices:
    """Each pair of different nodes once, the smaller first."""
    low, high = np.minimum(*edges.T), np.maximum(*edges.T)
    keys = np.sort((low * nodes + high)[low != high])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack(np.divmod(keys, max(nodes, 1)), axis=1)
