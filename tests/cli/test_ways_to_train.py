"""`rotorgram train` in this process and over UDP: the same numbers, and who flies which way."""

from pathlib import Path

import pytest
from rotorgram.agents import load
from rotorgram.cli import main

Capsys = pytest.CaptureFixture[str]
HERE = "flying in this process"
LEAST = ("--env-steps", "200", "--set", "steps_per_update=100")


def trained(capsys: Capsys, *words: object) -> str:
    assert main(["train", *map(str, words)]) == 0
    return capsys.readouterr().out


def test_twenty_updates_have_the_same_weights_both_ways(tmp_path: Path, capsys: Capsys) -> None:
    task = ("--env", "rotorgram/Hover-v0", "--num-envs", 8, "--env-steps", 2560)
    words = ("ppo", *task, "--set", "steps_per_update=128")
    assert HERE in trained(capsys, *words, "--out", tmp_path / "here")
    over = trained(capsys, *words, "--udp", "--out", tmp_path / "over")
    assert HERE not in over
    assert "wire: " in over
    here, there = (load(tmp_path / f / "checkpoint.safetensors") for f in ("here", "over"))
    assert here.state.keys() == there.state.keys()
    for name, array in here.state.items():
        assert array.tobytes() == there.state[name].tobytes(), name
    assert here.position.env_steps == there.position.env_steps >= 2560
    assert here.spec == there.spec


@pytest.mark.parametrize(
    ("words", "here"),
    [
        (("a2c",), False),
        (("a2c", "--no-udp"), True),
        (("a2c", "--env", "rotorgram/Hover-v0"), True),
        (("ppo",), True),
        (("ppo", "--record", "flight.mcap"), False),
    ],
)
def test_who_flies_in_this_process(
    words: tuple[str, ...], here: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: Capsys,
) -> None:  # fmt: skip
    """The paper's agents on its task, and what only the wire gives, fly over UDP."""
    monkeypatch.chdir(tmp_path)
    out = trained(capsys, *words, *LEAST, "--out", "run")
    assert (HERE in out) is here
    assert ("wire: " in out) is not here
    assert Path("flight.mcap").exists() == ("--record" in words)


@pytest.mark.parametrize("flags", [("--record", "a.mcap"), ("--listen", "127.0.0.1:0")])
def test_flags_of_the_wire_are_refused_in_this_process(
    flags: tuple[str, str], tmp_path: Path, capsys: Capsys
) -> None:
    assert main(["train", "a2c", "--no-udp", *flags, "--out", str(tmp_path / "run")]) == 1
    err = capsys.readouterr().err
    assert err == f"rotorgram: udp: expected --no-udp without flags of the wire, got {flags[0]}\n"
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("way", ["--udp", "--no-udp"])
def test_a_training_goes_on_with_the_settings_of_its_backend(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    content = 'backend = {name = "rigid", dtype = "float64"}\nepisode_length = 30\n'
    Path("drone.toml").write_text(content)
    words = ("a2c", "--config", "drone.toml", way, "--set", "steps_per_update=100", "--out", "run")
    trained(capsys, *words, "--env-steps", 230)
    trained(capsys, "a2c", "--resume", "run", "--env-steps", 400, way)
    kept = load(Path("run/checkpoint.safetensors"))
    assert kept.position.env_steps == 400
    assert kept.env is not None
    assert kept.env.backend.dtype == "float64"


@pytest.mark.parametrize(
    ("words", "notes"),
    [
        (("--vehicle", "crazyflie2"), 1),
        (("--vehicle", "crazyflie2", "--effects", "motor_lag"), 0),
        ((), 0),  # the paper's file has no lag
    ],
    ids=["without", "with", "none"],
)
def test_a_training_without_the_lag_of_its_rotors_is_noted(
    words: tuple[str, ...], notes: int, tmp_path: Path, capsys: Capsys
) -> None:
    hover = ("--preset", "tuned", "--env", "rotorgram/Hover-v0")
    task = ("ppo", *hover, *LEAST, "--out", tmp_path / "run")
    out = trained(capsys, *task, *words)
    note = (
        "note: the rotors of Crazyflie 2.x follow with a time constant of 0.072 s, "
        "those of this training at once: --effects motor_lag trains for the craft itself\n"
    )
    assert out.count(note) == out.count("note: ") == notes
