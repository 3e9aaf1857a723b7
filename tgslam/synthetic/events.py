"""What may befall a sequence: light, a covered lens, lost time, a camera that is carried off, a thing that moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import so3_exp, transform_points
from tgslam.kernels.procedural import BOOKS
from tgslam.synthetic.paths import CameraPath
from tgslam.synthetic.scene import Material, Scene, SceneBuilder
from tgslam.types import FloatImage, Matrix4

_STEPS = (1.0, 0.6, 0.85)  # gain in each third of the sequence
_WHITE_BALANCE = (0.7, 1.0, 1.35)  # gain of red, green and blue in the second half
_COVERED_S, _SLIDING_S = 1.0, 0.15  # how long a hand covers the lens, and takes to get there
_HAND_M, _HAND_RGB = 0.45, (0.03, 0.02, 0.02)  # as near as the sensor sees at all, and dark
_LOST_S = 1.0
_BESIDE_M, _BESIDE_RAD = (0.10, -0.05, 0.0), (0.0, 0.06, 0.03)  # where a carried camera goes on, from where it was
_LOWER_M, _AWAY_RAD = 0.3, 2.2  # where it has not been: turned about the vertical
_AWAY, _BACK = 0.33, (0.58, 0.95)  # of the sequence: when it is carried off, and when it turns back
_BOX_M, _BOX_AHEAD_M, _BOX_WAY_M = 0.45, 1.5, 3.6  # its size, and how it crosses the view at half time
_CROSSING = 0.6  # of the sequence
_BOX = Material(BOOKS, (0.75, 0.40, 0.30), (0.22, 0.34, 0.45), 0.06, 1.0, 0.0, 41)


@dataclass(frozen=True)
class Event:
    """What is unusual about a sequence, by its own time in s: frame number / frame rate."""

    path: CameraPath  # where the camera is, whatever happens to it
    gain: Callable[[float], tuple[float, float, float]] = lambda time_s: (1.0, 1.0, 1.0)  # of the colours
    covered: Callable[[float], float] = lambda time_s: 0.0  # share of the image, from its left, that a hand covers
    late_s: Callable[[float], float] = lambda time_s: 0.0  # by which timestamps are later
    box_w: Callable[[float], NDArray[np.float64]] | None = None  # [3] m, world: where a box is that moves

    def seen(self, scene: Scene, time_s: float) -> Scene:
        """The scene at that time, if it was made with `furnished`."""
        if self.box_w is None:
            return scene
        return replace(scene, centre_w=np.vstack([scene.centre_w[:-1], self.box_w(time_s)]))

    def furnished(self, scene: Scene) -> Scene:
        """The scene with what moves in it, as its last primitive."""
        return scene if self.box_w is None else _with_box(scene)

    def shown(self, colour: FloatImage, depth_m: FloatImage, time_s: float) -> tuple[FloatImage, FloatImage]:
        """Colour [H, W, 3] and depth [H, W] as the camera gives them at that time, but for noise."""
        colour = np.clip(colour * np.array(self.gain(time_s), np.float32), 0.0, 1.0)
        columns = round(self.covered(time_s) * colour.shape[1])
        if columns:
            colour, depth_m = colour.copy(), depth_m.copy()
            colour[:, :columns], depth_m[:, :columns] = _HAND_RGB, _HAND_M
        return colour, depth_m


def _none(path: CameraPath, duration_s: float) -> Event:
    return Event(path)


def _exposure_step(path: CameraPath, duration_s: float) -> Event:
    return Event(path, gain=lambda time_s: (_STEPS[min(int(3.0 * time_s / duration_s), 2)],) * 3)


def _white_balance(path: CameraPath, duration_s: float) -> Event:
    return Event(path, gain=lambda time_s: _WHITE_BALANCE if time_s >= duration_s / 2 else (1.0, 1.0, 1.0))


def _cover(path: CameraPath, duration_s: float) -> Event:
    def covered(time_s: float) -> float:
        until_s = abs(time_s - duration_s / 2) - _COVERED_S / 2
        return float(np.clip(1.0 - until_s / _SLIDING_S, 0.0, 1.0))

    return Event(path, covered=covered)


def _gap(path: CameraPath, duration_s: float) -> Event:
    def late_s(time_s: float) -> float:
        return _LOST_S if time_s >= duration_s / 2 else 0.0

    return Event(lambda time_s: path(time_s + late_s(time_s)), late_s=late_s)


def _kidnap_known(path: CameraPath, duration_s: float) -> Event:
    """Carried at two thirds of the time to beside where it was at first."""
    at_s, beside = 2.0 * duration_s / 3.0, np.eye(4)
    beside[:3, :3], beside[:3, 3] = so3_exp(_BESIDE_RAD), _BESIDE_M
    return Event(lambda time_s: path(time_s) if time_s < at_s else path(time_s - at_s) @ beside)


def _kidnap_unknown(path: CameraPath, duration_s: float) -> Event:
    """Carried to where it sees nothing that it has seen; in the end it turns back to that, the way that it came."""
    at_s = _AWAY * duration_s

    def carried(time_s: float) -> Matrix4:
        if time_s < at_s:
            return path(time_s)
        T_wc = path(at_s - (time_s - at_s) / 2.0).copy()
        away = float(np.clip((_BACK[1] - time_s / duration_s) / (_BACK[1] - _BACK[0]), 0.0, 1.0))
        T_wc[:3, :3] = so3_exp((0.0, 0.0, _AWAY_RAD * away)) @ T_wc[:3, :3]
        T_wc[2, 3] -= _LOWER_M * away
        return T_wc

    return Event(carried)


def _moving_box(path: CameraPath, duration_s: float) -> Event:
    """A box crosses the view from left to right, and is out of it at first and in the end."""
    middle_s, speed_m_s = duration_s / 2, _BOX_WAY_M / (_CROSSING * duration_s)

    def box_w(time_s: float) -> NDArray[np.float64]:
        return transform_points(path(middle_s), (speed_m_s * (time_s - middle_s), 0.1, _BOX_AHEAD_M))

    return Event(path, box_w=box_w)


def _with_box(scene: Scene) -> Scene:
    """On no plane of the scene's."""
    builder = SceneBuilder()
    builder.box((0.0, 0.0, 0.0), (_BOX_M,) * 3, _BOX, 0.4)
    box = builder.build(occlusion=False)
    meta = np.array([[box.meta[0, 0], len(scene.material), -1, box.meta[0, 3]]], np.int32)
    return replace(
        scene,
        meta=np.concatenate([scene.meta, meta]),
        axes_w=np.concatenate([scene.axes_w, box.axes_w]),
        centre_w=np.concatenate([scene.centre_w, box.centre_w]),
        half_m=np.concatenate([scene.half_m, box.half_m]),
        radius_m=np.concatenate([scene.radius_m, box.radius_m]),
        material_kind=np.concatenate([scene.material_kind, box.material_kind]),
        material=np.concatenate([scene.material, box.material]),
    )


_EVENTS: dict[str, Callable[[CameraPath, float], Event]] = {
    "none": _none,
    "exposure_step": _exposure_step,
    "white_balance": _white_balance,
    "cover": _cover,
    "gap": _gap,
    "kidnap_known": _kidnap_known,
    "kidnap_unknown": _kidnap_unknown,
    "moving_box": _moving_box,
}


def event(name: str, path: CameraPath, duration_s: float) -> Event:
    """What happens to a camera that would follow a path for so long; the names are `synthetic.event`'s."""
    return _EVENTS[name](path, duration_s)
