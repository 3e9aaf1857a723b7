"""Recordings of phones: Record3D, Polycam, ScanNet++, and nerfstudio's layout, in which they often come."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.recordings.shots import (
    CX,
    CY,
    FX,
    FY,
    OPENGL,
    Case,
    H,
    K,
    W,
    encoded,
    shots,
    spoil,
    truncate,
    write_image,
    write_json,
)
from tgslam.geometry import quat_wxyz_from_matrix


def write_nerfstudio(folder: Path) -> Path:
    frames = []
    for shot in reversed(shots()):
        name = f"frame_{shot.number + 9}"  # 9, 10, 11
        write_image(folder / f"images/{name}.png", shot.colour)
        write_image(folder / f"depths/{name}.png", shot.depth_mm)
        frames.append(
            {
                "file_path": f"./images/{name}.png",
                "depth_file_path": f"depths/{name}.png",
                "transform_matrix": (shot.T_wc @ OPENGL).tolist(),
            }
        )
    camera = {"fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5, "w": W, "h": H, "camera_model": "OPENCV"}
    write_json(folder / "transforms.json", {**camera, "k1": 0.0, "frames": frames})
    return folder


def write_scannetpp(folder: Path) -> Path:
    """The scene's folder; the images have no entry for a fourth frame."""
    phone, entries = folder / "0a5c013435" / "iphone", {}
    for shot in shots():
        name = f"frame_{10 * shot.number:06}"
        write_image(phone / f"rgb/{name}.jpg", shot.colour)
        write_image(phone / f"depth/{name}.png", shot.depth_mm)
        entries[name] = {
            "timestamp": 100.0 + shot.number / 6,
            "intrinsic": K.tolist(),
            "pose": np.eye(4).tolist(),
            "aligned_pose": shot.T_wc.tolist(),
        }
    write_image(phone / "rgb/frame_000030.jpg", shots()[0].colour)
    write_image(phone / "depth/frame_000030.png", shots()[0].depth_mm)
    write_json(phone / "pose_intrinsic_imu.json", entries)
    return phone.parent


def record3d_members(compress: Callable[[bytes], bytes] = zlib.compress) -> dict[str, bytes]:
    import json

    poses, members = [], {}
    for shot in shots():
        T = shot.T_wc @ OPENGL
        w, x, y, z = quat_wxyz_from_matrix(T[:3, :3])
        poses.append([x, y, z, w, *T[:3, 3]])
        members[f"rgbd/{shot.number}.jpg"] = encoded(shot.colour, ".jpg")
        members[f"rgbd/{shot.number}.depth"] = compress(shot.depth_m.astype("<f4").tobytes())
        members[f"rgbd/{shot.number}.conf"] = compress(bytes(W * H))
    metadata = {"w": W, "h": H, "dw": W, "dh": H, "fps": 60, "K": K.T.ravel().tolist(), "poses": poses}
    members["metadata"] = json.dumps(metadata).encode()
    return members


def write_zip(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def write_record3d(folder: Path) -> Path:
    return write_zip(folder / "kitchen.r3d", record3d_members())


def write_polycam(folder: Path) -> Path:
    capture = folder / "capture"
    for shot in shots():
        name = 1_000_000 + 500_000 * shot.number
        write_image(capture / f"keyframes/images/{name}.jpg", shot.colour)
        write_image(capture / f"keyframes/depth/{name}.png", shot.depth_mm)
        T = shot.T_wc @ OPENGL
        camera = {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        intrinsics = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": W, "height": H, "timestamp": name}
        write_json(capture / f"keyframes/cameras/{name}.json", {**camera, **intrinsics, "blur_score": 70.0})
    return capture


def with_members(path: Path, **changes: bytes | None) -> None:
    """Rewrite a .r3d; None removes a member, and `depth` stands for that of frame 1."""
    names = {"depth": "rgbd/1.depth", "colour": "rgbd/2.jpg"}
    members = record3d_members()
    for key, data in changes.items():
        members.pop(names.get(key, key))
        if data is not None:
            members[names.get(key, key)] = data
    write_zip(path, members)


NERFSTUDIO = Case(
    "nerfstudio",
    write_nerfstudio,
    {
        "json": (lambda path: truncate(path / "transforms.json"), r"transforms\.json: not JSON"),
        "outside": (
            lambda path: write_json(
                path / "transforms.json", {"frames": [{"file_path": "../a.png", "depth_file_path": "a.png"}]}
            ),
            r"transforms\.json: '\.\./a\.png' leads out of the folder",
        ),
        "no depth": (
            lambda path: write_json(path / "transforms.json", {"frames": [{"file_path": "images/frame_9.png"}]}),
            r"transforms\.json: none of its 1 frames has a depth_file_path",
        ),
        "image": (lambda path: (path / "images/frame_10.png").unlink(), r"frame_10\.png: cannot be read"),
    },
)
SCANNETPP = Case(
    "scannetpp",
    write_scannetpp,
    {
        "json": (lambda path: spoil(path / "iphone/pose_intrinsic_imu.json"), r"pose_intrinsic_imu\.json: not JSON"),
        "empty": (
            lambda path: write_json(path / "iphone/pose_intrinsic_imu.json", {}),
            r"pose_intrinsic_imu\.json: has no entry",
        ),
        "not extracted": (
            lambda path: (path / "iphone/depth").rename(path / "iphone/raw"),
            r"iphone: found no depth images; .*prepare_iphone_data",
        ),
    },
    colour_steps=6,
    times_s=(100.0, 100 + 1 / 6, 100 + 2 / 6),
)
RECORD3D = Case(
    "record3d",
    write_record3d,
    {
        "zip": (truncate, r"kitchen\.r3d: not a zip file"),
        "metadata": (lambda path: with_members(path, metadata=b"{"), r"kitchen\.r3d: metadata: not JSON"),
        "depth": (lambda path: with_members(path, depth=b"12"), r"kitchen\.r3d: rgbd/1\.depth: has 2 bytes"),
        "colour": (lambda path: with_members(path, colour=b"\xff\xd8"), r"kitchen\.r3d: rgbd/2\.jpg: "),
        "member": (lambda path: with_members(path, depth=None), r"kitchen\.r3d: rgbd/1\.depth: is not in it"),
    },
    colour_steps=6,
    times_s=(0.0, 1 / 60, 2 / 60),
)
POLYCAM = Case(
    "polycam",
    write_polycam,
    {
        "camera": (lambda path: spoil(path / "keyframes/cameras/1500000.json"), r"1500000\.json: not JSON"),
        "pose": (
            lambda path: write_json(
                path / "keyframes/cameras/1500000.json", {"fx": 1, "fy": 1, "cx": 1, "cy": 1, "t_00": 1}
            ),
            r"1500000\.json: expected a number as 't_01', found none",
        ),
        "no depth": (
            lambda path: (path / "keyframes/depth").rename(path / "keyframes/none"),
            r"keyframes: found no depth images; .*LiDAR mode",
        ),
    },
    colour_steps=6,
    times_s=(0.0, 0.5, 1.0),
)
