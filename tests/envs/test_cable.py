"""Several drones on one payload: statics, momentum, ends, and that it can be carried."""

import math

import mujoco
import numpy as np
import pytest
from contracts import rows_of, zero_actions
from rotorgram.agents import Geometric
from rotorgram.envs import LocalVectorEnv
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.models import InputError, Vehicle
from rotorgram.models.swarm import swarm_model
from rotorgram.sim import EffectOptions, InitialState, make_world

CABLE = "rotorgram/Cable-v0"


def started(drones: int, vehicle: str | None = None, **options: object) -> LocalVectorEnv:
    env = LocalVectorEnv(CABLE, drones, drones=drones, vehicle=vehicle, action="rotors", **options)
    env.reset(seed=3)
    return env


@pytest.mark.parametrize("drones", [2, 3, 8])
@pytest.mark.parametrize("vehicle", [None, "crazyflie2", "skydio_x2", "heavy_hexa"])
def test_the_start_is_an_equilibrium(vehicle: str | None, drones: int) -> None:
    """A second without control moves nothing by more than a thousandth of the cable.

    The cables are MuJoCo's limits, which yield a little. `skydio_x2` has its center of mass off the
    body's origin, where the cable pulls.
    """
    env = started(drones, vehicle)
    world = env.loop.world
    state = world.state
    crafts = state.position.copy()
    ball = state.payload.copy()
    cables = crafts - ball
    length = np.linalg.norm(cables, axis=-1)
    cable = length[0, 0]
    assert length == pytest.approx(cable)
    slant = np.arccos(cables[..., 2] / length)
    assert np.degrees(slant) == pytest.approx(30.0)
    steps = round(1 / world.vehicle.timestep)
    world.step(state.thrust.copy(), steps)
    assert np.abs(state.position - crafts).max() < 1e-3 * cable
    assert np.abs(state.payload - ball).max() < 1e-3 * cable
    assert not state.touching.any()


@pytest.mark.parametrize("drones", [2, 3, 5])
def test_the_tensions_carry_the_payload(drones: int) -> None:
    """T = m g / (A cos(angle)) in each cable: together the weight."""
    env = started(drones, payload_share=0.3, angle=40.0)
    world = env.loop.world
    state = world.state
    vehicle = world.vehicle
    mass = 0.3 * drones * vehicle.mass
    cables = state.position - state.payload
    cable = float(np.linalg.norm(cables[0, 0]))
    model = swarm_model([vehicle] * drones, payload=mass, cable=cable)
    data = mujoco.MjData(model)
    crafts = np.concatenate((state.position[0], state.quaternion[0]), axis=-1)
    data.qpos[:] = [*crafts.ravel(), *state.payload[0, 0], 1, 0, 0, 0]
    data.ctrl[:] = state.thrust[0].ravel()
    steps = round(2 / vehicle.timestep)
    mujoco.mj_step(model, data, nstep=steps)
    mujoco.mj_forward(model, data)
    at_limit = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON
    tension = data.efc_force[at_limit]
    cosine = math.cos(math.radians(40.0))
    wanted = mass * vehicle.gravity / (drones * cosine)
    assert tension == pytest.approx([wanted] * drones, rel=2e-3)


def test_cables_keep_the_momentum() -> None:
    """Without thrust all fall together, and what one craft is pulled back the others gain."""
    vehicle = Vehicle.load()
    effects = EffectOptions(payload=0.5 * vehicle.mass, cable=3.0)
    world = make_world(vehicle, 1, drones=2, effects=effects)
    here = np.array([[[-2.5, 0.0, 60.0], [2.5, 0.0, 60.0]]])
    ball = np.array([0.0, 0.0, 60.0 - 2.75**0.5]) + np.zeros((1, 2, 3))
    away = np.array([[[0.0, 0.0, 0.0], [3.0, 1.0, 0.0]]])
    pose = InitialState(position=here, velocity=away, payload=ball)
    world.reset(np.ones((1, 2), bool), pose)
    state = world.state
    loads = np.full(3, vehicle.mass)  # of both crafts, and of the ball

    def momentum() -> np.ndarray:
        moves = np.concatenate((state.velocity[0], state.payload_velocity[0, :1]))
        total: np.ndarray = loads @ moves
        return total

    start = momentum()
    assert start.tolist() == [60.0, 20.0, 0.0]
    seconds = 0.4
    steps = round(seconds / vehicle.timestep)
    world.step(np.zeros((1, 2, 4)), steps)
    weight = loads.sum() * vehicle.gravity
    fallen = np.array([0.0, 0.0, -weight * seconds])
    assert momentum() == pytest.approx(start + fallen, rel=1e-9)
    other, first = state.velocity[0, :, 0]
    assert first < 2.5  # pulled back by the ball,
    assert other > 0.05  # which pulls the other craft


def test_a_symmetric_flight_stays_symmetric() -> None:
    """More thrust for all lifts all alike, and the payload straight up."""
    env = started(4)
    world = env.loop.world
    state = world.state
    before = state.payload[0, 0].copy()
    steps = round(0.5 / world.vehicle.timestep)
    world.step(1.1 * state.thrust, steps)
    ball = state.payload[0, 0]
    assert ball[2] > before[2] + 0.1
    assert ball[:2] == pytest.approx(before[:2], abs=1e-9)
    heights = state.position[0, :, 2]
    assert np.ptp(heights) < 1e-9


def test_the_flight_of_one_world_ends_for_all_its_drones() -> None:
    env = LocalVectorEnv(CABLE, 6, drones=3, autoreset_mode="Disabled", action="rotors")
    env.reset(seed=0)
    actions = zero_actions(6, 4)
    actions[1] = -1.0  # one drone of the first world lets go
    for _ in range(400):
        _, rewards, terminated, *_ = env.step(actions)
        world = set(terminated[:3].tolist())
        assert len(world) == 1
        if terminated[0]:
            break
    assert terminated.tolist() == [True] * 3 + [False] * 3
    assert (rewards[:3] < -15.0).all()


@rows_of("the geometric controllers carry it to its goal", "vehicle, drones")
def test_the_geometric_controllers_carry_it_to_its_goal(vehicle: str | None, drones: int) -> None:
    env = LocalVectorEnv(
        CABLE, drones, drones=drones, vehicle=vehicle, action="position", autoreset_mode="Disabled"
    )
    most = 0.01 if vehicle else 0.1
    agent = Geometric(env.env_spec)
    for flight in fly_episodes(env, agent, 2, "final"):
        assert flight.ending == "truncated"
        errors = flight.telemetry["metrics"][:, 0]
        last = errors[-125:].mean()
        assert errors[0] > 10 * last
        assert last < most


@rows_of("what cannot be carried is told", "drones, options, sentence")
def test_what_cannot_be_carried_is_told(
    drones: int, options: dict[str, object], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence.replace(" m,", ".*,")):
        LocalVectorEnv(CABLE, drones, drones=drones, **options)
