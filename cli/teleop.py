"""`rotorgram teleop`: flights by hand, steered from a page in a browser."""

from pathlib import Path

from ._flags import Count, EnvFlags, parse_address


class Teleop(EnvFlags):
    """Fly by hand in real time: two sticks, keys or a gamepad, on a page in a browser.

    Without a hand, for half a second, the craft hovers, and five seconds later it lands.
    """

    bind: str = "127.0.0.1:8080"
    """Address of the page, HOST:PORT; port 0 takes a free one."""
    insecure: bool = False
    """Allow an address beyond this machine: the key in the page's address travels unsealed."""
    speed: float = 1.0
    """1 is real time, from 1/16 to 8."""
    seed: int = 0
    """Of the first episode; the next ones count up."""
    episodes: Count | None = None
    """End after so many episodes. Default: go on until Ctrl-C."""
    record: Path | None = None
    """MCAP file to write every message to."""

    def run(self) -> None:
        """Serve the page, and fly episode after episode."""
        from contextlib import closing
        from itertools import count, islice

        from ..envs.specification import make_task
        from ..flights.stick_page import StickPage
        from ..flights.sticks import HandPilot, fly_by_hand
        from ..models import InputError
        from ..rendering.live import Pace
        from ..udp.spawn import spawn_simulator
        from ..udp.transport.sockets import resolve

        if self.drones != 1:
            raise InputError(f"drones: expected 1, flown by hand, got {self.drones}")
        way_out = "--insecure, where others may read the key of the page"
        bind = resolve(parse_address(self.bind), insecure=self.insecure, way_out=way_out)
        config = self.env_config().resolve()
        pilot = HandPilot(make_task(config))
        simulator = spawn_simulator(config, num_envs=1, record=self.record)
        with closing(StickPage(bind, pilot.steer)) as page, simulator as env:
            pace = Pace(env.control_period, self.speed)
            print(f"open {page.url} (Ctrl-C ends)")
            for episode in islice(count(), self.episodes):
                seconds = fly_by_hand(env, pilot, page, pace, self.seed + episode)
                ending = "terminated" if env.terminated[0] else "truncated"
                print(f"episode {episode}: {seconds:.2f} s, {ending}, {env.headline[0]:.3f}")
