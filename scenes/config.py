"""Which scene surrounds the drones, and which of its layouts each episode has."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Self

from ..models.errors import InputError, shortened
from ..models.fields import (
    Limits,
    Rule,
    check_fields,
    immutable,
    read_table,
    rules_of,
    set_fields,
)
from .registry import MAX_SOLIDS, SCENES, SceneType, seeded_scenes

MAX_SEEDS = 64
"""Seeds of a scene among which episodes choose."""
NEW_SEEDS = 1 << 28
"""How many seeds there are for new layouts, and as many for unseen ones."""
FILES = (".toml", ".xml")
"""Endings of files that describe a scene."""


@immutable
class SceneConfig:
    """Ground and obstacles around the drones.

    As a text: NAME, then `:SEED`, `:FIRST-LAST`, `:new` or `:unseen`, then options, as in
    `forest:new,density=0.1,size=34x16,clear=ends`. Or the path of a TOML or MJCF file.
    """

    name: str = "plain"
    """One of `SCENES`, or the path of a file."""
    seeds: Annotated[
        tuple[int, ...], Limits(0, 2 * NEW_SEEDS - 1, whole=True, count=0, least=0)
    ] = ()
    """Seeds of layouts. Each episode draws one of them. Empty means seed 0."""
    layouts: Literal["given", "new", "unseen"] = "given"
    """`given`: those of `seeds`. `new`: each episode of each world draws a layout of its own.
    `unseen`: the same, of layouts that `new` never draws, for evaluation."""
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Options of the scene by name. Those that are missing have the defaults of its `SceneType`."""
    content: str = field(default="", repr=False)
    """Obstacles of the file, as `obstacles` has them; set by `EnvConfig.resolve`, which needs the
    file no more."""

    def __post_init__(self) -> None:
        check_fields(self, "scene.")
        seeds = self.seeds
        first = seeds[0] if seeds else 0
        if seeds != tuple(range(first, first + len(seeds))):
            raise InputError(f"scene: expected consecutive seeds, got {shortened(seeds)}")
        has_layouts = bool(seeds) or self.layouts != "given"
        both = bool(seeds) and self.layouts != "given"
        if self.name not in SCENES and not self.is_file:
            _refuse(shortened(self.name))
        if self.content and not self.is_file:
            raise InputError(f"scene: expected content of a file alone, got it with {self.name}")
        wrong = has_layouts and not self.is_seeded
        if wrong or both or len(seeds) > MAX_SEEDS:
            _refuse(f"{self.name} with seeds {shortened(seeds)} and {self.layouts} layouts")
        rules = rules_of(self.type.options)
        if self.options and not rules:
            got = ", ".join(self.options)
            raise InputError(f"scene: expected no options with {self.name}, got {got}")
        values = self.values
        given = {name: getattr(values, name) for name in rules if name in self.options}
        set_fields(self, options=given)

    def check_most(self) -> None:
        """Raise `InputError` for too many parts."""
        most = self.values.most
        if most > MAX_SOLIDS:
            raise InputError(f"scene: expected at most {MAX_SOLIDS} parts, got {most} of {self}")

    @cached_property
    def values(self) -> Any:
        """All options, as those of its `SceneType`."""
        return read_table(self.type.options, self.options, "scene")

    def __str__(self) -> str:
        """The text that `parse` reads."""
        text = self.name
        if self.layouts != "given":
            text += f":{self.layouts}"
        elif self.seeds:
            first, last = self.seeds[0], self.seeds[-1]
            text += f":{first}" if first == last else f":{first}-{last}"
        return text + "".join(f",{name}={_text_of(x)}" for name, x in self.options.items())

    @classmethod
    def parse(cls, scene: Any) -> Self:
        """A scene from its text, or from its fields by name. Raises `InputError`."""
        if isinstance(scene, cls):
            return scene
        if isinstance(scene, Mapping):
            return read_table(cls, scene, "scene")
        if is_scene_file(scene):
            return cls(name=scene)
        text, *pairs = scene.replace(" ", "").split(",") if isinstance(scene, str) else ("",)
        pattern = r"(\w+)(?::(?:(new|unseen)|([0-9]{1,9})(?:-([0-9]{1,9}))?))?"
        found = re.fullmatch(pattern, text)
        named = [re.fullmatch(r"(\w+)=([\w.+-]+)", pair) for pair in pairs]
        options = {match[1]: match[2] for match in named if match}
        if not found or len(options) < len(pairs):
            _refuse(shortened(scene))
        name, layouts, first, last = found.groups()
        seeds = range(int(first), int(last or first) + 1) if first else range(0)
        if len(seeds) > MAX_SEEDS or (first and not seeds):
            _refuse(shortened(scene))
        rules = rules_of(SCENES[name].options) if name in SCENES else {}
        values = {key: _value_of(text, rules.get(key)) for key, text in options.items()}
        layouts = layouts or "given"
        table = {"name": name, "seeds": tuple(seeds), "layouts": layouts, "options": values}
        return read_table(cls, table, "scene")

    @property
    def given_scenes(self) -> "tuple[SceneConfig, ...]":
        """The scenes of which each episode has one; none where each has a new one."""
        if self.layouts != "given":
            return ()
        return tuple(replace(self, seeds=(seed,)) for seed in self.seeds) or (self,)

    def with_seed(self, seed: int) -> "SceneConfig":
        """The scene of one seed."""
        return replace(self, seeds=(seed,), layouts="given") if self.is_seeded else self

    def filled(self, usual: "SceneConfig") -> "SceneConfig":
        """The same with the options of a task's own scene, if it is that. Raises `InputError` for
        options that contradict the task's.
        """
        if self.name != usual.name or not usual.options:
            return self
        for name, value in self.options.items():
            if value != usual.options.get(name):
                task = replace(self, options=usual.options)
                raise InputError(f"scene: expected {task}, as the task's options say, got {self}")
        return replace(self, options=usual.options)

    def unseen(self) -> "SceneConfig":
        """The same for tests: unseen layouts in place of new ones."""
        return replace(self, layouts="unseen") if self.layouts == "new" else self

    @property
    def shown(self) -> "SceneConfig":
        """What films and views show: the airport in place of bare ground."""
        return replace(self, name="airport") if self.name == "plain" else self

    @property
    def type(self) -> SceneType:
        """What draws it; a file has none."""
        return SCENES.get(self.name, SceneType())

    @property
    def is_seeded(self) -> bool:
        """Whether it is drawn from a seed."""
        return self.type.draw is not None

    @property
    def is_file(self) -> bool:
        """Whether a file describes it."""
        return is_scene_file(self.name)

    def embedded(self) -> Self:
        """The same with the content of its file, for a process that has not the file. Raises
        `InputError`.
        """
        if self.content or not self.is_file:
            return self
        from .files import read_scene_file  # it imports MuJoCo

        return replace(self, content=read_scene_file(Path(self.name)))

    @property
    def seed(self) -> int:
        """Of a single scene."""
        return self.seeds[0] if self.seeds else 0


