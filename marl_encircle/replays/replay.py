"""One evaluation round, played again and recorded step by step: what drawings and players of rounds show."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.geometry import Closure, Enclosure
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator, world_seeds
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.evaluate import WORLDS_AT_ONCE, evaluation_worlds
from marl_encircle.experiments.memory import available_memory, check_memory
from marl_encircle.maddpg.policies import MADDPGPolicy

Array = NDArray[np.float64]


class Snapshot(NamedTuple):
    """One moment and who encloses the target in it. N pursuers, M obstacles, D discs, K directions."""

    pursuers: Array
    """[scene units], (N, 2)."""
    target: Array
    """[scene units], (2,)."""
    discs: Array
    """x, y, radius [scene units], (D, 3)."""
    speed_ratio: float
    owner: NDArray[np.int8]
    """Who is met first in each direction: pursuers 0..N-1, obstacles N..N+M-1, or ``NOBODY``, (K,)."""
    distance: Array
    """How far away; inf where nobody is met [scene units], (K,)."""
    contributing_angle: Array
    """theta_c of every pursuer and obstacle [rad], (N + M,)."""
    occupied_angle: float
    """Their sum: theta_A or, of the pursuers alone, theta_G [rad]."""
    movement_range: float
    """R_m; inf unless closed [scene units^2]."""

    @classmethod
    def of(
        cls, pursuers: Array, target: Array, discs: Array, speed_ratio: float, enclosure: Enclosure, row: int
    ) -> "Snapshot":
        """Return a moment with one row of its enclosures.

        :param pursuers: (N, 2)
        :param target: (2,)
        :param discs: (D, 3)
        :param row: a moment of a replay, or a world of the simulator
        """
        return cls(
            pursuers=pursuers,
            target=target,
            discs=discs,
            speed_ratio=speed_ratio,
            owner=enclosure.owner[row],
            distance=enclosure.distance[row],
            contributing_angle=enclosure.contributing_angle[row],
            occupied_angle=float(enclosure.occupied_angle[row]),
            movement_range=float(enclosure.movement_range[row]),
        )

    @property
    def closed(self) -> bool:
        """Whether somebody is met in every direction."""
        return bool(np.isfinite(self.movement_range))


@dataclass(frozen=True)
class Replay:
    """One round from its start until both closure rules have held or time is up, T steps. All arrays are read-only.

    N pursuers, M obstacles, D discs, K directions. A composite obstacle (concave, tunnel) has D / M discs in a row.

    :param scenario: the rules
    :param closure: the method's own rule
    :param round: number of the round within its evaluation
    :param seed: seed the world was reset with
    :param step_all: first step, from 1, at which pursuers and obstacles had enclosed the target; None if never
    :param step_pursuers: the same for the pursuers alone
    :param pursuers: positions, at the start and after every step [scene units], (T + 1, N, 2)
    :param velocities: of the pursuers [scene units per time unit], (T + 1, N, 2)
    :param target: positions [scene units], (T + 1, 2)
    :param discs: x, y, radius of the discs that obstacles consist of; they stay where they are [scene units], (D, 3)
    :param enclosure: by closure rule; as the simulator measures it, with the moments in place of the worlds: ``owner``
        and ``nearness`` (T + 1, K), ``contributing_angle`` (T + 1, N + M), the others (T + 1,)
    :param rewards: of each pursuer at every step, (T, N)
    """

    scenario: Scenario
    closure: Closure
    round: int
    seed: int
    step_all: int | None
    step_pursuers: int | None
    pursuers: Array
    velocities: Array
    target: Array
    discs: Array
    enclosure: dict[Closure, Enclosure]
    rewards: Array

    @property
    def length(self) -> int:
        """T, the number of steps."""
        return len(self.target) - 1

    @property
    def success_step(self) -> int | None:
        """First step, from 1, at which the method's own rule held; None if never."""
        return self.step_all if self.closure == "all" else self.step_pursuers

    def snapshot(self, step: int) -> Snapshot:
        """Return one moment under the method's own rule.

        :param step: 0 is the start
        """
        enclosure, ratio = self.enclosure[self.closure], self.scenario.speed_ratio
        return Snapshot.of(self.pursuers[step], self.target[step], self.discs, ratio, enclosure, step)


