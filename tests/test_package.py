"""What ``import marl_encircle`` offers, and what it does not load."""

import subprocess
import sys
import tomllib
from pathlib import Path

import marl_encircle
from marl_encircle import encirclement_v0


def test_every_name_that_is_offered_is_there() -> None:
    assert set(marl_encircle.__all__) <= set(dir(marl_encircle))
    for name in marl_encircle.__all__:
        assert getattr(marl_encircle, name).__name__.rpartition(".")[2] == name


def test_the_version_is_that_of_the_project() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert marl_encircle.__version__ == project["version"]
    assert "__version__" in dir(marl_encircle)


def test_the_version_is_not_looked_up_before_it_is_asked_for() -> None:
    code = (
        "import importlib.metadata as m; m.version = lambda _: 'looked up'; import marl_encircle as e; "
        "assert '__version__' not in vars(e); assert e.__version__ == 'looked up'"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_environments_module_may_be_imported_in_pettingzoos_style() -> None:
    assert encirclement_v0.parallel_env is marl_encircle.parallel_env
    assert encirclement_v0.parallel_env(pursuers=4).possible_agents[-1] == "pursuer_3"


def test_an_environment_alone_does_not_load_torch() -> None:
    code = "import sys; from marl_encircle import encirclement_v0, parallel_env; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
