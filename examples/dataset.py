"""Journals as a data set for offline reinforcement learning: `docs/datasets.md` has the layout.

    rotorgram evaluate pid --episodes 2 --record flight.mcap
    python examples/dataset.py flight.mcap --to parquet --out flight.parquet [--help]

It writes whole episodes for Minari, or as one Parquet file.
"""

import copy
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro
from gymnasium.envs.registration import EnvSpec as GymSpec
from numpy.typing import NDArray
from rotorgram.envs import registry
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.spaces import action_space, info_columns, joined, observation_space
from rotorgram.envs.spec import ArraySpec, EnvSpec
from rotorgram.flights.recorded import read_episodes
from rotorgram.flights.trajectories import Trajectory
from rotorgram.models import MAX_DRONES, InputError
from rotorgram.models.fields import immutable
from rotorgram.models.files import check_new_file, removed_on_error
from rotorgram.models.fleet import load_vehicles
from rotorgram.udp.journal.reader import Session, count_of
from tyro.conf import Positional

if TYPE_CHECKING:
    from minari.data_collector.episode_buffer import EpisodeBuffer

_Item = TypeVar("_Item", bound=Sized)
_ROW_GROUP = 1 << 17  # steps that are written together
_MINARI_ID = re.compile(r"([\w-]{2,}/)*[\w-]+-v\d+", re.ASCII)


class RecordedEpisodes:
    """Whole episodes of journals of one env, in the order in which they ended. Iterated once.

    An episode is whole if its reset, every step and its end are in the journal. Others are left
    out: they were given up, their simulator was lost or the journal ends before them.

    Attributes:
        spec: The spec of the env.
        left_out: Episodes with at least one step that are not whole, so far.
        count: Whole episodes, so far.
        steps: Their steps.
        journal: Name of the file that the last episode comes from.

    Raises:
        OSError: A file cannot be read.
        InputError: There is no whole episode in them; while iterating: a file is no journal, two
            have different specs, or the same session.
    """

    spec: EnvSpec

    def __init__(self, paths: Sequence[Path]) -> None:
        self.left_out = 0
        self.count = 0
        self.steps = 0
        self.journal = ""
        self._sessions: dict[int, Path] = {}
        episodes = self._whole(paths)
        first = next(episodes, None)
        if first is None:
            got = f"none of {self.left_out}" if self.left_out else "no step of a flight"
            raise InputError(f"{', '.join(map(str, paths))}: expected a whole episode, got {got}")
        self._episodes = chain([first], episodes)

    def __iter__(self) -> Iterator[Trajectory]:
        return self._episodes

    def _whole(self, paths: Sequence[Path]) -> Iterator[Trajectory]:
        for path in paths:
            self.journal = path.name
            for one in read_episodes(path, observations=None):
                if isinstance(one, Session):
                    self._check(path, one.spec, one.hello.session)
                elif one.ending == "cut off":
                    self.left_out += 1
                else:
                    self.count += 1
                    self.steps += len(one)
                    yield one

    def _check(self, path: Path, spec: EnvSpec, session: int) -> None:
        """Refuse another spec than that of the first session, and a session that was read."""
        first = self.__dict__.setdefault("spec", spec)
        for one in fields(EnvSpec):
            ours = getattr(first, one.name)
            theirs = getattr(spec, one.name)
            if ours != theirs:
                raise InputError(
                    f"{path}: expected journals of one env, all with the {one.name} "
                    f"{ours!s:.120}, got {theirs}"
                )
        if session in self._sessions:
            raise InputError(
                f"journals: expected each flight once, got session {session:016x} "
                f"in {self._sessions[session]} and in {path}"
            )
        if session:  # 0: by text, where sessions have no number
            self._sessions[session] = path


# ---- Parquet


