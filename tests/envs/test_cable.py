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
    world, state = env.loop.world, env.loop.world.state
    crafts = state.position.copy()
    ball = state.payload.copy()
    length = np.linalg.norm(crafts - ball, axis=-1)
    assert length == pytest.approx(length[0, 0])
    slant = np.degrees(np.arccos((crafts - ball)[..., 2] / length))
    assert slant == pytest.approx(30.0)
    world.step(state.thrust.copy(), round(1 / world.vehicle.timestep))
    for now, before in ((state.position, crafts), (state.payload, ball)):
        assert np.abs(now - before).max() < 1e-3 * length[0, 0]
    assert not state.touching.any()


@pytest.mark.parametrize("drones", [2, 3, 5])
def test_the_tensions_carry_the_payload(drones: int) -> None:
    """T = m g / (A cos(angle)) in each cable: together the weight."""
    env = started(drones, payload_share=0.3, angle=40.0)
    state = env.loop.world.state
    vehicle = env.loop.world.vehicle
    mass = 0.3 * drones * vehicle.mass
    cable = float(np.linalg.norm((state.position - state.payload)[0, 0]))
    model = swarm_model([vehicle] * drones, payload=mass, cable=cable)
    data = mujoco.MjData(model)
    crafts = np.concatenate((state.position[0], state.quaternion[0]), axis=-1)
    data.qpos[:] = [*crafts.ravel(), *state.payload[0, 0], 1, 0, 0, 0]
    data.ctrl[:] = state.thrust[0].ravel()
    mujoco.mj_step(model, data, nstep=round(2 / vehicle.timestep))
    mujoco.mj_forward(model, data)
    at_limit = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON
    tension = data.efc_force[at_limit]
    wanted = mass * vehicle.gravity / (drones * math.cos(math.radians(40.0)))
    assert tension == pytest.approx(np.full(drones, wanted), rel=2e-3)


def test_cables_keep_the_momentum() -> None:
    """Without thrust all fall together, and what one craft is pulled back the others gain."""
    vehicle = Vehicle.load()
    effects = EffectOptions.from_options({"payload": 0.5 * vehicle.mass, "cable": 3.0})
    world = make_world(vehicle, 1, drones=2, effects=effects)
    here = np.array([[[-2.5, 0.0, 60.0], [2.5, 0.0, 60.0]]])
    ball = np.array([0.0, 0.0, 60.0 - 2.75**0.5]) + np.zeros((1, 2, 3))
    away = np.array([[[0.0, 0.0, 0.0], [3.0, 1.0, 0.0]]])
    world.reset(np.ones((1, 2), bool), InitialState(position=here, velocity=away, payload=ball))
    state = world.state
    loads = vehicle.mass * np.array([1.0, 1.0, 1.0])  # of both crafts, and of the ball

    def momentum() -> np.ndarray:
        moves = np.concatenate((state.velocity[0], state.payload_velocity[0, :1]))
        total: np.ndarray = loads @ moves
        return total

    start = momentum()
    assert start.tolist() == [60.0, 20.0, 0.0]
    seconds = 0.4
    world.step(np.zeros((1, 2, 4)), round(seconds / vehicle.timestep))
    fallen = np.array([0.0, 0.0, -loads.sum() * vehicle.gravity * seconds])
    assert momentum() == pytest.approx(start + fallen, rel=1e-9)
    assert state.velocity[0, 1, 0] < 2.5  # pulled back by the ball,
    assert state.velocity[0, 0, 0] > 0.05  # which pulls the other craft


def test_a_symmetric_flight_stays_symmetric() -> None:
    """More thrust for all lifts all alike, and the payload straight up."""
    env = started(4)
    world, state = env.loop.world, env.loop.world.state
    ball = state.payload[0, 0].copy()
    world.step(1.1 * state.thrust, round(0.5 / world.vehicle.timestep))
    assert state.payload[0, 0, 2] > ball[2] + 0.1
    assert state.payload[0, 0, :2] == pytest.approx(ball[:2], abs=1e-9)
    assert np.ptp(state.position[0, :, 2]) < 1e-9


def test_the_flight_of_one_world_ends_for_all_its_drones() -> None:
    env = LocalVectorEnv(CABLE, 6, drones=3, autoreset_mode="Disabled", action="rotors")
    env.reset(seed=0)
    actions = zero_actions(6, 4)
    actions[1] = -1.0  # one drone of the first world lets go
    for _ in range(400):
        _, rewards, terminated, *_ = env.step(actions)
        assert len(set(terminated[:3].tolist())) == 1
        if terminated[0]:
            break
    assert terminated.tolist() == [True] * 3 + [False] * 3
    assert (rewards[:3] < -15.0).all()


@pytest.mark.parametrize(("vehicle", "drones"), [("crazyflie2", 3), ("crazyflie2", 8), (None, 3)])
def test_the_geometric_controllers_carry_it_to_its_goal(vehicle: str | None, drones: int) -> None:
    env = LocalVectorEnv(
        CABLE, drones, drones=drones, vehicle=vehicle, action="position", autoreset_mode="Disabled"
    )
    for flight in fly_episodes(env, Geometric(env.env_spec), 2, "final"):
        assert flight.ending == "truncated"
        errors = flight.telemetry["metrics"][:, 0]
        assert errors[0] > 10 * errors[-125:].mean()
        assert errors[-125:].mean() < (0.01 if vehicle else 0.1)


@rows_of("what cannot be carried is told", "drones, options, sentence")
def test_what_cannot_be_carried_is_told(
    drones: int, options: dict[str, object], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence.replace(" m,", ".*,")):
        LocalVectorEnv(CABLE, drones, drones=drones, **options)
