"""All layouts that can be read, in the order in which a folder or file is tried for them."""

from __future__ import annotations

from pathlib import Path

from tgslam.datasets.icl import ICL
from tgslam.datasets.layout import Layout
from tgslam.datasets.layouts.bonn import BONN
from tgslam.datasets.layouts.bundle_fusion import BUNDLE_FUSION
from tgslam.datasets.layouts.described import FOLDER, plain_folder
from tgslam.datasets.layouts.nerfstudio import NERFSTUDIO
from tgslam.datasets.layouts.open3d_recording import OPEN3D
from tgslam.datasets.layouts.polycam import POLYCAM
from tgslam.datasets.layouts.record3d import RECORD3D
from tgslam.datasets.layouts.replica import REPLICA
from tgslam.datasets.layouts.ros_bag import ROS
from tgslam.datasets.layouts.scannet import SCANNET
from tgslam.datasets.layouts.scannetpp import SCANNETPP
from tgslam.datasets.layouts.sens_file import SENS
from tgslam.datasets.layouts.seven_scenes import SEVEN_SCENES
from tgslam.datasets.layouts.tartanair import TARTANAIR
from tgslam.datasets.tum import TUM

LAYOUTS: tuple[Layout, ...] = (
    FOLDER, BONN, TUM, ICL, REPLICA, BUNDLE_FUSION, SEVEN_SCENES, TARTANAIR, SENS, SCANNET, SCANNETPP, NERFSTUDIO,
    RECORD3D, POLYCAM, OPEN3D, ROS,
)  # fmt: skip


def layout_named(name: str) -> Layout | None:
    """The layout that `dataset.format` calls so."""
    return next((layout for layout in LAYOUTS if layout.name == name), None)


def layout_of(path: Path) -> Layout | None:
    """The layout that a folder or file, which exists, looks like."""
    is_file = path.is_file()
    candidates = (layout for layout in LAYOUTS if layout.is_file or not is_file)
    found = next((layout for layout in candidates if layout.recognises(path)), None)
    if found is None and all(plain_folder(path, kind) for kind in ("colour", "depth")):
        return FOLDER
    return found
