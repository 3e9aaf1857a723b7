"""Where else a frame may have been taken, and which of the places it was aligned at is the right one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tgslam.map.world import Map
from tgslam.recognition.verification import Look
from tgslam.tracking.doubt import misfit
from tgslam.tracking.result import TrackingResult
from tgslam.types import Matrix4

_LATEST = 3  # keyframes that a frame is most likely to share features with
_ALIKE = 4  # of all keyframes, those that a lost frame resembles most
_BETTER = 0.95  # times the misfit that another place has to have: places without texture fit alike


def recognised(look: Look, world: Map, *, anywhere: bool) -> Iterator[Matrix4]:
    """T_cw [4, 4] by the features that a frame shares with keyframes: with one of the latest, else of those alike.

    anywhere: all keyframes count, since the camera may have been carried; else only the latest do.
    """
    count = len(world.keyframes)
    latest = range(count - 1, max(count - 1 - _LATEST, -1), -1)
    alike = np.argsort(-world.looks.scores(look), kind="stable")[:_ALIKE].tolist() if anywhere else []
    for number in dict.fromkeys([*latest, *alike]):
        T_ji = world.looks.motion(number, look)
        if T_ji is not None:
            yield T_ji @ world.keyframes[number].T_cw
            return


def best(first: TrackingResult, others: Sequence[TrackingResult]) -> TrackingResult:
    """The place that fits best, of those where the frame is not lost; the first one where none fits clearly better."""
    sound = [other for other in others if not other.lost]
    if not sound:
        return first
    rival = min(sound, key=misfit)
    return rival if first.lost or misfit(rival) < _BETTER * misfit(first) else first
