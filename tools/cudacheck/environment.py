"""The stub driver, built once into a cache, and the environment in which a program finds it."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from enum import Enum
from pathlib import Path

from tools.cudacheck.compile import FLAGS, NATIVE
from tools.cudacheck.failures import CudaCheckError, MissingToolError

REPORT_PREFIX = "cudastub:"
CACHE_VARIABLE = "CUDACHECK_CACHE"
_PACKAGE = Path(__file__).parent
_CHECKOUT = _PACKAGE.parents[1]
_TRANSLATOR = ("compile.py", "instructions.py", "ptx.py", "translator.py", "native/kernel.h")
_DRIVER = ("driver.c", "emulator.c", "emulator.h", "kernel.h")
_DRIVER_FLAGS = ("-std=gnu11", "-O2", "-Wall", "-Wextra", "-march=x86-64-v3", "-fvisibility=hidden", "-shared", "-fPIC")


class Grid(Enum):
    """How the blocks of a launch follow each other: what a kernel computes must not depend on it."""

    DEFAULT = "default"  # 256 blocks at most
    SINGLE = "single"  # 2 blocks at most, which do all the work in turns: shows a missing barrier at a loop's end
    REVERSED = "reversed"  # last block and last thread first


_GRID_SETTINGS = {
    Grid.DEFAULT: {"CUDACHECK_SMS": "8", "CUDACHECK_BLOCKS_PER_SM": "16"},
    Grid.SINGLE: {"CUDACHECK_SMS": "1", "CUDACHECK_BLOCKS_PER_SM": "1"},
    Grid.REVERSED: {"CUDACHECK_SMS": "8", "CUDACHECK_BLOCKS_PER_SM": "16", "CUDACHECK_REVERSED": "1"},
}


def cache_folder() -> Path:
    """Where built things are kept: $CUDACHECK_CACHE, else `cudacheck` in the user's cache folder."""
    chosen = os.environ.get(CACHE_VARIABLE)
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cudacheck"


def require_program(name: str) -> str:
    """Path of an installed program. Raises MissingToolError."""
    found = shutil.which(name)
    if found is None:
        raise MissingToolError(f"{name} is not installed (not on PATH); the CUDA check needs it")
    return found


def require_platform() -> None:
    """Raises MissingToolError where programs cannot be executed: no gcc, or not x86-64 Linux with AVX2 and FMA."""
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        raise MissingToolError("the CUDA check runs on x86-64 Linux only")
    features = Path("/proc/cpuinfo").read_text().split()
    if not {"avx2", "fma", "f16c", "bmi2"} <= set(features):
        raise MissingToolError("the CUDA check needs a CPU with AVX2, FMA, F16C and BMI2")
    require_program("gcc")


def driver_folder() -> Path:
    """Folder that holds the built `libcuda.so`; processes that build it at the same time do not meet half of it.

    Raises MissingToolError without gcc, CudaCheckError if the build fails.
    """
    sources = [NATIVE / name for name in _DRIVER]
    folder = cache_folder() / "driver" / _digest(sources, _DRIVER_FLAGS)
    if folder.is_dir():
        return folder
    gcc = require_program("gcc")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as unfinished:
        built = Path(unfinished) / "built"
        built.mkdir()
        units = [str(source) for source in sources if source.suffix == ".c"]
        command = [gcc, *_DRIVER_FLAGS, "-Wl,-soname,libcuda.so", "-o", str(built / "libcuda.so"), *units]
        done = subprocess.run([*command, "-lpthread", "-ldl", "-lm"], capture_output=True, text=True, check=False)
        if done.returncode:
            raise CudaCheckError(f"the stub driver does not build: {done.stderr}")
        (built / "libcuda.so.1").symlink_to("libcuda.so")
        try:
            built.rename(folder)
        except OSError:  # another process was faster, with the same sources
            if not folder.is_dir():
                raise
    return folder


def environment(dump: Path, *, execute: bool, grid: Grid = Grid.DEFAULT) -> dict[str, str]:
    """Variables to add to a program's environment so that it finds the stub driver.

    dump: an existing folder for the PTX (`module_0000.ptx`, ...) and `launches.log`; one process at a time.
    execute: run kernels on the CPU; otherwise launches do nothing.
    Raises MissingToolError without gcc, CudaCheckError if the driver does not build.
    """
    modules, taichi = cache_folder() / "modules", cache_folder() / "taichi"
    for folder in (modules, taichi):
        folder.mkdir(parents=True, exist_ok=True)
    key = _digest([_PACKAGE / name for name in _TRANSLATOR], FLAGS)
    return {
        "LD_LIBRARY_PATH": _joined(driver_folder(), "LD_LIBRARY_PATH"),
        "PYTHONPATH": _joined(_CHECKOUT, "PYTHONPATH"),  # the driver runs tools.cudacheck.compile
        "TI_OFFLINE_CACHE_FILE_PATH": str(taichi),  # apart from what Taichi has compiled for a real GPU
        "CUDACHECK_DUMP": str(dump),
        "CUDACHECK_MODULES": str(modules),
        "CUDACHECK_PYTHON": sys.executable,
        "CUDACHECK_TOOL_KEY": key[:16],
        "CUDACHECK_EXECUTE": str(int(execute)),
        **_GRID_SETTINGS[grid],
    }


def reports(stderr: str) -> list[str]:
    """The lines in which the stub driver reports what is wrong with a program."""
    return [line for line in stderr.splitlines() if line.startswith(REPORT_PREFIX)]


def launched_kernels(dump: Path) -> bool:
    """Whether a program used the stub driver at all; if not, Taichi fell back to the CPU or launched nothing."""
    log = dump / "launches.log"
    return log.is_file() and re.search(r"^launch (?!runtime_)", log.read_text(), re.MULTILINE) is not None


def _joined(first: Path, variable: str) -> str:
    rest = os.environ.get(variable)
    return f"{first}{os.pathsep}{rest}" if rest else str(first)


def _digest(files: list[Path], options: tuple[str, ...]) -> str:
    digest = hashlib.sha256(" ".join(options).encode())
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:32]
