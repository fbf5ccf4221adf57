"""A configuration is complete and right, or refused in one line before anything is done."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml_cases
from gymnasium.spaces import Box

from marl_encircle import maddpg
from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator
from marl_encircle.experiments import config as configuration
from marl_encircle.experiments.config import Config, difference, load_config
from marl_encircle.experiments.library import reward_names
from marl_encircle.experiments.records import Setting, config_hash
from marl_encircle.experiments.sizes import count_weights, observation_size
from marl_encircle.experiments.train import run_folder
from marl_encircle.experiments.trainable import check_training
from marl_encircle.experiments.yaml_files import ConfigError


def refused(reward: str = "ours", **how: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(reward, **how)
    return str(caught.value)


def write(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return str(path)


# layers


def test_a_field_that_nobody_names_keeps_its_default_and_the_last_one_to_name_it_wins() -> None:
    assert load_config().scenario.safety_distance == 0.11
    scenario = {"safety_distance": 0.12, "pursuers": 4}
    config = load_config(fields=scenario, overrides=["scenario.safety_distance=0.13", "scenario.safety_distance=0.14"])
    assert (config.scenario.safety_distance, config.scenario.pursuers, config.scenario.obstacles) == (0.14, 4, 1)


def test_mappings_are_merged_key_by_key_and_null_switches_off(tmp_path: Path) -> None:
    path = write(tmp_path, "mine.yaml", "base: ours\nterms:\n  contraction: {weight: 2.0, cap: 5.0}\n  time: null\n")
    terms = load_config(path, overrides=["reward.terms.contraction.cap=4"]).reward.terms
    assert terms == {**load_config().reward.terms, "contraction": {"weight": 2.0, "cap": 4.0}, "time": None}
    assert "time" not in load_config(path).reward.build().active


def test_a_users_file_works_where_a_name_does_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, "elsewhere/mine.yaml", "base: ours\nname: ours\n")
    monkeypatch.chdir(tmp_path)
    for path in ("elsewhere/mine.yaml", "./elsewhere/mine.yaml", str(tmp_path / "elsewhere" / "mine.yaml")):
        assert load_config(path) == load_config("ours")
    algorithm = write(tmp_path, "slow.yml", "base: maddpg\nlearning_rate: 1e-4\n")
    for path in (algorithm, Path(algorithm)):
        assert load_config(algorithm=path).algorithm.learning_rate == 1e-4
    assert load_config(Path("elsewhere/mine.yaml")) == load_config("ours")
    write(tmp_path, "LOUD.YAML", "base: ours\n")
    assert load_config("LOUD.YAML").reward.name == "LOUD"


def test_a_file_whose_name_cannot_name_a_method_is_told_to_add_one(tmp_path: Path) -> None:
    path = write(tmp_path, "my idea.yaml", "base: ours\n")
    assert refused(path) == f"{path}: 'my idea' is not a method name; add 'name:' with letters, digits, _ . or -"
    assert load_config(path, overrides=["reward.name=said"]).reward.name == "said"
    assert load_config(write(tmp_path, "my idea.yaml", "base: ours\nname: idea\n")).reward.name == "idea"


def test_keys_that_came_later_leave_the_runs_before_them_their_hash() -> None:
    usual = load_config(overrides=["algorithm.n_steps=1", "algorithm.learning_rate_end=null"])
    assert usual.to_dict() == load_config().to_dict()
    assert not {"n_steps", "learning_rate_end"} & usual.to_dict()["algorithm"].keys()
    changed = load_config(overrides=["algorithm.n_steps=3", "algorithm.learning_rate_end=1e-4"])
    assert changed.to_dict()["algorithm"] == usual.to_dict()["algorithm"] | {"n_steps": 3, "learning_rate_end": 1e-4}
    assert Config.from_dict(changed.to_dict()) == changed
    assert Config.from_dict(usual.to_dict()) == usual


def test_an_algorithm_is_known_once_the_registry_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(maddpg.ALGORITHMS, "mine", maddpg.MATD3)
    assert load_config(overrides=["algorithm.name=mine"]).to_dict()["algorithm"]["name"] == "mine"


@pytest.mark.parametrize(
    ("ratio", "pursuers", "alone"),
    # Eq. 6: the least n is 3, 4, 4, 4 for 1.1, 1.2, 1.3, 1.4
    [(1.1, 2, False), (1.1, 3, True), *((r, n, n == 4) for r in (1.2, 1.3, 1.4) for n in (3, 4))],
)
@pytest.mark.parametrize("profile", ["full", "smoke"])
def test_the_curriculum_follows_from_eq_6_for_every_method_alike(
    ratio: float, pursuers: int, alone: bool, profile: Any
) -> None:
    for method in ("ours", "model_a", "ma2019"):
        config = load_config(method, profile=profile, fields={"speed_ratio": ratio, "pursuers": pursuers})
        ramps = {name for name, ramp in config.training.curriculum.items() if ramp is not None}
        assert ramps == ({"safety_distance"} if alone else {"obstacle_radius", "speed_ratio"})
        longer = config.training.world_steps > 1_000_000
        assert longer == (profile == "full" and not alone)


@pytest.mark.parametrize("profile", ["full", "smoke"])
def test_the_obstacles_of_the_papers_settings_start_as_the_file_says(profile: Any) -> None:
    for radius in (0.15, 0.2, 0.25):
        for ratio, pursuers, obstacles in ((1.1, 2, 1), *((r, 3, m) for r in (1.2, 1.3, 1.4) for m in (1, 2, 3))):
            setting = {"speed_ratio": ratio, "pursuers": pursuers, "obstacles": obstacles, "obstacle_radius": radius}
            assert start_of_radius(load_config(profile=profile, fields=setting)) == 0.45


@pytest.mark.parametrize(
    ("scene", "obstacles", "start"),
    [
        # A quarter of the scene: pi (m s R^2 + 3 x 0.0025) / 4 = 0.25, s = 1, 7 x 0.16, 10 x 0.16
        ("random", 4, 0.279),
        ("concave", 3, 0.304),
        ("tunnel", 2, 0.312),
        ("tunnel", 5, 0.2),  # 0.197, but they are not to grow
    ],
)
def test_obstacles_that_would_not_fit_at_first_start_at_a_quarter_of_the_scene(
    scene: str, obstacles: int, start: float
) -> None:
    config = load_config(fields={"pursuers": 2, "scene": scene, "obstacles": obstacles})
    assert start_of_radius(config) == start
    check_training(config)
    simulator = Simulator(config.scenario, n_worlds=16, seed=0)
    simulator.set_difficulty({"obstacle_radius": start})
    simulator.reset()


def start_of_radius(config: Config) -> float:
    ramp = config.training.curriculum["obstacle_radius"]
    assert ramp is not None
    return ramp.start


def test_null_switches_the_curriculum_off() -> None:
    for pursuers in (2, 3):
        config = load_config(fields={"pursuers": pursuers}, overrides=["training.curriculum=null"])
        assert config.to_dict()["training"]["curriculum"] == {}
        assert Config.from_dict(config.to_dict()) == config


# one run, one folder, one hash


def test_a_runs_folder_tells_method_and_setting_exactly() -> None:
    def folder(**scenario: Any) -> str:
        return str(run_folder(load_config("model_b", fields=scenario), 7, "out"))

    assert folder() == "out/model_b/ratio1.1_n3_m1_random/seed7"
    assert folder(speed_ratio=1, obstacles=0) == "out/model_b/ratio1.0_n3_m0_random/seed7"
    assert folder(speed_ratio=1.123456789, scene="tunnel") == "out/model_b/ratio1.123456789_n3_m1_tunnel/seed7"


def leaves(values: Any, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    if isinstance(values, dict) and values:
        return [leaf for key, inner in values.items() for leaf in leaves(inner, (*path, key))]
    return [(path, values)]


def hash_of(config: Config) -> str:
    return config_hash(config.to_dict())


def test_the_hash_changes_with_every_value_and_with_nothing_else() -> None:
    values = load_config().to_dict()
    hashes = {hash_of(load_config())}
    for path, value in leaves(values):
        changed = json.loads(json.dumps(values))
        place = changed
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = other(path[-1], value)
        hashes.add(hash_of(Config.from_dict(changed)))
    assert len(hashes) == 1 + len(leaves(values))
    assert len(leaves(values)) > 60
    backwards = dict(reversed(values.items()))
    assert hash_of(Config.from_dict(backwards)) == hash_of(load_config())
    same = ["reward.terms.time=8", "scenario.speed_ratio=1.10", "training.n_worlds=64"]
    assert hash_of(load_config(overrides=same)) == hash_of(load_config())


def other(key: str, value: Any) -> Any:
    """A different value that is allowed."""
    names = {
        "name": "matd3" if value == "maddpg" else "else",
        "closure": "pursuers",
        "critic": "per_agent",
        "scene": "tunnel",
        "dynamics": "first_order",
        "integration": "mpe2",
        "contacts": "off",
        "turn_order": "pursuers_first",
        "target": "still",
        "repulsion_from": "surface",
        "path_rule": "relaxed",
        "placement": "overlapping",
        "net_arch": [32],
        "observe_extras": ["stage"],
        "max_grad_norm": 1.0,
        "repulsion_power": 1,
    }
    if key in names:
        return names[key]
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 2
    return value * 0.9 + 0.0007 if key != "speed_ratio" else 1.2


def test_a_configuration_comes_back_from_its_plain_data() -> None:
    for method in reward_names():
        config = load_config(method, overrides=["scenario.observe_extras=[stage, speed_ratio]"])
        again = Config.from_dict(json.loads(json.dumps(config.to_dict())))
        assert again == config
        assert again.to_dict() == config.to_dict()


@pytest.mark.parametrize(
    "values", [None, [], "x", {}, {"scenario": [1]}, {"scenario": {"pursuer": 1}}, {"reward": 3, "scenario": {}}]
)
def test_plain_data_of_something_else_is_refused(values: Any) -> None:
    with pytest.raises(ConfigError):
        Config.from_dict(values)


def test_a_difference_names_every_key_that_differs_and_no_other() -> None:
    here = load_config("ours").to_dict()
    there = load_config("model_a", overrides=["training.curriculum.safety_distance=null"]).to_dict()
    assert difference(here, here) == []
    assert difference(here, there) == [
        "reward.name: ours here, model_a there",
        "reward.closure: all here, pursuers there",
        "reward.terms.obstacle_angle: 0.5 here, None there",
        "training.curriculum.safety_distance.start: 0.3 here, missing there",
        "training.curriculum.safety_distance.world_steps: 300000 here, missing there",
        "training.curriculum.safety_distance: missing here, None there",
    ]
    assert difference({"a": 1}, {}, ("left", "right")) == ["a: 1 left, missing right"]


# the paper's methods


def test_the_methods_are_those_of_the_notes() -> None:
    ours = load_config("ours").reward
    both, pursuers = "all", "pursuers"
    terms = {"overall_angle", "contributing_angle", "obstacle_angle", "contraction", "collision", "completion", "time"}
    expected = {
        "ours": (both, True, terms),
        "model_a": (pursuers, True, terms - {"obstacle_angle"}),
        "model_b": (both, False, terms),
        "model_c": (both, True, terms - {"contributing_angle"}),
        "ma2019": (pursuers, False, {"encirclement_radius", "phase_difference", "collision", "completion", "time"}),
    }
    assert sorted([*expected, "ours_plus", "generalist"]) == reward_names()
    assert difference(load_config().to_dict(), load_config("ours_plus").to_dict()) == [
        "reward.name: ours here, ours_plus there",
        "reward.terms.obstacle_angle: 0.5 here, 2.0 there",
    ]
    for method, (closure, two_stage, names) in expected.items():
        reward = load_config(method).reward
        active = reward.build().active
        assert (reward.name, reward.closure, reward.two_stage) == (method, closure, two_stage)
        assert active.keys() == names
        assert reward.scale == ours.scale
        for name in names & terms:
            assert active[name] == ours.build().active[name], (method, name)
    assert load_config("ma2019").reward.build().active["encirclement_radius"][1] == {"radius": 0.15}


def test_the_rewards_default_is_the_papers_method() -> None:
    assert Reward() == load_config("ours").reward.build()


def test_methods_differ_in_their_reward_only() -> None:
    for method in reward_names():
        here, there = load_config(method).to_dict(), load_config("ours").to_dict()
        assert all(line.startswith("reward.") for line in difference(here, there))


# what is refused


@pytest.mark.parametrize(("text", "reason"), yaml_cases.REWARD_FILES)
def test_a_bad_file_is_refused_by_name_and_reason(tmp_path: Path, text: str | bytes, reason: str) -> None:
    path = tmp_path / "case.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    message = refused(str(path))
    assert reason in message
    assert message.startswith(f"{tmp_path}/")
    assert_short(message.replace(str(path), ""))


@pytest.mark.parametrize(("override", "reason"), yaml_cases.OVERRIDES)
def test_a_bad_override_is_refused_by_key_and_reason(override: str, reason: str) -> None:
    message = refused(overrides=[override])
    assert reason in message
    assert_short(message)


@pytest.mark.parametrize(("how", "reason"), yaml_cases.ARGUMENTS)
def test_a_bad_name_or_setting_is_refused(how: dict[str, Any], reason: str) -> None:
    message = refused(**how)
    assert reason in message
    assert_short(message)


def assert_short(message: str) -> None:
    """One line a fault, none with a long value in it."""
    for line in message.splitlines():
        assert len(line) < 800
        assert "x" * 81 not in line
        assert "9" * 81 not in line


def test_a_scenario_may_be_given_as_it_is() -> None:
    scenario = Scenario(pursuers=4, observe_extras=("stage",))
    assert load_config(scenario=scenario).scenario == scenario
    assert load_config(scenario=scenario, fields={"pursuers": 3}).scenario.pursuers == 3


def test_there_are_many_cases() -> None:
    assert len(yaml_cases.REWARD_FILES) + len(yaml_cases.OVERRIDES) + len(yaml_cases.ARGUMENTS) >= 80


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    assert "not a regular file" in refused(str(tmp_path / "folder.yaml"))
    os.mkfifo(tmp_path / "pipe.yaml")
    assert "not a regular file" in refused(str(tmp_path / "pipe.yaml"))
    assert "No such file" in refused(str(tmp_path / "absent.yaml"))
    assert "No such file" in refused("ablations/absent.yml")


@pytest.mark.parametrize(
    ("overrides", "role"),
    [
        (["algorithm.net_arch=[4096, 4096, 4096]"], "the actors would have 404 MB of weights; at most 34 MB"),
        (["algorithm.net_arch=[300]", "algorithm.critic=per_agent", "scenario.pursuers=64",
          "scenario.pursuer_radius=0.01"], "the critics would have 1308 MB of weights; at most 537 MB"),
    ],
)  # fmt: skip
def test_networks_that_could_not_be_read_back_are_refused(overrides: Sequence[str], role: str) -> None:
    message = refused(overrides=overrides)
    assert "algorithm.net_arch" in message
    assert role in message


@pytest.mark.parametrize("critic", ["per_agent", "shared"])
def test_the_weights_that_are_counted_are_those_of_the_networks(critic: Any) -> None:
    overrides = [f"algorithm.critic={critic}", "algorithm.net_arch=[8, 6]"]
    config = load_config(fields={"pursuers": 4}, overrides=overrides)
    spaces = Box(-1, 1, (observation_size(config.scenario),)), Box(-1, 1, (2,))
    policy = maddpg.MADDPGPolicy(*spaces, lambda _: 1e-3, 4, critic=critic, net_arch=[8, 6])
    networks = {"actors": policy.actor, "critics": policy.critic}
    assert count_weights(config.scenario, config.algorithm) == {
        role: sum(parameter.numel() for parameter in network.parameters()) for role, network in networks.items()
    }


def test_with_defaults_a_configuration_has_the_keys_that_it_leaves_out() -> None:
    config = load_config(overrides=["algorithm.n_steps=3"])
    left_out, shown = config.to_dict(), config.with_defaults()
    assert {"features", "learning_rate_end"}.isdisjoint(left_out["algorithm"])
    assert "settings" not in left_out["training"]
    assert (shown["algorithm"]["features"], shown["algorithm"]["learning_rate_end"]) == ("observation", None)
    assert (shown["algorithm"]["n_steps"], shown["training"]["settings"]) == (3, [])
    assert Config.from_dict(shown) == Config.from_dict(left_out) == config


def test_settings_are_in_the_scenarios_scene() -> None:
    for scene in ("concave", "tunnel"):
        setting = f"{{speed_ratio: 1.1, pursuers: 3, obstacles: 1, scene: {scene}}}"
        overrides = ["algorithm.features=set", f"training.settings=[{setting}]"]
        assert "scene: must be scenario.scene, random" in refused(overrides=overrides)
        config = load_config(overrides=[*overrides, f"scenario.scene={scene}"])
        assert config.settings == [Setting(1.1, 3, 1, scene)]


def test_a_policy_may_fill_half_of_what_is_read_back_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    size = 4 * count_weights(load_config().scenario, load_config().algorithm)["actors"]
    monkeypatch.setattr(configuration, "MAX_POLICY_BYTES", 2 * size)
    load_config()
    monkeypatch.setattr(configuration, "MAX_POLICY_BYTES", 2 * size - 2)
    assert "the actors would have" in refused()
