"""`tgslam bench ablation`: the studies of section 4.4 and their like as tables, from whole runs or, Fig. 6, a frame."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tgslam.bench.ablation import results as table
from tgslam.bench.ablation.cases import Case, jobs_of, plan, require_effect
from tgslam.bench.ablation.studies import STUDIES, Study, keys_of
from tgslam.bench.runs.jobs import Input
from tgslam.cli.identity_frame import IDENTITY, measure_identity
from tgslam.cli.inputs import parse_frames, resolve_config
from tgslam.cli.job_runs import add_run_options, add_settings_options, carry_out, folder_input
from tgslam.cli.options import natural, size
from tgslam.errors import ConfigError
from tgslam.files.atomic import write_text

_IDENTITY_SCENES = ("room",)
_NAMES = (IDENTITY, *STUDIES)
_ALL = "all"
_OWN_OPTIONS = {"seed": "--seeds", "synthetic.scene": "--scene"}  # for these settings


def add_parser(benchmarks: Any) -> argparse.ArgumentParser:
    """Add the benchmark to the subparsers `benchmarks`."""
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "ablation",
        help="the method with parts of it left out",
        description="Compare runs with parts of the method left out, study by study: interval (structure closures at "
        "every k-th keyframe, Table 4), structure (planes and closures, Table 5), gate (the texture gate), terms (SSIM "
        "and gradient of the objective), viewpoints (sparse global viewpoints), recordings (exposure, recognition, "
        "closures, the sensor), quality (time for refinement); and identity (instance colours against "
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
    add_settings_options(parser)
    parser.add_argument(
        "--seeds", type=natural, nargs="+", default=[0], metavar="N", help="a run with each (default: 0)"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("runs/ablation"), metavar="DIR", help="folder (default: runs/ablation)"
    )
    add_run_options(parser)
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
    frames = [measure_identity(args, scene, args.frame, args.size) for scene in scenes] if IDENTITY in names else []
    jobs, failures = jobs_of(cases), dict[Path, str]()
    try:
        carry_out(args, jobs, failures)
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
    named = [folder_input(path, args.config, args.set, frames) for path in dict.fromkeys(args.input)]
    named += [_scene_input(args, scene) for scene in dict.fromkeys(args.scene)]
    seeds, parent = list(dict.fromkeys(args.seeds)), args.output.resolve() / "runs"
    return [
        case
        for study in studies
        for case in plan(study, named or [_scene_input(args, scene) for scene in study.scenes], seeds, frames, parent)
    ]


def _scene_input(args: argparse.Namespace, scene: str) -> Input:
    _require_scene(scene)
    config = resolve_config(args.config, None, [*args.set, f"synthetic.scene={scene}"])
    if config.dataset.format != "synthetic":
        raise ConfigError(f"dataset.format={config.dataset.format} reads a folder: give it with --input DIR")
    return Input(scene, None, config)


def _require_scene(name: str) -> None:
    from tgslam.synthetic.scenes import scene_spec

    scene_spec(name)


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
