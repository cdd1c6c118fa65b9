"""Workers that fly jobs: the cores of this machine, by joblib's loky, or a Ray cluster.

A job is anything that can be pickled, flown by a function that can be pickled too. Workers may
share no folder with the main process, so what a job brings home comes back as a value; and one
that fails comes back as a sentence, so that the others go on.
"""

import logging
import signal
import socket
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import islice
from multiprocessing import current_process
from typing import Any, Final, Literal, TypeVar

from joblib import Parallel, cpu_count, delayed
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError

from ..agents.checkpoints import software_versions
from .errors import RunsFailed
from .progress import OnProgress, ProgressListener, ProgressSender

__all__ = ["Backend", "Result", "Workers", "WorkersConfig", "open_workers"]

Backend = Literal["loky", "ray"]
"""What flies the jobs: the cores of this machine, or a Ray cluster."""

_KNOCK_TIMEOUT: Final = 5.0  # s

_Job = TypeVar("_Job")
_Value = TypeVar("_Value")
_Function = Callable[[_Job, ProgressSender], _Value]


@dataclass(frozen=True, kw_only=True)
class WorkersConfig:
    """Who flies, and how many at a time."""

    jobs: int | None = None
    """Jobs at a time; None: one for each core of the machine or of the cluster."""
    backend: Backend = "loky"
    """`loky`: processes of this machine. `ray`: a Ray cluster."""
    address: str | None = None
    """The cluster's: `ray://HOST:PORT` of its client server from anywhere, `HOST:PORT` or None on
    one of its machines."""

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise ValueError(f"jobs: expected at least 1, got {self.jobs}")
        if self.backend not in ("loky", "ray"):
            raise ValueError(f"backend: expected loky or ray, got {self.backend}")
        if self.address is not None and self.backend != "ray":
            raise ValueError(f"address: expected it with backend ray, got it with {self.backend}")


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a job brings home."""

    name: str
    """Of the job."""
    failure: str = ""
    """A sentence; empty if the job is done."""
    value: Any = None
    """What its function returned, if it is done."""


@dataclass(frozen=True, kw_only=True)
class _Task:
    """A job with all that a worker needs, on this machine or another."""

    name: str
    job: Any
    function: _Function[Any, Any]
    home: tuple[str, int]
    """Of the `ProgressListener`."""
    versions: dict[str, str]
    """Software of the main process."""


_Crew = Callable[[list[_Task]], Generator[Result, None, None]]
"""Flies tasks, as many at a time as there are workers."""


class Workers:
    """Fly jobs: made by `open_workers`."""

    def __init__(self, crew: _Crew, listener: ProgressListener) -> None:
        self._crew = crew
        self._listener = listener

    def fly(
        self, function: _Function[_Job, Any], jobs: Mapping[str, _Job]
    ) -> Generator[Result, None, None]:
        """Give results as they come. To be closed: what still flies then is ended.

        Args:
            function: Called in a worker, with a job and what tells its progress.
            jobs: By name.
        """
        home, versions = self._listener.home, software_versions()
        return self._crew(
            [
                _Task(name=name, job=job, function=function, home=home, versions=versions)
                for name, job in jobs.items()
            ]
        )

    def fly_all(
        self,
        function: _Function[_Job, _Value],
        jobs: Mapping[str, _Job],
        keep: Callable[[_Job, _Value], None],
    ) -> None:
        """Fly all jobs, and hand each with what it brings home to `keep` (in this process).

        Raises:
            RunsFailed: Some failed; the others were kept.
        """
        failures = []
        with closing(self.fly(function, jobs)) as results:
            for result in self._telling(results, len(jobs)):
                if result.failure:
                    failures.append(result.failure)
                else:
                    keep(jobs[result.name], result.value)
        if failures:
            raise RunsFailed(f"{len(failures)} of {len(jobs)} runs failed: {'; '.join(failures)}")

    def _telling(self, results: Iterator[Result], count: int) -> Iterator[Result]:
        """Tell what has come. Of jobs on other machines this is all the progress told."""
        tell = self._listener.tell
        tell("all runs", 0, count, "")
        for done, result in enumerate(results, 1):
            yield result
            kept = not result.failure
            tell(result.name, int(kept), 1, "done" if kept else "failed")
            tell("all runs", done, count, "")


@contextmanager
def open_workers(config: WorkersConfig, on_progress: OnProgress) -> Iterator[Workers]:
    """Workers, to the end of the block. Raises `ValueError`: there is no Ray, or no such cluster.

    Args:
        config: Who flies.
        on_progress: Told how far the jobs on this machine are, and which are done.
    """
    with _crew(config) as crew, ProgressListener(on_progress) as listener:
        yield Workers(crew, listener)


def _crew(config: WorkersConfig) -> AbstractContextManager[_Crew]:
    if config.backend == "ray":
        return _ray(config)
    return nullcontext(partial(_fly_by_loky, workers=config.jobs or cpu_count()))


def _fly_by_loky(tasks: list[_Task], workers: int) -> Generator[Result, None, None]:
    parallel = Parallel(n_jobs=workers, return_as="generator_unordered")
    results = parallel(delayed(_fly)(task) for task in tasks)
    try:
        # `yield from` would close it without the care below.
        for result in results:  # noqa: UP028
            yield result
    except BaseException as error:
        # Their simulators end with the workers.
        get_reusable_executor().shutdown(wait=False, kill_workers=True)
        with warnings.catch_warnings(action="ignore"):  # that runs are cut short is what we want
            results.close()
        if isinstance(error, TerminatedWorkerError):
            raise RunsFailed(
                "a worker was killed, perhaps for want of memory (try fewer --jobs); "
                "what was done before is kept"
            ) from None
        raise


@contextmanager
def _ray(config: WorkersConfig) -> Iterator[_Crew]:
    """Connect to the cluster. Raises `ValueError`."""
    try:
        ray: Any = import_module("ray")
    except ImportError:
        raise ValueError(
            "backend: expected Ray to be installed (pip install 'rotorgram[ray]'), got none"
        ) from None
    address = config.address or "auto"
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        words = str(getattr(error, "strerror", None) or error).rpartition("Error: ")[2]
        reason = " ".join(words.split())  # without the traceback of the client server
        raise ValueError(f"address: expected a Ray cluster at {address}, got: {reason}") from None
    try:
        cores = int(ray.cluster_resources().get("CPU", 0))  # 0: it starts machines when asked to
        yield partial(_fly_by_ray, ray=ray, workers=config.jobs or max(cores, 1))
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Whether anybody listens: Ray itself takes minutes to find out that nobody does."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), _KNOCK_TIMEOUT).close()


def _fly_by_ray(tasks: list[_Task], workers: int, ray: Any) -> Generator[Result, None, None]:
    # Ray's own backend for joblib gives results when all are there, so that whoever is interrupted
    # would lose every run; and it deals runs out in turn, to workers that are busy.
    remote = ray.remote(num_cpus=1)(_fly)
    waiting = iter(tasks)
    flying: dict[Any, str] = {}
    try:
        while True:
            more = islice(waiting, workers - len(flying))
            flying |= {remote.remote(task): task.name for task in more}
            if not flying:
                return
            (landed,), _ = ray.wait(list(flying))
            name = flying.pop(landed)
            try:
                result = ray.get(landed)
            except ray.exceptions.RayError as error:  # its machine is lost, or has no rotorgram
                reason = str(error).strip().splitlines()[-1]
                result = Result(name=name, failure=f"{name}: {reason}")
            yield result
    finally:
        for reference in flying:  # their simulators end with them
            ray.cancel(reference, force=True)


def _fly(task: _Task) -> Result:
    """Fly a job (in a worker process)."""
    if current_process().name != "MainProcess":  # but one of loky's, with our terminal
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's affair
    try:
        _check_software(task.versions)
        with ProgressSender(task.name, task.home) as progress:
            return Result(name=task.name, value=task.function(task.job, progress))
    except Exception as error:
        return Result(name=task.name, failure=f"{task.name}: {type(error).__name__}: {error}")


def _check_software(expected: dict[str, str]) -> None:
    """The config that is written tells one version of each."""
    for name, here in software_versions().items():
        if here != expected[name]:
            raise ValueError(
                f"{name}: expected version {expected[name]} as on the machine of the command, "
                f"got {here} on {socket.gethostname()}"
            )
