"""A keyframe: its images in compact form, its pose and exposure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.types import Exposure, Frame

_DEPTH_UNIT_M = 0.0002  # TUM's and finer than any RGB-D sensor's: 16 bits reach 13.1 m


@dataclass
class Keyframe:
    """Images are stored as 8 and 16 bits, so that an hour's keyframes fit in memory; the pose is refined in place."""

    index: int  # Frame.index
    timestamp_s: float
    T_cw: NDArray[np.float64]  # [4, 4]
    exposure: Exposure
    information: NDArray[np.float64]  # [6, 6] from tracking
    _colour: NDArray[np.uint8]
    _depth: NDArray[np.uint16]
    seen: dict[int, float] = field(default_factory=dict)  # shares of the map in view by keyframe it was born with
    plane_ids: NDArray[np.int32] | None = None  # [H, W] PGI of each pixel, -1 = none; None = planes are not looked for

    @classmethod
    def from_frame(
        cls, frame: Frame, T_cw: NDArray[np.float64], exposure: Exposure, information: NDArray[np.float64]
    ) -> Keyframe:
        """Keep a frame (its images on the host or on the device) with its tracked pose."""
        colour = np.rint(runtime.to_host(frame.colour) * 255.0).astype(np.uint8)
        limit = np.iinfo(np.uint16).max
        units = np.rint(runtime.to_host(frame.depth_m) / _DEPTH_UNIT_M)
        depth = np.where(units <= limit, units, 0).astype(np.uint16)
        return cls(frame.index, frame.timestamp_s, T_cw, exposure, information, colour, depth)

    def colour(self) -> NDArray[np.float32]:
        """[H, W, 3] RGB in [0, 1]."""
        return self._colour.astype(np.float32) / np.float32(255.0)

    def depth_m(self) -> NDArray[np.float32]:
        """[H, W] m, 0 = none."""
        return self._depth.astype(np.float32) * np.float32(_DEPTH_UNIT_M)
