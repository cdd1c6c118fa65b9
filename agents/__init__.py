"""Learning algorithms, their policies and files, and controllers: PID, geometric and RAPTOR.

Only SB3's algorithms need torch. Each name is imported when it is first used.
"""

from typing import TYPE_CHECKING

from .. import import_when_used

if TYPE_CHECKING:
    from .a2c import A2CConfig
    from .checkpoints import Checkpoint, load, store
    from .config import Config
    from .controllers import CONTROLLERS, Controller, find_controller, is_controller
    from .episodes import Episode, EpisodeRecorder, ResumeError
    from .geometric import Geometric
    from .making import make_agent, resume_agent
    from .pid import PID
    from .policies import Policy
    from .ppo import PPOConfig
    from .presets import find_preset, preset
    from .registry import ALGORITHMS, find_algorithm
    from .vpg import VPGConfig

__all__ = [
    "ALGORITHMS", "CONTROLLERS", "PID", "A2CConfig", "Checkpoint", "Config",
    "Controller", "Episode", "EpisodeRecorder", "Geometric", "PPOConfig", "Policy",
    "ResumeError", "VPGConfig", "find_algorithm", "find_controller", "find_preset", "is_controller",
    "load", "make_agent", "preset", "resume_agent", "store",
]  # fmt: skip

__getattr__ = import_when_used(__name__)
