"""Fixtures for the whole suite."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# No test fails for the machine being slow, and every run tries the same examples
settings.register_profile("tgslam", deadline=None, derandomize=True)
settings.load_profile("tgslam")


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
