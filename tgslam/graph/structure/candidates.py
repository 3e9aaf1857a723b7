"""Which earlier keyframes a keyframe is compared with: those that see the same planes, wherever and whenever."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.config.graph_settings import ClosureConfig
from tgslam.graph.relative import PlanePairs, of_planes
from tgslam.planes.estimate import PlaneEstimate, stacked
from tgslam.relative_motion import information_gain

Vector = NDArray[np.float64]
Sightings = Mapping[int, PlaneEstimate]  # PGI -> the plane as a keyframe saw it, in its camera's frame


@dataclass(frozen=True)
class Candidate:
    """An earlier keyframe with what it shares."""

    keyframe: int
    shared: tuple[int, ...]  # PGIs, ascending
    gain: float  # nats, of the planes' information on the motion; the more directions are fixed, the more


def candidates(
    seen: Sightings, earlier: Mapping[int, Sightings], T_ji: Mapping[int, Vector], config: ClosureConfig
) -> list[Candidate]:
    """At most `max_edges` earlier keyframes, oldest first, for a keyframe that saw the planes `seen`.

    earlier: what each keyframe before it saw; the latest `closure_gap` of them count as its neighbours. T_ji: [4, 4]
    from each of them to this one, as the graph has it; it decides on strength only. Of those that share two planes that
    are not parallel, the strongest of each of `max_edges` equally populated spans of age is taken.
    """
    possible = []
    for other in sorted(earlier)[: -config.closure_gap]:
        found = _candidate(other, seen, earlier[other], T_ji[other], config)
        possible += [found] if found is not None else []
    spans = np.array_split(np.arange(len(possible)), config.expert.edges.max_edges)
    return [max((possible[i] for i in span), key=lambda c: c.gain) for span in spans if len(span)]


def shared_planes(in_i: Sightings, in_j: Sightings) -> tuple[tuple[int, ...], PlanePairs]:
    """PGIs that both saw, ascending, and how."""
    shared = tuple(sorted(in_i.keys() & in_j.keys()))
    return shared, PlanePairs(stacked([in_i[k] for k in shared]), stacked([in_j[k] for k in shared]))


def _candidate(
    keyframe: int, in_j: Sightings, in_i: Sightings, T_ji: Vector, config: ClosureConfig
) -> Candidate | None:
    """None where the planes that are shared are fewer than two, or all parallel."""
    if len(in_i.keys() & in_j.keys()) < 2:
        return None
    shared, pairs = shared_planes(in_i, in_j)
    normals = pairs.in_j.normal
    sines = np.linalg.norm(np.cross(normals[:, None], normals[None]), axis=-1)
    if sines.max() < np.sin(config.expert.edges.min_angle_rad):
        return None
    return Candidate(keyframe, shared, information_gain(of_planes(pairs, T_ji), config.expert.acceptance))
