"""Geoms of a drawn model that move in the course of an episode."""

from itertools import compress

from mujoco import MjModel

from ..scenes import SceneConfig, Solids, parse_scene


class MovingGeoms:
    """The moving solids of a single scene, in a model that has the scene."""

    def __init__(self, model: MjModel, scene: str | SceneConfig) -> None:
        self._model = model
        chosen = parse_scene(scene)
        self._solids = Solids.of_layout(chosen, chosen.seed)
        self._moves = self._solids.moves
        names = compress(self._solids.names, self._moves)
        self._geoms = [model.geom(name).id for name in names]

    def show(self, time: float) -> None:
        """Put them where they are at a time of an episode, s."""
        if self._geoms:
            self._model.geom_pos[self._geoms] = self._solids.at(time).centers[self._moves]
