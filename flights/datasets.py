"""Data sets for offline reinforcement learning: the whole episodes of journals, for Minari or as
Parquet. See `docs/datasets.md`."""

import copy
import re
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np

from ..envs import registry
from ..envs.spaces import action_space, joined, observation_space
from ..envs.spec import ArraySpec, EnvSpec, component_names
from ..models.errors import InputError, expect, require
from ..udp.protocol.messages import MAX_UINT64, Command, State

if TYPE_CHECKING:
    from ..udp.journal.reader import Session

_ROW_GROUP: Final = 1 << 17  # rows of a Parquet file that are written together
_BATCH: Final = 100  # episodes that Minari gets together
_MINARI_ID: Final = re.compile(r"([\w-]{2,}/)*[\w-]+-v\d+", re.ASCII)


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedEpisode:
    """A whole episode of one drone, T control steps. Row k of T + 1 is after k steps."""

    journal: str
    """Name of the file."""
    session: int
    """Its session, from 1, as `rotorgram replay` counts."""
    drone: int
    """Of the session, from 0."""
    seed: int | None
    """Of the reset that began its world; None where that went on with its random numbers."""
    observations: dict[str, np.ndarray]
    """By name, shape (T + 1, *shape), of the spec's dtypes: as on the wire."""
    actions: np.ndarray
    """Shape (T, *shape), as on the wire; discrete ones int64, shape (T,)."""
    rewards: np.ndarray
    """float64, shape (T,)."""
    terminated: bool
    """Whether the last step ended it by a crash or the like."""
    truncated: bool
    """Whether the last step ended it by the clock."""
    telemetry: dict[str, np.ndarray]
    """By name, float64, shape (T + 1, *shape)."""

    def __len__(self) -> int:
        """T."""
        return len(self.rewards)


class RecordedEpisodes:
    """Whole episodes of journals of one env, in the order in which they ended. Iterated once.

    An episode is whole if its reset, every step and its end are in the journal. One that is not,
    because it was given up, its simulator was lost or the journal ends before it, is left out.
    Steps in which a drone is frozen are no steps of its episode.

    Attributes:
        spec: Of the env.
        left_out: Episodes with at least one step that are not whole, so far.

    Raises:
        OSError: A file cannot be read.
        InputError: There is no journal, or no whole episode in them; while iterating: a file is no
            journal, two have different specs, or the same session.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        expect(paths, "journals", "at least one file", "none")
        self.spec: EnvSpec
        self.left_out = 0
        self._episodes = self._read(paths)
        first = next(self._episodes, None)
        names = ", ".join(map(str, paths))
        if first is None:
            got = f"none of {self.left_out}" if self.left_out else "no step of a flight"
            raise InputError(f"{names}: expected a whole episode, got {got}")
        self._episodes = chain([first], self._episodes)

    def __iter__(self) -> Iterator[RecordedEpisode]:
        return self._episodes

    def _read(self, paths: Sequence[Path]) -> Iterator[RecordedEpisode]:
        from ..udp.journal.reader import Recording

        known: dict[int, Path] = {}  # files by session
        for path in paths:
            flying: dict[int, _Session] = {}  # the last of each slot
            for item in Recording(path):
                reader = flying.get(item.session.slot)
                if reader is None or reader.session is not item.session:
                    self.left_out += reader.unfinished if reader else 0
                    self._check(path, item.session.spec)
                    number = item.session.hello.session  # 0 where it is not known: by text
                    got = f"session {number:016x} in {known.get(number)} and in {path}"
                    expect(not number or number not in known, "journals", "each flight once", got)
                    known[number] = path
                    reader = flying[item.session.slot] = _Session(path.name, item.session)
                if isinstance(item.message, Command):
                    reader.command = item.message
                elif isinstance(item.message, State):
                    yield from reader.take(item.message)
                    self.left_out, reader.left_out = self.left_out + reader.left_out, 0
            self.left_out += sum(reader.unfinished for reader in flying.values())

    def _check(self, path: Path, spec: EnvSpec) -> None:
        """Raises `InputError` unless the spec is that of the others."""
        first = self.__dict__.setdefault("spec", spec)
        for one in fields(EnvSpec):
            ours, theirs = getattr(first, one.name), getattr(spec, one.name)
            expected = f"journals of one env, all with the {one.name} {ours!s:.120}"
            expect(ours == theirs, str(path), expected, str(theirs))


class _Session:
    """Makes episodes of what a journal has of one session."""

    def __init__(self, journal: str, session: "Session") -> None:
        self.session = session
        self.command: Command | None = None
        self.left_out = 0
        self._journal = journal
        self._sequence: int | None = None
        count, self._drones = session.num_envs, len(session.spec.agents)
        self._rows: list[list[tuple[State, Any]]] = [[] for _ in range(count)]
        """Of each drone: the States of its episode, each with the actions before it."""
        self._seeds: list[int | None] = [None] * count

    @property
    def unfinished(self) -> int:
        """Drones that have flown a part of an episode."""
        return sum(len(rows) > 1 for rows in self._rows)

    def take(self, state: State) -> Iterator[RecordedEpisode]:
        """Episodes that end with a State."""
        command, before = self.command, self._sequence
        count, self._sequence = self.session.num_envs, state.sequence
        everybody = np.ones(count, bool)
        if before is None:  # drone i takes seed + i: rule 6 of the protocol
            first = self.session.seed
            seeds = None if first is None else [(first + i) & MAX_UINT64 for i in range(count)]
            self._begin(state, everybody, seeds)
            return
        if command is None or not before == command.sequence == state.sequence - 1:
            self._begin(state, everybody, None)  # a gap: nobody knows what was flown
            for rows in self._rows:
                rows.clear()
            return
        flown = ~(command.resets | command.frozen)
        ended = flown & (state.terminated | state.truncated)
        for drone in np.flatnonzero(flown).tolist():
            if rows := self._rows[drone]:  # else its episode has ended
                rows.append((state, command.actions))
                if ended[drone]:
                    yield self._episode(drone)
                    rows.clear()
        if command.resets.any():
            seeds = None if command.seeds is None else command.seeds.tolist()
            self._begin(state, command.resets, seeds)

    def _begin(self, state: State, drones: np.ndarray, seeds: Sequence[int] | None) -> None:
        for drone in np.flatnonzero(drones).tolist():
            self.left_out += len(self._rows[drone]) > 1
            self._rows[drone] = [(state, None)]
            first = drone - drone % self._drones  # of its world: its seed counts
            self._seeds[drone] = None if seeds is None else seeds[first]

    def _episode(self, drone: int) -> RecordedEpisode:
        spec, rows = self.session.spec, self._rows[drone]
        states = [state for state, _ in rows]
        last = states[-1]
        return RecordedEpisode(
            journal=self._journal,
            session=self.session.index,
            drone=drone,
            seed=self._seeds[drone],
            observations={
                array.name: np.stack([state.observations[i][drone] for state in states])
                for i, array in enumerate(spec.observation)
            },
            actions=np.stack([actions[drone] for _, actions in rows[1:]]),
            rewards=np.array([state.rewards[drone] for state in states[1:]]),
            terminated=bool(last.terminated[drone]),
            truncated=bool(last.truncated[drone]),
            telemetry={
                array.name: np.stack([state.telemetry[i][drone] for state in states])
                for i, array in enumerate(spec.telemetry)
            },
        )


@contextmanager
def _removed_on_error(path: Path) -> Iterator[None]:
    """Half a data set is none. An `OSError` without a file's name gets this one."""
    try:
        yield
    except BaseException as error:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        if isinstance(error, OSError) and not error.filename:
            raise OSError(error.errno, error.strerror or str(error), str(path)) from None
        raise


