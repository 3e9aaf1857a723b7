"""Runs in processes of their own: some at a time on this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import logging
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from tgslam.bench.runs.jobs import Job
from tgslam.bench.whole_run import child_environment
from tgslam.config.loader import dump
from tgslam.device.runtime import available_threads
from tgslam.errors import ClusterError
from tgslam.files.atomic import write_text

Ended = Callable[[Job, str | None], None]  # told of each run as it ends: None, or why it failed

_COMMAND = (sys.executable, "-m", "tgslam")
_INTERRUPTED = 130  # exit code of a run that somebody stopped
_POLL_S = 0.05
_PREFIX = "tgslam: error: "
_log = logging.getLogger(__name__)


def run_here(jobs: Sequence[Job], at_once: int, threads: int, began: Callable[[str], None], ended: Ended) -> None:
    """Do the runs on this machine, `at_once` at a time.

    threads: of each; 0 = a fair share of the cores. A run that is killed, for want of memory say, begins anew once.
    When this raises, KeyboardInterrupt too, the runs that have not ended are killed, and begin anew next time.
    """
    waiting, running, anew = deque(jobs), list[_Process](), set[Path]()
    share = threads or max(1, available_threads() // max(1, min(at_once, len(jobs))))
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                job = waiting.popleft()
                if job.folder not in anew:
                    began(job.label)
                running.append(_Process(job, share))
            for process in [process for process in running if process.has_ended()]:
                running.remove(process)
                with process:
                    if process.was_killed() and process.job.folder not in anew:
                        _log.warning("%s was killed; it begins anew", process.job.label)
                        anew.add(process.job.folder)
                        waiting.append(process.job)
                    else:
                        ended(process.job, process.failure())
            time.sleep(_POLL_S)
    finally:
        for process in running:
            process.close()


def run_on_cluster(jobs: Sequence[Job], address: str, threads: int, began: Callable[[str], None], ended: Ended) -> None:
    """Do the runs on the workers of the Dask scheduler at `address`; inputs and output are at the same paths there.

    threads: of each; 0 = a fair share of the worker's cores. After KeyboardInterrupt, runs that have begun go on to
    their end. began: is called when a run has ended, since it is not known when a worker takes it up.
    Raises ClusterError when Dask is not installed or no scheduler answers.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address)
    except (OSError, ValueError) as error:
        raise ClusterError(f"--scheduler {address}: no Dask scheduler answers there: {error}") from error
    with client:
        if not client.scheduler_info()["workers"]:
            _log.warning("the scheduler at %s has no workers yet; waiting for them", address)
        futures = {client.submit(run_on_worker, job, threads, pure=False): job for job in jobs}
        try:
            for future in distributed.as_completed(futures):
                job = futures[future]
                began(job.label)
                ended(job, _failure_of(future))
        except BaseException:
            client.cancel(list(futures))
            raise


def run_on_worker(job: Job, threads: int) -> str | None:
    """Do one run on a Dask worker, once more if it is killed, and return None, or why it failed."""
    if not threads:
        threads = max(1, available_threads() // max(1, int(_distributed().get_worker().state.nthreads)))
    with _Process(job, threads) as process:
        process.wait()
        if not process.was_killed():
            return process.failure()
    with _Process(job, threads) as process:
        process.wait()
        return process.failure()


class _Process:
    """`tgslam run` for one job, from its construction on; closing it kills what has not ended."""

    def __init__(self, job: Job, threads: int) -> None:
        self.job = job
        self._scratch = tempfile.TemporaryDirectory(prefix="tgslam-job-")
        folder = Path(self._scratch.name)
        self._errors = folder / "stderr.txt"
        write_text(folder / "config.yaml", dump(job.config))
        environment = child_environment(ENABLE_TAICHI_HEADER_PRINT="0", OMP_NUM_THREADS=str(threads))
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                [*_COMMAND, *job.arguments(folder / "config.yaml", threads)],
                env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors,
            )  # fmt: skip

    def has_ended(self) -> bool:
        """Whether it has."""
        return self._process.poll() is not None

    def wait(self) -> None:
        """Return when it has ended."""
        self._process.wait()

    def was_killed(self) -> bool:
        """Whether a signal ended it, of which there are none on Windows."""
        code = self._process.poll()
        return code is not None and code < 0

    def failure(self) -> str | None:
        """Why the run failed, once it has ended; None if it did not."""
        code = self._process.returncode
        if not code:
            return None
        if code == _INTERRUPTED:
            return "interrupted"
        lines = self._errors.read_text(encoding="utf-8", errors="replace").split("\n")
        said = [line.removeprefix(_PREFIX) for line in lines if line.startswith(_PREFIX)]
        return said[-1] if said else f"killed by signal {-code}" if code < 0 else f"exit code {code}"

    def close(self) -> None:
        """Kill it unless it has ended, and clean up."""
        if not self.has_ended():
            self._process.kill()
            self._process.wait()
        self._scratch.cleanup()

    def __enter__(self) -> _Process:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _failure_of(future: Any) -> str | None:
    """What `run_on_worker` returned, or what became of it on its way."""
    if future.status == "finished":
        message: str | None = future.result()
        return message
    if future.status == "error":
        return f"on the worker: {type(future.exception()).__name__}: {future.exception()}"
    return f"the cluster gave it up ({future.status})"


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise ClusterError('Dask is not installed: pip install "tgslam[cluster]", here and on the workers') from error
    return distributed
