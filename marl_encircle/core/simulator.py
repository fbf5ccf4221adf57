"""The simulator: B worlds side by side, each with its own stream of random numbers and its own difficulty."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_encircle.core import geometry, scenes
from marl_encircle.core.compilation import kernel
from marl_encircle.core.dynamics import Constants, move_pursuers, move_target, physics_of
from marl_encircle.core.geometry import Enclosure, Measure, enclose
from marl_encircle.core.scenario import Scenario

Array = NDArray[np.float64]

PLACEMENT_DRAWS = 32
"""Placements that are tried per world; each may use twice the random numbers of the one before."""

MAX_UNIFORMS = 1 << 14
"""Most random numbers that one try may use."""


class PlacementError(RuntimeError):
    """The bodies of a scene did not fit in the bounded number of tries."""


class State(NamedTuple):
    """Where everything is. Live arrays of the simulator, changed in place by ``step`` and ``reset``."""

    pursuers: Array
    """Positions [scene units], (B, N, 2)."""
    velocities: Array
    """Pursuers' velocities [scene units per time unit], (B, N, 2)."""
    target: Array
    """Position [scene units], (B, 2)."""
    discs: Array
    """x, y, radius of the discs that obstacles consist of [scene units], (B, D, 3)."""
    obstacles: Array
    """Centres of the placed obstacles [scene units], (B, ``scenario.obstacles``, 2)."""
    speed_ratio: Array
    """lambda of each world's present round, (B,)."""
    safety_distance: Array
    """d_safe of each world's present round [scene units], (B,)."""
    obstacle_radius: Array
    """R of each world's present round [scene units], (B,)."""


class Difficulty(TypedDict, total=False):
    """What a curriculum may change from round to round; the fields of ``Scenario`` with these names."""

    speed_ratio: float
    safety_distance: float
    obstacle_radius: float


def world_seeds(seed: int | None, n: int) -> list[int]:
    """Return the seeds of n worlds, the same for the first worlds whatever n is: 63-bit integers.

    :param seed: None takes fresh entropy from the system
    """
    words = np.random.SeedSequence(seed).generate_state(n, np.uint64) >> np.uint64(1)
    return [int(word) for word in words]


