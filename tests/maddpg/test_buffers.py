import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from slot_envs import LabelledWorlds
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from marl_encircle.maddpg import JointReplayBuffer

N_WORLDS, N_AGENTS = 4, 3
OBSERVATION = spaces.Box(-np.inf, np.inf, (3,), np.float32)
ACTION = spaces.Box(-1, 1, (2,), np.float32)


def make_buffer(buffer_size: int = 1200, **kwargs) -> JointReplayBuffer:
    return JointReplayBuffer(buffer_size, OBSERVATION, ACTION, "cpu", N_WORLDS * N_AGENTS, n_agents=N_AGENTS, **kwargs)


def fill(buffer: JointReplayBuffer, n_steps: int, done_at: int = -1, infos: list | None = None) -> None:
    """Observation (world, agent, step), action (world, agent), reward 100 * agent + step."""
    world, agent = np.repeat(np.arange(N_WORLDS), N_AGENTS), np.tile(np.arange(N_AGENTS), N_WORLDS)
    for step in range(n_steps):
        obs, next_obs = (np.stack([world, agent, np.full(12, t)], axis=1) for t in (step, step + 1))
        done = np.full(12, step == done_at)
        buffer.add(obs, next_obs, np.stack([world, agent], axis=1), 100 * agent + step, done, infos or [{}] * 12)


def test_a_sample_holds_all_agents_of_one_world_at_one_step() -> None:
    buffer = make_buffer()
    fill(buffer, 50)
    sample = buffer.sample(200)
    assert sample.observations.shape == (200, 3, 3)
    assert sample.actions.shape == (200, 3, 2)
    assert sample.rewards.shape == sample.dones.shape == (200, 3)

    world, agent, step = sample.observations.unbind(-1)
    assert (world == world[:, :1]).all()
    assert (agent == np.arange(3)).all()
    assert (step == step[:, :1]).all()
    assert (sample.actions[..., 0] == world).all()
    assert (sample.actions[..., 1] == agent).all()
    assert (sample.rewards == 100 * agent + step).all()
    assert (sample.next_observations[..., 2] == step + 1).all()
    assert set(world.flatten().tolist()) == {0, 1, 2, 3}


def test_buffer_size_counts_agent_steps() -> None:
    buffer = make_buffer(buffer_size=1200)
    # 1200 agent steps = 400 joint transitions = 100 steps of 4 worlds
    assert buffer.buffer_size * buffer.n_worlds == 400
    fill(buffer, 130)
    assert buffer.full
    assert buffer.pos == 30
    assert buffer.sample(2000).observations[..., 2].min() == 30


@pytest.mark.parametrize("handle_timeout_termination", [True, False])
def test_time_limits_are_no_terminations(handle_timeout_termination: bool) -> None:
    buffer = make_buffer(handle_timeout_termination=handle_timeout_termination)
    # Worlds 0 and 1 end by the time limit, worlds 2 and 3 terminate
    infos = [{"TimeLimit.truncated": slot < 6} for slot in range(12)]
    fill(buffer, 5, done_at=3, infos=infos)
    sample = buffer.sample(2000)
    at_end = sample.observations[:, 0, 2] == 3
    truncated = sample.observations[:, 0, 0] < 2
    expected = at_end & ~truncated if handle_timeout_termination else at_end
    assert expected.any()
    assert (sample.dones == expected[:, None]).all()


def test_infos_are_read_only_where_an_episode_ends() -> None:
    class Unread(dict):
        def get(self, key, default=None):
            raise AssertionError("read")

    fill(make_buffer(), 5, infos=[Unread()] * 12)
    with pytest.raises(AssertionError, match="read"):
        fill(make_buffer(), 5, done_at=2, infos=[Unread()] * 12)


def test_memory_can_be_saved_by_storing_observations_once() -> None:
    buffer = make_buffer(buffer_size=120, optimize_memory_usage=True, handle_timeout_termination=False)
    fill(buffer, 25)
    sample = buffer.sample(500)
    assert (sample.next_observations[..., 2] == sample.observations[..., 2] + 1).all()
    assert (sample.next_observations[..., :2] == sample.observations[..., :2]).all()


def test_samples_are_normalised_by_vec_normalize() -> None:
    env = VecNormalize(LabelledWorlds(N_WORLDS, N_AGENTS))
    env.obs_rms, env.ret_rms = RunningMeanStd(shape=(3,)), RunningMeanStd(shape=())
    env.obs_rms.mean, env.obs_rms.var, env.ret_rms.var = np.array([0.0, 1.0, 2.0]), np.full(3, 4.0), np.array(10_000.0)
    buffer = make_buffer()
    fill(buffer, 4)
    np.random.seed(0)  # noqa: NPY002
    plain = buffer.sample(50)
    np.random.seed(0)  # noqa: NPY002
    normalised = buffer.sample(50, env=env)
    # (obs - mean) / sqrt(4), reward / sqrt(10,000)
    expected = (plain.observations.numpy() - [0.0, 1.0, 2.0]) / 2
    np.testing.assert_allclose(normalised.observations, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(normalised.rewards, plain.rewards / 100, rtol=1e-6)


def test_rewards_of_several_steps_are_summed_up_to_the_end_of_the_episode() -> None:
    buffer = make_buffer(n_steps=3, gamma=0.5)
    # Steps 0 to 4 are an episode; worlds 0 and 1 end it by the time limit, worlds 2 and 3 terminate. 7 is the newest
    fill(buffer, 8, done_at=4, infos=[{"TimeLimit.truncated": slot < 6} for slot in range(12)])
    sample = buffer.sample(2000)
    world, _, first = sample.observations[:, 0].unbind(-1)
    last = {0: 2, 1: 3, 2: 4, 3: 4, 4: 4, 5: 7, 6: 7, 7: 7}
    assert sample.next_observations[:, 0, 2].tolist() == [last[step] + 1 for step in first.int().tolist()]
    assert set(first.tolist()) == set(last)
    for i in range(200):
        steps = np.arange(int(first[i]), last[int(first[i])] + 1)
        rewards = 100 * np.arange(3)[:, None] + steps
        np.testing.assert_allclose(sample.rewards[i], (rewards * 0.5 ** np.arange(len(steps))).sum(axis=1))
        assert sample.discounts[i] == 0.5 ** len(steps)
        assert (sample.dones[i] == float(steps[-1] == 4 and world[i] >= 2)).all()


def test_a_sum_does_not_run_from_the_newest_step_into_the_oldest() -> None:
    buffer = make_buffer(buffer_size=120, n_steps=4)  # 10 steps of 4 worlds
    fill(buffer, 13)
    sample = buffer.sample(1000)
    steps = sample.next_observations[:, 0, 2] - sample.observations[:, 0, 2]
    assert set(steps.tolist()) == {1, 2, 3, 4}
    assert sample.next_observations[..., 2].max() == 13


def test_sums_have_the_precision_of_the_rewards_whatever_gammas_is() -> None:
    buffer = make_buffer(n_steps=3, gamma=np.float64(0.9))
    fill(buffer, 8)
    sample = buffer.sample(10)
    assert (sample.rewards.dtype, sample.discounts.dtype) == (th.float32, th.float32)


def test_slots_must_be_whole_worlds() -> None:
    with pytest.raises(ValueError, match="10 slots are no whole number of worlds with 3 agents"):
        JointReplayBuffer(100, OBSERVATION, ACTION, n_envs=10, n_agents=3)


def test_a_sum_of_no_rewards_is_refused() -> None:
    with pytest.raises(ValueError, match="n_steps must be at least 1, but got 0"):
        make_buffer(n_steps=0)
