"""Fixtures of the CUDA checks."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cuda.harness import Devices
from tools.cudacheck.environment import require_platform
from tools.cudacheck.errors import MissingToolError


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
