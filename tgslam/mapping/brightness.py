"""Brightness of a keyframe relative to the one before, from the surfaces that both see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.geometry import inverse, transform_points
from tgslam.map.keyframe import Keyframe

_STEP_PX = 4  # every n-th pixel and row
_SAME_SURFACE = 0.03  # relative difference of depth
_MIN_PIXELS = 200
_CLIPPED = 0.03, 0.97  # intensities beyond are cut off, or nearly


def relative_gain(keyframe: Keyframe, previous: Keyframe, camera: Camera) -> float | None:
    """By what to multiply the keyframe's intensities to have those of the previous one; None: too little to tell.

    The map cannot tell so well: from nearer than it was refined from, it looks a little darker, since the low-pass
    filter of splats widens them less. Keyframe by keyframe that would add up.
    """
    rows, columns = np.mgrid[_STEP_PX // 2 : camera.height : _STEP_PX, _STEP_PX // 2 : camera.width : _STEP_PX]
    z = keyframe.depth_m()[rows, columns].astype(np.float64)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(z.shape)], -1)
    x = transform_points(previous.T_cw @ inverse(keyframe.T_cw), (rays * z[..., None]).reshape(-1, 3))
    ahead = np.maximum(x[:, 2], 1e-3)
    u = np.rint(camera.fx * x[:, 0] / ahead + camera.cx).astype(int)
    v = np.rint(camera.fy * x[:, 1] / ahead + camera.cy).astype(int)
    inside = (z.ravel() > 0) & (x[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    u, v, ahead = u[inside], v[inside], ahead[inside]
    same = np.abs(previous.depth_m()[v, u] - ahead) < _SAME_SURFACE * ahead
    now = _intensity(keyframe)[rows, columns].ravel()[inside][same]
    before = _intensity(previous)[v[same], u[same]]
    sound = (np.minimum(now, before) > _CLIPPED[0]) & (np.maximum(now, before) < _CLIPPED[1])
    if sound.sum() < _MIN_PIXELS:
        return None
    return float(before[sound].mean() / now[sound].mean())


def _intensity(keyframe: Keyframe) -> NDArray[np.float32]:
    mean: NDArray[np.float32] = keyframe.colour().mean(axis=-1)
    return mean