def is_scene_file(word: object) -> bool:
    """Whether a word is the path of a file that describes a scene."""
    return isinstance(word, str) and Path(word).suffix.lower() in FILES


def parse_scene(text: Any) -> SceneConfig:
    """A single scene. Raises `InputError`."""
    scene = SceneConfig.parse(text)
    if len(scene.given_scenes) != 1:
        raise InputError(f"scene: expected one, got {scene}")
    scene.check_most()
    return scene


def refuse_hidden(names: Iterable[str], user: str) -> None:
    """Raise `InputError` for the first name of solids that their user does not know."""
    for name in names:
        expected = f"no mesh and no obstacle that moves with {user}: mujoco alone has them"
        raise InputError(f"scene: expected {expected}, got {name}")


def _text_of(value: object) -> str:
    """An option as `parse` reads it, a number with all of its digits."""
    if isinstance(value, tuple):
        return "x".join(map(_text_of, value))
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)


def _value_of(text: str, rule: Rule | None) -> object:
    """The reverse of `_text_of`; the text itself where it is no number."""
    if not isinstance(rule, Limits):
        return text
    try:
        numbers = tuple(map(float, text.split("x")))
    except ValueError:
        return text
    return numbers[0] if rule.count == len(numbers) == 1 else numbers


def _refuse(got: str) -> NoReturn:
    names = " or ".join(map(repr, SCENES))
    raise InputError(
        f"scene: expected {names}, a file that ends in {' or '.join(FILES)}, or one of "
        f"{', '.join(seeded_scenes())} with up to {MAX_SEEDS} seeds or none, as 'forest:3', "
        f"'forest:0-7', 'forest:new' or 'forest:unseen', got {got}"
    )