class Simulator:
    """B worlds of one scenario.

    :param scenario: the rules; worlds may differ in difficulty only
    :param n_worlds: B
    :param seed: see :meth:`seed`; without one, worlds start from fresh entropy
    :raises ValueError: for fewer than one world, or seeds that :meth:`seed` would not take
    """

    def __init__(self, scenario: Scenario, n_worlds: int = 1, seed: int | None = None) -> None:
        if n_worlds < 1:
            raise ValueError(f"n_worlds must be at least 1; got {n_worlds}")
        self.scenario = scenario
        self.n_worlds = n_worlds
        self.steps = np.zeros(n_worlds, np.int64)
        self._physics = physics_of(scenario)
        self._rays = geometry.half_circle(scenario.n_directions)
        self._shape = scenes.discs_of(scenario.scene)
        self._everywhere = np.arange(n_worlds)
        self._actions_shape = (n_worlds, scenario.pursuers, 2)
        self._difficulty: Difficulty = {}
        # Few arrays with many views: Numba takes as long to unpack three arguments as a world takes to measure.
        self._motion = np.zeros((2, n_worlds, scenario.pursuers, 2))
        self._difficulties = np.ones((3, n_worlds))
        self.state = self._views()
        self._present, self._former = _MeasureBuffers(scenario, n_worlds), _MeasureBuffers(scenario, n_worlds)
        self._streams: list[np.random.Generator] = []
        self.seed(seed)

    @property
    def measure(self) -> Measure:
        """The measure of the present state."""
        return self._present.measure

    @property
    def former_measure(self) -> Measure:
        """The measure before the last step."""
        return self._former.measure

    def seed(self, seed: int | Sequence[int] | None = None) -> None:
        """Give every world a new random stream, which its next resets draw from.

        :param seed: one seed for all (world b gets ``world_seeds(seed, B)[b]``), or one for each world
        :raises ValueError: for a negative seed, or another number of seeds than of worlds
        """
        seeds = list(seed) if isinstance(seed, Sequence | np.ndarray) else world_seeds(seed, self.n_worlds)
        if len(seeds) != self.n_worlds:
            raise ValueError(f"{self.n_worlds} worlds need {self.n_worlds} seeds; got {len(seeds)}")
        self._streams = [np.random.default_rng(s) for s in seeds]

    def set_difficulty(self, difficulty: Difficulty) -> None:
        """Change speed ratio, safety distance or obstacle radius from each world's next reset on.

        :raises ValueError: for another field, or a value that the scenario would not take
        """
        known = list(Difficulty.__annotations__)
        if unknown := [name for name in difficulty if name not in known]:
            raise ValueError(f"{unknown[0]:.80} is no difficulty; known: {', '.join(known)}")
        replace(self.scenario, **difficulty)
        self._difficulty = {**self._difficulty, **difficulty}

    def reset(self, worlds: NDArray[np.int64] | None = None) -> Measure:
        """Start a new round in some worlds, all by default.

        :param worlds: indices of the worlds to reset, (W,)
        :raises PlacementError: if the bodies cannot be placed
        """
        worlds = self._everywhere if worlds is None else worlds
        for name in ("speed_ratio", "safety_distance", "obstacle_radius"):
            values: Array = getattr(self.state, name)
            values[worlds] = self._difficulty.get(name, getattr(self.scenario, name))  # type: ignore[call-overload]  # a TypedDict read by a variable name
        self._place(worlds)
        self.state.velocities[worlds] = 0.0
        self.steps[worlds] = 0
        self._enclose(worlds)
        return self.measure

    def step(self, actions: ArrayLike) -> Measure:
        """Move all worlds by one step.

        :param actions: accelerations (velocities in first-order dynamics) as shares of the limit, in [-1, 1], (B, N, 2)
        :return: the measure of the new state, valid until the step after the next
        :raises ValueError: for actions of a wrong shape, or not finite, naming world and pursuer; nothing moves then
        """
        array = np.ascontiguousarray(actions, dtype=np.float64)
        if array.shape != self._actions_shape:
            raise ValueError(f"actions must have shape {self._actions_shape} (worlds, pursuers, 2); got {array.shape}")
        self._present, self._former = self._former, self._present
        slot = _advance(
            array,
            self._motion,
            self.state.target,
            self.state.discs,
            self._difficulties,
            self.steps,
            self._rays,
            self._physics,
            *self._present.arrays,
        )
        if slot >= 0:
            self._present, self._former = self._former, self._present
            world, pursuer = divmod(slot, self.scenario.pursuers)
            name = self.scenario.agents[pursuer]
            raise ValueError(f"the action of {name} in world {world} is not finite: {array[world, pursuer]}")
        return self._present.measure

    def get_state(self) -> dict[str, Any]:
        """Return everything that the future depends on, as arrays and plain numbers."""
        return {
            "state": {name: array.copy() for name, array in self.state._asdict().items()},
            "steps": self.steps.copy(),
            "difficulty": dict(self._difficulty),
            "streams": [stream.bit_generator.state for stream in self._streams],
        }

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on from what :meth:`get_state` returned, bit for bit."""
        for name, array in saved["state"].items():
            getattr(self.state, name)[:] = array
        self.steps[:] = saved["steps"]
        self._difficulty = saved["difficulty"]
        for stream, stream_state in zip(self._streams, saved["streams"], strict=True):
            stream.bit_generator.state = stream_state
        self._enclose(self._everywhere)

    def __getstate__(self) -> dict[str, Any]:
        return {"scenario": self.scenario, "n_worlds": self.n_worlds, "saved": self.get_state()}

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        # Built anew: copied one by one, arrays and the views into them would part.
        Simulator.__init__(self, pickled["scenario"], pickled["n_worlds"])
        self.set_state(pickled["saved"])

    def _enclose(self, worlds: NDArray[np.int64]) -> None:
        s = self.state
        _enclose_worlds(
            worlds, s.pursuers, s.target, s.discs, s.speed_ratio, self._rays, self._physics, *self._present.arrays
        )

    def _views(self) -> State:
        b, d = self.n_worlds, self.scenario.discs
        pursuers, velocities = self._motion
        speed_ratio, safety_distance, obstacle_radius = self._difficulties
        return State(
            pursuers=pursuers,
            velocities=velocities,
            target=np.zeros((b, 2)),
            discs=np.zeros((b, d, 3)),
            obstacles=np.zeros((b, self.scenario.obstacles, 2)),
            speed_ratio=speed_ratio,
            safety_distance=safety_distance,
            obstacle_radius=obstacle_radius,
        )

    def _place(self, worlds: NDArray[np.int64]) -> None:
        scenario = self.scenario
        # After the first draw worlds go on one by one, so that an impossible scene costs the tries of one world only.
        for b in self._draw(worlds, 0):
            if all(len(self._draw(np.array([b]), attempt)) for attempt in range(1, PLACEMENT_DRAWS)):
                raise PlacementError(
                    f"{scenario.obstacles} obstacles of radius {self.state.obstacle_radius[b]:g}, the target and "
                    f"{scenario.pursuers} pursuers could not be placed without overlap in {PLACEMENT_DRAWS} tries; "
                    "use fewer or smaller bodies, or placement='overlapping'"
                )

    def _draw(self, worlds: NDArray[np.int64], attempt: int) -> NDArray[np.int64]:
        """Place worlds anew and return those in which something did not fit."""
        scenario, s = self.scenario, self.state
        uniforms_needed = 3 * scenario.obstacles + 2 * (scenario.pursuers + 1)
        uniforms = np.empty((len(worlds), min(8 * uniforms_needed << attempt, MAX_UNIFORMS)))
        for row, b in zip(uniforms, worlds, strict=True):
            self._streams[b].random(out=row)
        placed = scenes.place(
            worlds,
            uniforms,
            self._shape,
            s.obstacle_radius,
            scenario.pursuer_radius,
            scenario.target_radius,
            scenario.half_width,
            scenario.obstacle_limit,
            scenario.placement == "separated",
            s.pursuers,
            s.target,
            s.discs,
            s.obstacles,
        )
        unplaced: NDArray[np.int64] = worlds[~placed]
        return unplaced


class _MeasureBuffers:
    """The arrays that ``geometry.enclose`` fills in, and the measure that views them."""

    def __init__(self, scenario: Scenario, n_worlds: int) -> None:
        b, n, k = n_worlds, scenario.pursuers, scenario.n_directions
        owner = np.full((2, b, k), geometry.NOBODY, np.int8)
        nearness = np.zeros((2, b, k))
        contributing_angle = np.zeros((2, b, n + scenario.units))
        totals = np.stack([np.zeros((2, b)), np.full((2, b), np.inf)])
        complete = np.zeros((2, b), np.bool_)
        target_distance = np.zeros((b, n))
        contacts = np.zeros((3, b, n), np.int64)
        by_rule = (owner, nearness, contributing_angle, *totals, complete)
        self.arrays: tuple[Any, ...] = (
            owner,
            nearness,
            contributing_angle,
            totals,
            complete,
            target_distance,
            contacts,
        )
        self.measure = Measure(
            enclosure={
                "all": Enclosure(*(a[0] for a in by_rule)),
                "pursuers": Enclosure(*(a[1] for a in by_rule)),
            },
            target_distance=target_distance,
            contacts_pursuers=contacts[0],
            contacts_target=contacts[1],
            contacts_obstacles=contacts[2],
        )


@kernel
def _advance(
    actions: Array,
    motion: Array,
    target: Array,
    discs: Array,
    difficulties: Array,
    steps: NDArray[np.int64],
    rays: Array,
    constants: Constants,
    owner: NDArray[np.int8],
    nearness: Array,
    contributing_angle: Array,
    totals: Array,
    complete: NDArray[np.bool_],
    target_distance: Array,
    contacts: NDArray[np.int64],
) -> int:
    """Move and measure every world; return -1, or the slot of the first action that is not finite, nothing moved."""
    for slot in range(actions.size):
        if not np.isfinite(actions.flat[slot]):
            return slot // 2
    physics = constants[0]
    pursuers, velocities = motion[0], motion[1]
    speed_ratio, safety_distance = difficulties[0], difficulties[1]
    n_worlds, n = pursuers.shape[:2]
    moved, seen, met = np.empty((n, 2)), np.empty((n, 2)), np.empty(2 * rays.shape[1])
    for b in range(n_worlds):
        _copy(pursuers[b], seen)
        move_pursuers(b, actions, pursuers, velocities, target, discs, physics, moved)
        if physics.target_sees_moves:
            _copy(pursuers[b], seen)
        move_target(b, seen, target, discs, speed_ratio[b], safety_distance[b], physics)
        enclose(
            b,
            pursuers,
            target,
            discs,
            speed_ratio[b],
            rays,
            physics,
            owner,
            nearness,
            contributing_angle,
            totals[0],
            totals[1],
            complete,
            target_distance,
            contacts,
            met,
        )
        steps[b] += 1
    return -1


@kernel
def _copy(source: Array, destination: Array) -> None:
    """Copy an (N, 2) array; Numba's own assignment checks shapes and overlaps, which costs more than the copy."""
    for i in range(len(source)):
        destination[i, 0], destination[i, 1] = source[i, 0], source[i, 1]


@kernel
def _enclose_worlds(
    worlds: NDArray[np.int64],
    pursuers: Array,
    target: Array,
    discs: Array,
    speed_ratio: Array,
    rays: Array,
    constants: Constants,
    owner: NDArray[np.int8],
    nearness: Array,
    contributing_angle: Array,
    totals: Array,
    complete: NDArray[np.bool_],
    target_distance: Array,
    contacts: NDArray[np.int64],
) -> None:
    """Measure some worlds as they are."""
    met = np.empty(2 * rays.shape[1])
    for b in worlds:
        enclose(
            b,
            pursuers,
            target,
            discs,
            speed_ratio[b],
            rays,
            constants[0],
            owner,
            nearness,
            contributing_angle,
            totals[0],
            totals[1],
            complete,
            target_distance,
            contacts,
            met,
        )
