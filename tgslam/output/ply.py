"""The map on disk: `map.ply` with the 3DGS standard's attributes, and a sidecar with what it has no place for.

A stored vertex is: position; a normal of zeros; the degree-0 spherical harmonic `f_dc = (colour - 0.5) / C0`; the
opacity before the sigmoid; the logarithms of the scales; the rotation as a unit quaternion wxyz. Public viewers read it
as it is.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import OutputError
from tgslam.files.atomic import atomic_file
from tgslam.types import Gaussians

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))

ATTRIBUTES = (
    *("x", "y", "z"),
    *("nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity",
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)
_READ_ATTRIBUTES = tuple(name for name in ATTRIBUTES if name not in ("nx", "ny", "nz"))
_HEADER_LIMIT_BYTES = 64 * 1024
_SIDECAR_SHAPES = {"embedding": (3,), "plane_id": (), "birth_keyframe": ()}


def sidecar_path(path: Path) -> Path:
    """`map.ply` -> `map_extra.npz` in the same folder."""
    return path.with_name(f"{path.stem}_extra.npz")


def write_map(path: Path, gaussians: Gaussians) -> None:
    """Write the map and its sidecar; the same Gaussians give the same bytes.

    The sidecar goes first, so that a whole `path` never lacks it. Raises OutputError for values that are not finite
    or a rotation of zero length, and OSError when a file cannot be written.
    """
    rows = _rows_of_gaussians(gaussians)
    with atomic_file(sidecar_path(path)) as file:
        np.savez(
            file,
            embedding=gaussians.embedding.astype("<f4"),
            plane_id=gaussians.plane_id.astype("<i4"),
            birth_keyframe=gaussians.birth_keyframe.astype("<i4"),
        )
    _write_rows(path, rows)


def write_vertices(path: Path, gaussians: Gaussians) -> None:
    """Write the PLY alone, without a sidecar, for viewers. Raises like `write_map`."""
    _write_rows(path, _rows_of_gaussians(gaussians))


def _write_rows(path: Path, rows: NDArray[np.float32]) -> None:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in ATTRIBUTES]
    lines += ["end_header", ""]
    with atomic_file(path) as file:
        file.write("\n".join(lines).encode("ascii"))
        file.write(rows.tobytes())


def read_map(path: Path) -> Gaussians:
    """Read a map: one of `write_map`, or another 3DGS PLY, whose further attributes are left out.

    Without a sidecar, embeddings are zero, no Gaussian is on a plane and all were born with keyframe 0.
    Raises OutputError for anything else than a whole binary little-endian PLY of finite floats, and for a sidecar
    that does not fit it.
    """
    try:
        with path.open("rb") as file:
            names, count = _read_header(path, file)
            body = file.read()
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    expected = 4 * len(names) * count
    if len(body) != expected:
        raise OutputError(f"{path}: damaged: {len(body)} bytes of vertices, but its header promises {expected}")
    table = np.frombuffer(body, "<f4").reshape(count, len(names))
    columns = table[:, [names.index(name) for name in _READ_ATTRIBUTES]]
    if not np.isfinite(columns).all():
        raise OutputError(f"{path}: damaged: it holds values that are not finite")
    return _gaussians_of_rows(columns, _read_sidecar(sidecar_path(path), count))


def _rows_of_gaussians(gaussians: Gaussians) -> NDArray[np.float32]:
    """[N, 17] little-endian float32 in the order of `ATTRIBUTES`."""
    length = np.linalg.norm(gaussians.quat_wxyz.astype(np.float64), axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        columns = (
            gaussians.mean,
            np.zeros_like(gaussians.mean),
            (gaussians.colour.astype(np.float64) - 0.5) / SH_C0,
            gaussians.opacity_logit[:, None],
            gaussians.log_scale,
            gaussians.quat_wxyz / length,
        )
    rows = np.ascontiguousarray(np.concatenate(columns, axis=1), "<f4")
    if not np.isfinite(rows).all():
        bad = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise OutputError(f"the map cannot be written: Gaussian {bad} of {len(rows)} holds values that are not finite")
    return rows


def _gaussians_of_rows(rows: NDArray[np.float32], sidecar: dict[str, NDArray[np.generic]]) -> Gaussians:
    """Rows [N, 14] in the order of `_READ_ATTRIBUTES`."""

    def columns(first: int, last: int) -> NDArray[np.float32]:
        return np.ascontiguousarray(rows[:, first:last], np.float32)

    return Gaussians(
        mean=columns(0, 3),
        colour=(columns(3, 6).astype(np.float64) * SH_C0 + 0.5).astype(np.float32),
        opacity_logit=columns(6, 7)[:, 0],
        log_scale=columns(7, 10),
        quat_wxyz=columns(10, 14),
        embedding=np.ascontiguousarray(sidecar["embedding"], np.float32),
        plane_id=np.ascontiguousarray(sidecar["plane_id"], np.int32),
        birth_keyframe=np.ascontiguousarray(sidecar["birth_keyframe"], np.int32),
    )


def _read_header(path: Path, file: BinaryIO) -> tuple[list[str], int]:
    """Names of the vertex attributes in file order, and the number of vertices; leaves `file` at the first vertex."""
    if file.readline(16).rstrip() != b"ply":
        raise OutputError(f"{path}: not a PLY file")
    names: list[str] = []
    count: int | None = None
    while file.tell() < _HEADER_LIMIT_BYTES:
        line = file.readline(1024)
        words = line.decode("ascii", "replace").split()
        match words:
            case ["end_header"]:
                return _checked_header(path, names, count)
            case ["format", kind, "1.0"] if kind != "binary_little_endian":
                raise OutputError(f"{path}: its format is {kind}, but a map is binary_little_endian")
            case ["element", "vertex", number] if count is None and number.isdecimal():
                count = int(number)
            case ["property", "float" | "float32", name] if count is not None:
                names.append(name)
            case ["format", _, "1.0"] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise OutputError(f"{path}: a map has one element `vertex` of floats, but its header says {line!r}")
    raise OutputError(f"{path}: damaged: its header has no end")


def _checked_header(path: Path, names: list[str], count: int | None) -> tuple[list[str], int]:
    missing = [name for name in _READ_ATTRIBUTES if name not in names]
    if count is None or missing:
        raise OutputError(f"{path}: not a 3DGS map: it lacks {', '.join(missing) or 'vertices'}")
    if len(set(names)) != len(names):
        raise OutputError(f"{path}: damaged: its header names an attribute twice")
    return names, count


def _read_sidecar(path: Path, count: int) -> dict[str, NDArray[np.generic]]:
    if not path.exists():
        return {
            "embedding": np.zeros((count, 3), np.float32),
            "plane_id": np.full(count, -1, np.int32),
            "birth_keyframe": np.zeros(count, np.int32),
        }
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in _SIDECAR_SHAPES}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise OutputError(f"{path}: damaged: {error}; move it away to read the map without it") from error
    for name, shape in _SIDECAR_SHAPES.items():
        if arrays[name].shape != (count, *shape):
            raise OutputError(
                f"{path}: `{name}` has shape {arrays[name].shape}, but the map beside it has {count} Gaussians"
            )
    return arrays
