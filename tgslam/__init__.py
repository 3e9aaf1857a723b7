"""tgslam: Structure Gaussian Splatting SLAM for RGB-D video, on a CPU or with CUDA, through Taichi kernels.

The names below are what programs use; docs/python.md shows how. They are imported when they are first asked for.
"""

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tgslam.adaptation import Slam
    from tgslam.camera import Camera
    from tgslam.config.loader import load as load_config
    from tgslam.config.schema import Config
    from tgslam.errors import TgslamError
    from tgslam.recording import Recording, open_recording
    from tgslam.saving import save_run
    from tgslam.types import Frame, FrameReport, FrameStatus, Gaussians, Plane, Trajectory

__version__ = "0.1.0"
__all__ = [
    "Camera",
    "Config",
    "Frame",
    "FrameReport",
    "FrameStatus",
    "Gaussians",
    "Plane",
    "Recording",
    "Slam",
    "TgslamError",
    "Trajectory",
    "load_config",
    "open_recording",
    "save_run",
]

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # stdout is the user's; read when taichi is imported

_MODULES = {
    "Camera": "camera",
    "Config": "config.schema",
    "Recording": "recording",
    "Slam": "adaptation",
    "TgslamError": "errors",
    "load_config": "config.loader",
    "open_recording": "recording",
    "save_run": "saving",
}  # of what is not in `types`
_NAMES = {"load_config": "load"}  # there, where it differs


def _import_from_checkout(name: str) -> None:
    """Import the package that stands beside tgslam/ in a checkout as `tgslam.name`, as it is where it is installed.

    Extending `__path__` by the checkout would make everything in there a part of tgslam, tgslam itself included.
    """
    folder = Path(__file__).resolve().parents[1] / name
    spec = importlib.util.spec_from_file_location(
        f"{__name__}.{name}", folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = globals()[name] = module
    spec.loader.exec_module(module)


for _name in ("kernels", "configs"):
    if not (Path(__file__).parent / _name).exists():
        _import_from_checkout(_name)
del _name


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tgslam.device.quick_import import quick_import

    with quick_import():
        module = importlib.import_module(f"{__name__}.{_MODULES.get(name, 'types')}")
    value = globals()[name] = getattr(module, _NAMES.get(name, name))
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
