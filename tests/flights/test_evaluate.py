"""`rotorgram evaluate` as a command: its sentences."""

import pytest
from rotorgram.cli import main


def test_pid_on_another_task_names_the_controller_that_flies_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Fault 64."""
    assert main(["evaluate", "pid", "--env", "rotorgram/Hover-v0"]) == 1
    sentence = capsys.readouterr().err
    assert sentence == (
        "rotorgram: pid: expected the env rotorgram/Elevation-v0, got rotorgram/Hover-v0: "
        "geometric flies tasks with a goal\n"
    )
