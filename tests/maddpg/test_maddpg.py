import hashlib
import inspect
import pickle
import warnings
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import supersuit
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from slot_envs import IdentityWorlds, LabelledWorlds
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger, configure
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from marl_encircle.maddpg import MADDPG, MATD3, MADDPGPolicy, UntrustedFileWarning
from marl_encircle.maddpg.models import Actor
from marl_encircle.maddpg.saving import load_actors

ALGORITHMS = [MADDPG, MATD3]
CRITICS = ["per_agent", "shared"]
SMALL = {"learning_starts": 24, "batch_size": 16, "buffer_size": 1200, "policy_kwargs": {"net_arch": [8]}}


def make_model(cls: type[MADDPG] = MADDPG, env: Any = None, **kwargs: Any) -> MADDPG:
    model = cls(
        "MlpPolicy", LabelledWorlds() if env is None else env, **{"seed": 0, "device": "cpu", **SMALL, **kwargs}
    )
    model.set_logger(configure(None, []))
    return model


def load(cls: type[MADDPG], path: Path, **kwargs: Any) -> MADDPG:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UntrustedFileWarning)
        return cls.load(path, device="cpu", **kwargs)


def weights_hash(model: MADDPG) -> str:
    return hashlib.sha256(
        b"".join(tensor.numpy().tobytes() for tensor in model.policy.state_dict().values())
    ).hexdigest()


def test_the_defaults_are_those_of_the_documentation() -> None:
    def defaults(function: Any) -> dict[str, Any]:
        parameters = inspect.signature(function).parameters.values()
        return {p.name: p.default for p in parameters if p.default is not p.empty and not p.name.startswith("_")}

    nothing = ("action_noise", "n_agents", "exploration_noise", "max_grad_norm", "policy_kwargs", "seed")
    assert defaults(MADDPG) == {
        **dict.fromkeys(nothing),
        "learning_rate": 1e-3,
        "buffer_size": 1_000_000,
        "learning_starts": 100,
        "batch_size": 1024,
        "tau": 0.01,
        "gamma": 0.95,
        "train_freq": 1,
        "gradient_steps": 1,
        "critic": "per_agent",
        "exploration_random": 0.05,
        "policy_delay": 1,
        "actor_regularization": 1e-3,
        "n_steps": 1,
    }
    assert defaults(MATD3) == {"policy_delay": 2, "target_policy_noise": 0.2, "target_noise_clip": 0.5}
    assert make_model().exploration_noise == 0.3
    for cls in ALGORITHMS:
        assert defaults(cls.learn) == {
            "callback": None,
            "log_interval": 4,
            "tb_log_name": cls.__name__,
            "reset_num_timesteps": True,
            "progress_bar": False,
        }
    assert defaults(MADDPG.train) == {"batch_size": 1024}
    of_policy = defaults(MADDPGPolicy)
    assert (of_policy["n_critics"], of_policy["normalize_images"], of_policy["share_parameters"]) == (1, True, False)
    assert (MADDPG.n_critics, MATD3.n_critics) == (1, 2)
    policy = MADDPG("MlpPolicy", LabelledWorlds(), device="cpu", buffer_size=120).policy
    for network in (policy.actor.mu, *policy.critic.networks):
        assert [weight.shape[-1] for weight in network.weights] == [64, 64]


# ---------------------------------------------------------------------------------------------------------------------
# The mathematics
# ---------------------------------------------------------------------------------------------------------------------