def write_parquet(episodes: RecordedEpisodes, out: Path) -> None:
    """Write one row for each of the T + 1 observations of an episode.

    A row has an observation, the action that follows and what this gives; action, reward and flags
    of the last row are null. The metadata of the schema has the spec: `env_spec`, JSON.

    Raises `InputError`: `out` exists, or its folder does not; or while the episodes are read.
    """
    check_new_file(out, ".parquet")
    tables = (_table(episodes.spec, i, episodes.journal, one) for i, one in enumerate(episodes))
    batches = map(pa.concat_tables, _batches(tables))
    first = next(batches)
    schema = first.schema.with_metadata({"env_spec": episodes.spec.to_json()})
    with removed_on_error(out), pq.ParquetWriter(out, schema, compression="zstd") as writer:
        for table in chain([first], batches):
            writer.write_table(table.cast(schema))


def _batches(items: Iterable[_Item]) -> Iterator[list[_Item]]:
    """All items, together as soon as they have more than `_ROW_GROUP` rows."""
    batch: list[_Item] = []
    for item in items:
        batch.append(item)
        if sum(map(len, batch)) > _ROW_GROUP:
            yield batch
            batch = []
    if batch:
        yield batch


def _table(spec: EnvSpec, number: int, journal: str, episode: Trajectory) -> pa.Table:
    rows = len(episode) + 1

    def repeated(value: object, kind: pa.DataType) -> pa.Array:
        return pa.repeat(pa.scalar(value, kind), rows)

    def with_null(values: object) -> pa.Array:
        array = values if isinstance(values, pa.Array) else pa.array(values)
        return pa.concat_arrays([array, pa.nulls(1, array.type)])

    columns = {
        "episode": repeated(number, pa.int32()),
        "step": pa.array(np.arange(rows, dtype=np.int32)),
        "time": pa.array(episode.times),
        "journal": repeated(journal, pa.string()).dictionary_encode(),
        "session": repeated(episode.session, pa.int32()),
        "drone": repeated(episode.drone, pa.int32()),
        "seed": repeated(episode.seed, pa.uint64()),
    }
    for array in spec.observation:
        stem = f"observation.{array.name}" if len(spec.observation) > 1 else "observation"
        columns |= _columns(stem, array, episode.observations[array.name])
    if isinstance(spec.action, ArraySpec):
        actions = _columns("action", spec.action, episode.actions)
    else:
        actions = {"action": pa.array(episode.actions)}
    columns |= {name: with_null(values) for name, values in actions.items()}
    columns["reward"] = with_null(episode.rewards)
    for ending in ("terminated", "truncated"):
        columns[ending] = with_null(_ends(episode, ending))
    for name, values in info_columns(spec, episode.telemetry).items():
        columns[f"telemetry.{name}"] = pa.array(values)
    return pa.table(columns)


def _ends(episode: Trajectory, ending: str) -> NDArray[np.bool_]:
    """Whether each step ended it so."""
    ends = np.zeros(len(episode), bool)
    ends[-1] = episode.ending == ending
    return ends


def _columns(stem: str, array: ArraySpec, values: NDArray[np.generic]) -> dict[str, pa.Array]:
    """One column for each component of a vector; an array of more axes is one column of lists."""
    flat = values.reshape(len(values), -1)
    if len(array.shape) > 1:
        return {stem: pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), array.size)}
    names = array.components or map(str, range(array.size))
    return {f"{stem}.{name}": pa.array(column) for name, column in zip(names, flat.T, strict=True)}


# ---- Minari


def write_minari(
    episodes: RecordedEpisodes, dataset_id: str, vehicle: Path | str | None = None
) -> None:
    """Write a data set that `minari.load_dataset` finds by its id.

    Its `infos` have the telemetry by its components, as `info` of the env has it. Its env spec
    makes `recover_environment` work, where `env_of` finds the env. Its metadata has the spec of the
    recorded env: `rotorgram_env_spec`, JSON.

    Raises `InputError`: the id is wrong, or exists; or while the episodes are read.
    """
    from minari import create_dataset_from_buffers
    from minari.storage.datasets_root_dir import get_dataset_path

    if not _MINARI_ID.fullmatch(dataset_id):
        raise InputError(f"out: expected an id of Minari as namespace/name-v0, got {dataset_id!r}")
    path = get_dataset_path(dataset_id)
    if path.exists():
        raise InputError(f"out: expected the id of a new data set, got {dataset_id}: {path} exists")
    spec = episodes.spec
    with removed_on_error(path), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`.*` is set to None|env_spec is None", UserWarning)
        data = create_dataset_from_buffers(
            dataset_id,
            [],
            env=env_of(spec, vehicle),
            observation_space=observation_space(spec),
            action_space=action_space(spec),
            description=f"Flights of {spec.env_id}, recorded by rotorgram",
            data_format="hdf5",
            jpeg_encoding=False,
        )
        data.storage.update_metadata({"rotorgram_env_spec": spec.to_json()})
        for batch in _batches(_buffer(spec, episode) for episode in episodes):
            data.update_dataset_from_buffer(batch)


