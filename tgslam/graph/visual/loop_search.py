"""Visual loop closure: a keyframe is recognised among all earlier ones by how it looks, and verified by geometry.

Unlike structure closures these are meant to correct drift that the graph does not know of, so that the graph's own
belief cannot be what decides. Evidence within the images does: many features on one motion, depth images that fit
together, and a second earlier keyframe that on its own leads to the same place. The graph rules out only what no drift
explains, such as the next of a corridor's equal doors in place of the one just passed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.config.graph_settings import LoopConfig
from tgslam.geometry import inverse, se3_log
from tgslam.graph.findings import Closure, Findings, Relative
from tgslam.graph.gating import passes
from tgslam.recognition.looks import Looks
from tgslam.recognition.verification import Sameness

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class _Verified:
    """An earlier keyframe whose place the present one shows."""

    keyframe: int
    same: Sameness


class LoopSearch:
    """Compares each keyframe with the earlier ones that look most alike."""

    def __init__(self, config: LoopConfig) -> None:
        self._config = config

    def find(
        self,
        looks: Looks,
        T_cw: Mapping[int, Vector],
        relative: Relative,
        apart: NDArray[np.bool_] | None = None,
    ) -> Findings:
        """At most one closure of the latest keyframe, the last one of `looks`.

        T_cw: [4, 4] of each keyframe so far, and `relative` between two of them, as the graph has it
        (`PoseGraph.relative`). apart: [K] those of which the graph does not know where they are from the latest one;
        None = it does of all.
        """
        latest = len(looks) - 1
        apart = np.zeros(latest + 1, bool) if apart is None else apart
        best, unconfirmed = self._recognised(looks, self._alike(looks.scores(looks[latest]), apart), T_cw)
        if best is None:
            return Findings((), unconfirmed, gated=0)
        measured = looks.verification.refined(best.same, looks[best.keyframe], looks[latest])
        if apart[best.keyframe]:
            return Findings((Closure(best.keyframe, (), measured),), unconfirmed, gated=0)
        T_ji, covariance = relative(best.keyframe, latest)
        drift = self._config.expert.confirmation.understated**2 * covariance
        if not passes(measured, T_ji, drift, self._config.expert.acceptance.gate_probability):
            return Findings((), unconfirmed, gated=1)
        return Findings((Closure(best.keyframe, (), measured),), unconfirmed, gated=0)

    def _alike(self, scores: Vector, apart: NDArray[np.bool_]) -> list[int]:
        """The most alike of the earlier keyframes that are no neighbours, best first; of equal ones the oldest."""
        neighbours = np.arange(len(scores)) >= len(scores) - 1 - self._config.loop_gap
        candidates = np.where(neighbours & ~apart, 0.0, scores)
        best = np.argsort(-candidates, kind="stable")[: self._config.candidates]
        return [int(keyframe) for keyframe in best if candidates[keyframe] > 0.0]

    def _recognised(
        self, looks: Looks, keyframes: list[int], T_cw: Mapping[int, Vector]
    ) -> tuple[_Verified | None, int]:
        """The better of the first two that confirm each other, and how many were verified and not confirmed."""
        verified: list[_Verified] = []
        for keyframe in keyframes:
            same = looks.verification.compare(looks[keyframe], looks[len(looks) - 1])
            if same is None:
                continue
            found = _Verified(keyframe, same)
            partner = next((other for other in verified if self._confirms(other, found, T_cw)), None)
            if partner is not None:
                return max(partner, found, key=lambda each: each.same.inliers), len(verified) - 1
            verified.append(found)
        return None, len(verified)

    def _confirms(self, other: _Verified, one: _Verified, T_cw: Mapping[int, Vector]) -> bool:
        """Whether two earlier keyframes, near to each other, see the present one at the same place."""
        limits = self._config.expert.confirmation
        if abs(other.keyframe - one.keyframe) > limits.partner_gap:
            return False
        between = T_cw[other.keyframe] @ inverse(T_cw[one.keyframe])
        error = se3_log(other.same.measured.T_ji @ between @ inverse(one.same.measured.T_ji))
        turn, shift = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
        return bool(turn <= limits.partner_rad and shift <= limits.partner_m)
