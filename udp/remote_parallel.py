"""The drones of one world of a remote simulator as PettingZoo's agents."""

from typing import Unpack

from ..envs.parallel import AdvancingParallelEnv
from .protocol.client import Address
from .remote import RemoteVectorEnv
from .transport.agent import AgentSettings
from .transport.simulator import DEFAULT_AGENT


class RemoteParallelEnv(AdvancingParallelEnv):
    """The drones of the one world of a simulator, in lock-step over UDP.

    `rotorgram sim --drones A` is such a simulator; its Hello tells the agents. Everything is that
    of the env in process, bit for bit. Arguments and errors are those of `RemoteVectorEnv`; it
    waits for the simulator at once.
    """

    def __init__(self, address: Address = DEFAULT_AGENT, **settings: Unpack[AgentSettings]) -> None:
        world = RemoteVectorEnv(address, autoreset_mode="Disabled", **settings)
        try:
            super().__init__(world)
        except BaseException:
            world.close()
            raise
        self.render_mode = None
