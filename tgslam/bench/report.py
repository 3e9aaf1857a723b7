"""What the benchmarks found, as tables; and the machine that they ran on."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import tgslam
from tgslam.bench.ablation import results as table
from tgslam.bench.paper import side_by_side
from tgslam.bench.whole_run import CACHES
from tgslam.device import runtime
from tgslam.output.console import print_columns

_CPU_INFO = Path("/proc/cpuinfo")
_DIRECTIONS = ("forward", "backward")


def machine() -> dict[str, Any]:
    """Processor, cores, versions, and how busy it is: what any figure is to be read beside."""
    return {
        "cpu": _cpu(),
        "cores": runtime.available_threads(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,  # processes wanting a core, last minute
        "system": platform.platform(),
        "python": platform.python_version(),
        "taichi": version("taichi"),
        "numpy": version("numpy"),
        "tgslam": tgslam.__version__,
    }


def print_machine(found: dict[str, Any]) -> None:
    """One line."""
    load = "" if found["load"] is None else f", load {found['load']:.1f} at the end"
    print(f"{found['cpu']}, {found['cores']} cores{load}; Python {found['python']}, Taichi {found['taichi']}")


def print_render(result: dict[str, Any]) -> None:
    """Rates, stages, linearity and scaling."""
    print_machine(result["machine"])
    flops = result["flops_per_pair"]
    for run in result["runs"]:
        where = f"{run['threads']} thread{'s' if run['threads'] > 1 else ''}"
        print()
        print_columns(
            f"rasterizer, {where}: ns a pair and share of the peak of {run['peak_gflops']:.0f} GFLOP/s, whole pass "
            f"(blending alone); {flops['forward']} and {flops['backward']} FLOP a pair",
            ("case", "Gaussians", "slots", "pairs", "skipped", "forward ns", "of peak", "backward ns", "of peak"),
            [_rates(case) for case in run["cases"]],
        )
        for direction in _DIRECTIONS:
            print()
            _print_stages(f"{direction}, {where}: ms, least / median", run["cases"], direction)
        print()
        print_columns(
            f"linearity, {where}: change of the ns a pair, whole pass (blending alone)",
            ("change", "slots", "pairs", "forward", "backward", "blending, both"),
            [_linearity(row) for row in run["linearity"]],
        )
    if result["scaling"]:
        print()
        cases = result["runs"][0]["cases"]
        print_columns(
            "scaling: times as fast, whole pass (slowest to speed up of its stages)",
            ("case", "Gaussians", "threads", "forward", "backward"),
            [_scaling(row, cases[row["case"]]) for row in result["scaling"]],
        )


def print_track(result: dict[str, Any]) -> None:
    """One step by stage."""
    print_machine(result["machine"])
    size = f"{result['source']} at {result['width']}x{result['height']}"
    print_columns(
        f"tracking step ({result['solver']}), {size}, {result['gaussians']:,} Gaussians, {result['frames']} frames, "
        f"{_threads(result)}",
        ("stage", "least ms", "median ms", "share"),
        [*_stage_rows(result), ("whole step", *_ms(result["ms"]), "")],
    )
    if result["map_ms"]:
        print(f"  mapping a keyframe: {result['map_ms']['median']:.1f} ms, median of {result['keyframes']}")


def print_map(result: dict[str, Any]) -> None:
    """One mapping iteration of each scene by stage."""
    print_machine(result["machine"])
    for case in result["cases"]:
        print()
        print_columns(
            f"mapping iteration, {_name(case)}, {case['gaussians']:,} Gaussians, {_threads(result)}",
            ("stage", "least ms", "median ms", "share"),
            [*_stage_rows(case), ("whole iteration", *_ms(case["ms"]), "")],
        )


def print_run(result: dict[str, Any]) -> None:
    """Both runs side by side."""
    print_machine(result["machine"])
    cold, warm = result["runs"]
    rows = [
        ("start of the process to first tracked frame, s", *_pair(cold, warm, "first_tracked_s")),
        ("whole process, s", *_pair(cold, warm, "process_s")),
        ("kernels", str(cold["kernels"]), str(warm["kernels"])),
        ("frames/s", *_pair(cold, warm, "fps")),
        ("frames", str(cold["frames"]), str(warm["frames"])),
        ("keyframes", str(cold["keyframes"]), str(warm["keyframes"])),
        ("Gaussians", f"{cold['gaussians']:,}", f"{warm['gaussians']:,}"),
        ("peak memory, MiB", f"{cold['peak_rss_mb']:.0f}", f"{warm['peak_rss_mb']:.0f}"),
    ]
    for title, group in (("kernels", "compile_s"), ("stage", "stage_s")):
        names = dict.fromkeys([*cold[group], *warm[group]])
        rows += [(f"{title}: {name}, s", *_pair(cold[group], warm[group], name)) for name in names]
    print_columns(f"tgslam run {' '.join(result['arguments'])}".rstrip(), ("kernel cache", *CACHES), rows)


def print_ablation(result: dict[str, Any]) -> None:
    """A table for each study and input; runs that failed are named below it."""
    print_machine(result["machine"])
    for frame in result["identity"]:
        print()
        titles, *body = table.identity_rows(frame)
        print_columns(table.identity_heading(frame), titles, body)
    for found in result["tables"]:
        print()
        print_columns(table.heading(found), table.header(found), table.rows(found))
        for failure in table.failed_runs(found):
            print(f"  failed: {failure}")


def print_paper(result: dict[str, Any]) -> None:
    """The paper's tables of which something is there; below them, what is not there and what failed."""
    print_machine(result["machine"])
    for heading, titles, rows in side_by_side.shown(result["tables"]):
        print()
        print_columns(heading, titles, rows)
    if result["identity"] is not None:
        print()
        titles, *body = table.identity_rows(result["identity"])
        print_columns(side_by_side.figure_heading(result["identity"]), titles, body)
    lines = side_by_side.absent(result["tables"])
    lines += [f"failed: {failure}" for failure in side_by_side.failed_runs(result["tables"])]
    for line in lines:
        print(f"  {line}")


