"""The named scenes: what stands in them and how the camera goes through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tgslam.errors import ConfigError
from tgslam.synthetic import corridor, paths, rooms
from tgslam.synthetic.paths import CameraPath
from tgslam.synthetic.scene import Scene

FRAME_RATE_HZ = 30.0  # as depth cameras have


@dataclass(frozen=True)
class SceneSpec:
    """A scene and its path, both for a sequence of a given duration in s."""

    about: str
    build: Callable[[float], tuple[Scene, CameraPath]]
    period_s: float | None  # after which the path repeats; None = it never does

    @property
    def period_frames(self) -> int | None:
        """Frames after which the camera is back at its first pose."""
        return None if self.period_s is None else round(self.period_s * FRAME_RATE_HZ)


def _periodic(
    about: str, build: Callable[[], Scene], path: Callable[[float], CameraPath], period_s: float
) -> SceneSpec:
    return SceneSpec(about, lambda duration_s: (build(), path(period_s)), period_s)


def _room_path(period_s: float) -> CameraPath:
    return paths.oval(period_s, (-0.1, -0.25), (0.75, 0.6), 1.45, 0.35, pitch_rad=-0.22, first_angle_rad=3.6)


def _loop_path(period_s: float) -> CameraPath:
    # Ahead and outwards: 55 degrees to the right of the way it goes.
    return paths.oval(period_s, (0.0, 0.0), (1.25, 1.0), 1.4, np.pi / 2 - 0.96, wander_rad=0.06, pitch_rad=-0.2)


def _blank_path(period_s: float) -> CameraPath:
    return paths.oval(period_s, (0.0, -0.2), (0.6, 0.5), 1.4, 0.2, pitch_rad=-0.25, first_angle_rad=3.4)


def _turn_path(period_s: float) -> CameraPath:
    return paths.oval(period_s, (0.0, -0.3), (0.12, 0.12), 1.4, 0.6, wander_rad=0.03, pitch_rad=-0.2)


def _desk_path(period_s: float) -> CameraPath:
    # Round the partition, looking inwards at it.
    return paths.oval(
        period_s, (0.0, 0.0), (1.9, 1.65), 1.5, np.pi / 2, wander_rad=0.05, pitch_rad=-0.38, first_angle_rad=-np.pi / 2
    )


def _corridor(duration_s: float) -> tuple[Scene, CameraPath]:
    length_m = max(corridor.SPEED_M_S * duration_s, 40.0)
    line = corridor.centre_line(length_m)
    return corridor.corridor(length_m), paths.walk(line, corridor.SPEED_M_S, 1.45)


SCENES: dict[str, SceneSpec] = {
    "room": _periodic(
        "a living room with one blank wall; the camera sweeps round it", rooms.living_room, _room_path, 24.0
    ),
    "loop": _periodic("once round a room, back to the first pose", rooms.loop_room, _loop_path, 14.0),
    "corridor": SceneSpec("doors and blank walls that repeat; no place is seen twice", _corridor, None),
    "blank": _periodic("a room with hardly any texture", rooms.blank_room, _blank_path, 24.0),
    "desk": _periodic("two coplanar desk tops and both sides of a thin partition", rooms.office, _desk_path, 22.0),
    "turn": _periodic("turning on the spot in the living room", rooms.living_room, _turn_path, 11.0),
}


def scene_spec(name: str) -> SceneSpec:
    """The scene of that name. Raises ConfigError that lists the names."""
    if name not in SCENES:
        raise ConfigError(f"synthetic.scene: there is no scene {name!r}; choose one of {', '.join(SCENES)}")
    return SCENES[name]
