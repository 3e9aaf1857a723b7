"""Plain data shared by every layer: frame, trajectory, Gaussians, plane. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
Matrix4 = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """One RGB-D image pair. It carries no pose: ground truth stays out of the system's reach.

    Programs may hand over what their sensor gives, 8-bit colour and 16-bit depth with its scale; the system turns it
    into float32, and checks it, once (`preparation`).
    """

    index: int  # position in the sequence
    timestamp_s: float
    colour: NDArray[Any]  # [H, W, 3] RGB, sRGB as stored: float in [0, 1], or uint8
    depth_m: NDArray[Any]  # [H, W] z, 0 or not finite = no measurement: float, or uint16 with a scale
    depth_scale: float = 1.0  # units of `depth_m` in a metre: 1000 for millimetres


@dataclass(frozen=True)
class Exposure:
    """map intensity = gain * frame intensity + bias; of a channel, gain * balance of it."""

    gain: float = 1.0
    bias: float = 0.0
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of red, green and blue: of a keyframe's image alone

    def balanced(self, colour: FloatImage) -> FloatImage:
        """The colours [..., 3] by the map's white balance."""
        if self.balance == (1.0, 1.0, 1.0):
            return colour
        return colour * np.array(self.balance, np.float32)

    def relative_to(self, other: Exposure) -> Exposure:
        """That of the same frame against another frame's image, whose exposure is `other`."""
        return Exposure(self.gain / other.gain, (self.bias - other.bias) / other.gain)


@dataclass(frozen=True)
class Trajectory:
    """Camera-to-world poses at increasing times."""

    timestamps_s: NDArray[np.float64]  # [N]
    T_wc: NDArray[np.float64]  # [N, 4, 4]

    def __len__(self) -> int:
        return len(self.timestamps_s)


@dataclass(frozen=True)
class Gaussians:
    """The map's Gaussians as host arrays, one row each (activated values are what `render` uses)."""

    mean: NDArray[np.float32]  # [N, 3] m, world
    log_scale: NDArray[np.float32]  # [N, 3] log of the standard deviation in m along the local axes
    quat_wxyz: NDArray[np.float32]  # [N, 4] local to world; any length but zero
    opacity_logit: NDArray[np.float32]  # [N]
    colour: NDArray[np.float32]  # [N, 3] RGB (SH degree 0 only, stored as the colour itself)
    embedding: NDArray[np.float32]  # [N, 3] plane-instance embedding theta, Eq. 1
    plane_id: NDArray[np.int32]  # [N] -1 = on no plane
    birth_keyframe: NDArray[np.int32]  # [N] index into the keyframes

    def __len__(self) -> int:
        return len(self.mean)


@dataclass(frozen=True)
class Plane:
    """A persistent plane of the world (a PGI): n . x + d = 0, n towards the side that it was seen from."""

    id: int
    normal_w: NDArray[np.float64]  # [3] unit
    offset_m: float  # d
    centroid_w: NDArray[np.float64]  # [3] m, on the plane, where it is known best
    covariance: NDArray[np.float64]  # [3, 3] of (rad, rad, m): turns about its tangents, shift at the centroid
    colour: tuple[float, float, float]  # RGB in [0, 1], of Eq. 2
    polygons_w: tuple[NDArray[np.float64], ...]  # outlines [V, 3] m, largest first, counter-clockwise from the front
    area_m2: float  # of everything seen of it
    inlier_rms_m: float  # distance of its points from it
    keyframes: tuple[int, ...]  # that saw it, ascending


@dataclass(frozen=True)
class RelativePose:
    """What was measured of the motion from a keyframe i to a keyframe j."""

    T_ji: Matrix4  # [4, 4] maps i to j
    information: NDArray[np.float64]  # [6, 6] of its left perturbation (rotation rad, translation m), in frame j

    def widened(self, sigma_rad: float, sigma_m: float) -> RelativePose:
        """With independent errors added about and along each axis; the information may be singular, and stays so."""
        limit = np.diag([sigma_rad**-2] * 3 + [sigma_m**-2] * 3)
        information = limit @ np.linalg.solve(self.information + limit, self.information)
        return RelativePose(self.T_ji, 0.5 * (information + information.T))


@dataclass(frozen=True)
class Rendering:
    """What the map looks like from one pose, as host arrays."""

    colour: FloatImage  # [H, W, 3] RGB over black
    depth_m: FloatImage  # [H, W] expected depth, divided by opacity; 0 where opacity < 0.5
    opacity: FloatImage  # [H, W] accumulated alpha in [0, 1]


class FrameStatus(Enum):
    """What became of a frame."""

    INITIAL = "initial"  # the first one: it defines the world frame
    TRACKED = "tracked"
    APART = "apart"  # tracked in a piece of the map that was not tied to the first one yet
    LOST = "lost"  # pose coasted on the motion model
    SKIPPED = "skipped"  # unusable image; it has no pose


@dataclass(frozen=True)
class FrameReport:
    """One line of log.jsonl: what `Slam.process_frame` did with a frame."""

    index: int
    timestamp_s: float
    status: FrameStatus
    is_keyframe: bool
    gaussians: int  # in the map, after the frame
    stage_s: dict[str, float]  # seconds spent by stage: "track", "map", ...
    measures: dict[str, float]  # residuals, inlier ratio, condition number, gain, bias, iterations
    message: str = ""  # why it was skipped or lost, or became a keyframe
    closures: int | None = None  # edges of the pose graph besides odometry, after the frame; None = there is no graph
    T_wc: Matrix4 | None = None  # [4, 4] camera to world, as it is known after the frame; None = it was skipped
