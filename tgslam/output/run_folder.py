"""The folder of one run: which file is where, what kind of run it was, and how not to lose an earlier one."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any

from tgslam.camera import Camera
from tgslam.config.loader import dump, load
from tgslam.config.schema import Config
from tgslam.errors import OutputError
from tgslam.files.atomic import write_text
from tgslam.output.floorplan import write_floorplan
from tgslam.output.log import plain
from tgslam.output.plane_colours import in_plane_colours
from tgslam.output.planes_io import write_planes
from tgslam.output.ply import write_vertices
from tgslam.types import Gaussians, Plane


class RunState(Enum):
    """How far a run came."""

    RUNNING = "running"  # or killed: nothing after the frames was written
    FINISHED = "finished"
    INTERRUPTED = "interrupted"  # by the user: everything up to that frame is there
    FAILED = "failed"


@dataclass(frozen=True)
class RunRecord:
    """run.json: what `eval` and `render` need to open the same input again."""

    tgslam: str  # version that made the run
    state: RunState
    source: str  # name of the sequence
    input: str | None  # absolute path of the input folder; None = a built-in scene
    frames: tuple[int | None, int | None, int | None]  # start, stop, step of --frames
    camera: Camera  # of the frames that the run saw
    message: str = ""  # why it failed


class RunFolder:
    """Paths inside a run folder, and its small files."""

    RECORD = "run.json"
    RESULTS = (
        "trajectory.txt",
        "keyframes.txt",
        "map.ply",
        "map_extra.npz",
        "planes.json",
        "planes.glb",
        "floorplan.svg",
        "map_planes.ply",
        "metrics.json",
        "log.jsonl",
        "config.yaml",
        "partial_trajectory.txt",
        "partial_map.ply",
        "partial_map_extra.npz",
    )

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def trajectory(self) -> Path:
        """Poses of every frame."""
        return self.path / "trajectory.txt"

    @property
    def keyframes(self) -> Path:
        """Poses of the keyframes."""
        return self.path / "keyframes.txt"

    @property
    def map(self) -> Path:
        """The Gaussians; what PLY has no place for lies beside it."""
        return self.path / "map.ply"

    @property
    def planes(self) -> Path:
        """The planes."""
        return self.path / "planes.json"

    @property
    def planes_mesh(self) -> Path:
        """The planes as a mesh."""
        return self.path / "planes.glb"

    @property
    def floorplan(self) -> Path:
        """The planes from above."""
        return self.path / "floorplan.svg"

    @property
    def map_planes(self) -> Path:
        """The Gaussians in the colours of their planes."""
        return self.path / "map_planes.ply"

    @property
    def metrics(self) -> Path:
        """What the run has been measured to."""
        return self.path / "metrics.json"

    @property
    def log(self) -> Path:
        """A line a frame."""
        return self.path / "log.jsonl"

    @property
    def config(self) -> Path:
        """Every setting of the run."""
        return self.path / "config.yaml"

    @property
    def record(self) -> Path:
        """What kind of run it was."""
        return self.path / self.RECORD

    @property
    def partial_trajectory(self) -> Path:
        """Poses as of the last keyframe, of a run that goes on or was killed."""
        return self.path / "partial_trajectory.txt"

    @property
    def partial_map(self) -> Path:
        """The map likewise."""
        return self.path / "partial_map.ply"

    @classmethod
    def create(cls, path: Path, overwrite: bool) -> RunFolder:
        """Make the folder of a new run, or clear the earlier run in it when `overwrite` is set.

        Only files that a run writes are ever removed, and only from a folder that holds a run. Raises OutputError when
        a file is in the way, and OSError when the folder cannot be made.
        """
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path}: is a file; give a folder with --output")
        folder = cls(path)
        in_the_way = [name for name in (cls.RECORD, *cls.RESULTS) if (path / name).exists()]
        if in_the_way and not folder.record.exists():
            raise OutputError(f"{path}: holds {in_the_way[0]}, which no run has written; choose another --output")
        if in_the_way and not overwrite:
            raise OutputError(f"{path}: holds a run already; choose another --output, or replace it with --overwrite")
        path.mkdir(parents=True, exist_ok=True)
        for name in in_the_way:
            if name != cls.RECORD:  # kept until it is replaced, so that the folder stays known as a run's
                (path / name).unlink()
        return folder

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """The folder of an earlier run. Raises OutputError when it is none."""
        folder = cls(path)
        if not folder.record.is_file():
            raise OutputError(f"{path}: not a run folder: it has no {cls.RECORD}; `tgslam run` makes one")
        return folder

    def write_config(self, config: Config) -> None:
        """Write every setting of the run to config.yaml."""
        header = "# Every setting of this run, defaults included. `tgslam run config.yaml` takes it again.\n"
        write_text(self.config, header + dump(config))

    def read_config(self) -> Config:
        """The settings of the run. Raises ConfigError."""
        return load(self.config)

    def write_record(self, record: RunRecord) -> None:
        """Write run.json."""
        values = {**dataclasses.asdict(record), "state": record.state.value}
        write_text(self.record, json.dumps(values, indent=2) + "\n")

    def read_record(self) -> RunRecord:
        """Read run.json. Raises OutputError when it is damaged."""
        values = _read_object(self.record)
        try:
            values["state"] = RunState(values["state"])
            values["camera"] = Camera(**values["camera"])
            start, stop, step = values["frames"]
            values["frames"] = (start, stop, step)
            return RunRecord(**values)
        except (KeyError, TypeError, ValueError) as error:
            raise OutputError(f"{self.record}: damaged: {error}") from error

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write metrics.json; what is not finite becomes null."""
        write_text(self.metrics, json.dumps(plain(metrics), indent=2, allow_nan=False) + "\n")

    def read_metrics(self) -> dict[str, Any]:
        """The metrics of the run, empty when it never wrote any. Raises OutputError when they are damaged."""
        return _read_object(self.metrics) if self.metrics.exists() else {}

    def write_planes(self, planes: Sequence[Plane], gaussians: Gaussians) -> None:
        """Write planes.json and, if there are planes, what shows them: mesh, floor plan, and the map in their colours.

        Raises OutputError for values that are not finite, and OSError.
        """
        from tgslam.output.planes_mesh import write_mesh  # brings in trimesh, which everything else does without

        write_planes(self.planes, planes)
        if planes:
            write_floorplan(self.floorplan, planes)
            write_vertices(self.map_planes, in_plane_colours(gaussians, planes))
        if any(plane.polygons_w for plane in planes):
            write_mesh(self.planes_mesh, planes)


def fresh_folder(parent: Path, name: str, now: datetime) -> Path:
    """A path `parent/name-YYYYmmdd-HHMMSS` that does not exist yet (with -2, -3, ... where needed)."""
    stem = f"{name}-{now:%Y%m%d-%H%M%S}"
    path, number = parent / stem, 1
    while path.exists():
        number += 1
        path = parent / f"{stem}-{number}"
    return path


def _read_object(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
    if not isinstance(values, dict):
        raise OutputError(f"{path}: damaged: not a JSON object")
    return values
