"""What all tests share: a busy machine is no failure, and Ctrl-C reaches the programs of tests."""

import os
import signal

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

# A shell that starts the tests in the background has Ctrl-C ignored, by their programs too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Of `-n auto`: one more than there are processors, for tests that wait for other programs."""
    if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ:
        return None
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0)) + 1
    return (os.cpu_count() or 1) + 1


@pytest.fixture(scope="session")
def opengl() -> None:
    """What draws."""
    from rotorgram.models.errors import NoOpenGL
    from rotorgram.rendering.gl import offscreen_context

    try:
        offscreen_context(16, 16).free()
    except NoOpenGL as error:
        pytest.skip(str(error))
