"""Runs, each with a folder of its own that its settings name, so that none is done twice."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tgslam import __version__
from tgslam.config.loader import dump
from tgslam.config.schema import Config
from tgslam.errors import ConfigError, OutputError
from tgslam.output.run_folder import RunFolder, RunState

Frames = tuple[int | None, int | None, int | None]


@dataclass(frozen=True)
class Input:
    """A sequence, and the settings that it is run with or that variants change."""

    name: str
    folder: Path | None  # absolute; None = a built-in scene
    config: Config


@dataclass(frozen=True)
class Job:
    """One run. Whoever asks for the same settings shares it."""

    label: str  # what the first who asks calls it, for the user
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


def job_of(label: str, input_: Input, config: Config, frames: Frames, parent: Path) -> Job:
    """The run of an input with these settings. parent: of the runs' folders."""
    folder = parent / f"{input_.name}-seed{config.seed}-{_digest(config, input_.folder, frames)}"
    return Job(label, config, input_.folder, frames, folder)


def each_once(jobs: Iterable[Job]) -> list[Job]:
    """The first of the jobs that share a folder, in order."""
    found: dict[Path, Job] = {}
    for job in jobs:
        found.setdefault(job.folder, job)
    return list(found.values())


def _digest(config: Config, folder: Path | None, frames: Frames) -> str:
    """Of all that a run depends on."""
    text = "\n".join((__version__, str(folder), str(frames), dump(config)))
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:10]
