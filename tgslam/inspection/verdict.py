"""What a survey of a recording says, in words: a table of what it is, and lines on what seems wrong."""

from __future__ import annotations

import numpy as np

from tgslam.camera import USUAL_NOISE, Camera
from tgslam.datasets.edge_alignment import said_of
from tgslam.inspection.survey import Survey, gaps_s
from tgslam.sensing import likelier_scale, unit_of

_GAP = 2.5  # times the usual time between frames
_EXPOSURE_STEP = 0.08  # of the logarithm of brightness
_SLOWEST_HZ, _FASTEST_HZ = 0.5, 250.0  # of what is filmed
_NARROWEST_DEG, _WIDEST_DEG = 20.0, 120.0  # of RGB-D cameras, across
_NAMED = 5  # of a kind that are named


def table(found: Survey, camera: Camera, depth_scale: float | None) -> list[tuple[str, str]]:
    """Names and values. depth_scale: units in a metre by which depth was read; None = it came in metres."""
    times = [frame.timestamp_s for frame in found.frames]
    rows = [("frames", f"{len(times) + len(found.unreadable)}, {len(found.unreadable)} of them unreadable")]
    if len(times) > 1:
        usual = float(np.median(gaps_s(times)))
        rows += [("duration", f"{times[-1] - times[0]:.2f} s from {times[0]:.6f} s on")]
        rows += [("rate", f"{1.0 / usual:.2f} frames/s" if usual > 0 else "times do not increase")]
        rows += [("gaps", _gaps(times))]
    rows += [("size", f"{camera.width}x{camera.height} px")]
    rows += [("camera", f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g} px")]
    rows += [("field of view", f"{_across_deg(camera):.0f} degrees across")]
    if times:
        low, middle, high = np.median([frame.depth_m for frame in found.frames], axis=0)
        rows += [("depth", f"{low:.2f} to {high:.2f} m, median {middle:.2f} m")]
        rows += [] if depth_scale is None else [("depth was read by", f"{depth_scale:g} units a metre")]
        rows += [("pixels with depth", f"{np.median([frame.measured for frame in found.frames]):.0%}")]
        rows += [("exposure steps", _exposure_steps(found))]
    if found.sensor:
        noise = np.median([one.per_m2 for one in found.sensor])
        step_mm = 1000.0 * float(np.median([one.step_m for one in found.sensor]))
        rows += [("step of depth", f"{step_mm:.2g} mm at the median")]
        rows += [("noise of depth", f"{noise / USUAL_NOISE.per_m2:.2g} times a Kinect's")]
    return rows


def warnings(found: Survey, camera: Camera, depth_scale: float | None) -> list[str]:
    """What is likely to be wrong, and what to change."""
    said = []
    if found.unreadable:
        said.append(f"{len(found.unreadable)} frames cannot be read; the first: {found.unreadable[0]}")
    times = [frame.timestamp_s for frame in found.frames]
    if len(times) > 1:
        said += _of_clock(float(np.median(gaps_s(times))))
    if found.sensor:
        said += _of_scale(found, depth_scale)
    if not _NARROWEST_DEG <= _across_deg(camera) <= _WIDEST_DEG:
        said.append(
            f"the camera sees {_across_deg(camera):.0f} degrees across, which is unusual; is dataset.fx for images of "
            f"another size than {camera.width}x{camera.height}?"
        )
    if found.off is not None:
        said.append(said_of(found.off))
    return said


def _of_clock(usual_s: float) -> list[str]:
    if usual_s > 0 and _SLOWEST_HZ <= 1.0 / usual_s <= _FASTEST_HZ:
        return []
    return [f"frames are {usual_s:g} s apart: their times are no seconds, or they are no video"]


def _of_scale(found: Survey, depth_scale: float | None) -> list[str]:
    per_m2, reach = (float(np.median([getattr(one, name) for one in found.sensor])) for name in ("per_m2", "reach_m"))
    other = None if depth_scale is None else likelier_scale(depth_scale, per_m2, reach)
    if depth_scale is not None and other is not None:
        return [
            f"dataset.depth_scale={depth_scale:g} is likely wrong: {other:g} makes a room of it, seen by a usual "
            f"sensor, with lengths {depth_scale / other:g} times as large"
        ]
    if unit_of(reach) != 1.0:
        return [f"what is seen reaches {reach:.2g} m, which is no room; if it is one, check dataset.depth_scale"]
    return []


def _gaps(times: list[float]) -> str:
    gaps = gaps_s(times)
    long = np.flatnonzero(gaps > _GAP * float(np.median(gaps)))
    if not len(long):
        return "none"
    named = ", ".join(f"{gaps[k]:.2f} s after frame {k}" for k in long[:_NAMED])
    return f"{len(long)}: {named}{', ...' if len(long) > _NAMED else ''}"


def _exposure_steps(found: Survey) -> str:
    steps = np.array([frame.brightness_step for frame in found.frames])
    large = np.flatnonzero(np.abs(np.nan_to_num(steps)) > _EXPOSURE_STEP)
    if not len(large):
        return "none"
    named = ", ".join(f"x{np.exp(steps[k]):.2f} at frame {k}" for k in large[:_NAMED])
    return f"{len(large)}: {named}{', ...' if len(large) > _NAMED else ''}"


def _across_deg(camera: Camera) -> float:
    return float(np.rad2deg(2.0 * np.arctan(camera.width / (2.0 * camera.fx))))
