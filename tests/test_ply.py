"""map.ply: the public attribute list, activations undone as the 3DGS standard has it, and strict reading."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from tgslam.errors import OutputError
from tgslam.output.ply import read_map, sidecar_path, write_map
from tgslam.types import Gaussians


def some_gaussians(count: int, seed: int = 0) -> Gaussians:
    random = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return random.normal(size=shape).astype(np.float32)

    return Gaussians(
        mean=normal(count, 3),
        log_scale=normal(count, 3) - 4,
        quat_wxyz=3 * normal(count, 4),
        opacity_logit=normal(count),
        colour=random.random((count, 3)).astype(np.float32),
        embedding=normal(count, 3),
        plane_id=random.integers(-1, 9, count).astype(np.int32),
        birth_keyframe=random.integers(0, 50, count).astype(np.int32),
    )


def assert_same(first: Gaussians, second: Gaussians) -> None:
    for field in dataclasses.fields(Gaussians):
        a, b = getattr(first, field.name), getattr(second, field.name)
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        if field.name == "quat_wxyz":
            a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
        np.testing.assert_allclose(a, b, atol=2e-6 if field.name in ("colour", "quat_wxyz") else 0, rtol=0)


def test_another_reader_finds_the_public_attributes(tmp_path: Path) -> None:
    gaussians = some_gaussians(7)
    write_map(tmp_path / "map.ply", gaussians)
    data = PlyData.read(str(tmp_path / "map.ply"))
    assert not data.text
    assert data.byte_order == "<"
    (vertices,) = data.elements
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert [p.name for p in vertices.properties] == names.split()
    assert {p.val_dtype for p in vertices.properties} == {"f4"}
    rotation = np.stack([vertices[f"rot_{i}"] for i in range(4)], 1)
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(
        rotation[:, 0] * gaussians.quat_wxyz[:, 1], rotation[:, 1] * gaussians.quat_wxyz[:, 0], atol=1e-5
    )
    np.testing.assert_array_equal(vertices["scale_2"], gaussians.log_scale[:, 2])
    np.testing.assert_array_equal(vertices["opacity"], gaussians.opacity_logit)
    colour = 0.5 + 0.28209479177387814 * np.stack([vertices[f"f_dc_{i}"] for i in range(3)], 1)
    np.testing.assert_allclose(colour, gaussians.colour, atol=1e-6)
    assert not vertices["nx"].any()


@settings(max_examples=20)
@given(count=st.integers(0, 40), seed=st.integers(0, 99))
def test_round_trip(count: int, seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("map") / "map.ply"
    gaussians = some_gaussians(count, seed)
    write_map(path, gaussians)
    assert_same(read_map(path), gaussians)


def test_the_same_map_gives_the_same_bytes_at_another_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contents = []
    for name, clock_s in (("a", 1e9), ("b", 1.7e9)):
        monkeypatch.setattr(time, "time", lambda now=clock_s: now)
        (tmp_path / name).mkdir()
        path = tmp_path / name / "map.ply"
        write_map(path, some_gaussians(11))
        contents.append((path.read_bytes(), sidecar_path(path).read_bytes()))
    assert contents[0] == contents[1]


def test_a_map_of_another_program_needs_no_sidecar(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_map(path, some_gaussians(3))
    sidecar_path(path).unlink()
    gaussians = read_map(path)
    assert (gaussians.plane_id == -1).all()
    assert gaussians.embedding.shape == (3, 3)
    data = PlyData.read(str(path))
    reordered = data["vertex"].data[[*reversed(data["vertex"].data.dtype.names)]]
    other = tmp_path / "other.ply"
    extended = np.empty(3, dtype=[*[(name, "<f4") for name in reordered.dtype.names], ("f_rest_0", "<f4")])
    for name in reordered.dtype.names:
        extended[name] = reordered[name]
    extended["f_rest_0"] = 9
    PlyData([PlyElement.describe(extended, "vertex")], byte_order="<").write(str(other))
    assert_same(read_map(other), gaussians)


def test_values_that_no_viewer_can_show_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    gaussians = some_gaussians(4)
    zero = dataclasses.replace(gaussians, quat_wxyz=np.zeros((4, 4), np.float32))
    nan = dataclasses.replace(gaussians, mean=np.full((4, 3), np.nan, np.float32))
    for bad in (zero, nan):
        with pytest.raises(OutputError, match="Gaussian 0 of 4"):
            write_map(path, bad)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda data: data[:-1], "damaged: 203 bytes"),
        (lambda data: data + b"x", "damaged: 205 bytes"),
        (lambda data: data[4:], "not a PLY"),
        (lambda data: b"", "not a PLY"),
        (lambda data: data[:40], "its header says b'elem'"),
        (lambda data: data.replace(b"binary_little_endian", b"binary_big_endian"), "binary_big_endian"),
        (lambda data: data.replace(b"float opacity", b"double opacity"), "double opacity"),
        (lambda data: data.replace(b"float opacity", b"float opaque"), "lacks opacity"),
        (lambda data: data.replace(b"float nx", b"float ny"), "twice"),
        (lambda data: data[:-4] + b"\x00\x00\xc0\x7f", "not finite"),
    ],
)
def test_damaged_maps_are_refused(tmp_path: Path, change, expected: str) -> None:
    path = tmp_path / "map.ply"
    write_map(path, some_gaussians(3))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(OutputError, match=r"map\.ply") as caught:
        read_map(path)
    assert expected in str(caught.value)


def test_a_sidecar_of_another_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_map(path, some_gaussians(3))
    other = sidecar_path(path).read_bytes()
    write_map(path, some_gaussians(4))
    for content, expected in ((other, "4 Gaussians"), (b"junk", "damaged"), (b"", "damaged")):
        sidecar_path(path).write_bytes(content)
        with pytest.raises(OutputError, match=expected):
            read_map(path)


def test_reading_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be read: No such file"):
        read_map(tmp_path / "map.ply")
