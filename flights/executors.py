"""Many jobs at a time: in processes of this machine, or on a Ray cluster.

An executor has the interface of `concurrent.futures`. A job is anything that can be pickled, and so
is the function that does it. Workers may share no folder with the main process, so the result of a
job comes back as a value. A job that fails comes back as a sentence, and the others go on.

A worker of this machine ends with the process that started it, however that process ends.
"""

import logging
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Lock
from threading import Thread
from typing import Any, Literal, TypeVar

from ..models import InputError
from ..models.fields import PositiveInt, check_fields, immutable

OnProgress = Callable[[str, int, int, str], None]
"""Called with a job's name, the amounts done and in total, and a status text."""
Tell = Callable[[int, int, str], None]
"""The same for one job, without its name."""
ALL_JOBS = "all runs"
"""Name under which the progress of all jobs is reported."""
_Job = TypeVar("_Job")
_Value = TypeVar("_Value")

_log = logging.getLogger(__name__)
_CHILD_ENVIRONMENT = {
    "PYTHONSAFEPATH": "1",  # no file of the working directory takes the place of a package
    "OMP_NUM_THREADS": "1",  # a second thread makes small tensors slower
}


@immutable
class WorkersConfig:
    """Kind and number of workers."""

    jobs: PositiveInt | None = None
    """Jobs at a time. Default: one for each core of this machine, or of the cluster."""
    runner: Literal["processes", "ray"] = "processes"
    """processes: of this machine. ray: a Ray cluster (pip install 'rotorgram[ray]')."""
    address: str | None = None
    """Address of the Ray cluster: `ray://HOST:PORT` of its client server from anywhere, `HOST:PORT`
    or None on one of its machines."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.address is not None and self.runner != "ray":
            raise InputError(f"address: expected it with runner ray, got it with {self.runner}")


class RunsFailed(RuntimeError):
    """Some jobs failed; the message names each with its reason. The others are kept."""


Result = tuple[str, str, Any]
"""The end of a job: its name, why it failed (empty if it did not), its value."""


# ---- in the main process


def run_jobs(
    executor: Executor,
    function: Callable[[_Job, Tell], _Value],
    jobs: Mapping[str, _Job],
    keep: Callable[[_Job, _Value], None],
    on_progress: OnProgress,
) -> None:
    """Do all jobs, given by name, and hand each with its result to `keep` as soon as it is there.

    Args:
        executor: Made by `open_executor`.
        function: Called in a worker with a job and a function that reports its progress.

    Raises:
        RunsFailed: At the end, if jobs failed; at once, if a worker was killed.
    """
    failures = []
    on_progress(ALL_JOBS, 0, len(jobs), "")
    results = _results(executor, function, jobs)
    for number, (name, failure, value) in enumerate(results, 1):
        if failure:
            failures.append(failure)
            on_progress(name, 0, 1, "failed")
        else:
            keep(jobs[name], value)
            on_progress(name, 1, 1, "done")
        on_progress(ALL_JOBS, number, len(jobs), "")
    if failures:
        raise RunsFailed(f"{len(failures)} of {len(jobs)} runs failed: {'; '.join(failures)}")


def _results(
    executor: Executor, function: Callable[[_Job, Tell], _Value], jobs: Mapping[str, _Job]
) -> Iterator[Result]:
    """Results in the order in which they come; at most `executor.workers` jobs are submitted."""
    waiting = iter(jobs.items())
    workers: int = getattr(executor, "workers", 1)
    submitted: dict[Future[Result], str] = {}
    while True:
        for name, job in islice(waiting, workers - len(submitted)):
            submitted[executor.submit(_do, function, name, job)] = name
        if not submitted:
            return
        done, _ = wait(submitted, return_when=FIRST_COMPLETED)
        # Before a worker that was killed ends all, what others have done.
        for future in sorted(done, key=lambda one: one.exception() is not None):
            name = submitted.pop(future)
            try:
                yield future.result()
            except BrokenProcessPool:
                raise RunsFailed(
                    "a worker was killed, perhaps for want of memory (try fewer --jobs); "
                    "what was done before is kept"
                ) from None
            except Exception as error:  # a cluster's machine is lost, or lacks our software
                cause = getattr(error, "cause", None) or error
                reason = (str(cause).strip() or repr(cause)).splitlines()[-1]
                yield name, f"{name}: {reason}", None


@contextmanager
def open_executor(
    config: WorkersConfig, jobs: int, on_progress: OnProgress = lambda *_: None
) -> Iterator[Executor]:
    """An executor for so many jobs, to the end of the block; jobs that still run then are ended.

    Progress is reported for jobs of this machine. One job at a time runs in this process. Raises
    `InputError` if there is no such Ray cluster.
    """
    workers = min(config.jobs or os.cpu_count() or 1, jobs)
    if config.runner == "ray":
        from .ray_cluster import RayExecutor

        executor: Executor = RayExecutor(config.address, config.jobs)
    elif workers <= 1:
        executor = _ThisProcess(on_progress)
    else:
        executor = _Processes(workers, on_progress)
    try:
        yield executor
    finally:
        executor.shutdown(wait=False, cancel_futures=True)


class _ThisProcess(Executor):
    """Does a job when it is submitted."""

    def __init__(self, on_progress: OnProgress) -> None:
        _Worker.report = on_progress

    def submit(
        self, function: Callable[..., _Value], /, *args: object, **_: object
    ) -> Future[_Value]:
        future: Future[_Value] = Future()
        future.set_result(function(*args))
        return future


class _Processes(ProcessPoolExecutor):
    """Spawned processes that end when this process ends or the executor is shut down."""

    def __init__(self, workers: int, on_progress: OnProgress) -> None:
        self.workers = workers
        context = get_context("spawn")
        # Nothing is sent through this pipe: its end says that the main process is gone.
        ends, self._alive = context.Pipe(duplex=False)
        progress, self._writer = context.Pipe(duplex=False)
        names = _CHILD_ENVIRONMENT.keys() & os.environ.keys()
        self._before = {name: os.environ[name] for name in names}
        os.environ.update(_CHILD_ENVIRONMENT)
        arguments = (ends, self._writer, context.Lock())
        super().__init__(workers, context, initializer=_begin_worker, initargs=arguments)
        Thread(target=_pass_on, args=(progress, on_progress), daemon=True).start()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._alive.close()  # workers end, and with them their simulators
        self._writer.close()  # with the last worker's, so `_pass_on` ends
        super().shutdown(wait=wait, cancel_futures=cancel_futures)
        for name in _CHILD_ENVIRONMENT:
            os.environ.pop(name, None)
        os.environ.update(self._before)


def _pass_on(progress: Connection, on_progress: OnProgress) -> None:
    """Until nobody can write any more. A worker that ends may hold the lock for ever."""
    with progress:
        while True:
            try:
                item = progress.recv()
            except (EOFError, OSError):  # the second: in the middle of an item
                return
            try:
                on_progress(*item)
            except Exception as error:  # no line is worth a run
                _log.warning("progress is not shown: %s", error)
                on_progress = lambda *_: None  # noqa: E731


# ---- in a worker


class _Worker:
    """State of this process, if it is a worker."""

    report: OnProgress = lambda *_: None


def _begin_worker(ends: Connection, progress: Connection, lock: Lock) -> None:
    """Before the first job: from here on this process ends with the main process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's affair
    Thread(target=_end_with, args=(ends,), daemon=True).start()

    def report(*item: object) -> None:
        with lock:
            progress.send(item)

    _Worker.report = report


def _end_with(ends: Connection) -> None:
    ends.poll(None)  # until the other end is closed, which it may be already
    os._exit(1)


def _do(function: Callable[[_Job, Tell], _Value], name: str, job: _Job) -> Result:
    """Do a job (in a worker)."""
    report = _Worker.report
    try:
        return name, "", function(job, lambda *progress: report(name, *progress))
    except Exception as error:
        return name, f"{name}: {type(error).__name__}: {error}", None
