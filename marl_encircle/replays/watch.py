"""What there is to watch: which policy, which rounds, and what a drawing shows of each moment. Numbers only."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from marl_encircle.core.geometry import Closure
from marl_encircle.drawing.view import View
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.pretrained import (
    USUAL_SETTING,
    find_run,
    first_run,
    in_words,
    is_run_path,
    pretrained_runs,
    setting_of,
)
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg.policies import MADDPGPolicy
from marl_encircle.replays.replay import Replay, record_round

WATCHED_SEED = 7000
"""Evaluation seed of the rounds that are shown unless another is asked for: neither trained on nor reported."""


@dataclass(frozen=True, eq=False)
class Side:
    """A policy to be watched.

    :param title: what it is called in the drawing
    :param policy: who acts
    :param config: of its run, with the reward and the scene that it is watched under
    :param folder: of its run
    :param train_seed: of its run
    :param trained_as: the method that the policy was trained as, if that is another than the title says
    """

    title: str
    policy: MADDPGPolicy
    config: Config
    folder: Path
    train_seed: int
    trained_as: str = ""


def find_match(
    what: str,
    versus: str | None,
    results: Path | None,
    fields: Mapping[str, Any],
    scene: str | None,
    policy: Path | None,
    eval_seed: int | None,
) -> "Match":
    """Return the rounds of one policy, or of two in the first one's setting and scene; see :func:`find_side`.

    :param versus: the other one; takes ``policy`` too if it is the YAML file of a reward
    :param eval_seed: see :class:`Match`
    """
    side = find_side(what, results, fields, scene, policy)
    if versus is None:
        return Match(side, eval_seed=eval_seed)
    setting = side.config.cell.setting
    other = find_side(versus, results, _numbers(setting), setting.scene, policy if _is_yaml(versus) else None)
    return Match(side, other, eval_seed=eval_seed)


def find_side(
    what: str,
    results: Path | None = None,
    fields: Mapping[str, Any] | None = None,
    scene: str | None = None,
    policy: Path | None = None,
) -> Side:
    """Return the policy that is meant.

    :param what: a method's name: the first training seed of its setting; a run folder; or the YAML file of a reward,
        which the policy of another run is watched under
    :param results: the folder of ``runs/``; by default ``results``, and for what it lacks the package's own runs
    :param fields: speed ratio, pursuers and obstacles as far as they are asked for; 1.1, 3 and 1 choose a method's run
    :param scene: play in a scene of this name
    :param policy: a run folder; whose policy is watched under the reward ``what``
    :raises ConfigError: if there is none, naming what there is
    :raises DamagedFileError: if a run is not what its record says
    """
    wanted = setting_of({"scene": scene or USUAL_SETTING.scene, **(fields or {})})
    is_folder = not _is_yaml(what) and is_run_path(what)
    if _is_yaml(what) and not Path(what).is_file():
        raise ConfigError(f"{what}: no such file")
    if _is_yaml(what) and policy is None:
        raise ConfigError(f"{what} is a reward without a policy: add --policy RUN_DIR, or train one with it")
    if is_folder and policy is not None:
        raise ConfigError(f"{what} is a run folder, whose policy is its own; --policy goes with a reward")
    folders = [results / "runs"] if results else [Path("results", "runs"), pretrained_runs()]
    if policy is not None:
        folder = policy
    elif is_folder:
        folder = Path(what)
    else:  # who was not trained in a scene plays it as trained in the usual one
        trained_in = first_run(Cell(what, wanted), folders)
        folder = trained_in or find_run(what, wanted._replace(scene=USUAL_SETTING.scene), folders)
    numbers = fields or {} if policy or is_folder else _numbers(wanted)
    chosen = [*numbers, *(["scene"] if scene else [])]
    actors, config, record = load_run(folder, {name: getattr(wanted, name) for name in chosen})
    trained = config.reward.name
    if policy is not None:
        config = config.model_copy(update={"reward": load_config(what).reward})
    title = what if policy is None and not is_folder else config.reward.name
    return Side(title, actors, config, folder, record["seed"], trained if trained != title else "")


def _numbers(setting: Setting) -> dict[str, Any]:
    """Return a setting but for its scene."""
    return {name: value for name, value in setting._asdict().items() if name != "scene"}


def _is_yaml(what: str) -> bool:
    return what.lower().endswith((".yaml", ".yml"))


class Match:
    """The rounds of an evaluation seed, played by one policy or by two from the same start.

    :param sides: one or two
    :param eval_seed: evaluation seed; by default one whose rounds none of them was trained on or is reported by
    :raises ConfigError: if two policies do not play the same rounds
    """

    def __init__(self, *sides: Side, eval_seed: int | None = None) -> None:
        self.sides = sides
        self.eval_seed = fresh_seed(sides) if eval_seed is None else eval_seed
        self.replays = lru_cache(maxsize=64)(self._replays)
        settings = [side.config.cell.setting for side in sides]
        for setting in settings[1:]:
            if setting != settings[0]:
                words = " and ".join(map(in_words, settings))
                raise ConfigError(f"not the same rounds: {words}")

    def _replays(self, number: int) -> tuple[Replay, ...]:
        replays = tuple(record_round(side.policy, side.config, number, self.eval_seed) for side in self.sides)
        first = replays[0]
        for other in replays[1:]:
            places = ((first.pursuers, other.pursuers), (first.target, other.target))
            if not all(np.array_equal(mine[0], its[0]) for mine, its in places) or not np.array_equal(
                first.discs, other.discs
            ):
                folders = " and ".join(str(side.folder) for side in self.sides)
                raise ConfigError(f"not the same rounds: the scenarios of {folders} place the bodies differently")
        return replays

    def length(self, number: int) -> int:
        """Return the number of steps of a round, of the longer one where there are two."""
        return max(end_of(replay) for replay in self.replays(number))

    def views(self, number: int, step: int) -> list[View]:
        """Return what is seen of a round at one step; a round that is over stays at its end.

        :param step: 0 is the start
        """
        caption = f"round {number} of seed {self.eval_seed}"
        sides = zip(self.sides, self.replays(number), strict=True)
        return [
            view_of(
                replay,
                min(step, end_of(replay)),
                side.title,
                f"policy of {side.trained_as}\n{caption}" if side.trained_as else caption,
            )
            for side, replay in sides
        ]

    def notes(self) -> Iterator[str]:
        """Yield what has to be known of what is seen."""
        for side in self.sides:
            yield f"{side.title}: {side.folder}, training seed {side.train_seed}"
        reported = sorted({side.config.evaluation.seed for side in self.sides})
        if any(self.eval_seed == side.train_seed for side in self.sides):
            yield f"rounds of seed {self.eval_seed}, which is a training seed: a policy may know them"
        elif self.eval_seed in reported:
            yield f"rounds of seed {self.eval_seed}: the reported ones"
        else:
            yield f"rounds of seed {self.eval_seed}: fresh ones; the reported ones are --seed {reported[0]}"


def fresh_seed(sides: tuple[Side, ...]) -> int:
    """Return an evaluation seed whose rounds nobody was trained on or is reported by."""
    used = {
        seed
        for side in sides
        for seed in (side.train_seed, side.config.evaluation.seed, side.config.evaluation.curve_seed)
    }
    return next(seed for seed in range(WATCHED_SEED, WATCHED_SEED + len(used) + 1) if seed not in used)


def end_of(replay: Replay) -> int:
    """Return the step at which a round is over for its spectators.

    When both rules have held; at the method's own success if the other rule never holds; else when time is up.
    """
    if replay.success_step is None or None not in (replay.step_all, replay.step_pursuers):
        return replay.length
    return replay.success_step


def view_of(replay: Replay, step: int, title: str = "", caption: str = "") -> View:
    """Return what is drawn of one moment of a round, under the method's own rule.

    :param step: 0 is the start
    """
    enclosure = replay.enclosure[replay.closure]
    moment = replay.snapshot(step)
    rewards = replay.rewards.mean(axis=1)
    steps: dict[Closure, int | None] = {"all": replay.step_all, "pursuers": replay.step_pursuers}
    return View(
        scenario=replay.scenario,
        pursuers=moment.pursuers,
        velocities=replay.velocities[step],
        target=moment.target,
        discs=moment.discs,
        speed_ratio=moment.speed_ratio,
        owner=moment.owner,
        distance=moment.distance,
        movement_range=moment.movement_range,
        complete=bool(enclosure.complete[step]),
        step=step,
        trail=[np.vstack([replay.pursuers[past], replay.target[past]]) for past in range(step + 1)],
        closure=replay.closure,
        success={rule: at if at is not None and at <= step else None for rule, at in steps.items()},
        ahead=replay.target[step + 1] if step < replay.length else None,
        rewards=(float(rewards[step - 1]) if step else 0.0, float(rewards[:step].sum())),
        title=title,
        caption=caption,
    )
