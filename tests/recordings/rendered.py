"""Rendered sequences: Replica."""

from __future__ import annotations

from pathlib import Path

from tests.recordings.shots import CX, CY, FX, FY, Case, H, W, shots, spoil, truncate, write_image, write_json


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
