"""planes.glb: the outlines of the planes, filled with their colours, in the world frame of map.ply."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from tgslam.files.atomic import atomic_file
from tgslam.geometry import tangent_axes
from tgslam.output.triangulation import triangulate
from tgslam.types import Plane


def write_mesh(path: Path, planes: Sequence[Plane]) -> None:
    """Write a glTF binary with a node `plane ID` for each plane that has an outline; there must be one. Raises OSError.

    Triangles face the side that the plane was seen from, and are visible from both.
    """
    scene = trimesh.Scene()
    for plane in planes:
        if plane.polygons_w:
            name = f"plane {plane.id}"
            scene.add_geometry(_mesh(plane, name), node_name=name, geom_name=name)
    with atomic_file(path) as file:
        file.write(scene.export(file_type="glb"))


def _mesh(plane: Plane, name: str) -> trimesh.Trimesh:
    axes = tangent_axes(plane.normal_w)
    first = np.cumsum([0, *(len(polygon) for polygon in plane.polygons_w)])
    triangles = [triangulate(polygon @ axes.T) for polygon in plane.polygons_w]
    faces = np.concatenate([part + start for part, start in zip(triangles, first, strict=False)])
    material = PBRMaterial(
        name=name,
        baseColorFactor=[*_linear(np.array(plane.colour)), 1.0],
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    return trimesh.Trimesh(
        np.concatenate(plane.polygons_w), faces, process=False, visual=TextureVisuals(material=material)
    )


def _linear(srgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """sRGB in [0, 1] as the linear values that glTF wants."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
