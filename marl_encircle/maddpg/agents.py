"""What an environment tells of the agents in its worlds: how many, and their names."""

from typing import Any

import pettingzoo
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper


def refuse_pettingzoo(env: GymEnv | str | None) -> None:
    """Refuse an environment of PettingZoo, or its id: SB3 would ask Gymnasium for it.

    :raises ValueError: with the call that makes a ``VecEnv`` of it
    """
    if isinstance(env, str):
        if env.partition("-v")[0] in {name.partition("-v")[0] for name in pettingzoo.parallel_registry}:
            raise ValueError(
                f"{env!r} is an environment of PettingZoo, which learns as a VecEnv: make_vec_env(...) where it is the "
                f'encirclement, else SuperSuitVecEnv(lambda: pettingzoo.make("parallel", {env!r}), n_worlds=...)'
            )
    elif hasattr(env, "possible_agents") and not isinstance(env, VecEnv):
        raise ValueError("a PettingZoo environment learns as a VecEnv: SuperSuitVecEnv(env, n_worlds=...)")


def count_agents(env: GymEnv | None, n_agents: int | None) -> int:
    """Return the number of agents in each world of ``env``.

    :param env: an environment tells it by an attribute ``n_agents``; a Gymnasium environment, alone or in SB3's
        ``DummyVecEnv`` and ``SubprocVecEnv``, has one; of others it is not known. None: a model without one
    :param n_agents: what the user or a saved model says
    :raises ValueError: where it is not known, differs from ``n_agents`` or does not divide the number of slots
    """
    told = None
    if isinstance(env, VecEnv):
        told = getattr(env, "n_agents", None)
        inner: Any = env
        while isinstance(inner, VecEnvWrapper):
            inner = inner.venv
        if told is None and (isinstance(inner, DummyVecEnv | SubprocVecEnv) or env.num_envs == 1):
            told = 1
    elif env is not None:
        told = 1
    if told is not None and n_agents is not None and told != n_agents:
        raise ValueError(f"the environment has n_agents={told}, but n_agents={n_agents} was given or saved")
    n = n_agents if told is None else int(told)
    if n is None:
        raise ValueError(
            "the environment has several slots but does not tell how many of them are the agents of one world: "
            "build it with make_vec_env, or give n_agents=..."
        )
    if isinstance(env, VecEnv) and (n < 1 or env.num_envs % n):
        raise ValueError(f"{env.num_envs} slots are no whole number of worlds with n_agents={n}")
    return n


def names_of_agents(env: GymEnv | None, n_agents: int, known: tuple[str, ...] | None) -> tuple[str, ...] | None:
    """Return the agents' names in the order of the slots.

    :param env: an environment tells them by an attribute ``agents``
    :param n_agents: number of agents N
    :param known: the names until now, which stay where there is no such attribute, or it does not name each agent of a
        world
    :raises ValueError: for the same names in another order: each actor would act for another agent
    """
    agents = getattr(env, "agents", None) if isinstance(env, VecEnv) else None
    if not isinstance(agents, list | tuple) or len(agents) != n_agents:
        return known
    if known is not None and tuple(agents) != known and set(agents) == set(known):
        raise ValueError(f"the environment's agents are {list(agents)}, but the actors are those of {list(known)}")
    return tuple(agents)
