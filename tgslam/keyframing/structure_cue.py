"""The structure cue of section 3.1: planes that have drifted in the camera's frame ask for a keyframe."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import PlanesConfig

if TYPE_CHECKING:
    from tgslam.planes.instances.instance import PlanarInstance


class StructureCue:
    """Remembers the planes that the last keyframe saw, as they stood in its camera's frame."""

    def __init__(self, config: PlanesConfig) -> None:
        self._settings = config.expert.cue
        self._normals_w: NDArray[np.float64] = np.zeros((0, 3))
        self._offsets_w: NDArray[np.float64] = np.zeros(0)
        self._T_cw: NDArray[np.float64] = np.eye(4)

    def reset(self, observed: Iterable[PlanarInstance], T_cw: NDArray[np.float64]) -> None:
        """A keyframe at T_cw [4, 4] has seen these PGIs."""
        planes = list(observed)
        self._normals_w = np.array([p.normal_w for p in planes], np.float64).reshape(-1, 3)
        self._offsets_w = np.array([p.offset_m for p in planes], np.float64)
        self._T_cw = T_cw.copy()

    def cue(self, T_cw: NDArray[np.float64]) -> str:
        """Why a frame at T_cw [4, 4] should be a keyframe, with figures for the log; "" if it should not.

        A plane has drifted if angle(n_c^cur, n_c^last) > tau_theta or |d_c^cur - d_c^last| > tau_d, with
        n_c = R_cw n_w and d_c = d_w - n_c . t_cw. The cue fires when more than max(1, tau_ratio N) of N have.
        """
        count = len(self._normals_w)
        if count == 0:
            return ""
        normals, offsets = _in_camera(self._normals_w, self._offsets_w, T_cw)
        last_normals, last_offsets = _in_camera(self._normals_w, self._offsets_w, self._T_cw)
        angles = np.arccos(np.clip(np.sum(normals * last_normals, axis=1), -1.0, 1.0))
        changes = np.abs(offsets - last_offsets)
        turned, shifted = angles > self._settings.cue_angle_rad, changes > self._settings.cue_distance_m
        drifted = int((turned | shifted).sum())
        if drifted <= max(1.0, self._settings.cue_ratio * count):
            return ""
        return (
            f"structure: {drifted} of {count} planes drifted, {int(turned.sum())} in angle (up to "
            f"{np.rad2deg(angles.max()):.1f} deg), {int(shifted.sum())} in distance (up to {changes.max():.2f} m)"
        )


def _in_camera(
    normals_w: NDArray[np.float64], offsets_w: NDArray[np.float64], T_cw: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World planes [N, 3], [N] in the camera's frame."""
    normals = normals_w @ T_cw[:3, :3].T
    return normals, offsets_w - normals @ T_cw[:3, 3]
