"""From configured or published intrinsics to the pinhole camera of the frames that a source returns."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig
from tgslam.errors import ConfigError
from tgslam.types import Matrix4

_log = logging.getLogger(__name__)
_MUCH_ZOOM = 0.01  # relative change of focal lengths
_MIDDLE = 0.1  # of an image: lenses are centred to within this, about
_OFF_MIDDLE = 0.25
DISTORTION_LENGTHS = (4, 5, 8, 12, 14)  # OpenCV's models


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of stored images: px, and OpenCV distortion coefficients (() = none). fy < 0: rows count upwards."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None  # width, height that the values are for; None = any

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The camera matrix [3, 3] px of the stored image, with fy as it is."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def flips_rows(self) -> bool:
        """Whether rows have to be reversed for a camera with positive fy."""
        return self.fy < 0

    def camera(self, width: int, height: int) -> Camera:
        """The camera after undistortion and, for fy < 0, the flip of rows: v' = H - 1 - v, so fy' = -fy."""
        if self.flips_rows:
            return Camera(width, height, self.fx, -self.fy, self.cx, height - 1 - self.cy)
        return Camera(width, height, self.fx, self.fy, self.cx, self.cy)


@dataclass(frozen=True)
class DepthCamera:
    """A depth camera of its own: its intrinsics, for images of `calibration.size`, and where it is."""

    calibration: Calibration
    T_colour_depth: Matrix4  # [4, 4] maps points of the depth camera's frame to the colour camera's, m

    @property
    def is_concentric(self) -> bool:
        """Whether it stands where the colour camera does and looks the same way, to within 0.1 mm and 0.1 mrad."""
        return bool(np.allclose(self.T_colour_depth, np.eye(4), atol=1e-4))


def of_matrix(K: NDArray[np.float64], size: tuple[int, int] | None = None) -> Calibration:
    """A camera matrix [3, 3], or larger, in px, without distortion."""
    return Calibration(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), (), size)


def typical(intrinsics: NDArray[np.float64], size: tuple[int, int], name: str) -> Calibration:
    """One camera for frames whose fx, fy, cx, cy [N, 4] px differ a little, as focus moves: the median."""
    median = np.median(intrinsics, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = float(np.abs(intrinsics[:, :2] / median[:2] - 1.0).max())
    if spread > _MUCH_ZOOM:
        _log.warning("%s: focal lengths differ by %.1f%% between frames; one is used for all", name, 100 * spread)
    fx, fy, cx, cy = (float(value) for value in median)
    return Calibration(fx, fy, cx, cy, (), size)


def depth_camera(colour: Calibration, depth: Calibration, T_colour_depth: Matrix4 | None = None) -> DepthCamera | None:
    """Of a recording that states both cameras; None where depth has the same camera as colour."""
    T = np.eye(4) if T_colour_depth is None else T_colour_depth
    found = DepthCamera(depth, T)
    alike = np.allclose(colour.matrix, depth.matrix, atol=0.01) and colour.size == depth.size
    return None if alike and found.is_concentric else found


def resolve(config: DatasetConfig, default: Calibration | None, hint: str) -> Calibration:
    """Configured values where they are set (not 0), else those of `default`.

    The default distortion holds only with the default intrinsics: as soon as one of fx, fy, cx, cy is configured,
    distortion is what the config says. Raises ConfigError, ending in `hint`, when a value has no default, and for
    values that no camera has.
    """
    given = {key: getattr(config, key) for key in ("fx", "fy", "cx", "cy")}
    distortion = tuple(float(value) for value in config.distortion)
    missing = [f"dataset.{key}" for key, value in given.items() if value == 0.0]
    if default is None:
        if missing:
            raise ConfigError(f"the camera is not known: set {', '.join(missing)} (px); {hint}")
        calibration = Calibration(**given, distortion=distortion)
    elif len(missing) == len(given):
        calibration = replace(default, distortion=distortion or default.distortion)
    else:
        values = {key: value or getattr(default, key) for key, value in given.items()}
        calibration = Calibration(**values, distortion=distortion)
    _check(calibration)
    return calibration if any(calibration.distortion) else replace(calibration, distortion=())


def check_size(calibration: Calibration, width: int, height: int, name: str) -> None:
    """Raise ConfigError if the calibration was published for images of another size: it is never scaled silently.

    A principal point that is outside the image or far from its middle, the usual sign of configured values for another
    size, is logged as a warning.
    """
    if calibration.size not in (None, (width, height)):
        raise ConfigError(
            f"{name}: its images are {width}x{height}, but the default camera is for "
            f"{'x'.join(map(str, calibration.size or ()))}; set dataset.fx, dataset.fy, dataset.cx, dataset.cy (px)"
        )
    if not (0 <= calibration.cx < width and 0 <= calibration.cy < height):
        _log.warning(
            "%s: the principal point (%g, %g) px lies outside its %dx%d images; are dataset.cx and dataset.cy for "
            "another size?",
            name,
            calibration.cx,
            calibration.cy,
            width,
            height,
        )
    else:
        _warn_of_another_size(calibration, width, height, name)


def _warn_of_another_size(calibration: Calibration, width: int, height: int, name: str) -> None:
    """Say so where the principal point is in the middle of images that are a few times as large, or as small."""
    across, down = (2.0 * calibration.cx + 1.0) / width, (2.0 * calibration.cy + 1.0) / height
    factor = 0.5 * (across + down)
    if abs(across - down) < _MIDDLE * factor and not 1.0 - _OFF_MIDDLE < factor < 1.0 + _OFF_MIDDLE:
        _log.warning(
            "%s: its camera is likely for images of %.0fx%.0f, but these are %dx%d; if so, divide dataset.fx, fy, cx "
            "and cy by %.3g",
            name, factor * width, factor * height, width, height, factor,
        )  # fmt: skip


def _check(calibration: Calibration) -> None:
    numbers = (calibration.fx, calibration.fy, calibration.cx, calibration.cy, *calibration.distortion)
    if not np.isfinite(numbers).all():
        raise ConfigError("dataset.fx, fy, cx, cy and distortion must be finite numbers")
    if calibration.fx <= 0:
        raise ConfigError(f"dataset.fx is {calibration.fx:g}, but it must be positive (px)")
    if calibration.distortion and len(calibration.distortion) not in DISTORTION_LENGTHS:
        raise ConfigError(
            f"dataset.distortion has {len(calibration.distortion)} values; OpenCV's models have "
            f"{', '.join(map(str, DISTORTION_LENGTHS))} (k1, k2, p1, p2, k3, ...)"
        )
