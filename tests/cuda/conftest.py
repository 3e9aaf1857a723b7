"""Fixtures of the CUDA checks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cuda.harness import Devices
from tools.cudacheck.environment import Grid, require_platform
from tools.cudacheck.failures import MissingToolError


@pytest.fixture(scope="session")
def devices(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Devices]:
    """Processes that run scenarios on the CPU and as emulated CUDA kernels; skips where that cannot be done."""
    try:
        require_platform()
    except MissingToolError as error:
        pytest.skip(str(error))
    devices = Devices(tmp_path_factory.mktemp("cuda"))
    yield devices
    devices.close()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One grid mode after another, so that each needs its process once; other tests stay where they are."""
    places = [place for place, item in enumerate(items) if Path(__file__).parent in item.path.parents]
    for place, item in zip(places, sorted((items[place] for place in places), key=_grid_position), strict=True):
        items[place] = item


def _grid_position(item: pytest.Item) -> int:
    callspec = getattr(item, "callspec", None)
    grid = callspec.params.get("grid") if callspec else None
    return list(Grid).index(grid) if isinstance(grid, Grid) else 0
