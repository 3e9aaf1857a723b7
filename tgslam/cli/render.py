"""`tgslam render`: a map seen along a trajectory, from a run's keyframes, or on a swing; or one picture of it all."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

import numpy as np

from tgslam.cli import engine
from tgslam.cli.bare_map import add_camera_options, bare_camera, first_look, require_a_run
from tgslam.cli.inputs import open_again
from tgslam.config.schema import Config
from tgslam.errors import OutputError
from tgslam.evaluation.held_out import Show
from tgslam.geometry import inverse, se3_exp, transform_points
from tgslam.output.log import read_log
from tgslam.output.overview import Overview, draw_overview
from tgslam.output.pictures import write_colour, write_depth, write_depth_colours
from tgslam.output.plane_overlay import plane_overlay
from tgslam.output.planes_io import read_planes
from tgslam.output.ply import read_map
from tgslam.output.run_folder import RunFolder
from tgslam.output.trajectory_io import read_trajectory, write_trajectory
from tgslam.types import Frame, Gaussians, Matrix4, Plane, Trajectory

_log = logging.getLogger(__name__)
_ORBIT_YAW_RAD = np.deg2rad(20.0)
_ORBIT_PITCH_RAD = np.deg2rad(8.0)
_ORBIT_FPS = 30.0
_MODES = ("orbit", "planes", "overview", "keyframes")  # besides a trajectory
_FAR_PERCENTILE = 95.0  # of the distances to the map's Gaussians: the blue end of depth colours


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "render",
        help="render images of a run's map, or of any 3DGS PLY",
        description="Write colour/, depth/ (16-bit PNG, 5000 units a metre, 0 = none) and depth_colours/, "
        "one PNG a pose, and the poses themselves in poses.txt; with --planes, planes/ instead of those; "
        "with --overview, overview.png.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder; or a 3DGS PLY (default: --orbit)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--trajectory", type=Path, metavar="FILE", help="camera-to-world poses as TUM text")
    what.add_argument("--keyframes", action="store_true", help="the run's keyframes")
    what.add_argument("--planes", action="store_true", help="the run's keyframes with the planes that the map shows")
    what.add_argument("--overview", action="store_true", help="one picture: input, rendering, planes and floor plan")
    what.add_argument("--orbit", action="store_true", help="a closed swing round what the first keyframe looks at")
    parser.add_argument("--count", type=_positive, default=60, metavar="N", help="poses of --orbit (default: 60)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder (default: RUN/render-...; PLY-render-...)")
    parser.add_argument("--overwrite", action="store_true", help="write into a folder that is not empty")
    add_camera_options(parser)
    engine.add_device_option(parser)
    parser.set_defaults(refuse=parser.error)
    return parser


def execute(args: argparse.Namespace) -> int:
    """Render every pose."""
    if args.run.is_file():
        return _render_ply(args)
    if args.trajectory is None and not any(getattr(args, mode) for mode in _MODES):
        args.refuse(f"one of the arguments --trajectory {' '.join(f'--{mode}' for mode in _MODES)} is required")
    folder = RunFolder.open(args.run)
    require_a_run(args)
    camera = folder.read_record().camera
    gaussians = read_map(folder.map)
    planes = _planes(folder) if args.planes or args.overview else ()
    name, poses = _poses(args, folder, gaussians)
    output = _output(args, folder.path / f"render-{name}")
    engine.start_device(args.device)
    show = engine.make_show(camera, gaussians, planes, folder.read_config())
    if args.overview:
        poses = _write_overview(output, folder, planes, poses, show)
    elif args.planes:
        _write_plane_images(output, poses, show, planes)
    else:
        _write_map_images(output, gaussians, poses, show)
    return _finish(output, poses)


def _render_ply(args: argparse.Namespace) -> int:
    """Render a PLY that comes without a run."""
    camera, gaussians = bare_camera(args), read_map(args.run)
    if args.trajectory is not None:
        name, poses = args.trajectory.stem, _stored_poses(args.trajectory)
    else:
        name, poses = "orbit", orbit(gaussians, first_look(gaussians, camera), args.count)
    output = _output(args, args.run.with_name(f"{args.run.stem}-render-{name}"))
    engine.start_device(args.device)
    _write_map_images(output, gaussians, poses, engine.make_show(camera, gaussians, (), Config()))
    return _finish(output, poses)


def _output(args: argparse.Namespace, default: Path) -> Path:
    """The folder to write. Raises OutputError when it holds something."""
    output: Path = args.output or default
    if output.exists() and (not output.is_dir() or any(output.iterdir())) and not args.overwrite:
        raise OutputError(f"{output}: is there already; choose another --output, or add --overwrite")
    return output


def _finish(output: Path, poses: Trajectory) -> int:
    write_trajectory(output / "poses.txt", poses)
    _log.info("%d image%s of each kind %s in %s", len(poses), *(("s", "are") if len(poses) > 1 else ("", "is")), output)
    return 0


def _write_map_images(output: Path, gaussians: Gaussians, poses: Trajectory, show: Show) -> None:
    for kind in ("colour", "depth", "depth_colours"):
        (output / kind).mkdir(parents=True, exist_ok=True)
    far_m = _far_m(gaussians, poses.T_wc[0])
    for number, T_wc in enumerate(poses.T_wc):
        image, _ = show(inverse(T_wc))
        file_name = f"{number:06d}.png"
        write_colour(output / "colour" / file_name, image.colour)
        write_depth(output / "depth" / file_name, image.depth_m)
        write_depth_colours(output / "depth_colours" / file_name, image.depth_m, far_m)


def _write_plane_images(output: Path, poses: Trajectory, show: Show, planes: tuple[Plane, ...]) -> None:
    (output / "planes").mkdir(parents=True, exist_ok=True)
    for number, T_wc in enumerate(poses.T_wc):
        image, ids = show(inverse(T_wc))
        assert ids is not None  # of a map with planes
        write_colour(output / "planes" / f"{number:06d}.png", plane_overlay(image.colour, ids, planes))


def _write_overview(
    output: Path, folder: RunFolder, planes: tuple[Plane, ...], keyframes: Trajectory, show: Show
) -> Trajectory:
    """Write overview.png at the keyframe that shows most planes, the first of equals, and return its pose."""
    record = folder.read_record()
    number = max(range(len(keyframes)), key=lambda k: sum(k in plane.keyframes for plane in planes))
    frame = _keyframe_image(folder, number)
    T_wc = keyframes.T_wc[number]
    rendering, ids = show(inverse(T_wc))
    assert ids is not None  # of a map with planes
    view = Overview(
        title=f"input: keyframe {number} (frame {frame.index})",
        colour=frame.colour,
        rendering=rendering.colour,
        ids=ids,
        planes=planes,
        T_wc=T_wc,
        centres_w=read_trajectory(folder.trajectory).T_wc[:, :3, 3],
        half_width=0.5 * record.camera.width / record.camera.fx,
    )
    output.mkdir(parents=True, exist_ok=True)
    write_colour(output / "overview.png", draw_overview(view), small=True)
    return Trajectory(keyframes.timestamps_s[number : number + 1], keyframes.T_wc[number : number + 1])


def _keyframe_image(folder: RunFolder, number: int) -> Frame:
    """The input of a keyframe. Raises what opening the input of the run and reading from it raise."""
    record = folder.read_record()
    positions = [position for position, report in enumerate(read_log(folder.log)) if report.is_keyframe]
    if number >= len(positions):
        raise OutputError(f"{folder.log}: names {len(positions)} keyframes, fewer than {folder.keyframes.name}")
    source = open_again(folder.read_config(), record)
    return source.read(positions[number])


def orbit(gaussians: Gaussians, T_wc: Matrix4, count: int) -> Trajectory:
    """Poses on a closed curve round the point straight ahead of `T_wc`, at the median depth of the Gaussians before it.

    The camera keeps looking at that point. Raises OutputError when no Gaussian is in front of the camera.
    """
    depths_m = transform_points(inverse(T_wc), gaussians.mean)[:, 2]
    if not (depths_m > 0).any():
        raise OutputError("no Gaussian lies in front of the first camera, so there is nothing to orbit")
    to_pivot = np.eye(4)
    to_pivot[2, 3] = np.median(depths_m[depths_m > 0])
    phases = 2.0 * np.pi * np.arange(count) / count
    turns = [
        se3_exp([_ORBIT_PITCH_RAD * (np.cos(phase) - 1.0), _ORBIT_YAW_RAD * np.sin(phase), 0, 0, 0, 0])
        for phase in phases
    ]
    poses = [T_wc @ to_pivot @ turn @ inverse(to_pivot) for turn in turns]
    return Trajectory(np.arange(count) / _ORBIT_FPS, np.stack(poses))


def _poses(args: argparse.Namespace, folder: RunFolder, gaussians: Gaussians) -> tuple[str, Trajectory]:
    """A name for the folder, and at least one pose."""
    if args.trajectory is not None:
        name, path = args.trajectory.stem, args.trajectory
    else:
        name, path = next(mode for mode in _MODES if getattr(args, mode)), folder.keyframes
    poses = _stored_poses(path)
    return name, orbit(gaussians, poses.T_wc[0], args.count) if args.orbit else poses


def _stored_poses(path: Path) -> Trajectory:
    poses = read_trajectory(path)
    if not len(poses):
        raise OutputError(f"{path}: holds no pose")
    return poses


def _planes(folder: RunFolder) -> tuple[Plane, ...]:
    """The run's planes. Raises OutputError when it has none."""
    planes = read_planes(folder.planes) if folder.planes.exists() else ()
    if not planes:
        raise OutputError(f"{folder.path}: this run has no planes to show")
    return planes


def _far_m(gaussians: Gaussians, T_wc: Matrix4) -> float:
    if not len(gaussians):
        return 1.0
    return float(np.percentile(np.linalg.norm(gaussians.mean - T_wc[:3, 3], axis=1), _FAR_PERCENTILE)) or 1.0


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)
