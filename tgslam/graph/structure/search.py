"""A keyframe's structure closures, from the candidates to what passes every test."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.graph_settings import ClosureConfig
from tgslam.geometry import inverse
from tgslam.graph.gating import passes
from tgslam.graph.relative import Measurement, measure
from tgslam.graph.structure.candidates import Sightings, candidates, shared_planes
from tgslam.graph.structure.icp import Registration, View

Vector = NDArray[np.float64]
Relative = Callable[[int, int], tuple[Vector, Vector]]  # T_ji [4, 4] of keyframes i, j and its covariance [6, 6]


@dataclass(frozen=True)
class Closure:
    """A motion from an earlier keyframe, measured through planes that both saw."""

    earlier: int
    shared: tuple[int, ...]  # PGIs, ascending
    measured: Measurement


@dataclass(frozen=True)
class Findings:
    """What came of a keyframe's candidates."""

    closures: tuple[Closure, ...]
    inconsistent: int  # whose planes do not agree with each other on a motion
    gated: int  # that do not agree with the graph


class ClosureSearch:
    """Compares every k-th keyframe with earlier ones."""

    def __init__(self, camera: Camera, depth_sigma_per_m2: float, config: ClosureConfig) -> None:
        """depth_sigma_per_m2: the sensor's noise, sigma_z = this * z^2."""
        self._camera, self._sigma, self._config = camera, depth_sigma_per_m2, config

    def find(
        self,
        sightings: Mapping[int, Sightings],
        T_cw: Mapping[int, Vector],
        relative: Relative,
        view: Callable[[int], View],
    ) -> Findings:
        """Closures of the latest keyframe in `sightings`, which holds what every keyframe so far saw.

        T_cw: [4, 4] of each, and `relative` between two of them, as the graph has it (`PoseGraph.relative`). view: a
        keyframe's images, with the PGIs under the ids that they have in `sightings`.
        """
        config, latest = self._config, max(sightings)
        if (len(sightings) - 1) % config.interval:
            return Findings((), 0, 0)
        earlier = {k: seen for k, seen in sightings.items() if k != latest}
        T_ji = {k: T_cw[latest] @ inverse(T_cw[k]) for k in earlier}
        closures, inconsistent, gated = [], 0, 0
        for candidate in candidates(sightings[latest], earlier, T_ji, config):
            i = candidate.keyframe
            shared, pairs = shared_planes(earlier[i], sightings[latest])
            measured = measure(pairs, T_ji[i], config)
            if not measured.consistent(config.gate_probability):
                inconsistent += 1
                continue
            if config.icp_rounds:
                registration = Registration(view(i), view(latest), shared, self._camera, self._sigma, config)
                measured = registration.refine(pairs, measured)
            if passes(measured, *relative(i, latest), config.gate_probability):
                closures.append(Closure(i, shared, measured))
            else:
                gated += 1
        return Findings(tuple(closures), inconsistent, gated)
