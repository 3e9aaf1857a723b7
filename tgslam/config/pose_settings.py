"""Settings of poses that are known beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.config.setting import setting


@dataclass(frozen=True)
class PosesConfig:
    """Poses of frames that are known: of motion capture, a phone, another program."""

    use: str = setting(
        "none",
        choices=("none", "fixed", "prior"),
        doc="fixed: the camera is where they say, and only the map is built. prior: tracking starts from them, and "
        "weighs them by the deviations below. none: they are not looked at.",
    )
    file: str = setting("", doc="File of poses, camera to world; `recording`: those that came with the frames.")
    sigma_m: float = setting(
        0.05, 1e-5, 100.0, doc="Standard deviation of each coordinate of a known place in m, with use: prior."
    )
    sigma_rad: float = setting(
        0.02, 1e-5, 10.0, doc="Standard deviation of a known attitude about each axis in rad, with use: prior."
    )

    @property
    def information(self) -> NDArray[np.float64]:
        """[6, 6] of a left perturbation of a known T_cw (rotation rad, translation m)."""
        return np.diag([self.sigma_rad**-2] * 3 + [self.sigma_m**-2] * 3)
