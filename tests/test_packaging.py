"""The package as users get it: a wheel with every module and config, and a plain checkout that runs from anywhere."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
FOLDERS = ("tgslam", "kernels", "configs")


def run(*command: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy of the sources, so that nothing is left in the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in FOLDERS:
        shutil.copytree(CHECKOUT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / name, folder)
    pip = (sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", "dist", ".")
    done = run(*pip, cwd=folder)
    assert done.returncode == 0, done.stderr
    (path,) = (folder / "dist").glob("tgslam-*.whl")
    return path


def expected_files(sources: Path) -> set[str]:
    """What a wheel of the tree at `sources` has to hold."""
    found = set()
    for name in FOLDERS:
        for path in (sources / name).rglob("*"):
            if path.suffix in (".py", ".yaml") or path.name == "py.typed":
                inner = path.relative_to(sources)
                found.add((inner if name == "tgslam" else Path("tgslam") / inner).as_posix())
    return found


def test_a_wheel_holds_every_module_and_config_under_tgslam(wheel: Path) -> None:
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == expected_files(wheel.parents[1])
    assert "tgslam/kernels/__init__.py" in names
    assert "tgslam/configs/tum.yaml" in names


def test_an_installed_wheel_runs_and_finds_its_configs(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    code = (
        "from pathlib import Path; import tgslam, tgslam.kernels;"
        "from tgslam.config.loader import load, find_config;"
        "assert load(Path('configs/tum_fr1.yaml')).dataset.format == 'tum';"
        "assert len(tgslam.__path__) == 1;"
        "print(find_config(Path('tum')), tgslam.kernels.__file__)"
    )
    done = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(site))
    assert done.returncode == 0, done.stderr
    config, kernels = done.stdout.split()
    assert Path(config) == site / "tgslam" / "configs" / "tum.yaml"
    assert Path(kernels) == site / "tgslam" / "kernels" / "__init__.py"


def test_a_plain_checkout_runs_from_another_folder(tmp_path: Path) -> None:
    done = run(sys.executable, "-m", "tgslam", "--help", cwd=tmp_path, PYTHONPATH=str(CHECKOUT))
    assert done.returncode == 0, done.stderr
    assert "COMMAND" in done.stdout
    code = "import tgslam.kernels; from tgslam.config.loader import packaged_names; print(packaged_names())"
    done = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(CHECKOUT))
    assert done.returncode == 0, done.stderr
    assert "'icl'" in done.stdout


def test_the_metadata_names_the_command_and_the_python(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (metadata,) = (name for name in archive.namelist() if name.endswith("METADATA"))
    (entry_points,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
    assert "tgslam = tgslam.cli:main" in archive.read(entry_points).decode()
    text = archive.read(metadata).decode()
    assert "Requires-Python: <3.14,>=3.11" in text
    assert "Requires-Dist: taichi==" in text
    assert "License-Expression: MIT" in text
    assert "Author: tgslam contributors" in text
    assert any(name.endswith("licenses/LICENSE") for name in archive.namelist())