def record_round(policy: MADDPGPolicy, config: Config, round_number: int, eval_seed: int) -> Replay:
    """Play one evaluation round as :func:`~marl_encircle.experiments.evaluate.play_rounds` does, and record it.

    :param policy: whose round
    :param config: of its run
    :param round_number: number of the round within its evaluation
    :param eval_seed: evaluation seed, usually ``config.evaluation.seed``
    """
    # The round is played among the same others as in its evaluation, since rounding depends on the batch.
    first, world = round_number - round_number % WORLDS_AT_ONCE, round_number % WORLDS_AT_ONCE
    seeds = world_seeds(eval_seed, first + WORLDS_AT_ONCE)[first:]
    (replay,) = _record(policy, config, seeds, [world], first)
    return replay


def record_first_rounds(policy: MADDPGPolicy, config: Config, n: int, eval_seed: int) -> list[Replay]:
    """Record rounds 0 to n - 1 of an evaluation in one go; see :func:`record_round`.

    :param n: 1 to ``WORLDS_AT_ONCE``
    """
    return _record(policy, config, world_seeds(eval_seed, WORLDS_AT_ONCE), list(range(n)), 0)


def _record(
    policy: MADDPGPolicy, config: Config, seeds: Sequence[int], worlds: list[int], first_round: int
) -> list[Replay]:
    """Play the rounds of a batch of worlds and record some of them, each to its own end.

    :raises ConfigError: if the longest that they may be would not fit into this machine's memory
    """
    arena = evaluation_worlds(config, seeds)
    sim, scenario = arena.simulator, arena.scenario
    observations = arena.reset()
    moments = {world: [_Moment.of(sim, world)] for world in worlds}
    steps = len(worlds) * scenario.max_cycles
    check_memory({"scenario.max_cycles": 2 * steps * moments[worlds[0]][0].nbytes}, available_memory())  # and stacked
    rewards: dict[int, list[Array]] = {world: [] for world in worlds}
    playing = worlds
    for _ in range(scenario.max_cycles):
        actions, _ = policy.predict(observations, deterministic=True)
        outcome = arena.step(np.asarray(actions))
        observations = outcome.observations
        for world in playing:
            rewards[world].append(outcome.rewards[world].astype(np.float64))
            moments[world].append(_Moment.of(sim, world))
        playing = [world for world in playing if None in arena.rounds.success_steps(world).values()]
        if not playing:
            break
    return [
        Replay(
            scenario=scenario,
            closure=arena.reward.closure,
            round=first_round + world,
            seed=seeds[world],
            step_all=arena.rounds.success_steps(world)["all"],
            step_pursuers=arena.rounds.success_steps(world)["pursuers"],
            pursuers=_stack(moments[world], lambda moment: moment.pursuers),
            velocities=_stack(moments[world], lambda moment: moment.velocities),
            target=_stack(moments[world], lambda moment: moment.target),
            discs=_frozen(sim.state.discs[world].copy()),
            enclosure={
                "all": _over_time(moments[world], "all"),
                "pursuers": _over_time(moments[world], "pursuers"),
            },
            rewards=_frozen(np.stack(rewards[world])),
        )
        for world in worlds
    ]


class _Moment(NamedTuple):
    """Copies of one world's arrays."""

    pursuers: Array
    velocities: Array
    target: Array
    enclosure: dict[Closure, Enclosure]

    @classmethod
    def of(cls, sim: Simulator, world: int) -> "_Moment":
        s = sim.state
        return cls(
            s.pursuers[world].copy(),
            s.velocities[world].copy(),
            s.target[world].copy(),
            {
                rule: Enclosure(*(field[world].copy() for field in enclosure))
                for rule, enclosure in sim.measure.enclosure.items()
            },
        )

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        arrays = [self.pursuers, self.velocities, self.target]
        return sum(array.nbytes for array in [*arrays, *(each for e in self.enclosure.values() for each in e)])


def _over_time(moments: list[_Moment], rule: Closure) -> Enclosure:
    """One world's enclosures, moment by moment."""
    fields = zip(*(moment.enclosure[rule] for moment in moments), strict=True)
    return Enclosure(*(_frozen(np.stack(field)) for field in fields))


def _stack(moments: list[_Moment], part: Callable[[_Moment], Array]) -> Array:
    array: Array = _frozen(np.stack([part(moment) for moment in moments]))
    return array


def _frozen(array: NDArray[Any]) -> Any:
    array.flags.writeable = False
    return array
