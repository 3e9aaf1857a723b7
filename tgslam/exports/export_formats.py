"""The formats that `tgslam export` writes, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tgslam.errors import OutputError
from tgslam.exports.colmap import write_colmap
from tgslam.exports.dxf_plan import write_dxf
from tgslam.exports.kitti_poses import write_kitti
from tgslam.exports.nerfstudio_folder import write_nerfstudio
from tgslam.exports.packed_ply import write_packed_ply
from tgslam.exports.run_content import RunContent
from tgslam.exports.sparse_cloud import sparse_cloud
from tgslam.exports.splat_rows import write_splat
from tgslam.exports.spz import write_spz
from tgslam.output.floorplan import write_floorplan
from tgslam.output.planes_io import write_planes
from tgslam.output.ply import write_vertices
from tgslam.output.trajectory_io import write_trajectory
from tgslam.types import Plane


@dataclass(frozen=True)
class ExportFormat:
    """A way to write a run."""

    file: str  # name of the file, or folder, that is written by default
    write: Callable[[Path, RunContent], None]
    is_folder: bool = False
    levels: bool = True  # whether a level world makes a difference


def write_export(name: str, content: RunContent, path: Path, overwrite: bool) -> None:
    """Write a run as `FORMATS[name]` to a file, or into a folder.

    Raises OutputError for what is in the way and for what the run lacks, and OSError.
    """
    chosen = FORMATS[name]
    own = content.folder
    if path.resolve() in {(own.path / file).resolve() for file in (own.RECORD, *own.RESULTS)}:
        raise OutputError(f"{path}: is the run's own, which an export never replaces; choose another --output")
    if path.is_dir() != chosen.is_folder and path.exists():
        raise OutputError(f"{path}: {name} is a {'folder' if chosen.is_folder else 'file'}; choose another --output")
    if path.exists() and not overwrite and not (chosen.is_folder and not any(path.iterdir())):
        raise OutputError(f"{path}: is there already; choose another --output, or add --overwrite")
    path.parent.mkdir(parents=True, exist_ok=True)
    chosen.write(path, content)


def _colmap(folder: Path, content: RunContent, *, text: bool) -> None:
    write_colmap(folder, content.camera, content.views(), sparse_cloud(content.gaussians), text=text)


def _nerfstudio(folder: Path, content: RunContent) -> None:
    write_nerfstudio(folder, content.camera, content.views(), sparse_cloud(content.gaussians))


def _planes_mesh(path: Path, content: RunContent) -> None:
    from tgslam.output.planes_mesh import write_mesh  # brings in trimesh, which all others do without

    if not any(plane.polygons_w for plane in content.planes):
        raise OutputError(f"{content.folder.path}: this run has no planes with outlines to export")
    write_mesh(path, content.planes)


def _plan_planes(content: RunContent) -> tuple[Plane, ...]:
    if not content.plan_planes:
        raise OutputError(f"{content.folder.path}: this run has no planes to draw a floor plan of")
    return content.plan_planes


FORMATS = {
    "ply": ExportFormat("map.ply", lambda path, run: write_vertices(path, run.gaussians)),
    "splat": ExportFormat("map.splat", lambda path, run: write_splat(path, run.gaussians)),
    "spz": ExportFormat("map.spz", lambda path, run: write_spz(path, run.gaussians, run.level)),
    "compressed-ply": ExportFormat("map.compressed.ply", lambda path, run: write_packed_ply(path, run.gaussians)),
    "colmap": ExportFormat("colmap", lambda path, run: _colmap(path, run, text=False), is_folder=True),
    "colmap-text": ExportFormat("colmap-text", lambda path, run: _colmap(path, run, text=True), is_folder=True),
    "nerfstudio": ExportFormat("nerfstudio", _nerfstudio, is_folder=True),
    "tum": ExportFormat("trajectory.tum.txt", lambda path, run: write_trajectory(path, run.trajectory)),
    "kitti": ExportFormat("trajectory.kitti.txt", lambda path, run: write_kitti(path, run.trajectory)),
    "planes": ExportFormat("planes.json", lambda path, run: write_planes(path, run.planes)),
    "glb": ExportFormat("planes.glb", _planes_mesh),
    "svg": ExportFormat("floorplan.svg", lambda path, run: write_floorplan(path, _plan_planes(run)), levels=False),
    "dxf": ExportFormat("floorplan.dxf", lambda path, run: write_dxf(path, _plan_planes(run)), levels=False),
}
