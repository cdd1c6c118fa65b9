"""Which scene surrounds the drones, and which of its layouts each episode has."""

import re
from collections.abc import Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Self

from ..models.errors import InputError, shortened
from ..models.fields import Limits, check_fields, immutable, read_table
from .registry import MAX_SOLIDS, SCENES, SceneType, seeded_scenes

MAX_SEEDS = 64
"""Seeds of a scene among which episodes choose."""
NEW_SEEDS = 1 << 28
"""How many seeds there are for new layouts, and as many for unseen ones."""
FILES = (".toml", ".xml")
"""Endings of files that describe a scene."""
FOREST_SIZE = (120.0, 120.0)  # m
GATES_SIZE = 50.0  # m
OPENING = 5.0
"""Width of a gate inside, in a scene of `GATES_SIZE`, m: the paper's craft is 2.8 m wide."""
TREE_DENSITY = 0.0076  # 1/m²
MAX_TREES = 2000
_LEAST_SIDE = 10.0  # m: of a forest or a maze
_LEAST_HALF = 12.0  # m: half of a forest or a maze at least, around a middle that is clear


@immutable
class SceneConfig:
    """Ground and obstacles around the drones.

    As a text: NAME, then `:SEED`, `:FIRST-LAST`, `:new` or `:unseen`, then further fields, as in
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
    density: Annotated[float | None, Limits(1e-4, 0.5, "1/m²")] = None
    """Trees per square metre of a forest."""
    size: Annotated[tuple[float, float] | None, Limits(4.0, 400.0, "m", count=2)] = None
    """Along x and y, m: of a forest, of a maze, of aisles, or of a square of gates, which grow with
    it: those of 50 m are 5 m wide."""
    clear: Literal["middle", "ends"] = "middle"
    """Where a forest or a maze leaves room for craft: 8 m about the z axis, or 2 m about the
    middles of both of its ends in x."""
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
        self._check_options()
        if self.name == "forest" and self.trees > MAX_TREES:
            raise InputError(f"scene: expected at most {MAX_TREES} trees, got {self.trees}")
        most = self.type.most(self)
        if most > MAX_SOLIDS:
            raise InputError(f"scene: expected at most {MAX_SOLIDS} parts, got {most} of {self}")

    def _check_options(self) -> None:
        """Raise `InputError` for a field that the scene does not have, or no room for obstacles."""
        more = {"density": self.density, "size": self.size, "clear": self.clear != "middle"}
        for option, value in more.items():
            if value and option not in self.type.options:
                able = [name for name, kind in SCENES.items() if option in kind.options]
                expected = f"{option} with the scene {' or '.join(able)} alone"
                raise InputError(f"scene: expected {expected}, got {self.name}")
        if self.name == "gates" and len(set(self.size or ())) > 1:
            raise InputError(f"scene: expected a square of gates, got {self}")
        if not (self.size and "clear" in self.type.options):
            return
        narrowest, widest = sorted(self.size)
        if narrowest < _LEAST_SIDE:
            expected = f"sides of at least {_LEAST_SIDE:g} m"
            raise InputError(f"scene: expected {expected}, got {narrowest:g} m")
        if self.clear == "middle" and widest < 2 * _LEAST_HALF:
            expected = f"a size of {2 * _LEAST_HALF:g} m or more, or clear=ends"
            raise InputError(f"scene: expected {expected}, got a size of {widest:g} m")

    @property
    def trees(self) -> int:
        """How many a forest has."""
        wide, deep = self.size or FOREST_SIZE
        return round(wide * deep * (self.density or TREE_DENSITY))

    @property
    def scale(self) -> float:
        """How large gates are: 1 in a scene of `GATES_SIZE`."""
        return (self.size or (GATES_SIZE,))[0] / GATES_SIZE

    @property
    def room(self) -> float:
        """Half the width of the space about the z axis that is clear, m."""
        if self.clear == "ends":
            return 0.0
        return self.type.room * (self.scale if self.name == "gates" else 1.0)

    def __str__(self) -> str:
        """The text that `parse` reads."""
        text = self.name
        if self.layouts != "given":
            text += f":{self.layouts}"
        elif self.seeds:
            first, last = self.seeds[0], self.seeds[-1]
            text += f":{first}" if first == last else f":{first}-{last}"
        if self.density:
            text += f",density={_digits(self.density)}"
        if self.size:
            text += f",size={'x'.join(map(_digits, self.size))}"
        return text + (f",clear={self.clear}" if self.clear != "middle" else "")

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
        fields = [re.fullmatch(r"(density|size|clear)=([\w.+-]+)", pair) for pair in pairs]
        once = len({pair.partition("=")[0] for pair in pairs}) == len(pairs)
        if not found or not all(fields) or not once:
            _refuse(shortened(scene))
        name, layouts, first, last = found.groups()
        seeds = range(int(first), int(last or first) + 1) if first else range(0)
        if len(seeds) > MAX_SEEDS or (first and not seeds):
            _refuse(shortened(scene))
        values: dict[str, Any] = {match[1]: match[2] for match in fields if match}
        for number, mark in (("density", ""), ("size", "x")):
            if number in values:
                values[number] = _numbers(values[number], mark)
        values |= {"name": name, "layouts": layouts or "given", "seeds": tuple(seeds)}
        return cls(**values)

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
        """The same; without options of its own it has those of another scene of its name."""
        if self.name != usual.name or self != replace(
            self, density=None, size=None, clear="middle"
        ):
            return self
        return replace(self, density=usual.density, size=usual.size, clear=usual.clear)

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
    return scene


def _digits(number: float) -> str:
    """All digits of a number."""
    return repr(number).removesuffix(".0")


def _numbers(text: str, mark: str) -> Any:
    """A number of a text, or several with a mark between; the text where it is none."""
    try:
        return tuple(map(float, text.split(mark))) if mark else float(text)
    except ValueError:
        return text


def _refuse(got: str) -> NoReturn:
    names = " or ".join(map(repr, SCENES))
    raise InputError(
        f"scene: expected {names}, a file that ends in {' or '.join(FILES)}, or one of "
        f"{', '.join(seeded_scenes())} with up to {MAX_SEEDS} seeds or none, as 'forest:3', "
        f"'forest:0-7', 'forest:new' or 'forest:unseen', got {got}"
    )
