"""tgslam: Structure Gaussian Splatting SLAM for RGB-D video, on a CPU or with CUDA, through Taichi kernels."""

from pathlib import Path

__version__ = "0.1.0"

_here = Path(__file__).resolve().parent
if not (_here / "kernels").exists():
    # A checkout (plain or editable): kernels/ and configs/ stand beside tgslam/ and are subpackages of it all the same.
    __path__.append(str(_here.parent))
