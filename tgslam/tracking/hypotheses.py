"""Where else a frame may have been taken: the places where it is recognised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from tgslam.geometry import inverse, se3_log
from tgslam.map.world import Map
from tgslam.recognition.verification import Look
from tgslam.types import Matrix4

_LATEST = 3  # keyframes that a frame is most likely to share features with
_ALIKE = 4  # of all keyframes, those that a lost frame resembles most
_AGREEMENT = 0.999  # probability with which a right pose agrees with a right place


class Sighted(NamedTuple):
    """A frame by its look, and where it was taken."""

    look: Look
    T_cw: Matrix4  # [4, 4]


class Place(NamedTuple):
    """Where a frame was taken by the features that it shares with another view."""

    T_cw: Matrix4  # [4, 4]
    information: NDArray[np.float64]  # [6, 6] of its left perturbation

    def agrees(self, T_cw: Matrix4) -> bool:
        """Whether a pose [4, 4] is this one, but for what features may be off by."""
        error = se3_log(T_cw @ inverse(self.T_cw))
        return float(error @ self.information @ error) <= float(chi2.ppf(_AGREEMENT, 6))


def recognised(look: Look, world: Map, previous: Sighted | None, *, anywhere: bool) -> Place | None:
    """By features that a frame shares with the previous one, else with one of the latest keyframes or of those alike.

    previous: None where its pose is not known. anywhere: all keyframes count, since the camera may have been carried;
    else only the latest do.
    """
    views = [previous] if previous is not None else []
    count = len(world.keyframes)
    latest = range(count - 1, max(count - 1 - _LATEST, -1), -1)
    alike = np.argsort(-world.looks.scores(look), kind="stable")[:_ALIKE].tolist() if anywhere else []
    views += [Sighted(world.looks[k], world.keyframes[k].T_cw) for k in dict.fromkeys([*latest, *alike])]
    for view in views:
        same = world.looks.verification.compare(view.look, look)
        if same is not None:
            motion = same.measured.motion
            return Place(motion.T_ji @ view.T_cw, motion.information)
    return None
