"""The cases of the studies' tables, and the runs that they ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tgslam.bench.ablation.studies import Study, Variant, keys_of
from tgslam.bench.runs.jobs import Frames, Input, Job, each_once, job_of
from tgslam.config.loader import override
from tgslam.errors import ConfigError


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
    return each_once(case.job for case in cases)


def require_effect(overrides: Sequence[str], studies: Sequence[Study]) -> None:
    """Raise ConfigError for an override of the user that a study would override itself."""
    for key in sorted(keys_of(tuple(overrides))):
        for study in studies:
            if key in study.fixed_keys():
                raise ConfigError(f"--set {key}: the study {study.name!r} sets it itself; leave one of the two out")


def _case(study: Study, input_: Input, variant: Variant, seed: int, frames: Frames, parent: Path) -> Case:
    config = override(input_.config, (*study.overrides(variant), f"seed={seed}"))
    label = f"{study.name} {variant.name}, {input_.name}, seed {seed}"
    return Case(study, input_, variant, seed, job_of(label, input_, config, frames, parent))
