"""What tests of envs share."""

import pytest


@pytest.fixture(autouse=True)
def _pictures_need_opengl(request: pytest.FixtureRequest) -> None:
    """The case `pictures` of contracts.py needs what draws."""
    case = getattr(request.node, "callspec", None)
    if case is not None and "pictures" in case.id:
        request.getfixturevalue("opengl")
