"""An executor whose workers are those of a Ray cluster."""

import logging
import socket
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import TypeVar

from ..models.errors import InputError, one_line, require
from ..models.files import other_versions, software_versions

_Value = TypeVar("_Value")
_LISTENING_TIMEOUT = 5.0  # s


class RayExecutor(Executor):
    """Submits tasks of one core each. Raises `InputError` if there is no cluster at the address."""

    def __init__(self, address: str | None, jobs: int | None) -> None:
        self._ray = require("ray", "ray", "the runner ray")
        address = address or "auto"
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
        cores = int(self._ray.cluster_resources().get("CPU", 0))  # 0: machines start on demand
        self.workers = jobs or max(cores, 1)
        self._submitted: dict[object, object] = {}

    def submit(
        self, function: Callable[..., _Value], /, *args: object, **_: object
    ) -> Future[_Value]:
        """Submit a function; a lost machine, or other software there, is its future's error."""
        remote = self._ray.remote(num_cpus=1)(_with_same_software)
        reference = remote.remote(software_versions(), function, *args)
        future: Future[_Value] = reference.future()
        self._submitted[future] = reference
        future.add_done_callback(self._submitted.pop)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel what still runs, whose simulators end with it, and leave the cluster."""
        for reference in list(self._submitted.values()):
            self._ray.cancel(reference, force=True)
        self._ray.shutdown()


def _with_same_software(
    versions: dict[str, str], function: Callable[..., _Value], *args: object
) -> _Value:
    """Call a function; `config.json` names one version of each package. (In a worker.)"""
    for package, (there, here) in other_versions(versions).items():
        raise InputError(
            f"{package}: expected version {there} as on the machine of the "
            f"command, got {here} on {socket.gethostname()}"
        )
    return function(*args)
