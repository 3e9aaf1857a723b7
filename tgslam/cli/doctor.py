"""`tgslam doctor`: what is installed, which devices there are, and whether the kernels work here."""

from __future__ import annotations

import argparse
import ctypes
import ctypes.util
import importlib.metadata
import importlib.util
import os
import platform
import time
from typing import Any

import numpy as np

from tgslam import __version__
from tgslam.camera import Camera
from tgslam.cli import engine
from tgslam.errors import DeviceError
from tgslam.output.console import print_table
from tgslam.types import Gaussians

_DISTRIBUTIONS = ("taichi", "numpy", "opencv-python-headless", "scipy", "PyYAML", "rich", "trimesh", "gtsam")
_EXTRAS = {"test": ("pytest", "hypothesis", "evo", "plyfile", "ruff", "mypy")}  # extra: modules that it brings


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "doctor",
        help="check the installation",
        description="Print versions and devices, then compile the renderer and draw one Gaussian with it.",
    )
    engine.add_device_option(parser)
    return parser


def execute(args: argparse.Namespace) -> int:
    """Print the findings; raises DeviceError when the kernels do not work."""
    rows = [("tgslam", __version__), ("python", platform.python_version()), ("system", platform.platform())]
    rows += [(name, _version(name)) for name in _DISTRIBUTIONS]
    rows += [("CPU threads", str(_threads())), ("CUDA", _cuda())]
    rows += [(f"extra [{name}]", _extra(modules)) for name, modules in _EXTRAS.items()]
    try:
        rows.append(("kernels", _check_kernels(args.device)))
    except Exception as error:  # a diagnosis: whatever the compiler raises is what the user wants to see
        rows.append(("kernels", f"FAILED: {error}"))
        print_table("tgslam doctor", rows)
        raise DeviceError(f"the kernels do not work here: {type(error).__name__}: {error}") from error
    print_table("tgslam doctor", rows)
    return 0


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed under that name"


def _threads() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cuda() -> str:
    """What the CUDA driver says, asked directly: Taichi would print its own complaints."""
    name = ctypes.util.find_library("cuda") or ("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    try:
        driver = ctypes.CDLL(name)
    except OSError:
        return "no driver (the CPU is used)"
    count = ctypes.c_int(0)
    status = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count))
    if status:
        return f"the driver reports error {status}"
    return f"{count.value} device{'' if count.value == 1 else 's'}"


def _extra(modules: tuple[str, ...]) -> str:
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    return f"lacks {', '.join(missing)}" if missing else "complete"


def _check_kernels(device: str) -> str:
    """Draw one opaque red Gaussian ahead of a small camera and look at the middle pixel."""
    start_s = time.perf_counter()
    used = engine.start_device(device)
    camera = Camera(32, 32, 32.0, 32.0, 15.5, 15.5)
    image = engine.make_render(camera)(_one_gaussian(), np.eye(4))
    red, green, _ = image.colour[16, 16]
    if not (red > 0.5 and green < 0.1 and abs(image.depth_m[16, 16] - 2.0) < 0.05):
        raise DeviceError(f"the renderer draws colour {image.colour[16, 16]} where it should draw red")
    return f"compile and run on {used} ({time.perf_counter() - start_s:.1f} s)"


def _one_gaussian() -> Gaussians:
    return Gaussians(
        mean=np.array([[0.0, 0.0, 2.0]], np.float32),
        log_scale=np.full((1, 3), np.log(0.2), np.float32),
        quat_wxyz=np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        opacity_logit=np.full(1, 5.0, np.float32),
        colour=np.array([[1.0, 0.0, 0.0]], np.float32),
        embedding=np.zeros((1, 3), np.float32),
        plane_id=np.full(1, -1, np.int32),
        birth_keyframe=np.zeros(1, np.int32),
    )
