"""Environments are found by id and by import path; one that MADDPG cannot be trained on is refused with what to do."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from marl_encircle.experiments import worlds
from marl_encircle.experiments.worlds import find_world, parse_arguments, random_actions
from marl_encircle.experiments.yaml_files import ConfigError


@pytest.fixture(autouse=True)
def _modules() -> Iterator[None]:
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name.startswith("mine"):
            del sys.modules[name]


def refused(name: str, pad: bool = False, **arguments: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        find_world(name, arguments, pad)
    assert str(caught.value).startswith(name)
    return str(caught.value)


def test_an_id_is_looked_up_in_pettingzoos_registry() -> None:
    world = find_world("marl_encircle/encirclement-v0", {"pursuers": 4})
    assert world().metadata["name"] == "encirclement_v0"
    assert world().possible_agents == [f"pursuer_{i}" for i in range(4)]
    assert world() is not world()


def test_an_import_path_is_a_module_or_a_function_of_one() -> None:
    assert len(find_world("mpe2.simple_spread_v3", {"N": 2, "continuous_actions": True})().possible_agents) == 2
    for name in ("imitation", "imitation:Imitation"):
        assert type(find_world(name, {"length": 7})()).__name__ == "Imitation"


def test_a_module_of_the_working_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine_alone.py").write_text("from imitation import Imitation as parallel_env\n")
    path = sys.path[:]
    assert "No module named 'mine_alone'" in refused("mine_alone")
    monkeypatch.chdir(tmp_path)
    find_world("mine_alone", {})
    assert sys.path == path


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("imitations", "cannot be imported: No module named 'imitations'"),
        ("imitation:absent", "the module has no absent; give module:function"),
        ("os.path", "the module has no parallel_env; give module:function"),
        ("no spaces", "neither an id of PettingZoo, such as sisl/multiwalker-v9, nor an import path"),
        ("nobody/knows-v0", "nobody/knows-v0: not among PettingZoo's environments; known: "),
        ("sisl/multiwalke-v9", "not among PettingZoo's environments; did you mean sisl/multiwalker-v9?"),
        ("mpe2.simple_spred_v3", "No module named 'mpe2.simple_spred_v3'; did you mean mpe2.simple_spread_v3?"),
        ("imitation:no_environment", "object is no ParallelEnv; pettingzoo.utils.aec_to_parallel converts an AECEnv"),
    ],
)
def test_a_name_that_leads_to_no_environment_is_refused(name: str, reason: str) -> None:
    assert reason in refused(name)


@pytest.mark.parametrize(
    ("unfit", "reason"),
    [
        (
            "discrete",
            "Discrete(3); MADDPG needs continuous ones (Box). Many environments have them by an argument, for",
        ),
        ("unbounded", "MADDPG needs bounds: supersuit.clip_actions_v0"),
        ("symbols", "the observations of left are Discrete(3); MADDPG needs numbers (Box)"),
        ("images", "the observations of left have shape (8, 8, 3); play-with trains on vectors. SuperSuit's"),
        ("unequal", "MADDPG needs equal spaces: --pad makes them so"),
        ("staggered", "['right'] ended, ['left'] did not; all must end at the same step"),
        ("endless", "a round has not ended after 50 steps; give it a time limit, for example --set max_cycles=100"),
    ],
)
def test_an_environment_that_maddpg_cannot_serve_is_refused_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, unfit: str, reason: str
) -> None:
    monkeypatch.setattr(worlds, "MAX_ROUND", 50)
    monkeypatch.setattr(worlds, "NO_END", worlds.NO_END.replace("10000", "50"))
    assert reason in refused("imitation", unfit=unfit)


def test_spaces_can_be_made_equal() -> None:
    world = find_world("imitation", {"unfit": "unequal"}, pad=True)()
    assert {world.observation_space(agent).shape for agent in world.possible_agents} == {(2,)}


def test_an_argument_that_an_environment_does_not_take_is_refused_with_its_words() -> None:
    message = refused("imitation", lenght=3)
    assert message.startswith("imitation: no world could be made with lenght=3: TypeError: ")
    assert "unexpected keyword argument 'lenght'" in message
    assert "ValueError: length must be at least 1; got 0" in refused("imitation", length=0)


def test_arguments_are_read_as_yaml() -> None:
    texts = ["continuous=true", "N=3", "name=tall one", "sizes=[1, 2.5]", "none=null"]
    expected = {"continuous": True, "N": 3, "name": "tall one", "sizes": [1, 2.5], "none": None}
    assert parse_arguments(texts) == expected
    for text in ("N", "=3", "a.b=3", "two words=3", "x=!!python/name:os.system"):
        with pytest.raises(ConfigError, match=r"^--set "):
            parse_arguments([text])


def test_random_actions_fill_the_space_and_are_the_same_each_time() -> None:
    space = Box(np.float32([-1, 0]), np.float32([1, 5]))
    actions = random_actions(space)(np.zeros((4000, 3)))
    assert actions.shape == (4000, 2)
    assert actions.dtype == np.float32
    assert all(space.contains(action) for action in actions)
    np.testing.assert_allclose(actions.mean(axis=0), [0.0, 2.5], atol=0.1)
    np.testing.assert_array_equal(random_actions(space)(np.zeros((4000, 3))), actions)