def print_graph(result: dict[str, Any]) -> None:
    """An update of each graph, and what its process took of memory."""
    print_machine(result["machine"])
    rows = [
        (
            f"{case['keyframes']:,}",
            f"{case['planes']:,}",
            f"{case['sightings']:,}",
            *(f"{case['update_ms'][name]:.2f}" for name in ("mean", "median", "max")),
            f"{case['cpu_ms']:.2f}",
            "-" if case["peak_rss_mb"] is None else f"{case['peak_rss_mb']:.0f}",
        )
        for case in result["cases"]
    ]
    heads = ("keyframes", "planes", "seen by each", "mean, ms", "median, ms", "most, ms", "CPU, ms", "peak memory, MiB")
    print_columns("an update of the pose graph after each keyframe", heads, rows)


def _rates(case: dict[str, Any]) -> tuple[str, ...]:
    slot_pairs = case["pairs"] + case["pairs_skipped"]
    row = [
        _name(case),
        f"{case['gaussians']:,}",
        f"{case['slots']:,}",
        f"{case['pairs'] / 1e6:.2f} M",
        f"{case['pairs_skipped'] / max(slot_pairs, 1):.0%}",
    ]
    for direction in _DIRECTIONS:
        times = case[direction]
        row.append(f"{times['ns_per_pair']:.2f} ({times['blend_ns_per_pair']:.2f})")
        row.append(f"{times['share_of_peak']:.1%} ({times['blend_share_of_peak']:.1%})")
    return tuple(row)


def _print_stages(title: str, cases: list[dict[str, Any]], direction: str) -> None:
    stages = list(dict.fromkeys(name for case in cases for name in case[direction]["stages_ms"]))
    rows = []
    for case in cases:
        times = case[direction]
        cells = [times["stages_ms"].get(name) for name in stages]
        rows.append((_name(case), f"{case['gaussians']:,}", *map(_both, cells), _both(times["ms"])))
    print_columns(title, ("case", "Gaussians", *stages, "whole pass"), rows)


def _linearity(row: dict[str, Any]) -> tuple[str, ...]:
    changes = (
        f"{row[f'{direction}_ns_per_pair_percent']:+.0f} % ({row[f'{direction}_blend_ns_per_pair_percent']:+.0f} %)"
        for direction in _DIRECTIONS
    )
    both = f"{row['blend_ns_per_pair_percent']:+.0f} %"
    return (row["change"], f"x {row['slots_ratio']:.2f}", f"x {row['pairs_ratio']:.2f}", *changes, both)


def _scaling(row: dict[str, Any], case: dict[str, Any]) -> tuple[str, ...]:
    cells = []
    for direction in _DIRECTIONS:
        slowest = min(row[direction]["stages"], key=row[direction]["stages"].__getitem__)
        least = row[direction]["stages"][slowest]
        cells.append(f"x {row[direction]['speedup']:.2f} ({slowest} x {least:.2f})")
    before, after = row["threads"]
    return (_name(case), f"{case['gaussians']:,}", f"{before} to {after}", *cells)


def _stage_rows(case: dict[str, Any]) -> Iterable[tuple[str, ...]]:
    return [(name, *_ms(ms), f"{case['share'][name]:.0%}") for name, ms in case["stages_ms"].items()]


def _name(case: dict[str, Any]) -> str:
    return f"{case['scene']} {case['width']}x{case['height']}"


def _threads(result: dict[str, Any]) -> str:
    return f"{result['threads']} thread{'s' if result['threads'] > 1 else ''}"


def _ms(times: dict[str, float]) -> tuple[str, str]:
    return f"{times['min']:.2f}", f"{times['median']:.2f}"


def _both(times: dict[str, float] | None) -> str:
    return "-" if times is None else f"{times['min']:.1f} / {times['median']:.1f}"


def _pair(cold: dict[str, Any], warm: dict[str, Any], key: str) -> tuple[str, str]:
    first, second = (values.get(key) for values in (cold, warm))
    return _number(first), _number(second)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _cpu() -> str:
    """The processor's name where the system tells it."""
    if _CPU_INFO.is_file():
        for line in _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
