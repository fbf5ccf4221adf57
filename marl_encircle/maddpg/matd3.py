"""Multi-Agent Twin Delayed Deep Deterministic Policy Gradient."""

from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples

from marl_encircle.maddpg.arguments import check_range
from marl_encircle.maddpg.maddpg import MADDPG
from marl_encircle.maddpg.policies import MADDPGPolicy

SelfMATD3 = TypeVar("SelfMATD3", bound="MATD3")


class MATD3(MADDPG):
    """MADDPG with twin critics, delayed actors and target policy smoothing (MATD3).

    Paper: https://arxiv.org/abs/1910.01465 (Ackermann et al., 2019), after TD3: https://arxiv.org/abs/1802.09477.

    :param policy: the policy to use (MlpPolicy, CnnPolicy)
    :param env: the environment to learn from
    :param policy_delay: critic updates per update of the actors and the targets
    :param target_policy_noise: standard deviation of the Gaussian noise on the target actors' actions
    :param target_noise_clip: limit of that noise's absolute value
    :param kwargs: passed on to ``MADDPG``
    """

    n_critics: ClassVar[int] = 2

    def __init__(
        self,
        policy: str | type[MADDPGPolicy],
        env: GymEnv | str,
        *args: Any,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        **kwargs: Any,
    ) -> None:
        check_range("target_policy_noise", target_policy_noise, 0)
        check_range("target_noise_clip", target_noise_clip, 0)
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        super().__init__(policy, env, *args, policy_delay=policy_delay, **kwargs)

    def _target_actions(self, batch: ReplayBufferSamples) -> th.Tensor:
        """Return the target actors' actions with clipped noise, in [-1, 1], shape (B, N, U)."""
        noise = th.empty_like(batch.actions).normal_(0, self.target_policy_noise)
        noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
        return (super()._target_actions(batch) + noise).clamp(-1, 1)

    def learn(
        self: SelfMATD3,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "MATD3",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMATD3:
        """Return the trained model, see ``MADDPG.learn``."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
