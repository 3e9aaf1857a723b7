"""The layouts that recordings are written in: where the images of a frame go, and the files that list them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tgslam.camera import Camera
from tgslam.types import Matrix4

TUM_DEPTH_SCALE = 5000.0
_REPLICA_DEPTH_SCALE = 6553.5  # 10 m are the most that 16 bits hold
_MILLIMETRES = 1000.0
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # of a camera that looks along -z with y up


@dataclass(frozen=True)
class Written:
    """A frame whose images are in the folder."""

    number: int  # from 0, without those that were left out
    timestamp_s: float
    T_wc: Matrix4 | None  # [4, 4], where it is known


Index = Callable[[Camera, Sequence[Written]], dict[str, str]]  # file -> text


@dataclass(frozen=True)
class Layout:
    """How a recording lies in a folder. Templates take `number` and `time`, in s."""

    colour: str  # path of a colour image
    depth: str  # path of a depth image: PNG of 16 bits
    depth_scale: float  # its units in a metre
    index: Index  # the files that list the frames
    every_pose: bool = False  # it has no way to say that the pose of a frame is not known
    rows_upwards: bool = False  # images are stored from their last row on, as ICL-NUIM's are
    trajectory: str | None = None  # file of the poses, at their own times
    numbered: bool = False  # its times are the numbers of the frames

    @property
    def farthest_m(self) -> float:
        """What lies beyond has no place in 16 bits."""
        return np.iinfo(np.uint16).max / self.depth_scale

    def time_s(self, frame: Written) -> float:
        """When the frame is said to have been taken."""
        return float(frame.number) if self.numbered else frame.timestamp_s


def _tum_index(camera: Camera, frames: Sequence[Written]) -> dict[str, str]:
    files = {"camera.yaml": _camera_yaml("tum", camera)}
    for kind in ("rgb", "depth"):
        rows = [f"{f.timestamp_s:.6f} {kind}/{f.timestamp_s:.6f}.png\n" for f in frames]
        files[f"{kind}.txt"] = "".join(["# timestamp filename\n", *rows])
    return files


def _icl_index(camera: Camera, frames: Sequence[Written]) -> dict[str, str]:
    upwards = Camera(camera.width, camera.height, camera.fx, -camera.fy, camera.cx, camera.height - 1 - camera.cy)
    rows = [f"{f.number} depth/{f.number}.png {f.number} rgb/{f.number}.png\n" for f in frames]
    return {"associations.txt": "".join(rows), "camera.yaml": _camera_yaml("icl", upwards)}


def _camera_yaml(format: str, camera: Camera) -> str:
    """The config that reads a folder back."""
    lines = ["dataset:", f"  format: {format}", f"  depth_scale: {TUM_DEPTH_SCALE}"]
    lines += [f"  {key}: {getattr(camera, key)!r}" for key in ("fx", "fy", "cx", "cy")]
    return "\n".join(lines) + "\n"


def _replica_index(camera: Camera, frames: Sequence[Written]) -> dict[str, str]:
    values: dict[str, float] = {"w": camera.width, "h": camera.height}
    values |= {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
    values["scale"] = _REPLICA_DEPTH_SCALE
    rows = [" ".join(f"{value:.12g}" for value in _pose(frame).ravel()) + "\n" for frame in frames]
    return {"cam_params.json": json.dumps({"camera": values}, indent=4) + "\n", "traj.txt": "".join(rows)}


def _nerfstudio_index(camera: Camera, frames: Sequence[Written]) -> dict[str, str]:
    """Its pixels have their centres at halves, so that the principal point is half a pixel farther from the corner."""
    values = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "depth_unit_scale_factor": 1.0 / _MILLIMETRES,
        "frames": [
            {
                "file_path": NERFSTUDIO.colour.format(number=frame.number),
                "depth_file_path": NERFSTUDIO.depth.format(number=frame.number),
                "timestamp": frame.timestamp_s,
                "transform_matrix": (_pose(frame) @ _OPENGL).tolist(),
            }
            for frame in frames
        ],
    }
    return {"transforms.json": json.dumps(values, indent=2) + "\n"}


def _pose(frame: Written) -> Matrix4:
    assert frame.T_wc is not None  # frames without are left out where every one needs it
    return frame.T_wc


TUM = Layout("rgb/{time:.6f}.png", "depth/{time:.6f}.png", TUM_DEPTH_SCALE, _tum_index, trajectory="groundtruth.txt")
ICL = Layout(
    "rgb/{number}.png",
    "depth/{number}.png",
    TUM_DEPTH_SCALE,
    _icl_index,
    rows_upwards=True,
    trajectory="groundtruth.txt",
    numbered=True,
)
REPLICA = Layout(
    "results/frame{number:06d}.jpg", "results/depth{number:06d}.png", _REPLICA_DEPTH_SCALE, _replica_index, True
)
NERFSTUDIO = Layout(
    "images/frame_{number:06d}.png", "depths/frame_{number:06d}.png", _MILLIMETRES, _nerfstudio_index, True
)
LAYOUTS = {"tum": TUM, "icl": ICL, "replica": REPLICA, "nerfstudio": NERFSTUDIO}