class DoubleFlatten(FlattenExtractor):
    """SB3 casts observations to float32; back to double, exactly, for its double networks."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations).double()


def copy_from_sb3(model: MADDPG, sb3: TD3) -> None:
    pairs = [(model.actor.mu, sb3.actor.mu), *zip(model.critic.q_networks, sb3.critic.q_networks, strict=True)]
    with th.no_grad():
        for stacked, sequential in pairs:
            weights, biases = [*stacked.weights, stacked.head_weight], [*stacked.biases, stacked.head_bias]
            linear = [layer for layer in sequential if isinstance(layer, th.nn.Linear)]
            for weight, bias, layer in zip(weights, biases, linear, strict=True):
                weight[0] = layer.weight.T
                bias[0, 0] = layer.bias
    model.actor_target.load_state_dict(model.actor.state_dict())
    model.critic_target.load_state_dict(model.critic.state_dict())


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("critic", CRITICS)
@pytest.mark.parametrize(("cls", "sb3_cls"), [(MADDPG, DDPG), (MATD3, TD3)])
def test_with_one_agent_200_updates_equal_sb3(cls: type[MADDPG], sb3_cls: type[TD3], critic: str, n_steps: int) -> None:
    def make_env() -> DummyVecEnv:
        return DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 4)

    common = {"gamma": 0.95, "tau": 0.01, "learning_rate": 1e-3, "buffer_size": 2000, "seed": 0, "device": "cpu"}
    common["n_steps"] = n_steps
    net_arch = {"pi": [16, 12], "qf": [12, 16]}
    sb3 = sb3_cls(
        "MlpPolicy",
        make_env(),
        policy_kwargs={"net_arch": net_arch, "features_extractor_class": DoubleFlatten},
        **common,
    )
    model = cls(
        "MlpPolicy",
        make_env(),
        policy_kwargs={"net_arch": net_arch},
        critic=critic,
        actor_regularization=0.0,
        max_grad_norm=None,
        **common,
    )
    sb3.policy.double()
    model.policy.double()
    copy_from_sb3(model, sb3)

    rng = np.random.default_rng(0)
    for _ in range(100):
        obs, next_obs = rng.standard_normal((2, 4, 3))
        dones = rng.random(4) < 0.3
        infos = [{"TimeLimit.truncated": bool(truncated)} for truncated in dones & (rng.random(4) < 0.5)]
        transition = obs, next_obs, rng.uniform(-1, 1, (4, 1)), rng.standard_normal(4), dones, infos
        sb3.replay_buffer.add(*transition)
        model.replay_buffer.add(*transition)
    for learner in (sb3, model):
        learner.set_logger(configure(None, []))
        np.random.seed(1)  # noqa: NPY002 - SB3 draws its batches from it
        th.manual_seed(1)
        learner.train(gradient_steps=200, batch_size=64)

    expected = cls("MlpPolicy", make_env(), policy_kwargs={"net_arch": net_arch}, critic=critic, device="cpu")
    expected.policy.double()
    copy_from_sb3(expected, sb3)
    for network in ("actor", "critic"):
        th.testing.assert_close(
            getattr(model, network).state_dict(), getattr(expected, network).state_dict(), rtol=0, atol=1e-9
        )
    targets = sb3.actor_target(th.ones(1, 3)), model.actor_target(th.ones(1, 1, 3)).flatten(1)
    th.testing.assert_close(*targets, rtol=0, atol=1e-9)


@pytest.mark.parametrize("terminated", [False, True])
@pytest.mark.parametrize("critic", CRITICS)
def test_one_update_equals_the_one_worked_out_by_hand(critic: str, terminated: bool) -> None:
    class TwoAgents(LabelledWorlds):
        def __init__(self) -> None:
            super().__init__(n_worlds=1, n_agents=2, action_size=1)
            self.observation_space = spaces.Box(-1, 1, (1,), np.float32)

    model = make_model(
        env=TwoAgents(),
        critic=critic,
        gamma=0.5,
        tau=0.5,
        learning_rate=0.1,
        actor_regularization=0.0,
        policy_kwargs={"net_arch": [], "optimizer_class": th.optim.SGD},
    )
    model.policy.double()
    (q_network,) = model.critic.q_networks
    with th.no_grad():
        # mu_1 = tanh(o_1 - 1), mu_2 = tanh(1 - o_2)
        # Q_1 = o_1 + 2 o_2 + 3 a_1 + 4 a_2, Q_2 = 4 o_1 + 3 o_2 + 2 a_1 + a_2
        model.actor.mu.head_weight[:, 0, 0] = th.tensor([1.0, -1.0])
        model.actor.mu.head_bias[:, 0, 0] = th.tensor([-1.0, 1.0])
        q_network.head_weight[:, :, 0] = th.tensor([[1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 1.0]])
        q_network.head_bias.zero_()
    model.actor_target.load_state_dict(model.actor.state_dict())
    model.critic_target.load_state_dict(model.critic.state_dict())
    # o = o' = (1, 1), a = (1/2, -1/2), r = (2, 2)
    one = np.ones((2, 1))
    done = np.full(2, terminated)
    model.replay_buffer.add(one, one, np.array([[0.5], [-0.5]]), np.array([2.0, 2.0]), done, [{}, {}])
    model.train(gradient_steps=1, batch_size=16)

    # Q_1 = 1 + 2 + 1.5 - 2 = 2.5, Q_2 = 4 + 3 + 1 - 0.5 = 7.5. With mu' = (0, 0): Q'_1 = 3, Q'_2 = 7
    # y_1 = 2 + 3/2 = 3.5, y_2 = 2 + 7/2 = 5.5; terminated: y = (2, 2)
    # dL/dQ = 2 (Q - y) = (-2, 4); terminated: (1, 11). Steps of 0.1 against it, times (1, 1, 1/2, -1/2), 1
    step = np.array([0.1, 1.1]) if terminated else np.array([-0.2, 0.4])
    q_weight = np.array([[1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 1.0]]) - step[:, None] * [1.0, 1.0, 0.5, -0.5]
    np.testing.assert_allclose(q_network.head_weight[:, :, 0].detach(), q_weight, atol=1e-12)
    np.testing.assert_allclose(q_network.head_bias[:, 0, 0].detach(), -step, atol=1e-12)
    # dQ_1/da_1 = 3 - step_1/2, dQ_2/da_2 = 1 + step_2/2; tanh'(0) = 1 and o = 1: steps of 0.1 up along it
    rise = 0.1 * np.array([3 - step[0] / 2, 1 + step[1] / 2])
    np.testing.assert_allclose(model.actor.mu.head_weight[:, 0, 0].detach(), [1 + rise[0], -1 + rise[1]], atol=1e-12)
    np.testing.assert_allclose(model.actor.mu.head_bias[:, 0, 0].detach(), [-1 + rise[0], 1 + rise[1]], atol=1e-12)
    # The targets go half the way
    np.testing.assert_allclose(
        model.actor_target.mu.head_bias[:, 0, 0], [-1 + rise[0] / 2, 1 + rise[1] / 2], atol=1e-12
    )
    np.testing.assert_allclose(model.critic_target.q_networks[0].head_bias[:, 0, 0], -step / 2, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("critic", CRITICS)
@pytest.mark.parametrize("cls", ALGORITHMS)
def test_a_multi_agent_identity_environment_is_solved(cls: type[MADDPG], critic: str) -> None:
    env = IdentityWorlds()
    model = make_model(
        cls,
        env,
        critic=critic,
        learning_starts=480,
        batch_size=128,
        buffer_size=20_000,
        gamma=0.0,
        exploration_noise=0.3,
        gradient_steps=2,
        policy_kwargs={"net_arch": [32]},
    )
    model.learn(24 * 500)
    obs = np.random.default_rng(0).uniform(-0.9, 0.9, (300, 1)).astype(np.float32)
    actions, _ = model.predict(obs)
    sign = (-1.0) ** np.tile(np.arange(3), 100)
    # Uniformly random actions are 0.67 off, always 0 is 0.45 off
    assert np.abs(actions[:, 0] - sign * obs[:, 0]).mean() < 0.05
    # Ten steps an episode, the optimum earns 0
    assert evaluate_policy(model, VecMonitor(env), n_eval_episodes=48)[0] > -0.5


@pytest.mark.parametrize("critic", CRITICS)
def test_an_actor_gets_no_gradient_from_another_agents_value(critic: str) -> None:
    model = make_model(critic=critic)
    obs, actions = th.randn(16, 3, 3), th.rand(16, 3, 2)
    q_values = model.critic.own_action_values(obs, actions, model.actor(obs))
    for i in range(3):
        grads = th.autograd.grad(q_values[i].mean(), list(model.actor.parameters()), retain_graph=True)
        for grad in grads:
            reached = grad.flatten(1).abs().sum(1) > 0
            assert reached.tolist() == [j == i for j in range(3)]


@pytest.mark.parametrize("critic", CRITICS)
def test_others_actions_come_from_the_buffer(critic: str) -> None:
    model = make_model(critic=critic)
    obs, actions, own_actions = th.randn(16, 3, 3), th.rand(16, 3, 2), th.rand(16, 3, 2)
    q_values = model.critic.own_action_values(obs, actions, own_actions)
    for i in range(3):
        joint = actions.clone()
        joint[:, i] = own_actions[:, i]
        th.testing.assert_close(q_values[i], model.critic(obs, joint)[0, i])


@pytest.mark.parametrize(("critic", "trunks"), [("per_agent", 3), ("shared", 1)])
def test_critics_are_networks_of_their_own_or_heads_of_one_trunk(critic: str, trunks: int) -> None:
    (network,) = make_model(critic=critic).critic.networks
    assert [len(weight) for weight in (*network.weights, network.head_weight)] == [trunks, 3]


def test_regularization_pulls_the_logits_to_zero() -> None:
    def mean_logit(actor_regularization: float) -> float:
        model = make_model(actor_regularization=actor_regularization, learning_rate=0.01)
        model.learn(1200)
        return model.actor.logits(th.ones(1, 3, 3)).abs().mean().item()

    assert mean_logit(100.0) < 0.5 * mean_logit(0.0)


def test_max_grad_norm_limits_each_update() -> None:
    model = make_model(max_grad_norm=1e-3, policy_kwargs={"net_arch": [8], "optimizer_class": th.optim.SGD})
    model.policy.double()
    model.learn(36)
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    model.train(gradient_steps=1, batch_size=16)
    for name in ("actor", "critic"):
        steps = [
            tensor - before[key] for key, tensor in model.policy.state_dict().items() if key.startswith(f"{name}.")
        ]
        norm = th.cat([step.flatten() for step in steps]).norm().item()
        assert 0 < norm <= 1.001 * 1e-3 * model.learning_rate


def test_policy_delay_spares_actors_and_targets() -> None:
    model = make_model(policy_delay=3)
    model.learn(36)
    model._n_updates = 0
    actor, target = weights(model.actor), weights(model.critic_target)
    critic = weights(model.critic)
    model.train(gradient_steps=2, batch_size=16)
    assert th.equal(weights(model.actor), actor)
    assert th.equal(weights(model.critic_target), target)
    assert not th.equal(weights(model.critic), critic)
    model.train(gradient_steps=1, batch_size=16)
    assert not th.equal(weights(model.actor), actor)
    assert not th.equal(weights(model.critic_target), target)


@pytest.mark.parametrize("mode", [True, False])
def test_a_module_that_was_put_into_another_mode_alone_is_put_back(mode: bool) -> None:
    policy = make_model().policy
    modules = [*policy.actor.modules(), *policy.critic.modules()]
    for module in modules:
        policy.set_training_mode(mode)
        module.train(not mode)
        policy.set_training_mode(mode)
        assert {each.training for each in modules} == {mode}


def weights(module: th.nn.Module) -> th.Tensor:
    return th.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


# ---------------------------------------------------------------------------------------------------------------------
# Worlds and slots
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("truncates", [True, False])
def test_what_is_learnt_from_is_what_happened(truncates: bool) -> None:
    env = LabelledWorlds()
    env.truncates = truncates
    model = make_model(env=env)
    model.learn(240)
    sample = model.replay_buffer.sample(1000)
    world, agent, step = sample.observations.unbind(-1)
    assert (sample.rewards == 100 * agent + step).all()
    # Episodes have 5 steps: the last observation is the true one, not the first of the next episode
    assert (sample.next_observations == th.stack([world, agent, step + 1], dim=-1)).all()
    # The time limit bootstraps, a termination does not
    assert ((sample.dones == 1) == ((step == 4) & (not truncates))).all()


def test_normalised_environments_are_stored_unnormalised() -> None:
    model = make_model(env=VecNormalize(LabelledWorlds(), gamma=0.95))
    model.learn(240)
    buffer = model.replay_buffer
    assert (buffer.rewards[:20] == 100 * np.tile(np.arange(3), 4) + np.arange(20)[:, None] % 5).all()
    np.testing.assert_allclose(buffer.next_observations[:20, :, 2], buffer.observations[:20, :, 2] + 1, atol=1e-4)
    # ... and sampled normalised
    assert abs(buffer.sample(500, env=model.get_vec_normalize_env()).rewards.mean()) < 50


def test_minus_one_gradient_steps_are_one_per_step_of_a_world() -> None:
    model = make_model(gradient_steps=-1, learning_starts=0)
    # 12 slots, 4 worlds: 10 steps of 4 worlds are 40 joint updates
    model.learn(120)
    assert model._n_updates == 40


class Dumps(KVWriter):
    def __init__(self) -> None:
        self.written: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: Any, step: int = 0) -> None:
        self.written.append(dict(key_values))

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("log_interval", "logged_at"), [(4, [4, 8, 12, 16]), (8, [8, 16]), (1, [4, 8, 12, 16])])
def test_logs_count_episodes_of_worlds_and_come_once_a_step(log_interval: int, logged_at: list[int]) -> None:
    # 4 worlds of 5 steps: 20 steps of 12 slots end 16 episodes, 4 at a time
    dumps = Dumps()
    model = make_model(stats_window_size=6)
    model.set_logger(Logger(None, [dumps]))
    model.learn(240, log_interval=log_interval)
    assert [dump["time/episodes"] for dump in dumps.written] == logged_at
    # Each step earns 100 * agent + step: 0..4 sum to 10, so agents earn 10, 510, 1010
    assert dumps.written[-1]["rollout/ep_rew_mean"] == 510
    assert dumps.written[-1]["rollout/ep_len_mean"] == 5
    # The last 6 of worlds 0 1 2 3 | 0 1 2 3, of which the odd ones succeed
    assert dumps.written[-1]["rollout/success_rate"] == 0.5
    assert len(model.ep_info_buffer) == 6


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_logs_may_be_left_out_but_not_come_after_no_episode(cls: type[MADDPG]) -> None:
    dumps = Dumps()
    model = make_model(cls)
    model.set_logger(Logger(None, [dumps]))
    model.learn(120, log_interval=None)
    assert not dumps.written
    for log_interval in (0, -4):
        with pytest.raises(ValueError, match=f"log_interval must be at least 1, or None .*, but got {log_interval}"):
            model.learn(120, log_interval=log_interval)


def test_vec_monitor_statistics_are_means_over_agents() -> None:
    dumps = Dumps()
    model = make_model(env=VecMonitor(LabelledWorlds()))
    model.set_logger(Logger(None, [dumps]))
    model.learn(120)
    assert dumps.written[-1]["rollout/ep_rew_mean"] == 510


def test_an_environment_tells_its_agents_through_wrappers() -> None:
    assert make_model(env=VecMonitor(LabelledWorlds())).n_agents == 3
    assert make_model(env=VecNormalize(VecMonitor(LabelledWorlds(n_agents=2)))).n_agents == 2


def test_plain_gymnasium_environments_have_one_agent_each() -> None:
    model = make_model(env=gym.make("Pendulum-v1"))
    assert model.n_agents == 1
    model.set_env(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="n_agents=1, but n_agents=3"):
        make_model().set_env(gym.make("Pendulum-v1"))
    envs = DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 4)
    assert make_model(env=envs).n_agents == 1
    with pytest.raises(ValueError, match="n_agents=1, but n_agents=4"):
        make_model(env=envs, n_agents=4)


class HidesAgents(VecEnvWrapper):
    """Slots that do not tell what they are."""

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.n_agents = None

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        return self.venv.step_wait()


def test_slots_that_hide_their_agents_are_refused_unless_the_number_is_given() -> None:
    with pytest.raises(ValueError, match=r"make_vec_env.*n_agents="):
        make_model(env=HidesAgents(LabelledWorlds()))
    assert make_model(env=HidesAgents(LabelledWorlds()), n_agents=3).n_agents == 3
    with pytest.raises(ValueError, match="12 slots are no whole number of worlds with n_agents=5"):
        make_model(env=HidesAgents(LabelledWorlds()), n_agents=5)
    with pytest.raises(ValueError, match="12 slots are no whole number of worlds with n_agents=0"):
        make_model(env=HidesAgents(LabelledWorlds()), n_agents=0)


def test_a_pettingzoo_environment_and_the_bare_supersuit_wrapper_are_refused(tmp_path: Path) -> None:
    class Parallel(ParallelEnv):
        metadata: ClassVar[dict[str, Any]] = {"name": "parallel"}
        possible_agents: ClassVar[list[str]] = ["agent_0", "agent_1"]
        agents = possible_agents
        render_mode = None

        def observation_space(self, agent: str) -> spaces.Box:
            return spaces.Box(-1, 1, (3,), np.float32)

        def action_space(self, agent: str) -> spaces.Box:
            return spaces.Box(-1, 1, (2,), np.float32)

    with pytest.raises(ValueError, match="SuperSuitVecEnv"):
        make_model(env=Parallel())
    model = make_model()
    with pytest.raises(ValueError, match="SuperSuitVecEnv"):
        model.set_env(Parallel())
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="SuperSuitVecEnv"):
        load(MADDPG, tmp_path / "model.zip", env=Parallel())
    slots = supersuit.pettingzoo_env_to_vec_env_v1(Parallel())
    env = supersuit.concat_vec_envs_v1(slots, 3, base_class="stable_baselines3")
    assert env.num_envs == 6
    with pytest.raises(ValueError, match=r"make_vec_env.*n_agents="):
        make_model(env=env)


@pytest.mark.parametrize("env", ["marl_encircle/encirclement-v0", "marl_encircle/encirclement", "sisl/pursuit-v5"])
def test_the_id_of_a_pettingzoo_environment_is_refused_with_the_call_that_builds_it(env: str) -> None:
    with pytest.raises(ValueError, match=rf"make_vec_env.* SuperSuitVecEnv\(lambda: .*make\(\"parallel\", '{env}'\)"):
        make_model(env=env)


def test_an_id_that_nobody_knows_stays_gymnasiums() -> None:
    with pytest.raises(gym.error.NameNotFound):
        make_model(env="encirclement-v0")


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_discrete_actions_are_refused_with_the_argument_for_others(cls: type[MADDPG]) -> None:
    env = LabelledWorlds()
    env.action_space = spaces.Discrete(5)
    with pytest.raises(AssertionError, match=r"deterministic, but got Discrete\(5\).* continuous_actions=True"):
        make_model(cls, env)
    with pytest.raises(AssertionError, match="Box action space"):
        make_model(cls, "CartPole-v1")


def test_a_number_of_agents_that_differs_from_the_environments_is_refused() -> None:
    with pytest.raises(ValueError, match="n_agents=3, but n_agents=2"):
        make_model(n_agents=2)


def test_set_env_and_load_compare_the_number_of_agents(tmp_path: Path) -> None:
    model = make_model()
    with pytest.raises(ValueError, match="n_agents=4, but n_agents=3"):
        model.set_env(LabelledWorlds(n_worlds=3, n_agents=4))
    model.set_env(LabelledWorlds())
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="n_agents=4, but n_agents=3"):
        load(MADDPG, tmp_path / "model.zip", env=LabelledWorlds(n_agents=4))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 0}, "n_steps must be at least 1, but got 0"),
        (
            {
                "n_steps": 3,
                "optimize_memory_usage": True,
                "replay_buffer_kwargs": {"handle_timeout_termination": False},
            },
            "n_steps must be 1",
        ),
        ({"replay_buffer_class": DDPG}, "JointReplayBuffer"),
        ({"use_sde": True}, "use_sde is not for deterministic actors"),
        ({"critic": "central"}, "central"),
        ({"policy_kwargs": {"critic": "shared"}}, "critic is an argument of MADDPG, not of policy_kwargs"),
        ({"policy_delay": 0}, "policy_delay must be at least 1, but got 0"),
        ({"max_grad_norm": 0.0}, r"max_grad_norm must be positive or None, but got 0\.0"),
        ({"max_grad_norm": -1.0}, r"max_grad_norm must be positive or None, but got -1\.0"),
        ({"train_freq": 0}, "train_freq must be at least 1, but got 0"),
        ({"train_freq": (-1, "episode")}, "train_freq must be at least 1, but got -1"),
        ({"batch_size": 0}, "batch_size must be at least 1, but got 0"),
        ({"actor_regularization": -1}, "actor_regularization must be at least 0, but got -1"),
        ({"gamma": 1.5}, r"gamma must be between 0 and 1, but got 1\.5"),
        ({"tau": -0.1}, r"tau must be between 0 and 1, but got -0\.1"),
        ({"exploration_noise": -1.0}, r"exploration_noise must be at least 0, but got -1\.0"),
        ({"exploration_noise": float("nan")}, "exploration_noise must be at least 0, but got nan"),
        ({"exploration_noise": "0.3"}, "exploration_noise must be a number or a function .* but got '0.3'"),
        ({"exploration_random": 5}, "exploration_random must be between 0 and 1, but got 5"),
    ],
    ids=str,
)
def test_what_is_not_supported_is_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, AssertionError), match=message):
        make_model(**kwargs)


@pytest.mark.parametrize("name", ["target_policy_noise", "target_noise_clip"])
def test_noise_on_target_actions_is_not_negative(name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name} must be at least 0, but got -0\.5"):
        make_model(MATD3, **{name: -0.5})


def test_training_by_episodes_needs_one_world() -> None:
    make_model(env=LabelledWorlds(n_worlds=1), train_freq=(1, "episode")).learn(60)
    with pytest.raises(ValueError, match="one world, but there are 4"):
        make_model(train_freq=(1, "episode")).learn(60)


# ---------------------------------------------------------------------------------------------------------------------
# Acting and exploring
# ---------------------------------------------------------------------------------------------------------------------


def test_predict_takes_worlds_their_slots_one_world_or_a_dict_by_agent() -> None:
    model = make_model()
    obs = np.random.default_rng(0).standard_normal((6, 3)).astype(np.float32)
    actions, state = model.predict(obs)
    assert actions.shape == (6, 2)
    assert state is None
    np.testing.assert_array_equal(model.predict(obs.reshape(2, 3, 3))[0], actions.reshape(2, 3, 2))
    np.testing.assert_allclose(model.predict(obs[3:])[0], actions[3:], rtol=1e-5, atol=1e-6)
    by_name, _ = model.predict({f"agent_{i}": obs[3 + i] for i in range(3)})
    assert list(by_name) == ["agent_0", "agent_1", "agent_2"]
    np.testing.assert_allclose(np.stack(list(by_name.values())), actions[3:], rtol=1e-5, atol=1e-6)
    # Each agent has its own actor
    same = model.predict(np.ones((3, 3), np.float32))[0]
    assert len(np.unique(same, axis=0)) == 3


def test_a_dict_is_read_by_name_where_the_environment_names_its_agents(tmp_path: Path) -> None:
    class Named(LabelledWorlds):
        agents = ("left", "middle", "right")

    obs = dict(zip(Named.agents, np.random.default_rng(0).standard_normal((3, 3)).astype(np.float32), strict=True))
    for env in Named(), VecMonitor(Named()):
        model = make_model(env=env)
        model.save(tmp_path / "model.zip")
        for same in model, load(MADDPG, tmp_path / "model.zip"):
            expected, _ = same.predict(obs)
            actions, _ = same.predict({name: obs[name] for name in reversed(Named.agents)})
            assert all((actions[name] == expected[name]).all() for name in Named.agents)
            with pytest.raises(ValueError, match="observations of left, middle, right"):
                same.predict({f"agent_{i}": np.zeros(3) for i in range(3)})
        model.policy.save(tmp_path / "policy.pth")
        for actors in load_actors(tmp_path / "model.zip"), MADDPGPolicy.load(tmp_path / "policy.pth", device="cpu"):
            actions, _ = actors.predict({name: obs[name] for name in reversed(Named.agents)})
            assert all((actions[name] == expected[name]).all() for name in Named.agents)


def test_agents_in_another_order_are_refused_since_actors_are_by_place(tmp_path: Path) -> None:
    class Named(LabelledWorlds):
        agents = ("left", "middle", "right")

    class Reordered(LabelledWorlds):
        agents = ("right", "middle", "left")

    model = make_model(env=Named())
    message = r"agents are \['right', 'middle', 'left'\], but the actors are those of \['left', 'middle', 'right'\]"
    with pytest.raises(ValueError, match=message):
        model.set_env(Reordered())
    assert model.agents == Named.agents
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=message):
        load(MADDPG, tmp_path / "model.zip", env=Reordered())


def test_the_names_are_those_of_the_environment_that_is_set_last() -> None:
    class Named(LabelledWorlds):
        agents = ("left", "middle", "right")

    class Numbered(LabelledWorlds):
        agents = (2, 1, 0)

    model = make_model(env=Named())
    model.set_env(Numbered())
    assert model.policy.agents == model.agents == (2, 1, 0)
    with pytest.raises(ValueError, match="observations of 2, 1, 0"):
        model.predict(dict.fromkeys(Named.agents, np.zeros(3)))
    model.set_env(LabelledWorlds())
    assert model.policy.agents == (2, 1, 0)


@pytest.mark.parametrize("agents", [3, "abc", ["left", "right"]], ids=repr)
def test_what_does_not_name_each_agent_of_a_world_is_no_names(agents: Any) -> None:
    env = LabelledWorlds()
    env.agents = agents
    assert make_model(env=env).policy.agents is None


@pytest.mark.parametrize(
    "observation",
    [
        np.zeros(3),
        np.zeros((4, 3)),
        np.zeros((2, 4, 3)),
        {"agent_0": np.zeros(3)},
        {f"agent_{i}": np.zeros(3) for i in range(6)},
    ],
    ids=["one row", "four rows", "four agents", "one agent", "six agents"],
)
def test_predict_refuses_observations_of_some_agents(observation: Any) -> None:
    with pytest.raises(ValueError, match="observations of all 3 agents"):
        make_model().predict(observation)


def test_what_gymnasium_returns_from_a_reset_is_refused_as_sb3_does() -> None:
    model = MADDPG("MlpPolicy", "Pendulum-v1", device="cpu")
    with pytest.raises(ValueError, match="mixing Gym API with SB3 VecEnv API"):
        model.predict(gym.make("Pendulum-v1").reset())  # type: ignore[arg-type]  # the mistake


def test_what_is_missing_to_predict_is_said_with_its_shape() -> None:
    with pytest.raises(ValueError, match=r"all 3 agents, shape \(n_worlds \* 3, 3\), but got 4 row"):
        make_model().predict(np.zeros((4, 3)))


def test_actions_are_scaled_to_the_action_space() -> None:
    env = LabelledWorlds()
    env.action_space = spaces.Box(np.array([0, -3], np.float32), np.array([10, -1], np.float32))
    model = make_model(env=env, exploration_noise=0.5)
    model.learn(240)
    assert np.abs(model.replay_buffer.actions).max() <= 1
    model._last_obs = model.env.reset()
    for learning_starts in (0, 10**6):
        actions, scaled = model._sample_action(learning_starts, n_envs=12)
        assert env.action_space.contains(actions[0])
        # 0..10 and -3..-1 from -1..1
        np.testing.assert_allclose(actions, [5, -2] + scaled * [5, 1], rtol=1e-5, atol=1e-5)
    model.exploration_noise = 0.0
    actions, _ = model._sample_action(0, n_envs=12)
    np.testing.assert_allclose(actions, model.predict(model._last_obs)[0], rtol=1e-5, atol=1e-5)


def explored(model: MADDPG, n: int = 400) -> np.ndarray:
    """Scaled actions of ``n`` steps on the same observation, shape (n, 12, 2)."""
    model.num_timesteps, model._last_obs = 10**6, model.env.reset()
    return np.stack([model._sample_action(0, n_envs=12)[1] for _ in range(n)])


def test_exploration_noise_has_its_standard_deviation_and_follows_its_schedule() -> None:
    model = make_model(exploration_noise=lambda progress: 0.2 * progress, exploration_random=0.0)
    greedy = model.predict(model.env.reset())[0]
    assert (explored(model) - greedy).std() == pytest.approx(0.2, rel=0.05)
    model._current_progress_remaining = 0.5
    assert (explored(model) - greedy).std() == pytest.approx(0.1, rel=0.05)
    model._current_progress_remaining = 0.0
    np.testing.assert_allclose(explored(model, 1)[0], greedy, atol=1e-6)


def test_exploration_may_be_told_in_numpys_numbers() -> None:
    model = make_model(exploration_noise=np.float32(0.25), exploration_random=np.int64(0))
    model.learn(120)
    assert (model.exploration_noise, model.exploration_random) == (0.25, 0)


def test_exploration_random_replaces_a_share_of_the_actions() -> None:
    model = make_model(exploration_noise=0.0, exploration_random=0.25)
    actions, greedy = explored(model), model.predict(model.env.reset())[0]
    replaced = (np.abs(actions - greedy) > 1e-5).any(axis=-1)
    assert replaced.mean() == pytest.approx(0.25, abs=0.03)
    # Uniform in [-1, 1]: variance 1/3
    assert actions[replaced].var() == pytest.approx(1 / 3, rel=0.1)


def test_warm_up_actions_are_uniform() -> None:
    model = make_model(learning_starts=4800)
    model.learn(4800)
    actions = model.replay_buffer.actions
    assert actions.var() == pytest.approx(1 / 3, rel=0.1)
    assert model._n_updates == 0


def test_sb3_action_noise_takes_the_place_of_the_default_noise() -> None:
    noise = NormalActionNoise(np.zeros(2), np.full(2, 1e-3))
    model = make_model(action_noise=noise)
    assert model.exploration_noise == 0
    model.learn(120)
    model.num_timesteps, greedy = 10**6, model.predict(model._last_obs)[0]
    spread = model._sample_action(0, model.action_noise, 12)[1] - greedy
    assert 0 < np.abs(spread).max() < 1e-2


def test_action_noise_of_another_size_than_the_actions_is_refused() -> None:
    noise = NormalActionNoise(np.zeros(3), np.full(3, 1e-3))
    sizes = r"action_noise has shape \(12, 3\), but the actions of 12 slots \(12, 2\): .* must have shape \(2,\)"
    with pytest.raises(ValueError, match=sizes):
        make_model(action_noise=noise).learn(12)
    with pytest.raises(ValueError, match=r"action_noise has shape \(3,\), .* 1 slots \(1, 2\)"):
        make_model(env=LabelledWorlds(n_worlds=1, n_agents=1), action_noise=noise).learn(1)


def test_sb3_action_noise_is_reset_where_an_episode_ends() -> None:
    class Noise(NormalActionNoise):
        def reset(self, *args: Any, **kwargs: Any) -> None:
            resets.append((args, kwargs))

    resets: list[Any] = []
    noise = Noise(np.zeros(2), np.full(2, 1e-3))
    make_model(env=LabelledWorlds(n_worlds=1, n_agents=1), action_noise=noise, learning_starts=0).learn(11)
    assert resets[-2:] == [((), {})] * 2  # episodes have five steps
    resets.clear()
    make_model(env=LabelledWorlds(n_worlds=2), action_noise=VectorizedActionNoise(noise, 6)).learn(6 * 6)
    assert len(resets) >= 6  # of every slot


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_same_seed_same_weights(cls: type[MADDPG]) -> None:
    def trained(seed: int) -> str:
        model = make_model(cls, IdentityWorlds(), seed=seed)
        model.learn(480)
        return weights_hash(model)

    first = trained(0)
    assert trained(0) == first
    assert trained(1) != first


# ---------------------------------------------------------------------------------------------------------------------
# As an SB3 user expects
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("critic", CRITICS)
@pytest.mark.parametrize("cls", ALGORITHMS)
def test_a_saved_model_acts_alike_and_learns_on_with_any_number_of_worlds(
    cls: type[MADDPG], critic: str, tmp_path: Path
) -> None:
    model = make_model(cls, critic=critic, exploration_noise=0.3)
    model.learn(120)
    model.save(tmp_path / "model.zip")
    loaded = load(cls, tmp_path / "model.zip", env=LabelledWorlds(n_worlds=7))
    assert loaded.n_agents == 3
    assert loaded.exploration_noise == 0.3
    assert loaded.critic_kind == critic
    assert weights_hash(loaded) == weights_hash(model)
    # The exploration goes on where it stopped
    assert loaded.exploration_rng.random() == model.exploration_rng.random()
    loaded.learn(210, reset_num_timesteps=False)
    assert loaded.num_timesteps == 330
    without_env = load(cls, tmp_path / "model.zip")
    obs = np.ones((6, 3), np.float32)
    np.testing.assert_array_equal(without_env.predict(obs)[0], model.predict(obs)[0])


def test_a_loaded_model_with_a_new_seed_explores_anew(tmp_path: Path) -> None:
    make_model().learn(60).save(tmp_path / "model.zip")
    draws = [load(MADDPG, tmp_path / "model.zip", seed=seed).exploration_rng.random() for seed in (1, 2, 1)]
    assert draws[0] == draws[2] != draws[1]


class Twin(MADDPG):
    """A user's own: two critics, but none of MATD3's noise."""

    n_critics = 2


def test_a_model_is_loaded_by_its_class_or_one_that_inherits_from_it(tmp_path: Path) -> None:
    class Further(Twin):
        pass

    make_model(Twin).save(tmp_path / "twin.zip")
    for cls in Twin, Further:
        assert type(load(cls, tmp_path / "twin.zip")) is cls
    for cls in MADDPG, MATD3:
        with pytest.raises(ValueError, match=rf"was saved by Twin, not by {cls.__name__}: use Twin\.load"):
            load(cls, tmp_path / "twin.zip")


def test_a_file_of_another_library_is_refused_by_name(tmp_path: Path) -> None:
    DDPG("MlpPolicy", "Pendulum-v1", device="cpu").save(tmp_path / "ddpg.zip")
    (tmp_path / "text.zip").write_text("no zip-file")
    for name in "ddpg.zip", "text.zip":
        with pytest.raises(ValueError, match=rf"{name} is no model that MADDPG or a subclass of it saved"):
            load(MADDPG, tmp_path / name)


@pytest.mark.parametrize("critic", CRITICS)
@pytest.mark.parametrize(("cls", "other"), [(MADDPG, MATD3), (MATD3, MADDPG)])
def test_a_file_of_the_other_algorithm_is_refused_with_the_class_that_loads_it(
    cls: type[MADDPG], other: type[MADDPG], critic: str, tmp_path: Path
) -> None:
    make_model(other, critic=critic).save(tmp_path / "model.zip")
    name = other.__name__
    with pytest.raises(ValueError, match=rf"model\.zip was saved by {name}, not by {cls.__name__}: use {name}\.load"):
        load(cls, tmp_path / "model.zip")
    with (tmp_path / "model.zip").open("rb") as file, pytest.raises(ValueError, match=f"saved by {name}"):
        load(cls, file)  # type: ignore[arg-type]  # SB3 takes both


def test_a_subclass_loads_what_its_parent_saved_and_other_faults_stay_pytorchs(tmp_path: Path) -> None:
    class Own(MADDPG):
        pass

    class OtherPolicy(MADDPGPolicy):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **{**kwargs, "net_arch": [9]})

    model = make_model()
    model.save(tmp_path / "model.zip")
    assert weights_hash(load(Own, tmp_path / "model.zip")) == weights_hash(model)
    with pytest.raises(RuntimeError, match="size mismatch"):
        load(MADDPG, tmp_path / "model.zip", custom_objects={"policy_class": OtherPolicy})


def test_action_noise_is_that_of_as_many_slots_as_there_are_after_loading(tmp_path: Path) -> None:
    model = make_model(action_noise=NormalActionNoise(np.zeros(2), np.full(2, 1e-3)))
    model.learn(60)
    model.save(tmp_path / "model.zip")
    for n_worlds in 7, 1:
        loaded = load(MADDPG, tmp_path / "model.zip", env=LabelledWorlds(n_worlds=n_worlds))
        loaded.learn(3 * n_worlds)
        assert isinstance(loaded.action_noise, VectorizedActionNoise)
        assert len(loaded.action_noise.noises) == 3 * n_worlds


@pytest.mark.parametrize("again", ["learn", "load"])
def test_returns_of_several_steps_do_not_run_on_into_an_episode_after_a_reset(again: str, tmp_path: Path) -> None:
    model = make_model(n_steps=3, learning_starts=10**6)
    model.learn(12 * 8)  # episodes have five steps: the second one is left in the middle, at its third
    if again == "learn":
        model.learn(12 * 4)
    else:
        model.save(tmp_path / "model.zip")
        model.save_replay_buffer(tmp_path / "buffer.pkl")
        model = load(MADDPG, tmp_path / "model.zip", env=LabelledWorlds())
        model.load_replay_buffer(tmp_path / "buffer.pkl")
        model.learn(12 * 4, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert buffer.pos == 12
    batch = buffer._get_samples(np.repeat(np.arange(12), 20))
    steps = (batch.next_observations - batch.observations)[:, 0, 2].reshape(12, 20).amax(dim=1)
    assert steps[:8].tolist() == [3, 3, 3, 2, 1, 3, 2, 1]
    assert not batch.dones.any(), "time limits and the cut are bootstrapped"


def test_going_on_without_a_reset_cuts_nothing() -> None:
    model = make_model(n_steps=3, learning_starts=10**6)
    model.learn(12 * 8)
    model.learn(12 * 4, reset_num_timesteps=False)
    batch = model.replay_buffer._get_samples(np.full(20, 7))
    assert (batch.next_observations - batch.observations)[0, 0, 2] == 3


@pytest.mark.parametrize(
    ("other", "difference"),
    [
        ({"n_steps": 1}, "n_steps is 1, not 3"),
        ({"gamma": 0.9}, r"gamma is 0\.9, not 0\.95"),
        ({"env": LabelledWorlds(n_worlds=2)}, "n_envs is 6, not 12"),
        ({"env": LabelledWorlds(action_size=1)}, "action_dim is 1, not 2"),
        ({"env": IdentityWorlds(n_worlds=4)}, r"obs_shape is \(1,\), not \(3,\)"),
        ({"env": LabelledWorlds(n_worlds=6, n_agents=2)}, "n_agents is 2, not 3"),
    ],
    ids=["n_steps", "gamma", "worlds", "actions", "observations", "agents"],
)
def test_a_replay_buffer_of_another_model_is_refused_and_the_own_one_stays(
    tmp_path: Path, other: dict[str, Any], difference: str
) -> None:
    make_model(**{"n_steps": 3, **other}).save_replay_buffer(tmp_path / "buffer.pkl")
    model = make_model(n_steps=3)
    own = model.replay_buffer
    with pytest.raises(ValueError, match=rf"buffer\.pkl is no replay buffer of this model: its {difference}"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer is own


def test_a_replay_buffer_made_by_its_keyword_arguments_is_the_own_one(tmp_path: Path) -> None:
    model = make_model(replay_buffer_kwargs={"n_steps": 3, "gamma": 0.9}).learn(48)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    model.replay_buffer = None  # frees memory before a large one is loaded
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer.dones[model.replay_buffer.pos - 1].all(), "the worlds may be elsewhere by now"
    assert model.n_steps == 3
    assert (model.replay_buffer.n_steps, model.replay_buffer.gamma) == (3, 0.9)


def test_the_own_replay_buffer_stays_where_a_file_holds_none(tmp_path: Path) -> None:
    (tmp_path / "buffer.pkl").write_bytes(pickle.dumps({"no": "buffer"}))
    model = make_model()
    own = model.replay_buffer
    with pytest.raises(AssertionError, match="must inherit from ReplayBuffer"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer is own


def test_a_policy_is_saved_and_loaded_without_its_model_as_in_sb3(tmp_path: Path) -> None:
    policy = make_model(MATD3, critic="shared", policy_kwargs={"net_arch": [5], "share_parameters": True}).policy
    policy.save(tmp_path / "policy.pth")
    loaded = MADDPGPolicy.load(tmp_path / "policy.pth", device="cpu")
    obs = np.random.default_rng(0).standard_normal((6, 3)).astype(np.float32)
    np.testing.assert_array_equal(loaded.predict(obs)[0], policy.predict(obs)[0])
    assert {name: tensor.shape for name, tensor in loaded.state_dict().items()} == {
        name: tensor.shape for name, tensor in policy.state_dict().items()
    }
    policy.actor.save(tmp_path / "actor.pth")
    actor, joint = Actor.load(tmp_path / "actor.pth", device="cpu"), th.as_tensor(obs).view(2, 3, 3)
    assert th.equal(actor(joint), policy.actor(joint))


def test_load_warns_that_the_file_can_run_code(tmp_path: Path) -> None:
    make_model().save(tmp_path / "model.zip")
    with pytest.warns(UntrustedFileWarning, match="can run code"):
        MADDPG.load(tmp_path / "model.zip", device="cpu")


def test_parameters_can_be_taken_and_set() -> None:
    model, other = make_model(), make_model(seed=1)
    assert weights_hash(model) != weights_hash(other)
    other.set_parameters(model.get_parameters(), device="cpu")
    assert weights_hash(model) == weights_hash(other)


def test_the_actors_are_plain_named_tensors() -> None:
    tensors = make_model().policy.actor_state_dict()
    assert {name: tuple(tensor.shape) for name, tensor in tensors.items()} == {
        "mu.weights.0": (3, 3, 8),
        "mu.biases.0": (3, 1, 8),
        "mu.head_weight": (3, 8, 2),
        "mu.head_bias": (3, 1, 2),
    }


@pytest.mark.parametrize("frozen", ["actor", "critic"])
def test_a_frozen_network_stays_as_it_is_while_the_other_learns(frozen: str) -> None:
    model = make_model(MATD3, max_grad_norm=1.0)
    networks = {"actor": model.actor, "critic": model.critic}
    networks[frozen].requires_grad_(False)
    before = {name: weights(network) for name, network in networks.items()}
    model.learn(120)
    assert {name for name in networks if not th.equal(weights(networks[name]), before[name])} == {*networks} - {frozen}


def test_shared_parameters_are_one_actor_for_all() -> None:
    model = make_model(policy_kwargs={"net_arch": [8], "share_parameters": True})
    model.learn(120)
    assert {len(tensor) for tensor in model.policy.actor_state_dict().values()} == {1}
    same = model.predict(np.ones((3, 3), np.float32))[0]
    np.testing.assert_array_equal(same, same[[0, 0, 0]])


def test_critics_keep_their_own_features_where_actors_share_them() -> None:
    kwargs = {"net_arch": [8], "features_extractor_class": LearntFeatures, "share_parameters": True}
    model = make_model(policy_kwargs=kwargs)
    networks = model.actor, model.actor_target, model.critic, model.critic_target
    assert [len(network.features_extractor.extractors) for network in networks] == [1, 1, 3, 3]


class LearntFeatures(BaseFeaturesExtractor):
    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, features_dim=5)
        self.linear = th.nn.Linear(3, 5)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.linear(observations)


def test_features_extractors_that_learn_are_an_agents_own() -> None:
    model = make_model(policy_kwargs={"net_arch": [8], "features_extractor_class": LearntFeatures})
    before = [weights(extractor) for extractor in model.actor.features_extractor.extractors]
    assert len(before) == 3
    model.learn(120)
    after = [weights(extractor) for extractor in model.actor.features_extractor.extractors]
    assert not any(th.equal(*pair) for pair in zip(before, after, strict=True))
    obs, actions = th.randn(4, 3, 3), th.rand(4, 3, 2)
    q_values = model.critic.own_action_values(obs, actions, model.actor(obs))
    grads = th.autograd.grad(
        q_values[1].sum(), [extractor.linear.weight for extractor in model.actor.features_extractor.extractors]
    )
    assert [bool(grad.abs().sum() > 0) for grad in grads] == [False, True, False]


class NormalisedFeatures(LearntFeatures):
    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space)
        self.linear = th.nn.Sequential(th.nn.BatchNorm1d(3), th.nn.Linear(3, 5))


def test_targets_take_over_running_statistics_whatever_tau_is() -> None:
    policy = make_model(policy_kwargs={"features_extractor_class": NormalisedFeatures}).policy
    target = weights(policy.actor_target)
    for model in (policy.actor, policy.critic):
        for extractor in model.features_extractor.extractors:
            extractor.linear[0].running_mean.fill_(2.0)
    policy.update_targets(0.0)
    for model in (policy.actor_target, policy.critic_target):
        for extractor in model.features_extractor.extractors:
            assert extractor.linear[0].running_mean.tolist() == [2.0] * 3
    assert th.equal(weights(policy.actor_target), target)


def test_images_are_seen_by_the_cnn_policy() -> None:
    class Pictures(LabelledWorlds):
        def __init__(self) -> None:
            super().__init__(n_worlds=1, n_agents=2)
            self.observation_space = spaces.Box(0, 255, (36, 40, 3), np.uint8)

        def observe(self) -> np.ndarray:
            return np.full((2, 36, 40, 3), self.time[0], np.uint8)

    model = MADDPG("CnnPolicy", Pictures(), device="cpu", learning_starts=4, batch_size=4, buffer_size=40)
    model.learn(8)
    assert model._n_updates == 2
    slots = np.random.default_rng(0).integers(0, 256, (6, 36, 40, 3), np.uint8)
    np.testing.assert_array_equal(
        model.predict(slots.reshape(3, 2, 36, 40, 3))[0].reshape(6, 2), model.predict(slots)[0]
    )


def test_float64_policies_train_in_float64() -> None:
    model = make_model()
    model.policy.double()
    model.learn(120)
    assert model._n_updates > 0
    assert all(parameter.dtype == th.float64 for parameter in model.policy.parameters())
    assert all(state["exp_avg"].dtype == th.float64 for state in model.actor.optimizer.state.values())


def test_eval_and_checkpoint_callbacks_and_tensorboard(tmp_path: Path) -> None:
    env, eval_env = VecMonitor(LabelledWorlds()), VecMonitor(LabelledWorlds())
    model = MADDPG("MlpPolicy", env, tensorboard_log=str(tmp_path / "tb"), device="cpu", **SMALL)
    evaluation = EvalCallback(eval_env, eval_freq=5, n_eval_episodes=12, best_model_save_path=str(tmp_path), verbose=0)
    model.learn(240, callback=[evaluation, CheckpointCallback(10, str(tmp_path))])
    assert evaluation.last_mean_reward == 510
    assert (tmp_path / "rl_model_120_steps.zip").exists()
    assert load(MADDPG, tmp_path / "best_model.zip").n_agents == 3
    (events,) = (tmp_path / "tb" / "MADDPG_1").glob("events.*")
    for tag in (b"train/actor_loss", b"train/critic_loss", b"rollout/ep_rew_mean", b"eval/mean_reward"):
        assert tag in events.read_bytes()


def test_a_callback_can_stop_the_training() -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.locals["rewards"].shape == (12,) and self.n_calls < 3

    model = make_model()
    model.learn(240, callback=Stop())
    assert model.num_timesteps == 36


@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")
def test_a_progress_bar_can_be_shown() -> None:
    make_model().learn(120, progress_bar=True)
