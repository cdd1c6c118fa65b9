"""`--config FILE` and the configs of checkpoints: what a file says is flown, or refused."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from rotorgram.agents import load
from rotorgram.cli import main
from rotorgram.cli._parser import parse
from rotorgram.cli.compare import Compare
from rotorgram.cli.evaluate import Evaluate
from rotorgram.cli.serve import Serve
from rotorgram.cli.view import View
from rotorgram.envs import LocalVectorEnv
from rotorgram.models import QUAD_XML
from rotorgram.models.errors import InputError

HOVER = "rotorgram/Hover-v0"
FOREST = "rotorgram/Forest-v0"
FILE = f'env_id = "{HOVER}"\nhistory = 2\n[effects]\ngusts = 2\n'
RIGID = '[backend]\nname = "rigid"\ndtype = "float64"\n'


def parsed(kind: Any, path: Path, text: str, *words: str) -> Any:
    path.write_text(text)
    return parse(kind, "rotorgram", ["pid", "--config", str(path), *words])


def test_settings_of_the_backend_reach_the_env(tmp_path: Path) -> None:
    command = parsed(Evaluate, tmp_path / "drone.toml", FILE + RIGID)
    assert command.backend == "rigid"
    config = command.env_config()
    assert config.backend.name == "rigid"
    assert config.backend.dtype == "float64"
    assert config.history == 2
    assert config.effects.gusts == 2.0


@pytest.mark.parametrize("kind", [Evaluate, View])
def test_a_flag_wins_over_a_file_and_a_file_over_the_task(kind: Any, tmp_path: Path) -> None:
    path = tmp_path / "drone.toml"
    wood = f'env = "{FOREST}"\n'
    on_mujoco = '[backend]\nname = "mujoco"\n'

    def backend(text: str, *words: str) -> str:
        return str(parsed(kind, path, text, *words).env_config().backend.name)

    assert backend(wood) == "rigid"
    assert backend(wood + on_mujoco) == "mujoco"
    assert backend(wood, "--backend", "mujoco") == "mujoco"
    assert backend(wood + on_mujoco, "--backend", "rigid") == "rigid"
    assert backend(FILE) == "mujoco"


def test_a_server_has_no_backend(tmp_path: Path) -> None:
    command = parsed(Serve, tmp_path / "drone.toml", FILE + RIGID)
    with pytest.raises(InputError, match=r"^backend: expected it of the simulator that comes"):
        command.run()


def test_another_task_takes_the_world_of_a_file_and_not_its_options(tmp_path: Path) -> None:
    path = tmp_path / "drone.toml"
    other = ("--env", "rotorgram/Landing-v0")
    command = parsed(Evaluate, path, FILE, *other)
    assert command.env_id == "rotorgram/Landing-v0"
    assert command.options["history"] == 2
    assert command.options["effects"]["gusts"] == 2.0
    sentence = "config: expected no options of .*Hover-v0 with --env .*Landing-v0, got start_tilt"
    with pytest.raises(InputError, match=f"^{sentence}$"):
        parsed(Evaluate, path, "start_tilt = 3\n" + FILE, *other)


def test_a_policy_flies_with_the_config_of_its_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "craft").mkdir()
    craft = QUAD_XML.read_text().replace('ctrlrange="0 100"', 'ctrlrange="0 90"')
    (tmp_path / "craft" / "own.xml").write_text(craft)
    words = ["train", "a2c", "--vehicle", "craft/own.xml", "--num-envs", "2", "--env-steps", "40"]
    words += ["--set", "steps_per_update=20", "--episode-length", "30", "--out", "run"]
    assert main(words) == 0
    kept = load(tmp_path / "run" / "checkpoint.safetensors")
    assert kept.env is not None
    assert kept.env.vehicle == ("craft/own.xml",)
    assert kept.env.digest == kept.spec.config_digest
    settings = json.loads((tmp_path / "run" / "config.json").read_text())
    assert settings["env"]["episode_length"] == 30
    shutil.rmtree("craft")
    env = LocalVectorEnv(kept.env, 2)
    assert env.env_spec == kept.spec
    assert env.loop.vehicle.thrust_high.tolist() == [90.0] * 4
    env.close()
    capsys.readouterr()
    assert main(["evaluate", "run", "--episodes", "1"]) == 0
    assert "episodes   1" in capsys.readouterr().out
    assert main(["train", "a2c", "--resume", "run", "--env-steps", "80"]) == 0
    assert load(tmp_path / "run" / "checkpoint.safetensors").env == kept.env


def test_the_env_of_a_file_is_an_id(tmp_path: Path) -> None:
    path = tmp_path / "env.toml"
    path.write_text('[env]\nenv_id = "rotorgram/Hover-v0"\n')
    with pytest.raises(InputError, match=r"^env: expected the id of a task, got \{"):
        parse(Compare, "rotorgram compare", ["--config", str(path)])


def test_files_of_a_comparison_have_the_same_settings_or_are_refused(tmp_path: Path) -> None:
    files = []
    for name, seeds in (("a", 3), ("b", 4)):
        (tmp_path / f"{name}.toml").write_text(
            f'seeds = {seeds}\nepisodes = 7\n[[row]]\nagent = "pid"\nname = "{name}"\n'
        )
        files.append(str(tmp_path / f"{name}.toml"))
    alone = parse(Compare, "rotorgram compare", files[:1]).study()
    assert alone.episodes == 7
    with pytest.raises(InputError, match=r"^seeds: expected the same in all files, got 3 and 4$"):
        parse(Compare, "rotorgram compare", files).study()
    both = parse(Compare, "rotorgram compare", [*files, "--seeds", "2"]).study()
    assert both.seeds == 2
    assert both.episodes == 100  # 200 flights of each row
