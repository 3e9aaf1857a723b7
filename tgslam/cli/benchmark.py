"""`tgslam bench`: how fast the rasterizer, tracking, mapping and whole runs are here; and comparisons of methods."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tgslam.cli import bench_ablation, bench_paper, engine
from tgslam.cli.inputs import open_frames, parse_frames, resolve_config
from tgslam.cli.options import add_log_options, add_thread_count, positive, size
from tgslam.errors import ConfigError, EvaluationError
from tgslam.output.console import error_console
from tgslam.output.progress import frame_progress, step_progress

if TYPE_CHECKING:
    from tgslam.camera import Camera
    from tgslam.types import Frame

_SIZES = [(320, 240), (640, 480), (1200, 680)]
_COUNTS = [20_000, 67_000, 200_000, 500_000]
_SIZE, _COUNT = (640, 480), 67_000
_KEYFRAMES = [500, 2000]
_DEPTH_SCALE = 5000.0


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "bench",
        help="measure speed",
        description="Time the rasterizer, a mapping iteration, a tracking step, the pose graph or a whole run, stage "
        "by stage; or compare ways of learning which plane is where.",
    )
    benchmarks = parser.add_subparsers(metavar="BENCHMARK", required=True)
    for add in (
        _add_render,
        _add_map,
        _add_track,
        _add_run,
        bench_ablation.add_parser,
        bench_paper.add_parser,
        _add_graph,
    ):
        benchmark = add(benchmarks)
        benchmark.add_argument("--json", action="store_true", help="print everything as JSON instead of tables")
        add_log_options(benchmark, default=argparse.SUPPRESS)
    return parser


def execute(args: argparse.Namespace) -> int:
    """Run the benchmark that the arguments name, and print what it found."""
    result = args.measure(args)
    if args.json:
        print(json.dumps(result, indent=2, allow_nan=False))
    else:
        _print(result)
    if result.get("failed"):
        raise EvaluationError(f"{result['failed']} of {result['runs']} runs failed; the table says why")
    return 0


def _print(result: dict[str, Any]) -> None:
    from tgslam.bench import report

    printers = {
        "render": report.print_render, "map": report.print_map, "track": report.print_track, "run": report.print_run,
        "ablation": report.print_ablation, "paper": report.print_paper, "graph": report.print_graph,
    }  # fmt: skip
    printers[result["benchmark"]](result)


def _add_render(benchmarks: Any) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "render",
        help="the rasterizer, forward and backward",
        description="Time the rasterizer forward and backward: the built-in room at every size and number of "
        "Gaussians and, if it is given, an RGB-D frame at its own size with a Gaussian at every second pixel. The "
        "middle of the grid is also drawn with twice the Gaussians and with twice the pixels.",
    )
    parser.add_argument(
        "--size",
        type=size,
        nargs="+",
        default=_SIZES,
        metavar="WxH",
        help=f"images of the room (default: {' '.join(f'{width}x{height}' for width, height in _SIZES)})",
    )
    parser.add_argument(
        "--gaussians", type=positive, nargs="+", default=_COUNTS, metavar="N", help="in the room, about (default: "
        f"{' '.join(map(str, _COUNTS))})",
    )  # fmt: skip
    _add_frame_options(parser)
    _add_repeats(parser, 20)
    parser.add_argument(
        "--threads", type=positive, nargs="+", metavar="N",
        help="CPU threads; several take turns, in a process each (default: 1, and all cores)",
    )  # fmt: skip
    parser.set_defaults(measure=_measure_render)
    return parser


def _add_map(benchmarks: Any) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "map",
        help="one mapping iteration",
        description="Time an iteration of the map's refinement on the built-in room and, if it is given, on an RGB-D "
        "frame with a Gaussian at every second pixel.",
    )
    parser.add_argument("--size", type=size, default=_SIZE, metavar="WxH", help="image of the room (default: 640x480)")
    parser.add_argument(
        "--gaussians", type=positive, default=_COUNT, metavar="N", help="in the room, about (default: %(default)s)"
    )
    _add_frame_options(parser)
    _add_repeats(parser, 20)
    add_thread_count(parser)
    parser.set_defaults(measure=_measure_map)
    return parser


def _add_track(benchmarks: Any) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "track",
        help="one tracking step",
        description="Run the system over a few frames (without arguments: of the built-in room), and time what it does "
        "with a tracked frame.",
    )
    _add_sequence_options(parser, frames=":30")
    add_thread_count(parser)
    parser.set_defaults(measure=_measure_track)
    return parser


def _add_run(benchmarks: Any) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "run",
        help="a whole run, with a cold and a warm cache of kernels",
        description="Do `tgslam run` twice in processes of their own (without arguments: on the built-in room), first "
        "with an empty cache of compiled kernels, then with a full one. Nothing is left behind.",
    )
    _add_sequence_options(parser, frames=None)
    parser.set_defaults(measure=_measure_run)
    return parser


def _add_graph(benchmarks: Any) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "graph",
        help="the pose graph with planes as landmarks",
        description="Add keyframes with sightings of planes to synthetic pose graphs, and time the update that follows "
        "each. Every graph has a process of its own, whose peak memory is told.",
    )
    parser.add_argument(
        "--keyframes", type=positive, nargs="+", default=_KEYFRAMES, metavar="N",
        help=f"of each graph (default: {' '.join(map(str, _KEYFRAMES))})",
    )  # fmt: skip
    parser.add_argument("--planes", type=positive, default=40, metavar="N", help="of a graph (default: %(default)s)")
    parser.add_argument(
        "--sightings", type=positive, default=6, metavar="N", help="planes that a keyframe sees (default: %(default)s)"
    )
    parser.set_defaults(measure=_measure_graph)
    return parser


def _add_frame_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("an RGB-D frame, besides the built-in room")
    group.add_argument("--colour", type=Path, metavar="FILE", help="colour image")
    group.add_argument("--depth", type=Path, metavar="FILE", help="16-bit depth image of the same size")
    group.add_argument("--camera", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="its camera, px")
    group.add_argument(
        "--depth-scale", type=float, default=_DEPTH_SCALE, metavar="S", help="depth units a metre (default: 5000)"
    )


def _add_sequence_options(parser: argparse.ArgumentParser, frames: str | None) -> None:
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG", help="YAML file, or a packaged one by name")
    parser.add_argument("--input", type=Path, metavar="DIR", help="folder of the sequence")
    parser.add_argument(
        "--frames", default=frames, metavar="START:STOP:STEP",
        help=f"which frames, as a Python slice (default: {frames or 'all'})",
    )  # fmt: skip
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a setting; repeatable"
    )


def _add_repeats(parser: argparse.ArgumentParser, default: int) -> None:
    parser.add_argument(
        "--repeats",
        type=positive,
        default=default,
        metavar="R",
        help="measurements of each case (default: %(default)s)",
    )


def _measure_render(args: argparse.Namespace) -> dict[str, Any]:
    """One process a number of threads, since Taichi starts once a process: this one when there is but one number."""
    frame = _frame(args)
    from tgslam.bench import arithmetic, report
    from tgslam.bench import rasterizer as render
    from tgslam.device.runtime import available_threads

    threads = list(dict.fromkeys(args.threads or sorted({1, available_threads()})))
    if len(threads) == 1:
        runs = [_render_here(args, threads[0], frame)]
    else:
        runs = [run for count in threads for run in _render_in_process(args, count)["runs"]]
    return {
        "benchmark": "render",
        "machine": report.machine(),
        "repeats": args.repeats,
        "flops_per_pair": {"forward": arithmetic.FORWARD_FLOPS, "backward": arithmetic.BACKWARD_FLOPS},
        "runs": runs,
        "scaling": render.scaling(runs),
    }


def _render_here(args: argparse.Namespace, threads: int, frame: tuple[Camera, Frame] | None) -> dict[str, Any]:
    from tgslam.bench import rasterizer as render
    from tgslam.bench import workloads as scenes

    engine.start_device("cpu", threads)
    makers: list[Callable[[], scenes.Scene]] = [
        lambda width=width, height=height, count=count: scenes.room_scene(width, height, count)  # type: ignore[misc]
        for width, height in args.size
        for count in args.gaussians
    ]
    if frame is not None:
        makers.append(lambda: scenes.frame_scene(*frame))
    with step_progress(
        f"case on {threads} thread{'s' if threads > 1 else ''}", len(makers) + 1, error_console(), args.quiet
    ) as step:
        result = render.run(makers, args.repeats, threads, step)
        step("linearity")
        (width, height), count = _middle(args.size), _middle(args.gaussians)
        return {**result, "linearity": render.linearity(width, height, count, args.repeats)}


def _render_in_process(args: argparse.Namespace, threads: int) -> dict[str, Any]:
    """The same benchmark on that many threads in a process of its own."""
    from tgslam.bench.whole_run import child_environment

    command = [sys.executable, "-m", "tgslam", "bench", "render", "--json", "--threads", threads]
    command += ["--repeats", args.repeats, "--gaussians", *args.gaussians]
    command += ["--size", *(f"{width}x{height}" for width, height in args.size)]
    if args.colour is not None:
        command += ["--colour", args.colour, "--depth", args.depth, "--depth-scale", args.depth_scale]
        command += ["--camera", *args.camera]
    command += [option for option in ("--quiet", "--debug") if getattr(args, option[2:])]
    done = subprocess.run([str(part) for part in command], env=child_environment(), stdout=subprocess.PIPE)
    if done.returncode:
        raise EvaluationError(f"the benchmark on {threads} threads ended with exit code {done.returncode}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def _measure_map(args: argparse.Namespace) -> dict[str, Any]:
    frame = _frame(args)
    from tgslam.bench import map_steps as mapping
    from tgslam.bench import report
    from tgslam.bench import workloads as scenes

    threads = _start(args)
    with step_progress("scene", 1 if frame is None else 2, error_console(), args.quiet) as step:
        step("room")
        width, height = args.size
        room = scenes.room_scene(width, height, args.gaussians)
        cases = [mapping.measure(room, scenes.room_frame(width, height)[1], args.repeats)]
        if frame is not None:
            step("frame")
            cases.append(mapping.measure(scenes.frame_scene(*frame), frame[1], args.repeats))
    return {
        "benchmark": "map",
        "machine": report.machine(),
        "threads": threads,
        "repeats": args.repeats,
        "cases": cases,
    }


def _measure_track(args: argparse.Namespace) -> dict[str, Any]:
    config, frames = resolve_config(args.config, args.input, args.set), parse_frames(args.frames)
    from tgslam.bench import report, track

    threads = _start(args)
    source = open_frames(config, args.input, frames)
    with frame_progress(len(source), error_console(), args.quiet) as observer:
        found = track.measure(source, config, observer)
    return {"benchmark": "track", "machine": report.machine(), "threads": threads, **found}


def _measure_run(args: argparse.Namespace) -> dict[str, Any]:
    config, frames = resolve_config(args.config, args.input, args.set), parse_frames(args.frames)
    if config.dataset.format != "synthetic":
        open_frames(config, args.input, frames)  # what is wrong with the input is said once, and before the runs
    from tgslam.bench import report
    from tgslam.bench import whole_run as run

    arguments = [str(args.config)] if args.config is not None else []
    arguments += ["--input", str(args.input)] if args.input is not None else []
    arguments += [f"--frames={args.frames}"] if args.frames is not None else []
    arguments += [f"--set={text}" for text in args.set]
    with step_progress("run", len(run.CACHES), error_console(), args.quiet) as step:
        runs = run.measure(arguments, step)
    return {"benchmark": "run", "machine": report.machine(), "arguments": arguments, "runs": runs}


def _measure_graph(args: argparse.Namespace) -> dict[str, Any]:
    from tgslam.bench import graph_updates as graph
    from tgslam.bench import report

    sizes = [graph.Size(keyframes, args.planes, args.sightings) for keyframes in args.keyframes]
    with step_progress("graph", len(sizes), error_console(), args.quiet) as step:
        cases = graph.measure(sizes, step)
    return {"benchmark": "graph", "machine": report.machine(), "cases": cases}


def _start(args: argparse.Namespace) -> int:
    """Start the kernels and return the number of threads."""
    from tgslam.device.runtime import available_threads

    threads = args.threads or available_threads()
    engine.start_device("cpu", threads)
    return threads


def _frame(args: argparse.Namespace) -> tuple[Camera, Frame] | None:
    """The frame of --colour and its fellows, if they are there. Raises ConfigError and FrameError."""
    given = {"--colour": args.colour, "--depth": args.depth, "--camera": args.camera}
    missing = [name for name, value in given.items() if value is None]
    if len(missing) == len(given):
        return None
    if missing:
        raise ConfigError(f"{', '.join(given)} go together: {' and '.join(missing)} missing")
    if not (args.camera[0] > 0 and args.camera[1] > 0 and args.depth_scale > 0):
        raise ConfigError("--camera FX FY and --depth-scale must be greater than 0")
    from tgslam.bench.workloads import read_frame

    return read_frame(args.colour, args.depth, tuple(args.camera), args.depth_scale)


def _middle(values: Sequence[Any]) -> Any:
    return values[(len(values) - 1) // 2]
