"""Kernels that both devices launch unchanged: as CUDA kernels they give what they give on the CPU."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import GRIDS, Devices, assert_close
from tests.cuda.scenarios import adam, closures, images, planes, projection, relaxation, rigid
from tools.cudacheck.environment import Grid

pytestmark = [pytest.mark.cuda_check, pytest.mark.parametrize("grid", GRIDS)]


def test_relaxation(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(relaxation.colours, grid)
    assert_close(cuda, cpu, atol=1e-6)


def test_rows_that_move(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(rigid.rows, grid)
    assert_close(cuda, cpu, atol=2e-6)


def test_adam(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(adam.steps, grid)
    assert_close(cuda, cpu, rtol=1e-5, atol=1e-6)


def test_colour_images(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(images.colour, grid)
    assert_close(cuda, cpu, atol=1e-6)


def test_depth_images(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(images.geometry, grid)
    assert_close(cuda, cpu, atol=2e-5)
    assert 0.3 < (cpu["normals"] != 0).any(axis=2).mean() < 1.0


def test_planes(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(planes.extraction, grid)
    assert len(cpu["normal"]) >= 3
    assert (cuda["labels"] != cpu["labels"]).mean() < 1e-3
    for name in ("normal", "offset_m"):
        np.testing.assert_allclose(cuda[name], cpu[name], atol=1e-4, err_msg=name)
    np.testing.assert_allclose(cuda["covariance"], cpu["covariance"], rtol=0.01, atol=1e-9)
    np.testing.assert_array_equal(cuda["reliable"], cpu["reliable"])


@pytest.mark.parametrize(("points", "planes"), [(333, 3), (5, 1), (1, 2)])
def test_sums_of_closures(devices: Devices, grid: Grid, points: int, planes: int) -> None:
    cpu, cuda = devices.both(closures.sums, grid, points=points, planes=planes)
    for name in ("points", "matches"):
        np.testing.assert_array_equal(cuda[name], cpu[name])
    for name in ("information", "moment", "A", "b", "squares"):
        scale = abs(cpu[name]).max(initial=0.0) + 1e-30
        np.testing.assert_allclose(cuda[name] / scale, cpu[name] / scale, atol=2e-4, err_msg=name)


@pytest.mark.parametrize("with_embedding", [True, False])
def test_projection(devices: Devices, grid: Grid, with_embedding: bool) -> None:
    cpu, cuda = devices.both(projection.forward_and_backward, grid, with_embedding=with_embedding)
    assert 0.1 < (cpu["tile_count"] > 0).mean() < 0.9
    for name, expected in cpu.items():
        scale = np.abs(expected).max(axis=0, keepdims=True) if expected.ndim > 1 else np.abs(expected).max()
        np.testing.assert_allclose(cuda[name] / (scale + 1e-30), expected / (scale + 1e-30), atol=2e-5, err_msg=name)
