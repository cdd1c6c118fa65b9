"""Workers that do jobs: the cores of this machine, by joblib's loky, or a Ray cluster.

A job is anything that can be pickled, done by a function that can be pickled too. Workers may share
no folder with the main process, so the result of a job comes back as a value; and a job that fails
comes back as a sentence, so that the others go on. A worker of this machine ends with the process
that started it, however that ends, and its simulators end with the worker.

Workers tell their progress by a small datagram now and then. A lost one does no harm: the next has
the same numbers. Processes share no pipe or lock, and a run goes on without a listener. Datagrams
stay on this machine: a run on another machine reports nothing before it is done.
"""

import json
import logging
import os
import signal
import socket
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from functools import cache
from itertools import islice
from threading import Lock, Thread
from typing import Any, Final, NamedTuple, TypeVar

from ..agents.checkpoints import software_versions
from ..envs.registry import load
from ..models.errors import InputError, expect, require
from .pairs import close_shared_pairs
from .settings import EnvConfig, WorkersConfig

_LISTENING_TIMEOUT: Final = 5.0  # s
_WATCH_EVERY: Final = 0.5  # s

OnProgress = Callable[[str, int, int, str], None]
"""Called with a run's name, the amounts done and in total, and a status text."""
Tell = Callable[[int, int, str], None]
"""The same for one run, without its name."""
_Home = tuple[str, int]
"""Where progress is told: the name of the machine, and a port."""
_Job = TypeVar("_Job")
_Value = TypeVar("_Value")
_Function = Callable[[_Job, Tell], _Value]


class RunsFailed(RuntimeError):
    """Some runs failed; the message names each with its reason. The others are kept."""


class Result(NamedTuple):
    """The end of a job, by its name: a sentence about its failure, or the value of its function."""

    name: str
    failure: str
    value: Any


_Do = Callable[[Mapping[str, Any], Mapping[str, Any]], Generator[Result, None, None]]
"""Does jobs, as many at a time as there are workers: `_done` with the name and the job of each, and
with keywords that all have."""


class Workers:
    """Do jobs: made by `open_workers`."""

    def __init__(self, do: _Do, home: _Home, tell: OnProgress, parent: int | None) -> None:
        self._do, self._home, self._tell, self._parent = do, home, tell, parent

    def fly(
        self, function: _Function[_Job, Any], jobs: Mapping[str, _Job], env: EnvConfig | None = None
    ) -> Generator[Result, None, None]:
        """Call a function in workers, with each job and what tells its progress: the results, as
        they come. To be closed: what still flies then is ended.

        If the jobs, given by name, fly an env, a worker imports the module of the user's task.
        """
        shared = {
            "function": function,
            "task": f"{env.module}:{env.env_id}" if env and env.module else None,
            "home": self._home,
            "versions": software_versions(),
            "parent": self._parent,
        }
        return self._do(jobs, shared)

    def fly_all(
        self,
        function: _Function[_Job, _Value],
        jobs: Mapping[str, _Job],
        keep: Callable[[_Job, _Value], None],
        env: EnvConfig | None = None,
    ) -> None:
        """Do all jobs, and hand each with its result to `keep`. Raises `RunsFailed` at the end."""
        failures = []
        # Of jobs on other machines this is all the progress told.
        self._tell("all runs", 0, len(jobs), "")
        with closing(self.fly(function, jobs, env)) as results:
            for number, result in enumerate(results, 1):
                if result.failure:
                    failures.append(result.failure)
                    self._tell(result.name, 0, 1, "failed")
                else:
                    keep(jobs[result.name], result.value)
                    self._tell(result.name, 1, 1, "done")
                self._tell("all runs", number, len(jobs), "")
        if failures:
            raise RunsFailed(f"{len(failures)} of {len(jobs)} runs failed: {'; '.join(failures)}")


@contextmanager
def open_workers(config: WorkersConfig, on_progress: OnProgress) -> Iterator[Workers]:
    """Workers, to the end of the block; told is how far the jobs of this machine are, and which are
    done. Raises `InputError` if there is no such Ray cluster.
    """
    here = config.runner == "loky"
    with (_loky if here else _ray)(config) as do, _listening(on_progress) as (home, tell):
        yield Workers(do, home, tell, os.getpid() if here else None)


@contextmanager
def _listening(on_progress: OnProgress) -> Iterator[tuple[_Home, OnProgress]]:
    """Pass on progress from a thread: the home of the listener, and what tells progress here."""
    lock = Lock()

    def tell(name: str, done: int, total: int, words: str) -> None:
        with lock:
            on_progress(name, done, total, words)

    def listen() -> None:
        while datagram := sock.recv(4096):
            try:
                name, done, total, words = json.loads(datagram)
            except (TypeError, ValueError):
                continue
            tell(str(name), int(done), int(total), str(words))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        address = sock.getsockname()
        thread = Thread(target=listen, daemon=True)
        thread.start()
        try:
            yield (socket.gethostname(), address[1]), tell
        finally:
            sock.sendto(b"", address)
            thread.join()


