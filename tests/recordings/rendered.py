"""Rendered sequences: Replica and TartanAir."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.recordings.shots import CX, CY, FX, FY, Case, H, W, shots, spoil, truncate, write_image, write_json
from tgslam.geometry import quat_wxyz_from_matrix

NED = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # our camera's axes in north, east, down
INTRINSICS = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}


def write_replica(folder: Path) -> Path:
    """The sequence's folder, with the camera above it."""
    sequence, scale = folder / "room0", 6553.5
    rows = []
    for shot in shots():
        write_image(sequence / f"results/frame{shot.number:06}.jpg", shot.colour)
        depth = (shot.depth_m * scale + 0.5).astype("uint16")
        write_image(sequence / f"results/depth{shot.number:06}.png", depth)
        rows.append(" ".join(f"{x:.9e}" for x in shot.T_wc.ravel()))
    (sequence / "traj.txt").write_text("\n".join(rows) + "\n")
    camera = {"w": W, "h": H, "fx": FX, "fy": FY, "cx": CX, "cy": CY, "scale": scale}
    write_json(folder / "cam_params.json", {"camera": camera})
    return sequence


REPLICA = Case(
    "replica",
    write_replica,
    {
        "image": (lambda path: truncate(path / "results/depth000001.png"), r"depth000001\.png: .*truncated"),
        "camera": (lambda path: spoil(path.parent / "cam_params.json"), r"cam_params\.json: not JSON"),
        "poses": (lambda path: spoil(path / "traj.txt"), r"traj\.txt: expected numbers only"),
    },
    colour_steps=6,
)


def write_tartanair(folder: Path, camera: str) -> Path:
    """V1 for the camera "left", V2 for "lcam_front"."""
    trajectory, rows = folder / "office" / "Easy" / "P000", []
    for shot in shots():
        name = f"{shot.number:06}_{camera}"
        write_image(trajectory / f"image_{camera}/{name}.png", shot.colour)
        depth = trajectory / f"depth_{camera}/{name}_depth"
        if camera == "left":
            depth.parent.mkdir(parents=True, exist_ok=True)
            np.save(depth.with_suffix(".npy"), shot.depth_m)
        else:
            write_image(depth.with_suffix(".png"), shot.depth_m.view(np.uint8).reshape(H, W, 4))
        T = NED @ shot.T_wc @ NED.T
        w, x, y, z = quat_wxyz_from_matrix(T[:3, :3])
        rows.append(" ".join(f"{value:.9f}" for value in (*T[:3, 3], x, y, z, w)))
    (trajectory / f"pose_{camera}.txt").write_text("\n".join(rows))
    return trajectory


TARTANAIR_V1 = Case(
    "tartanair",
    lambda folder: write_tartanair(folder, "left"),
    {
        "depth": (lambda path: truncate(path / "depth_left/000001_left_depth.npy"), r"000001_left_depth\.npy: not an"),
        "image": (lambda path: truncate(path / "image_left/000002_left.png"), r"000002_left\.png: .*truncated"),
        "poses": (lambda path: (path / "pose_left.txt").write_text("1 2 3"), r"pose_left\.txt: expected 7 numbers"),
        "camera": (lambda path: (path / "depth_left").rename(path / "depth_right"), "its format is not known"),
    },
    INTRINSICS,
    name="tartanair-v1",
)
TARTANAIR_V2 = Case(
    "tartanair",
    lambda folder: write_tartanair(folder, "lcam_front"),
    {
        "depth": (
            lambda path: write_image(path / "depth_lcam_front/000001_lcam_front_depth.png", shots()[0].depth_mm),
            r"000001_lcam_front_depth\.png: expected a PNG with four bytes a pixel",
        ),
        "image": (lambda path: truncate(path / "image_lcam_front/000000_lcam_front.png"), r"front\.png: .*truncated"),
        "poses": (lambda path: spoil(path / "pose_lcam_front.txt"), r"pose_lcam_front\.txt: expected numbers only"),
    },
    INTRINSICS,
    name="tartanair-v2",
)
