"""Fixtures for the whole suite."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# No test fails for the machine being slow, and every run tries the same examples
settings.register_profile("tgslam", deadline=None, derandomize=True)
settings.load_profile("tgslam")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--long`: tests that take minutes and tell what shorter ones mostly tell too."""
    parser.addoption("--long", action="store_true", help="run the tests marked `long` as well")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is marked `long`, unless it is asked for."""
    if config.getoption("--long"):
        return
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.skip(reason="long: run it with --long"))


@pytest.fixture(scope="session")
def clips_dir() -> Path:
    """Folder of the benchmark clips: TGSLAM_TEST_DATA, or shared/data beside the checkout. Skips without it."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TGSLAM_TEST_DATA", default))
    if not folder.is_dir():
        pytest.skip("benchmark clips are not here; set TGSLAM_TEST_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def tum_clip(clips_dir: Path) -> Path:
    """A clip of the TUM RGB-D benchmark."""
    return _clip(clips_dir, "tum_fr3_structure_notexture_far")


@pytest.fixture(scope="session")
def icl_clip(clips_dir: Path) -> Path:
    """A clip of ICL-NUIM."""
    return _clip(clips_dir, "icl_office_kt0")


def _clip(clips_dir: Path, name: str) -> Path:
    if not (clips_dir / name).is_dir():
        pytest.skip(f"{name} is not among the benchmark clips")
    return clips_dir / name
