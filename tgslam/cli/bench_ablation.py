"""`tgslam bench ablation`: the studies of section 4.4 and their like as tables, from whole runs or, Fig. 6, a frame."""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tgslam.bench.ablation import results as table
from tgslam.bench.ablation.jobs import Case, Input, Job, jobs_of, plan, require_effect
from tgslam.bench.ablation.studies import STUDIES, Study, keys_of
from tgslam.cli import engine
from tgslam.cli.inputs import open_frames, parse_frames, resolve_config
from tgslam.cli.options import add_thread_count, natural, positive, size
from tgslam.errors import ConfigError
from tgslam.files.atomic import write_text
from tgslam.output.console import error_console
from tgslam.output.pictures import write_colour
from tgslam.output.progress import step_progress

_IDENTITY = "identity"
_IDENTITY_SCENES = ("room",)
_NAMES = (_IDENTITY, *STUDIES)
_ALL = "all"
_OWN_OPTIONS = {"seed": "--seeds", "synthetic.scene": "--scene"}  # for these settings
_log = logging.getLogger(__name__)


def add_parser(benchmarks: Any) -> argparse.ArgumentParser:
    """Add the benchmark to the subparsers `benchmarks`."""
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "ablation",
        help="the method with parts of it left out",
        description="Compare runs with parts of the method left out, study by study: interval (structure closures at "
        "every k-th keyframe, Table 4), structure (planes and closures, Table 5), gate (the texture gate), terms (SSIM "
        "and gradient of the objective), viewpoints (sparse global viewpoints); and identity (instance colours against "
        "scalar ids on one frame, Fig. 6). Tables go to stdout and, as Markdown and JSON, into --output. Runs that are "
        "finished there with the same settings are not done again.",
    )
    parser.add_argument(
        "studies", nargs="*", type=_study, default=[_ALL], metavar="STUDY",
        help=f"{', '.join(_NAMES)} or all (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--input", type=Path, nargs="+", default=[], metavar="DIR",
        help="folders of sequences (default: built-in scenes that suit the study)",
    )  # fmt: skip
    parser.add_argument("--scene", nargs="+", default=[], metavar="NAME", help="built-in scenes, likewise")
    parser.add_argument("--config", type=Path, metavar="CONFIG", help="YAML file, or a packaged one by name")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a setting; repeatable"
    )
    parser.add_argument("--frames", metavar="START:STOP:STEP", help="which frames, as a Python slice (default: all)")
    parser.add_argument(
        "--seeds", type=natural, nargs="+", default=[0], metavar="N", help="a run with each (default: 0)"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("runs/ablation"), metavar="DIR", help="folder (default: runs/ablation)"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", type=positive, default=1, metavar="N", help="runs at a time, which share the cores (default: 1)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="of a Dask scheduler, whose workers do the runs; they see inputs and output at the same paths",
    )  # fmt: skip
    add_thread_count(parser)
    group = parser.add_argument_group("identity")
    group.add_argument("--frame", type=natural, default=0, metavar="N", help="of the scene (default: 0)")
    group.add_argument("--size", type=size, default=(640, 480), metavar="WxH", help="of the image (default: 640x480)")
    parser.set_defaults(measure=_measure)
    return parser


def _measure(args: argparse.Namespace) -> dict[str, Any]:
    """All that was asked for; whatever is wrong with the arguments is said before anything runs."""
    from tgslam.bench import report

    names = _NAMES if _ALL in args.studies else tuple(dict.fromkeys(args.studies))
    cases = _plan(args, [STUDIES[name] for name in names if name in STUDIES])
    scenes = list(dict.fromkeys(args.scene)) or _IDENTITY_SCENES
    for scene in scenes:
        _require_scene(scene)
    args.output.mkdir(parents=True, exist_ok=True)
    frames = [_measure_identity(args, scene) for scene in scenes] if _IDENTITY in names else []
    jobs, failures = jobs_of(cases), dict[Path, str]()
    try:
        _run(args, jobs, failures)
    finally:  # after Ctrl-C too
        found = {job.folder: metrics for job in jobs if (metrics := job.metrics()) is not None}
        tables = table.tabulate(cases, found, failures)
        machine = report.machine()
        _write_tables(args.output, tables, machine)
    return {
        "benchmark": "ablation",
        "machine": machine,
        "identity": frames,
        "tables": tables,
        "runs": len(jobs),
        "failed": len(failures),
    }


