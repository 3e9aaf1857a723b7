"""`.spz`: Niantic's compressed Gaussians, version 2: a gzipped header of 16 bytes and one block for each attribute.

Its world is right, up, back (OpenGL's). Positions are fixed point numbers of 24 bits; opacities, colours, logarithms of
scales and x, y, z of the rotation are bytes.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.exports.moved import moved_gaussians
from tgslam.exports.quantised import as_bytes, opacity_of, unit_quat
from tgslam.files.atomic import atomic_file
from tgslam.geometry import quat_product_wxyz
from tgslam.output.ply import SH_C0
from tgslam.types import Gaussians, Matrix4

_MAGIC = 0x5053474E
_VERSION = 2
_MOST_FRACTION_BITS = 12  # a quarter of a millimetre; readers expect no more
_LARGEST = 2**23 - 1
_COLOUR_SCALE = 0.15  # of the harmonic, in the range of a byte
_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])  # right, down, ahead
_FROM_LEVEL = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # right, ahead, up


def write_spz(path: Path, gaussians: Gaussians, level: bool) -> None:
    """Write the map. level: its z points up; else it is in the frame of the first camera. Raises OSError."""
    T: Matrix4 = _FROM_LEVEL if level else _FROM_CAMERA
    turned = moved_gaussians(gaussians, T)
    bits = _fraction_bits(turned.mean)
    harmonic = (turned.colour.astype(np.float64) - 0.5) / SH_C0
    blocks = (
        struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(turned), 0, bits, 0, 0),
        _fixed_point(turned.mean, bits),
        as_bytes(255.0 * opacity_of(turned)).tobytes(),
        as_bytes(255.0 * (_COLOUR_SCALE * harmonic + 0.5)).tobytes(),
        as_bytes(16.0 * (turned.log_scale.astype(np.float64) + 10.0)).tobytes(),
        as_bytes(127.5 * (_mostly_real(unit_quat(turned))[:, 1:] + 1.0)).tobytes(),
    )
    with atomic_file(path) as file:
        file.write(gzip.compress(b"".join(blocks), mtime=0))


def _mostly_real(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the unit quaternions [N, 4] wxyz of the same ellipsoids, those with the largest w, which is at least 0.5.

    Half a turn about an axis of its own leaves a Gaussian as it is. Readers compute w from the other three, and a small
    one would come out wrong by many degrees.
    """
    halves = np.eye(4)  # no turn, and half a turn about x, y and z
    alike = np.stack([quat_product_wxyz(quat, half) for half in halves], axis=1)  # [N, 4 turns, 4]
    best = alike[np.arange(len(quat)), np.argmax(np.abs(alike[..., 0]), axis=1)]
    return np.where(best[:, :1] < 0, -best, best)


def _fraction_bits(mean: NDArray[np.float32]) -> int:
    """As many as leave room for the farthest Gaussian."""
    farthest_m = float(np.abs(mean).max(initial=0.0))
    return max(0, min(_MOST_FRACTION_BITS, int(np.floor(np.log2(_LARGEST / max(farthest_m, 1.0))))))


def _fixed_point(mean: NDArray[np.float32], bits: int) -> bytes:
    """[N, 3] m as signed numbers of 24 bits, least byte first."""
    whole = np.clip(np.round(mean.astype(np.float64) * 2.0**bits), -_LARGEST, _LARGEST).astype("<i4")
    return np.ascontiguousarray(whole).view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
