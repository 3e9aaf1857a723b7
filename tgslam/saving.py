"""Saving a run from Python: the files of a run folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from tgslam import __version__
from tgslam.adaptation import Slam
from tgslam.output.log import FrameLog
from tgslam.output.run_folder import RunFolder, RunRecord, RunState
from tgslam.output.run_results import write_results
from tgslam.types import FrameReport


def save_run(
    slam: Slam, folder: str | Path, *, reports: Iterable[FrameReport] = (), overwrite: bool = False
) -> RunFolder:
    """Write trajectories, map, planes and settings as `tgslam run` does, so that `tgslam render` takes the folder.

    reports: what `process_frame` has returned, for log.jsonl. overwrite: replace an earlier run in that folder. Raises
    OutputError for a folder that holds something else, and OSError when it cannot be written.
    """
    run = RunFolder.create(Path(folder), overwrite)
    record = RunRecord(
        tgslam=__version__,
        state=RunState.FINISHED,
        source=run.path.name,
        input=None,
        frames=(None, None, None),
        camera=slam.camera,
    )
    run.write_record(record)
    run.write_config(slam.config)
    with FrameLog(run.log) as log:
        for report in reports:
            log.append(report)
    write_results(run, slam)
    return run
