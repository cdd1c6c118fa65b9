"""What all tests share: a busy machine is no failure."""

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")


@pytest.fixture(scope="session")
def opengl() -> None:
    """What draws."""
    from rotorgram.rendering.gl import NoOpenGL, offscreen_context

    try:
        offscreen_context(16, 16).free()
    except NoOpenGL as error:
        pytest.skip(str(error))
