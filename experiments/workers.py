"""Workers that do jobs: the cores of this machine, by joblib's loky, or a Ray cluster.

A job is anything that can be pickled, done by a function that can be pickled too. Workers may share
no folder with the main process, so the result of a job comes back as a value; and a job that fails
comes back as a sentence, so that the others go on. A worker of this machine ends with the process
that started it, however that ends, and its simulators end with the worker.
"""

import logging
import os
import signal
import socket
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from threading import Thread
from typing import Any, Final, TypeVar

from ..agents.checkpoints import software_versions
from ..envs.registry import load
from ..models.errors import InputError, require
from .errors import RunsFailed
from .pairs import close_shared_pairs
from .progress import OnProgress, ProgressListener, ProgressSender
from .settings import EnvConfig, WorkersConfig

__all__ = ["Result", "Workers", "WorkersConfig", "open_workers"]

_LISTENING_TIMEOUT: Final = 5.0  # s
_WATCH_EVERY: Final = 0.5  # s

_Job = TypeVar("_Job")
_Value = TypeVar("_Value")
_Function = Callable[[_Job, ProgressSender], _Value]


@dataclass(frozen=True, kw_only=True)
class Result:
    """The end of a job."""

    name: str
    """Of the job."""
    failure: str = ""
    """A sentence; empty if the job is done."""
    value: Any = None
    """Result of its function, if it is done."""


@dataclass(frozen=True, kw_only=True)
class _Order:
    """A job with all that a worker needs, on this machine or another."""

    name: str
    job: Any
    function: _Function[Any, Any]
    task: str | None
    """`module:id` of a task of the user's own, which the worker has to import."""
    home: tuple[str, int]
    """Of the `ProgressListener`."""
    versions: dict[str, str]
    """Software of the main process."""
    parent: int | None
    """Process that the worker ends with; None: another machine's."""


_Do = Callable[[list[_Order]], Generator[Result, None, None]]
"""Does jobs, as many at a time as there are workers."""


class Workers:
    """Do jobs: made by `open_workers`."""

    def __init__(self, do: _Do, listener: ProgressListener, parent: int | None) -> None:
        self._do = do
        self._listener = listener
        self._parent = parent

    def fly(
        self, function: _Function[_Job, Any], jobs: Mapping[str, _Job], env: EnvConfig | None = None
    ) -> Generator[Result, None, None]:
        """Give results as they come. To be closed: what still flies then is ended.

        Args:
            function: Called in a worker, with a job and its progress sender.
            jobs: By name.
            env: Env of the jobs: a worker imports the module of the user's task.
        """
        task = f"{env.module}:{env.env_id}" if env and env.module else None
        order = partial(
            _Order,
            function=function,
            task=task,
            home=self._listener.home,
            versions=software_versions(),
            parent=self._parent,
        )
        return self._do([order(name=name, job=job) for name, job in jobs.items()])

    def fly_all(
        self,
        function: _Function[_Job, _Value],
        jobs: Mapping[str, _Job],
        keep: Callable[[_Job, _Value], None],
        env: EnvConfig | None = None,
    ) -> None:
        """Do all jobs, and hand each with its result to `keep` (in this process).

        Raises:
            RunsFailed: Some failed; the others were kept.
        """
        failures = []
        with closing(self.fly(function, jobs, env)) as results:
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
    """Workers, to the end of the block.

    Args:
        config: Which, and how many.
        on_progress: Told how far the jobs on this machine are, and which are done.

    Raises:
        InputError: There is no such Ray cluster.
        MissingPackage: There is no joblib, or no Ray.
    """
    here = config.backend == "loky"
    with _loky(config) if here else _ray(config) as do, ProgressListener(on_progress) as listener:
        yield Workers(do, listener, os.getpid() if here else None)


@contextmanager
def _loky(config: WorkersConfig) -> Iterator[_Do]:
    joblib = require("joblib", "train", "running several trainings")
    try:
        yield partial(_do_by_loky, joblib=joblib, workers=config.jobs or joblib.cpu_count())
    finally:
        close_shared_pairs()  # of a single worker, which is this process


def _do_by_loky(orders: list[_Order], joblib: Any, workers: int) -> Generator[Result, None, None]:
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    parallel = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")
    results = parallel(joblib.delayed(_done)(order) for order in orders)
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
def _ray(config: WorkersConfig) -> Iterator[_Do]:
    """Connect to the cluster. Raises `InputError`."""
    ray: Any = require("ray", "ray", "the backend ray")
    address = config.address or "auto"
    try:
        _check_listening(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        words = str(getattr(error, "strerror", None) or error).rpartition("Error: ")[2]
        reason = " ".join(words.split())  # without the traceback of the client server
        raise InputError(f"address: expected a Ray cluster at {address}, got: {reason}") from None
    try:
        cores = int(ray.cluster_resources().get("CPU", 0))  # 0: it starts machines when asked to
        yield partial(_do_by_ray, ray=ray, workers=config.jobs or max(cores, 1))
    finally:
        ray.shutdown()


def _check_listening(address: str) -> None:
    """Raise `OSError` if nothing listens: Ray itself takes minutes to find that out."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), _LISTENING_TIMEOUT).close()


def _do_by_ray(orders: list[_Order], workers: int, ray: Any) -> Generator[Result, None, None]:
    # Ray's own backend for joblib gives results when all are there, so that an interrupt
    # would lose every run; and it deals runs out in turn, to workers that are busy.
    remote = ray.remote(num_cpus=1)(_done)
    waiting = iter(orders)
    flying: dict[Any, str] = {}
    try:
        while True:
            more = islice(waiting, workers - len(flying))
            flying |= {remote.remote(order): order.name for order in more}
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


def _done(order: _Order) -> Result:
    """Do a job (in a worker process)."""
    if order.parent is not None and os.getpid() != order.parent:  # one of loky's
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's affair
        _watch(order.parent)
    try:
        _check_software(order.versions)
        if order.task:
            load(order.task)
        with ProgressSender(order.name, order.home) as progress:
            return Result(name=order.name, value=order.function(order.job, progress))
    except Exception as error:
        return Result(name=order.name, failure=f"{order.name}: {type(error).__name__}: {error}")


_watched: set[int] = set()


def _watch(parent: int) -> None:
    """End this process as soon as its parent has ended, by whatever signal."""
    if parent in _watched or os.getppid() != parent:
        return
    _watched.add(parent)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_EVERY)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def _check_software(expected: dict[str, str]) -> None:
    """The config that is written tells one version of each."""
    for name, here in software_versions().items():
        if here != expected[name]:
            raise InputError(
                f"{name}: expected version {expected[name]} as on the machine of the command, "
                f"got {here} on {socket.gethostname()}"
            )
