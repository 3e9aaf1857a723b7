"""Checks of device arrays at the boundary of the op wrappers."""

from __future__ import annotations

import numpy as np


def require(
    name: str, array: np.ndarray, shape: tuple[int | None, ...], dtype: type = np.float32, *, at_least: bool = False
) -> np.ndarray:
    """Return the array if a kernel may use it in place; None in `shape` stands for any length.

    at_least: the first axis may be longer than `shape` says (arrays with spare capacity).
    Raises ValueError naming the array otherwise: wrong shape, dtype, or NumPy memory that is not C-contiguous.
    """
    found = tuple(array.shape)
    fits = len(found) == len(shape) and all(
        want in (None, have) for have, want in zip(found[1:], shape[1:], strict=True)
    )
    if fits and shape and shape[0] is not None:
        fits = found[0] >= shape[0] if at_least else found[0] == shape[0]
    if not fits:
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name} must have shape [{wanted}], but has {list(found)}")
    if isinstance(array, np.ndarray):
        if array.dtype != dtype:
            raise ValueError(f"{name} must be {np.dtype(dtype).name}, but is {array.dtype}")
        if not array.flags.c_contiguous:
            raise ValueError(f"{name} must be C-contiguous: pass numpy.ascontiguousarray({name})")
    return array