def _telling(name: str, home: _Home) -> Tell:
    """A function that tells the progress of one run to a listener on the same machine."""
    host, port = home

    def tell(done: int, total: int, words: str) -> None:
        if host == socket.gethostname():
            data = json.dumps([name, done, total, words]).encode()
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, suppress(OSError):
                sock.sendto(data, ("127.0.0.1", port))

    return tell


@contextmanager
def _loky(config: WorkersConfig) -> Iterator[_Do]:
    joblib: Any = require("joblib", "train", "running several trainings")
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    def do(jobs: Mapping[str, Any], shared: Mapping[str, Any]) -> Generator[Result, None, None]:
        workers = config.jobs or joblib.cpu_count()
        parallel = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")
        results = parallel(joblib.delayed(_done)(name, job, **shared) for name, job in jobs.items())
        try:
            # `yield from` would close it without the care below.
            for result in results:  # noqa: UP028
                yield result
        except BaseException as error:
            # Their simulators end with the workers.
            # With other arguments than those it has, loky would wait for them here.
            get_reusable_executor(reuse=True).shutdown(wait=False, kill_workers=True)
            with warnings.catch_warnings(action="ignore"):  # that runs are cut short is wanted
                results.close()
            if isinstance(error, TerminatedWorkerError):
                raise RunsFailed(
                    "a worker was killed, perhaps for want of memory (try fewer --jobs); "
                    "what was done before is kept"
                ) from None
            raise

    try:
        yield do
    finally:
        close_shared_pairs()  # of a single worker, which is this process


@contextmanager
def _ray(config: WorkersConfig) -> Iterator[_Do]:
    """Connect to the cluster. Raises `InputError`."""
    ray: Any = require("ray", "ray", "the runner ray")
    address = config.address or "auto"
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if host and port.isdecimal():  # Ray takes minutes to find out that nothing listens
            socket.create_connection((host, int(port)), _LISTENING_TIMEOUT).close()
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        words = str(getattr(error, "strerror", None) or error).rpartition("Error: ")[2]
        reason = " ".join(words.split())  # without the traceback of the client server
        raise InputError(f"address: expected a Ray cluster at {address}, got: {reason}") from None

    # Ray's own backend for joblib gives results when all are there, so that an interrupt
    # would lose every run; and it deals runs out in turn, to workers that are busy.
    def do(jobs: Mapping[str, Any], shared: Mapping[str, Any]) -> Generator[Result, None, None]:
        cores = int(ray.cluster_resources().get("CPU", 0))  # 0: it starts machines when asked to
        workers = config.jobs or max(cores, 1)
        remote = ray.remote(num_cpus=1)(_done)
        waiting = iter(jobs.items())
        flying: dict[Any, str] = {}
        try:
            while True:
                more = islice(waiting, workers - len(flying))
                flying |= {remote.remote(name, job, **shared): name for name, job in more}
                if not flying:
                    return
                (landed,), _ = ray.wait(list(flying))
                name = flying.pop(landed)
                try:
                    result = ray.get(landed)
                except ray.exceptions.RayError as error:  # its machine is lost, or lacks rotorgram
                    reason = str(error).strip().splitlines()[-1]
                    result = Result(name, f"{name}: {reason}", None)
                yield result
        finally:
            for reference in flying:  # their simulators end with them
                ray.cancel(reference, force=True)

    try:
        yield do
    finally:
        ray.shutdown()


def _done(
    name: str, job: Any, *, function: _Function[Any, Any], task: str | None, home: _Home,
    versions: dict[str, str], parent: int | None,
) -> Result:  # fmt: skip
    """Do a job, by its name, as of `Workers.fly` (in a worker process).

    It imports a `task` of the user's own, `module:id`, tells progress at `home`, and ends with the
    process `parent` (None: another machine's). The versions of software have to be the main
    process's: `config.json` tells one of each.
    """
    if parent is not None and os.getpid() != parent:  # one of loky's
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's affair
        _watch(parent)
    try:
        for package, here in software_versions().items():
            wanted = f"version {versions[package]} as on the machine of the command"
            expect(here == versions[package], package, wanted, f"{here} on {socket.gethostname()}")
        if task:
            load(task)
        return Result(name, "", function(job, _telling(name, home)))
    except Exception as error:
        return Result(name, f"{name}: {type(error).__name__}: {error}", None)


@cache
def _watch(parent: int) -> None:
    """End this process as soon as its parent has ended, by whatever signal; once is enough."""
    if os.getppid() != parent:
        return

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_EVERY)
        os._exit(1)

    Thread(target=watch, daemon=True).start()
