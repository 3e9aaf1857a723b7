"""What `tgslam render` needs of a 3DGS PLY that comes without a run: a camera, and a place to look from."""

from __future__ import annotations

import argparse

import numpy as np

from tgslam.camera import Camera
from tgslam.cli.options import size
from tgslam.errors import ConfigError
from tgslam.types import Gaussians, Matrix4

_SIZE_PX = (640, 480)
_HALF_VIEW = np.tan(np.deg2rad(30.0))  # of an image's width, where no focal length is given
_SEEN_SHARE = 0.1  # of the Gaussians in the image, for the origin to be a place to look from
_EXTENT_PERCENTILE = 90.0
_STEP_BACK = 2.0  # in extents
_RUN_ONLY = ("keyframes", "planes", "overview")


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """`--size` and `--intrinsics`."""
    group = parser.add_argument_group("for a PLY without a run")
    group.add_argument("--size", type=size, metavar="WxH", help="of the images, px (default: 640x480)")
    group.add_argument(
        "--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"),
        help="of the camera, px, pixel centres at whole numbers (default: 60 degrees across, centred)",
    )  # fmt: skip


def require_a_run(args: argparse.Namespace) -> None:
    """Raises ConfigError for what only a PLY without a run takes."""
    if args.size is not None or args.intrinsics is not None:
        raise ConfigError(f"{args.run}: --size and --intrinsics are for a PLY; a run is rendered by its own camera")


def bare_camera(args: argparse.Namespace) -> Camera:
    """The camera of `--size` and `--intrinsics`. Raises ConfigError for what a PLY alone cannot give."""
    for mode in _RUN_ONLY:
        if getattr(args, mode):
            raise ConfigError(f"--{mode} needs a run folder, and {args.run} is a file; give --trajectory or --orbit")
    width, height = args.size or _SIZE_PX
    focal = 0.5 * width / _HALF_VIEW
    fx, fy, cx, cy = args.intrinsics or (focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise ConfigError("--intrinsics FX FY CX CY must be finite, and FX and FY greater than 0")
    return Camera(width, height, fx, fy, cx, cy)


def first_look(gaussians: Gaussians, camera: Camera) -> Matrix4:
    """T_wc [4, 4] of a camera that sees the map, with y of the world downwards.

    It is at the origin and looks along z, as the first camera of a run is, if that shows a fair share of the Gaussians;
    else it looks from outside at their middle.
    """
    T_wc = np.eye(4)
    if not len(gaussians):
        return T_wc
    mean = gaussians.mean.astype(np.float64)
    u, v = camera.project(mean)
    if (camera.holds(u, v) & (mean[:, 2] > 0)).mean() >= _SEEN_SHARE:
        return T_wc
    middle = np.median(mean, axis=0)
    extent = float(np.percentile(np.linalg.norm(mean - middle, axis=1), _EXTENT_PERCENTILE))
    T_wc[:3, 3] = middle - [0.0, 0.0, _STEP_BACK * max(extent, 1e-3)]
    return T_wc
