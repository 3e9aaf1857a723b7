"""The runs that studies ask for, each with a folder of its own that its settings name, so that none is done twice."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tgslam import __version__
from tgslam.bench.ablation.studies import Study, Variant, keys_of
from tgslam.config.loader import dump, override
from tgslam.config.schema import Config
from tgslam.errors import ConfigError, OutputError
from tgslam.output.run_folder import RunFolder, RunState

Frames = tuple[int | None, int | None, int | None]


@dataclass(frozen=True)
class Input:
    """A sequence, and the settings that variants change."""

    name: str
    folder: Path | None  # absolute; None = a built-in scene
    config: Config


@dataclass(frozen=True)
class Job:
    """One run. Cases that come to the same settings share it."""

    label: str  # what the first of them is, for the user
    config: Config
    input: Path | None  # absolute
    frames: Frames
    folder: Path  # absolute, of the run

    def arguments(self, config: Path, threads: int) -> list[str]:
        """Of `tgslam run`, which reads the settings from the file `config`."""
        frames = ":".join("" if bound is None else str(bound) for bound in self.frames)
        where = [] if self.input is None else ["--input", str(self.input)]
        options = [f"--frames={frames}", "--threads", str(threads), "--overwrite", "--quiet"]
        return ["run", str(config), *where, "--output", str(self.folder), *options]

    def metrics(self) -> dict[str, Any] | None:
        """Of its run, if that came to its end with these settings; else None."""
        try:
            folder = RunFolder.open(self.folder)
            done = folder.read_record().state is RunState.FINISHED and folder.read_config() == self.config
            return (folder.read_metrics() or None) if done else None
        except (OutputError, ConfigError):  # damaged, or written by a version with other settings: it is done again
            return None


@dataclass(frozen=True)
class Case:
    """One seed of one row of one table."""

    study: Study
    input: Input
    variant: Variant
    seed: int
    job: Job


def plan(study: Study, inputs: Sequence[Input], seeds: Sequence[int], frames: Frames, parent: Path) -> list[Case]:
    """Every case of a study, in the order of its tables. parent: of the runs' folders.

    Raises ConfigError for a variant whose settings are wrong.
    """
    return [
        _case(study, input_, variant, seed, frames, parent)
        for input_ in inputs
        for variant in study.variants
        for seed in seeds
    ]


def jobs_of(cases: Sequence[Case]) -> list[Job]:
    """The runs of the cases, each once."""
    jobs: dict[Path, Job] = {}
    for case in cases:
        jobs.setdefault(case.job.folder, case.job)
    return list(jobs.values())


def require_effect(overrides: Sequence[str], studies: Sequence[Study]) -> None:
    """Raise ConfigError for an override of the user that a study would override itself."""
    for key in sorted(keys_of(tuple(overrides))):
        for study in studies:
            if key in study.fixed_keys():
                raise ConfigError(f"--set {key}: the study {study.name!r} sets it itself; leave one of the two out")


def _case(study: Study, input_: Input, variant: Variant, seed: int, frames: Frames, parent: Path) -> Case:
    config = override(input_.config, (*study.overrides(variant), f"seed={seed}"))
    label = f"{study.name} {variant.name}, {input_.name}, seed {seed}"
    folder = parent / f"{input_.name}-seed{seed}-{_digest(config, input_.folder, frames)}"
    return Case(study, input_, variant, seed, Job(label, config, input_.folder, frames, folder))


def _digest(config: Config, folder: Path | None, frames: Frames) -> str:
    """Of all that a run depends on."""
    text = "\n".join((__version__, str(folder), str(frames), dump(config)))
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:10]