def _plan(args: argparse.Namespace, studies: Sequence[Study]) -> list[Case]:
    """Raises ConfigError and DatasetError for settings and inputs that are wrong."""
    frames = parse_frames(args.frames)
    for key, option in _OWN_OPTIONS.items():
        if key in keys_of(args.set):
            raise ConfigError(f"--set {key}: name it with {option}")
    require_effect(args.set, studies)
    named = [_folder_input(args, path) for path in dict.fromkeys(args.input)]
    named += [_scene_input(args, scene) for scene in dict.fromkeys(args.scene)]
    seeds, parent = list(dict.fromkeys(args.seeds)), args.output.resolve() / "runs"
    return [
        case
        for study in studies
        for case in plan(study, named or [_scene_input(args, scene) for scene in study.scenes], seeds, frames, parent)
    ]


def _folder_input(args: argparse.Namespace, path: Path) -> Input:
    config, folder = resolve_config(args.config, path, args.set), path.resolve()
    open_frames(config, folder, parse_frames(args.frames))
    return Input(folder.name, folder, config)


def _scene_input(args: argparse.Namespace, scene: str) -> Input:
    _require_scene(scene)
    config = resolve_config(args.config, None, [*args.set, f"synthetic.scene={scene}"])
    if config.dataset.format != "synthetic":
        raise ConfigError(f"dataset.format={config.dataset.format} reads a folder: give it with --input DIR")
    return Input(scene, None, config)


def _require_scene(name: str) -> None:
    from tgslam.synthetic.scenes import scene_spec

    scene_spec(name)


def _run(args: argparse.Namespace, jobs: Sequence[Job], failures: dict[Path, str]) -> None:
    """Do what is not finished yet, and note in `failures` what fails, by the run's folder."""
    from tgslam.bench.ablation import workers

    todo = [job for job in jobs if job.metrics() is None]
    if len(todo) < len(jobs):
        _log.info("%d of %d runs are finished already", len(jobs) - len(todo), len(jobs))
    if not todo:
        return

    def ended(job: Job, failure: str | None) -> None:
        if failure is None and job.metrics() is None:
            failure = f"it ended well, but {job.folder} is not here: workers need --output at the same path"
        if failure is not None:
            failures[job.folder] = failure
            _log.warning("%s failed: %s", job.label, failure)

    threads = args.threads or 0
    with step_progress("run", len(todo), error_console(), args.quiet) as step:
        if args.scheduler is not None:
            workers.run_on_cluster(todo, args.scheduler, threads, step, ended)
        else:
            workers.run_here(todo, args.jobs, threads, step, ended)


def _measure_identity(args: argparse.Namespace, scene: str) -> dict[str, Any]:
    """Fig. 6 on one frame; its picture goes into the output folder."""
    from tgslam.bench.ablation import identity_study as identity
    from tgslam.device.runtime import available_threads

    threads = args.threads or available_threads()
    engine.start_device("cpu", threads)
    with step_progress(_IDENTITY, len(identity.IDENTITIES), error_console(), args.quiet) as step:
        found = identity.measure(scene, args.frame, args.size, step)
    stem = args.output / f"{_IDENTITY}-{scene}"
    write_colour(stem.with_suffix(".png"), identity.picture(found))
    result = {
        "threads": threads,
        "scene": scene,
        "frame": found.frame,
        "width": found.size[0],
        "height": found.size[1],
        "planes": found.planes,
        "gaussians": found.gaussians,
        "iterations": list(identity.ITERATIONS),
        "curves": {curve.identity: {"wrong": curve.wrong, "loss": curve.loss} for curve in found.curves},
    }
    write_text(stem.with_suffix(".json"), json.dumps(result, indent=2, allow_nan=False) + "\n")
    write_text(stem.with_suffix(".md"), table.identity_markdown(result))
    return result


def _write_tables(output: Path, tables: Sequence[dict[str, Any]], machine: dict[str, Any]) -> None:
    """Two files a study."""
    for study in dict.fromkeys(found["study"] for found in tables):
        ours = [found for found in tables if found["study"] == study]
        write_text(output / f"{study}.md", table.markdown(ours))
        text = json.dumps({"machine": machine, "tables": ours}, indent=2, allow_nan=False)
        write_text(output / f"{study}.json", text + "\n")


def _study(text: str) -> str:
    if text not in (*_NAMES, _ALL):
        raise argparse.ArgumentTypeError(f"there is no study {text!r}; choose from {', '.join(_NAMES)} and all")
    return text
