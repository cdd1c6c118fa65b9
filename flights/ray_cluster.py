"""An executor whose workers are those of a Ray cluster."""

import logging
import socket
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from ..models.errors import InputError, one_line, require
from ..models.files import software_versions
from .executors import Result

_LISTENING_TIMEOUT = 5.0  # s


class RayExecutor(Executor):
    """Submits tasks of one core each. Raises `InputError` if there is no cluster at the address."""

    def __init__(self, address: str | None, jobs: int | None) -> None:
        self._ray = require("ray", "ray", "the runner ray")
        self._connect(address or "auto")
        cores = int(self._ray.cluster_resources().get("CPU", 0))  # 0: machines start on demand
        self.workers = jobs or max(cores, 1)
        self._submitted: dict[Future[Result], object] = {}

    def _connect(self, address: str) -> None:
        host, _, port = address.removeprefix("ray://").rpartition(":")
        try:
            if host and port.isdecimal():  # Ray takes minutes to find out that nothing listens
                socket.create_connection((host, int(port)), _LISTENING_TIMEOUT).close()
            self._ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as error:
            text = str(getattr(error, "strerror", None) or error)
            # The client server sends its traceback, which ends with the reason.
            reason = one_line(text.rpartition("Error: ")[2])
            raise InputError(
                f"address: expected a Ray cluster at {address}, got: {reason}"
            ) from None

    def submit(self, function: Callable[..., Any], /, *args: Any, **_: object) -> Future[Any]:
        """Submit a function of `executors`, whose second argument is the job's name."""
        remote = self._ray.remote(num_cpus=1)(_with_same_software)
        reference = remote.remote(software_versions(), function, *args)
        future: Future[Result] = Future()
        self._submitted[future] = reference

        def finish(done: Future[Result]) -> None:
            if self._submitted.pop(future, None) is None:  # cancelled
                return
            error = done.exception()
            if error is None:
                future.set_result(done.result())
            else:
                future.set_result(_failure(args[1], error))

        reference.future().add_done_callback(finish)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel what still runs, whose simulators end with it, and leave the cluster."""
        running = list(self._submitted.values())
        self._submitted.clear()
        for reference in running:
            self._ray.cancel(reference, force=True)
        self._ray.shutdown()


def _failure(name: str, error: BaseException) -> Result:
    """A job whose machine is lost, or lacks rotorgram or the versions of this machine."""
    cause = getattr(error, "cause", None) or error
    reason = str(cause).strip().splitlines()[-1]
    return Result(name, f"{name}: {reason}", None)


def _with_same_software(
    versions: dict[str, str], function: Callable[..., Result], *args: object
) -> Result:
    """Call a function; `config.json` names one version of each package. (In a worker.)"""
    for package, here in software_versions().items():
        if here != versions[package]:
            raise InputError(
                f"{package}: expected version {versions[package]} as on the machine of the "
                f"command, got {here} on {socket.gethostname()}"
            )
    return function(*args)
