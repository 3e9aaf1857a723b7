"""A keyframe's structure closures, from the candidates to what passes every test."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.graph_settings import ClosureConfig
from tgslam.geometry import inverse
from tgslam.graph.findings import Closure, Findings, Relative
from tgslam.graph.gating import passes
from tgslam.graph.relative import measure
from tgslam.graph.structure.candidates import Sightings, candidates, shared_planes
from tgslam.graph.structure.icp import Registration, View

Vector = NDArray[np.float64]


class ClosureSearch:
    """Compares every k-th keyframe with earlier ones."""

    def __init__(self, camera: Camera, noise: SensorNoise, config: ClosureConfig) -> None:
        self._camera, self._noise, self._config = camera, noise, config

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
        icp, acceptance = config.expert.icp, config.expert.acceptance
        if (len(sightings) - 1) % config.interval:
            return Findings((), 0, 0)
        earlier = {k: seen for k, seen in sightings.items() if k != latest}
        T_ji = {k: T_cw[latest] @ inverse(T_cw[k]) for k in earlier}
        closures, inconsistent, gated = [], 0, 0
        for candidate in candidates(sightings[latest], earlier, T_ji, config):
            i = candidate.keyframe
            shared, pairs = shared_planes(earlier[i], sightings[latest])
            measured = measure(pairs, T_ji[i], acceptance)
            if not measured.consistent(acceptance.gate_probability):
                inconsistent += 1
                continue
            if icp.icp_rounds:
                views = view(i), view(latest)
                registration = Registration(views, shared, self._camera, self._noise, icp, acceptance)
                measured = registration.refine(pairs, measured)
            if passes(measured, *relative(i, latest), acceptance.gate_probability):
                closures.append(Closure(i, shared, measured))
            else:
                gated += 1
        return Findings(tuple(closures), inconsistent, gated)
