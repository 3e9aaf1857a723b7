"""Mistakes in kernels are found, each as what it is, and a failure of one scenario does not hide the next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.cuda import broken
from tests.cuda.harness import GRIDS, Devices, Scenario, ScenarioError
from tests.cuda.scenarios import relaxation
from tools.cudacheck.environment import Grid

pytestmark = pytest.mark.cuda_check


@pytest.fixture(scope="module")
def own_devices(devices: Devices, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Devices]:
    """Apart from those that all tests share: these kernels have no budget. (`devices` skips where it cannot run.)"""
    own = Devices(tmp_path_factory.mktemp("broken"))
    yield own
    own.close()


@pytest.mark.parametrize("grid", GRIDS)
def test_a_correct_kernel_passes(own_devices: Devices, grid: Grid) -> None:
    sums = np.arange(broken.N, dtype=np.float32).reshape(-1, broken.BLOCK).sum(axis=1)
    np.testing.assert_array_equal(own_devices.cuda(broken.correct, grid)["y"], np.repeat(sums, broken.BLOCK))


@pytest.mark.parametrize(
    ("scenario", "grid", "reported"),
    [
        (broken.one_cell_for_all, Grid.DEFAULT, r"shared memory race \(write after write\)"),
        (broken.no_barrier, Grid.DEFAULT, r"shared memory race \(read after write\)"),
        (broken.no_last_barrier, Grid.SINGLE, r"shared memory race \(write after read\)"),
        (broken.atomics_without_barrier, Grid.DEFAULT, "shared memory race"),
        (broken.divergent_barrier, Grid.DEFAULT, "divergent barrier"),
        (broken.uninitialised, Grid.DEFAULT, "uninitialised shared memory"),
        (broken.outside_shared, Grid.DEFAULT, "shared memory access out of range"),
        (broken.outside_array, Grid.DEFAULT, "illegal address"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_mistake_is_reported(own_devices: Devices, scenario: Scenario, grid: Grid, reported: str) -> None:
    with pytest.raises(ScenarioError, match=f"(?m)^cudastub: .*{reported}"):
        own_devices.cuda(scenario, grid)


def test_enough_blocks_hide_a_missing_last_barrier(own_devices: Devices) -> None:
    blocks = np.arange(broken.N, dtype=np.float32).reshape(-1, broken.BLOCK)
    np.testing.assert_array_equal(own_devices.cuda(broken.no_last_barrier)["y"], blocks[:, ::-1].ravel())


def test_an_index_below_zero_is_reported(own_devices: Devices) -> None:
    with pytest.raises(ScenarioError, match=r"(?m)^cudastub: .*illegal address"):
        own_devices.cuda(broken.outside_array, offset=-1)


def test_a_crash_or_an_exception_is_that_scenarios_alone(own_devices: Devices) -> None:
    with pytest.raises(ScenarioError, match=r"crashing[\s\S]*ended with status -[\s\S]*subgroupAdd not found"):
        own_devices.cuda(broken.crashing)
    assert own_devices.cuda(relaxation.colours)["colour"].shape == (300, 3)
    with pytest.raises(ScenarioError, match="RuntimeError: for a test"):
        own_devices.cuda(broken.raising)
    assert own_devices.cuda(relaxation.colours, count=5)["colour"].shape == (5, 3)
