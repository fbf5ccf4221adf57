"""Where machine code is kept, and that the old one is never run for new sources."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from core_worlds import random_actions
from numba.core.registry import CPUDispatcher

from marl_encircle.core import compilation, dynamics, geometry
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

PACKAGE = Path(compilation.__file__).parent

CALLER = """
import numba
from toy.compilation import kernel
from toy.callee import kept, trapped

@kernel
def ours(x):
    return 10 * kept(x)

@numba.njit(cache=True)
def naive(x):
    return 10 * trapped(x)

print(naive(1), ours(1))
"""

CALLEE = """
import numba
from toy.compilation import kernel

@kernel
def kept(x):
    return x + NUMBER

@numba.njit(cache=True)
def trapped(x):
    return x + NUMBER
"""


def run(code: str, folder: Path, **environment: str) -> str:
    """What a new process prints that sees only this environment."""
    base = {"PATH": os.environ["PATH"], "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=base | environment, capture_output=True, text=True, cwd=folder, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_callee_that_changed_in_another_file_is_noticed(tmp_path: Path) -> None:
    toy = tmp_path / "toy"
    toy.mkdir()
    (toy / "__init__.py").write_text("")
    (toy / "compilation.py").write_bytes((PACKAGE / "compilation.py").read_bytes())
    (toy / "caller.py").write_text(CALLER)
    caches = {"MARL_ENCIRCLE_CACHE": str(tmp_path / "ours"), "NUMBA_CACHE_DIR": str(tmp_path / "theirs")}
    (toy / "callee.py").write_text(CALLEE.replace("NUMBER", "1"))
    assert run("import toy.caller", tmp_path, **caches) == "20 20"
    (toy / "callee.py").write_text(CALLEE.replace("NUMBER", "2"))
    # Numba alone runs the old machine code: 10 (1 + 1); right is 10 (1 + 2)
    assert run("import toy.caller", tmp_path, **caches) == "20 30"
    assert len(list((tmp_path / "ours" / "marl_encircle").iterdir())) == 2
    # The second process of the same sources takes the code that the first one left
    index = sorted((tmp_path / "ours").rglob("*.nbc"))
    assert run("import toy.caller", tmp_path, **caches) == "20 30"
    assert sorted((tmp_path / "ours").rglob("*.nbc")) == index


def test_the_hash_is_of_every_source_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "__file__", str(tmp_path / "compilation.py"))
    seen = [compilation.core_hash()]
    for name, text in (("a.py", "x"), ("b.py", "x"), ("a.py", "y"), ("c.py", "")):
        (tmp_path / name).write_text(text)
        seen.append(compilation.core_hash())
    (tmp_path / "b.py").rename(tmp_path / "d.py")
    seen.append(compilation.core_hash())
    assert len(set(seen)) == 6
    (tmp_path / "notes.txt").write_text("no source")
    assert compilation.core_hash() == seen[-1]


def test_the_folder_is_the_first_of_the_users_that_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named, xdg, home = tmp_path / "named", tmp_path / "xdg", tmp_path / "home"
    monkeypatch.setenv("MARL_ENCIRCLE_CACHE", str(named))
    monkeypatch.setenv("XDG_CACHE_HOME", str(xdg))
    monkeypatch.setenv("HOME", str(home))
    assert compilation.cache_folder().parent.parent == named
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder should be")
    monkeypatch.setenv("MARL_ENCIRCLE_CACHE", str(blocked))
    assert compilation.cache_folder().parent.parent == xdg
    monkeypatch.delenv("MARL_ENCIRCLE_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert compilation.cache_folder().parent.parent == home / ".cache"
    assert compilation.cache_folder().name == f"numba-{compilation.core_hash()}"


def test_without_any_such_folder_it_is_a_new_private_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder should be")
    for name in ("MARL_ENCIRCLE_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, str(blocked))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    first, second = compilation.cache_folder(), compilation.cache_folder()
    assert first != second
    assert first.parent == tmp_path
    assert first.stat().st_mode & 0o077 == 0


@pytest.mark.slow
def test_the_package_works_where_nothing_of_the_users_can_be_written(tmp_path: Path) -> None:
    code = (
        "import numpy as np; from marl_encircle.core.geometry import half_circle, _area\n"
        "from marl_encircle.core import compilation\n"
        "print(_area(np.ones(8)), compilation._CACHE_FOLDER.parent, any(compilation._CACHE_FOLDER.rglob('*.nbi')))"
    )
    nowhere = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "MARL_ENCIRCLE_CACHE"), "/proc/nowhere")
    out = run(code, PACKAGE.parent.parent, TMPDIR=str(tmp_path), **nowhere)
    assert out == f"{np.pi} {tmp_path} True"


@pytest.mark.compiled
def test_other_peoples_kernels_keep_their_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "theirs"))
    ours = compilation.kernel(lambda x: x + 1)
    assert str(tmp_path / "theirs") == numba.config.CACHE_DIR
    assert str(compilation._CACHE_FOLDER) in str(ours._cache.cache_path)  # type: ignore[attr-defined]  # Numba does not type it
    with pytest.raises(TypeError):
        compilation.kernel(3)  # type: ignore[arg-type]  # that is the test
    assert str(tmp_path / "theirs") == numba.config.CACHE_DIR


@pytest.mark.compiled
def test_every_kernel_is_kept_in_our_folder() -> None:
    kernels = [f for module in (geometry, dynamics) for f in vars(module).values() if isinstance(f, CPUDispatcher)]
    assert len(kernels) > 8
    for f in kernels:
        assert str(compilation._CACHE_FOLDER) in f._cache.cache_path


PLAIN = """
import numba
import numpy as np
assert numba.config.DISABLE_JIT
np.seterr(all="ignore")  # division by zero is part of the plan
from test_compilation import rollout
np.savez("plain.npz", **rollout())
"""


def rollout() -> dict[str, np.ndarray]:
    """Some steps of everything that kernels do."""
    told = {}
    for contacts, scene in (("soft", "random"), ("hard", "concave")):
        sim = Simulator(Scenario(contacts=contacts, scene=scene, n_directions=36), 2, seed=5)
        rng = np.random.default_rng(5)
        sim.reset()
        for _ in range(5):
            sim.step(random_actions(sim, rng))
        enclosure = sim.measure.enclosure["all"]
        told |= {f"{scene} {name}": array for name, array in sim.state._asdict().items()}
        told |= {f"{scene} {name}": array for name, array in enclosure._asdict().items()}
    return told


@pytest.mark.slow
def test_plain_python_says_the_same(tmp_path: Path) -> None:
    here = os.pathsep.join([str(Path(__file__).parent), str(PACKAGE.parent.parent)])
    run(PLAIN, tmp_path, PYTHONPATH=here, NUMBA_DISABLE_JIT="1")
    plain, fast = np.load(tmp_path / "plain.npz"), rollout()
    assert set(plain) == set(fast)
    for name, array in fast.items():
        np.testing.assert_allclose(array, plain[name], rtol=1e-12, atol=1e-12, err_msg=name)