# ---- Parquet


def write_parquet(episodes: RecordedEpisodes, out: Path) -> tuple[int, int]:
    """Write one row for each of the T + 1 observations of an episode; episodes and steps written.

    A row has an observation, the action that follows and what this gives; action, reward and flags
    of the last row are null. The metadata of the schema has the spec: `env_spec`, JSON.

    Raises `InputError`: `out` exists, or its folder does not; or while the episodes are read.
    """
    require("pyarrow", "dataset", "a data set as Parquet")
    import pyarrow as pa
    import pyarrow.parquet as pq

    expect(out.suffix == ".parquet", "out", "a file that ends in .parquet", str(out))
    expect(not out.exists(), "out", "the name of a new file", f"{out}, which is there")
    expect(out.absolute().parent.is_dir(), "out", "a folder that is there for it", str(out))
    metadata = {"env_spec": episodes.spec.to_json()}
    count = steps = waiting = 0
    batches: list[Any] = []
    writer: Any = None
    with _removed_on_error(out):
        for episode in episodes:
            batch = _table(episodes.spec, count, episode).replace_schema_metadata(metadata)
            writer = writer or pq.ParquetWriter(out, batch.schema, compression="zstd")
            batches.append(batch)
            count, steps, waiting = count + 1, steps + len(episode), waiting + len(batch)
            if waiting > _ROW_GROUP:
                writer.write_table(pa.concat_tables(batches))
                batches, waiting = [], 0
        if batches:
            writer.write_table(pa.concat_tables(batches))
        writer.close()
    return count, steps


