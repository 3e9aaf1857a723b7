"""nerfstudio's folder: images, depth, `transforms.json`, and a cloud of points to start from."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from tgslam.camera import Camera
from tgslam.conversion.targets import NERFSTUDIO, Written
from tgslam.exports.run_content import View
from tgslam.exports.sparse_cloud import SparseCloud, write_cloud
from tgslam.files.atomic import write_text
from tgslam.output.pictures import write_colour, write_depth

CLOUD = "sparse_pc.ply"
_INDEX = "transforms.json"


def write_nerfstudio(folder: Path, camera: Camera, views: Iterable[View], cloud: SparseCloud) -> None:
    """Write the images and, last, transforms.json, which is taken away first where there is one. Raises OSError."""
    for template in (NERFSTUDIO.colour, NERFSTUDIO.depth):
        (folder / template).parent.mkdir(parents=True, exist_ok=True)
    (folder / _INDEX).unlink(missing_ok=True)
    written = []
    for view in views:
        write_colour(folder / NERFSTUDIO.colour.format(number=view.number), view.frame.colour)
        write_depth(folder / NERFSTUDIO.depth.format(number=view.number), view.frame.depth_m, NERFSTUDIO.depth_scale)
        written.append(Written(view.number, view.frame.timestamp_s, view.T_wc))
    write_cloud(folder / CLOUD, cloud)
    index = json.loads(NERFSTUDIO.index(camera, written)[_INDEX])
    write_text(folder / _INDEX, json.dumps({**index, "ply_file_path": CLOUD}, indent=2) + "\n")
