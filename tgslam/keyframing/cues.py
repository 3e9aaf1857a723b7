"""The cues of section 3.1 together: whether a tracked frame becomes a keyframe."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import PlanesConfig
from tgslam.config.tracking_settings import KeyframeConfig
from tgslam.keyframing.covisibility import KeyframeSelector
from tgslam.keyframing.structure_cue import StructureCue
from tgslam.types import Frame, Matrix4

if TYPE_CHECKING:
    from tgslam.planes.instances.instance import PlanarInstance


class Cues:
    """Co-visibility and baseline first, then structure."""

    def __init__(self, keyframes: KeyframeConfig, planes: PlanesConfig) -> None:
        self._appearance, self._structure = KeyframeSelector(keyframes), StructureCue(planes)

    def ask(self, frame: Frame, T_cw: Matrix4, seen: NDArray[np.bool_], overlap: float) -> str:
        """Why the frame, tracked at T_cw [4, 4], should be a keyframe, "" if it should not.

        seen: [N] Gaussians in its view. overlap: share of its pixels with depth that meet the map.
        """
        return self._appearance.cue(frame, T_cw, seen, 1.0 - overlap) or self._structure.cue(T_cw)

    def reset(self, frame: Frame, T_cw: Matrix4, seen: NDArray[np.bool_], planes: Iterable[PlanarInstance]) -> None:
        """The frame has become a keyframe at T_cw [4, 4]; it sees these Gaussians [N] of the map as it is now."""
        self._appearance.reset(frame, T_cw, seen)
        self._structure.reset(planes, T_cw)