def _table(spec: EnvSpec, number: int, episode: RecordedEpisode) -> Any:
    import pyarrow as pa

    rows = len(episode) + 1
    last = np.arange(1, rows) == rows - 1

    def same(value: Any, kind: Any) -> Any:
        return pa.repeat(pa.scalar(value, kind), rows)

    def with_null(values: Any) -> Any:
        array = values if isinstance(values, pa.Array) else pa.array(values)
        return pa.concat_arrays([array, pa.nulls(1, array.type)])

    columns = {
        "episode": same(number, pa.int32()),
        "step": pa.array(np.arange(rows, dtype=np.int32)),
        "journal": same(episode.journal, pa.string()).dictionary_encode(),
        "session": same(episode.session, pa.int32()),
        "drone": same(episode.drone, pa.int32()),
        "seed": same(episode.seed, pa.uint64()),
    }
    several = len(spec.observation) > 1
    for array in spec.observation:
        stem = f"observation.{array.name}" if several else "observation"
        columns |= _columns(stem, array, episode.observations[array.name])
    if isinstance(spec.action, ArraySpec):
        actions = _columns("action", spec.action, episode.actions)
    else:
        actions = {"action": pa.array(episode.actions)}
    columns |= {name: with_null(values) for name, values in actions.items()}
    columns["reward"] = with_null(episode.rewards)
    columns["terminated"] = with_null(last & episode.terminated)
    columns["truncated"] = with_null(last & episode.truncated)
    for array in spec.telemetry:
        flat = episode.telemetry[array.name].reshape(rows, -1)
        for name, column in zip(component_names(array), flat.T, strict=True):
            columns[f"telemetry.{name}"] = pa.array(np.ascontiguousarray(column))
    return pa.table(columns)


def _columns(stem: str, array: ArraySpec, values: np.ndarray) -> dict[str, Any]:
    """One column for each component of a vector; an array of more axes is one column of lists."""
    import pyarrow as pa

    flat = values.reshape(len(values), -1)
    if len(array.shape) > 1:
        return {stem: pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), array.size)}
    names = array.components or map(str, range(array.size))
    return {
        f"{stem}.{name}": pa.array(np.ascontiguousarray(column))
        for name, column in zip(names, flat.T, strict=True)
    }


# ---- Minari


def write_minari(
    episodes: RecordedEpisodes, dataset_id: str, vehicle: Path | str | None = None
) -> tuple[int, int]:
    """Write a data set that `minari.load_dataset` finds by its id; episodes and steps written.

    Its `infos` have the telemetry by its components, as `info` of the env has it. Its env spec
    makes `recover_environment` work, where `env_of` finds the env. Its metadata has the spec of the
    recorded env: `rotorgram_env_spec`, JSON.

    Raises `InputError`: the id is none, or exists; or while the episodes are read.
    """
    require("minari", "dataset", "a data set for Minari")
    require("h5py", "dataset", "a data set for Minari")
    from minari import create_dataset_from_buffers
    from minari.storage.datasets_root_dir import get_dataset_path

    right = _MINARI_ID.fullmatch(dataset_id)
    expect(right, "out", "an id of Minari as namespace/name-v0", repr(dataset_id))
    path = get_dataset_path(dataset_id)
    expect(not path.exists(), "out", "the id of a new data set", f"{dataset_id}: {path} exists")
    spec = episodes.spec
    count = steps = 0
    with _removed_on_error(path), warnings.catch_warnings():
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
        batch: list[Any] = []
        for episode in episodes:
            batch.append(_buffer(spec, episode))
            count, steps = count + 1, steps + len(episode)
            if len(batch) == _BATCH:
                data.update_dataset_from_buffer(batch)
                batch = []
        data.update_dataset_from_buffer(batch)
    return count, steps


def env_of(spec: EnvSpec, vehicle: Path | str | None = None) -> Any:
    """Gymnasium's spec of the env, which makes it with these options and this vehicle (file or
    name; None: the paper's). None if it is not registered here, or is another env here.
    """
    if not registry.is_known(spec.env_id):
        return None
    try:
        here = registry.env_spec(spec.env_id, spec.options, vehicle)
    except InputError:  # options that this vehicle does not have
        return None
    if here != spec:
        return None
    made = copy.deepcopy(gym.spec(spec.env_id))
    made.kwargs |= {**spec.options, **({} if vehicle is None else {"vehicle": str(vehicle)})}
    return made


def _buffer(spec: EnvSpec, episode: RecordedEpisode) -> Any:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    last = np.arange(1, len(episode) + 1) == len(episode)
    infos = {
        name: column.tolist()
        for array in spec.telemetry
        for name, column in zip(
            component_names(array),
            episode.telemetry[array.name].reshape(len(episode) + 1, -1).T,
            strict=True,
        )
    }
    return EpisodeBuffer(
        seed=episode.seed,
        observations=joined(spec, episode.observations),
        actions=episode.actions,
        rewards=episode.rewards,
        terminations=last & episode.terminated,
        truncations=last & episode.truncated,
        infos=infos,
    )
