"""The Taichi runtime: the one place that starts it and that knows which device the arrays live on."""

from __future__ import annotations

import contextlib
import io
import math
import os
from enum import Enum

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike

from tgslam.device.compilation import speed_up_translation
from tgslam.errors import DeviceError

_ALIGNMENT = 64  # bytes, of 16 lanes loaded as one vector


class Device(Enum):
    """Where kernels run.

    `AUTO` is the CPU as long as the kernels for CUDA have only been checked by execution on a CPU, not on a card.
    """

    AUTO = "auto"
    CPU = "cpu"
    CUDA = "cuda"


class _Runtime:
    device: Device | None = None
    threads: int = 0


def start(device: Device = Device.AUTO, threads: int = 0) -> Device:
    """Initialise Taichi once a process and return the device in use; later calls must ask for the same one.

    threads: CPU threads, 0 = every core that this process may use. Results do not depend on it.
    Raises DeviceError when CUDA was asked for and is not available, or when another device is already in use.
    """
    wanted = Device.CPU if device is Device.AUTO else device
    if _Runtime.device is not None:
        if _Runtime.device is not wanted:
            raise DeviceError(
                f"the kernels already run on {_Runtime.device.value}; start a new process to use {wanted.value}"
            )
        return wanted
    threads = threads or available_threads()
    speed_up_translation()
    with contextlib.redirect_stdout(io.StringIO()):  # stdout is the user's, and Taichi prints a line there
        ti.init(
            arch=ti.cuda if wanted is Device.CUDA else ti.cpu,
            default_ip=ti.i32,
            default_fp=ti.f32,
            fast_math=True,
            offline_cache=True,
            unrolling_limit=0,
            cpu_max_num_threads=threads,
            log_level=ti.ERROR,
        )
    if wanted is Device.CUDA and ti.cfg.arch != ti.cuda:
        ti.reset()
        raise DeviceError("no CUDA device was found; use --device cpu, or check the driver with `nvidia-smi`")
    _Runtime.device, _Runtime.threads = wanted, threads
    return wanted


def available_threads() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def device() -> Device:
    """The device in use (starts the CPU one if none was chosen)."""
    return _Runtime.device or start()


def wait() -> None:
    """Return when everything launched on the device has ended (kernels on the CPU end before they return)."""
    if device() is Device.CUDA:
        ti.sync()


def empty(shape: tuple[int, ...], dtype: type = np.float32, *, lanes: bool = False) -> np.ndarray:
    """An uninitialised array on the device: NumPy memory on the CPU (kernels use it in place), `ti.ndarray` under CUDA.

    lanes: the last axis is the 16-wide vector axis of a `Lanes` kernel argument.
    """
    if device() is Device.CPU:
        return _aligned(shape, dtype)
    element = ti.f32 if dtype is np.float32 else ti.i32
    if lanes:
        return ti.ndarray(ti.types.vector(shape[-1], element), shape[:-1])
    return ti.ndarray(element, shape)


def zeros(shape: tuple[int, ...], dtype: type = np.float32, *, lanes: bool = False) -> np.ndarray:
    """Like `empty`, filled with zeros."""
    array = empty(shape, dtype, lanes=lanes)
    array.fill(0)
    return array


def to_device(array: ArrayLike, dtype: type = np.float32) -> np.ndarray:
    """A host array as a device array: no copy on the CPU if it is contiguous and of that dtype already.

    An array that is on the device comes back as it is.
    """
    if isinstance(array, ti.Ndarray):
        return array
    host: np.ndarray = np.ascontiguousarray(array, dtype)
    if device() is Device.CPU:
        return host
    result = empty(host.shape, dtype)
    result.from_numpy(host)  # type: ignore[attr-defined]
    return result


def upload(array: ArrayLike, into: np.ndarray) -> None:
    """Copy a host array into a device array of the same shape and of float32."""
    host: np.ndarray = np.ascontiguousarray(array, np.float32)
    if device() is Device.CPU:
        into[...] = host
    else:
        into.from_numpy(host)  # type: ignore[attr-defined]


def to_host(array: np.ndarray) -> np.ndarray:
    """A device array as a NumPy array: the same memory on the CPU, a copy under CUDA."""
    return array if isinstance(array, np.ndarray) else array.to_numpy()


def _aligned(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Uninitialised NumPy memory at a multiple of `_ALIGNMENT`, as compiled `Lanes` kernels expect it."""
    items, size = math.prod(shape), np.dtype(dtype).itemsize
    buffer: np.ndarray = np.empty(items + _ALIGNMENT // size, dtype)
    skip = -buffer.ctypes.data % _ALIGNMENT // size
    return buffer[skip : skip + items].reshape(shape)
