"""tgslam: Structure Gaussian Splatting SLAM for RGB-D video, on a CPU or with CUDA, through Taichi kernels."""

import importlib.util
import sys
from pathlib import Path

__version__ = "0.1.0"


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