def env_of(spec: EnvSpec, vehicle: Path | str | None = None) -> GymSpec | None:
    """Gymnasium's spec of the env, which makes it with these options and this vehicle (file or
    name; None: the paper's). None if it is not registered here, or is another env here.
    """
    if not registry.is_known(spec.env_id):
        return None
    try:
        config = EnvConfig.from_keywords(spec.env_id, vehicle=vehicle, **spec.options)
        here = registry.env_spec(config)
    except InputError:  # options that this vehicle does not have
        return None
    if replace(here, config_digest=spec.config_digest) != spec:  # its backend may be another
        return None
    made = copy.deepcopy(gym.spec(spec.env_id))
    made.kwargs |= spec.options
    if vehicle is not None:
        made.kwargs["vehicle"] = str(vehicle)
    return made


def _buffer(spec: EnvSpec, episode: Trajectory) -> "EpisodeBuffer":
    """An episode for Minari."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    telemetry = info_columns(spec, episode.telemetry)
    return EpisodeBuffer(
        seed=episode.seed,
        observations=joined(spec, dict(episode.observations)),
        actions=episode.actions,
        rewards=episode.rewards,
        terminations=_ends(episode, "terminated"),
        truncations=_ends(episode, "truncated"),
        infos={name: values.tolist() for name, values in telemetry.items()},
    )


# ---- the program


@immutable
class Command:
    """Write the whole episodes of journals as a data set, for Minari or as Parquet.

    An episode that was given up, or whose end is not in the journal, is left out and counted.
    """

    journals: Positional[tuple[Path, ...]]
    """MCAP files that --record wrote, all of one env."""
    to: Literal["minari", "parquet"]
    """minari: a data set that minari.load_dataset finds. parquet: one file, one row per step."""
    out: str
    """minari: its id, as rotorgram/elevation-v0; MINARI_DATASETS_PATH is the folder of them all.
    parquet: the file to write."""
    env: str | None = None
    """module:Name-v0 to import a module of the working directory that registers the journals' task.
    An id in a journal is never imported."""
    vehicle: str | None = None
    """TOML or MJCF file that was flown, or its name. Default: the paper's quadcopter."""

    def run(self) -> None:
        """Write it; print what it holds."""
        if not self.journals:
            raise InputError("journals: expected one or more, got none")
        if self.vehicle:
            # Before a journal is read: a wrong name is no other env.
            load_vehicles(self.vehicle, MAX_DRONES)
        if self.env:
            registry.load(self.env)
        episodes = RecordedEpisodes(self.journals)
        if self.to == "minari":
            write_minari(episodes, self.out, self.vehicle)
        else:
            write_parquet(episodes, Path(self.out))
        print(
            f"{self.out}: {count_of(episodes.count, 'episode')}, {count_of(episodes.steps, 'step')}"
        )
        if episodes.left_out:
            print(f"left out: {count_of(episodes.left_out, 'episode')}, not recorded to the end")
        if self.to == "minari" and env_of(episodes.spec, self.vehicle) is None:
            print(
                f"recover_environment cannot make its env: {episodes.spec.env_id} with this "
                "vehicle and these options is not known here; --env MODULE:NAME registers a task, "
                "--vehicle names the vehicle"
            )


if __name__ == "__main__":
    try:
        tyro.cli(Command).run()
    except (InputError, ImportError, OSError) as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
