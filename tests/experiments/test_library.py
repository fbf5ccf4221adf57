"""A name is a file of the installation or a path; a file says only what differs from its base."""

from pathlib import Path
from typing import Any

import pytest

from marl_encircle.experiments.library import PACKAGE, find_file, load_reward, load_section, reward_names
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml


def write(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return str(path)


def refused(name: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_reward(name)
    return str(caught.value)


def test_the_installation_knows_the_papers_methods_and_the_algorithms() -> None:
    assert reward_names() == ["generalist", "ma2019", "model_a", "model_b", "model_c", "ours", "ours_plus"]
    assert load_section("algorithm", "matd3")["name"] == "matd3"


def test_a_name_is_looked_up_in_every_folder_and_a_path_in_none() -> None:
    paths = [find_file(name, "reward") for name in ("model_a", "ma2019")]
    assert [path.parent.name for path in paths] == ["ablations", "baselines"]
    assert find_file("model_a.yaml", "reward") == Path("model_a.yaml")
    with pytest.raises(ConfigError, match=r"grid 'smok': neither a known name .*did you mean smoke"):
        find_file("smok", "grid")


def test_every_plan_of_the_package_is_of_its_kind() -> None:
    for path in (PACKAGE / "configs" / "paper").glob("*.yaml"):
        kind: Any = "protocol" if "neighbours" in read_yaml(path) else "grid"
        assert find_file(path.stem, kind) == path
        with pytest.raises(ConfigError, match="neither a known name"):
            find_file(path.stem, "grid" if kind == "protocol" else "protocol")


def test_a_chain_of_bases_is_followed_from_file_to_file(tmp_path: Path) -> None:
    write(tmp_path, "far/first.yaml", "base: model_b\nscale: 0.5\nterms: {time: 1.0}\n")
    write(tmp_path, "second.yaml", "base: far/first.yaml\nterms: {time: 2.0}\n")
    third = write(tmp_path, "near/third.yaml", "base: ../second.yaml\nname: third\n")
    reward = load_reward(third)
    assert [reward[key] for key in ("name", "scale", "two_stage")] == ["third", 0.5, False]
    assert (reward["terms"]["time"], reward["terms"]["completion"]) == (2.0, 50.0)


def test_a_base_that_leads_back_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "a.yaml", "base: b.yaml\n")
    path = write(tmp_path, "b.yaml", "base: a.yaml\n")
    assert refused(path).endswith("circular base; it leads back to this file")
    assert refused(write(tmp_path, "c.yaml", "base: ./c.yaml\n")).endswith("circular base; it leads back to this file")
    (tmp_path / "link.yaml").symlink_to(tmp_path / "link.yaml")
    assert refused(str(tmp_path / "link.yaml")).endswith("not a regular file")


def test_bases_do_not_go_on_for_ever(tmp_path: Path) -> None:
    for i in range(30):
        write(tmp_path, f"{i}.yaml", f"base: {i + 1}.yaml\n")
    assert "more than 20 nested bases" in refused(str(tmp_path / "0.yaml"))


def test_a_changed_method_has_its_own_name_or_its_files_never_its_bases(tmp_path: Path) -> None:
    assert load_reward(write(tmp_path, "bold.yaml", "base: ours\nscale: 1.0\n"))["name"] == "bold"
    assert load_reward(write(tmp_path, "bolder.yaml", "base: bold.yaml\n"))["name"] == "bolder"
    assert load_reward(write(tmp_path, "x.yaml", "base: bold.yaml\nname: said\n"))["name"] == "said"
