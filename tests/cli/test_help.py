"""What the command teaches: help pages that show at every width, examples that work, names that the shell completes."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from search_files import search_file
from tiny_runs import TINY, Done, copy_of_finished, tiny, tiny_arguments, train_in_this_process

from marl_encircle import cli
from marl_encircle.cli import machine, tensorboard
from marl_encircle.experiments import config, grid
from marl_encircle.experiments.train import train
from marl_encircle.study import calibrate
from marl_encircle.study.figures import write

Run = Callable[..., Done]
ROOT = Path(__file__).parents[2]
SLOW_IMPORTS = {"torch", "numba", "scipy", "stable_baselines3", "supersuit", "matplotlib", "ray"}


# help


@pytest.mark.parametrize("columns", [80, 100])
@pytest.mark.parametrize("name", ["", "config", *cli.EXAMPLES])
def test_every_help_page_fits_and_cuts_no_name(
    run: Run, monkeypatch: pytest.MonkeyPatch, name: str, columns: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    page = run(*name.split(), "--help")
    assert page.code == 0
    assert max(map(len, page.out.splitlines())) <= columns
    assert "…" not in page.out
    if name in cli.EXAMPLES:
        assert f"marl-encircle {name} {cli.EXAMPLES[name][0][:20]}".rstrip() in page.out


def test_the_commands_stand_in_the_order_in_which_they_were_added(run: Run) -> None:
    listing = run("--help").out
    places = [listing.index(f"│ {name} ") for name in cli.EXAMPLES if " " not in name and name != "bench"]
    assert places == sorted(places)
    assert {name for name in cli.EXAMPLES if f"│ {name.split()[0]} " not in listing} == set()


def test_help_and_completion_wait_for_nothing_slow() -> None:
    code = f"""
import sys
from marl_encircle.cli import app
from typer.testing import CliRunner
for arguments in (["--help"], ["--version"], ["train", "--help"], ["config", "show", "--help"]):
    assert CliRunner().invoke(app, arguments).exit_code == 0
print(sorted({SLOW_IMPORTS} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_a_wrong_configuration_is_refused_before_anything_slow_is_imported(tmp_path: Path) -> None:
    slow = SLOW_IMPORTS - {"numba", "scipy"} | {"scipy.stats"}  # the rules of the world are kernels
    (tmp_path / "my.yaml").write_text("seeds: nobody\n")
    code = f"""
import sys
from marl_encircle.cli import main
for line in (
    "train --reward our", "train --scenario nowhere", "train --set training.n_worlds=0", "config show --pursuers 0",
    "sweep comitted", "sweep my.yaml", "tables --grid my.yaml", "figures --grid my.yaml", "report --grid my.yaml",
    "verify-results --grid my.yaml", "tune my.yaml", "calibrate my.yaml", "reproduce-tables --grid my.yaml",
    "config validate my.yaml --kind grid", "config validate nowhere", "config diff our my.yaml",
):
    sys.argv = ["marl-encircle", *line.split()]
    try:
        main()
    except SystemExit as ended:
        assert ended.code == 2, line
    assert not {slow} & set(sys.modules), line
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert done.stderr.count("error: ") == 16


def test_one_thread_is_all_that_torch_gets(tmp_path: Path) -> None:
    code = (
        "import torch\nfrom marl_encircle.cli import configs\nopen('threads', 'w').write(str(torch.get_num_threads()))"
    )
    (tmp_path / "sitecustomize.py").write_text("import atexit\natexit.register(lambda: exec(" + repr(code) + "))")
    path = f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    environment = {**os.environ, "PYTHONPATH": path}
    environment.pop("OMP_NUM_THREADS")
    subprocess.run(
        [sys.executable, "-m", "marl_encircle", "config", "show"],
        cwd=tmp_path, env=environment, capture_output=True, check=True,
    )  # fmt: skip
    assert (tmp_path / "threads").read_text() == "1"


def test_the_help_of_train_says_what_can_be_set_and_how_a_training_is_shortened(run: Run) -> None:
    page = " ".join(run("train", "--help").out.replace("│", " ").split())
    assert f"Sections: {', '.join(config.Config.model_fields)}; keys: marl-encircle config show." in page
    assert "--set training.world_steps=20000" in page


# examples


@pytest.fixture(scope="module")
def example_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs that the examples are about."""
    folder = tmp_path_factory.mktemp("runs")
    copy_of_finished(folder)
    train(tiny("model_b"), 0, "native", folder)
    return folder


@pytest.fixture
def checkout(run: Run, monkeypatch: pytest.MonkeyPatch, example_runs: Path) -> Run:
    """The command in a folder like a checkout, where trainings are tiny."""
    Path("ablations").symlink_to(ROOT / "ablations")
    for results in ("results", "trial"):
        shutil.copytree(example_runs, f"{results}/runs")
    monkeypatch.setattr(grid, "load_config", load_tiny)
    train_in_this_process(monkeypatch)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    return run


def load_tiny(*arguments: Any, overrides: Sequence[str], **more: Any) -> config.Config:
    return config.load_config(*arguments, overrides=[*TINY, *overrides], **more)


def long_calibration(*_: object) -> None:
    Path("results/calibration").mkdir()
    Path("results/calibration/sensitivity.md").write_text("the table")


@pytest.mark.parametrize("example", [f"{name} {line}" for name, lines in cli.EXAMPLES.items() for line in lines])
def test_every_example_works(checkout: Run, monkeypatch: pytest.MonkeyPatch, example: str) -> None:
    monkeypatch.setattr(calibrate, "calibrate", long_calibration)
    monkeypatch.setattr(write, "write_figures", lambda *_: ["results/figures/figure1.svg"])
    monkeypatch.setattr(tensorboard, "_serve", lambda *_: 0)
    monkeypatch.setattr(machine, "subprocess", SimpleNamespace(run=lambda *_, **__: SimpleNamespace(returncode=0)))
    arguments = shlex.split(example.replace("--grid study", "--grid smoke").replace("sweep study", "sweep smoke"))
    if arguments[0] == "tune":
        pytest.importorskip("optuna")
        search_file(Path.cwd()).rename("my_search.yaml")
        arguments += ["--trials", "1"]
    if arguments[0] == "train":
        arguments += tiny_arguments()
    if arguments[0] == "export" and "--to" not in arguments:
        pytest.importorskip("onnxscript")
    if arguments[0] == "play-with":
        arguments += ["--world-steps", "200", "--episodes", "5"]
    if arguments[0] in ("tables", "figures", "report", "verify-results"):
        assert checkout("reproduce-tables", "--grid", "smoke").code == 0
    done = checkout(*arguments)
    if example == "watch ours --pursuers 3 --obstacles 1":
        assert "found no display to open a window on" in done.err
        assert "use --save FILE.gif to write a film, or --headless DIR for pictures" in done.err
    else:
        assert done.code == 0, done.err
        assert done.out or arguments[0] in ("bench", "tensorboard")
        assert "already finished" not in done.err
    if "--json" in arguments:
        assert json.loads(done.out)


# completion


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("train --reward m", ["ma2019", "model_a", "model_b", "model_c"]),
        ("train --scenario ", ["centre", "default", "paper"]),
        ("train --algorithm ", ["maddpg", "matd3", "matd3_relative", "matd3_set"]),
        ("train --scene t", ["tunnel"]),
        ("train --engine n", ["native"]),
        ("watch o", ["ours", "ours_plus"]),
        ("watch --versus o", ["ours", "ours_plus"]),
        ("sweep ", ["smoke", "study"]),
        ("tables --grid st", ["study"]),
        ("calibrate ", ["calibration"]),
        ("tune ", ["default"]),
        ("config validate p", ["paper"]),
        ("config diff ours o", ["ours", "ours_plus"]),
        ("train --reward ablations/", []),  # the shell goes on with files
    ],
)
def test_the_shell_completes_names(run: Run, monkeypatch: pytest.MonkeyPatch, words: str, offered: list[str]) -> None:
    line = f"marl-encircle {words}"
    monkeypatch.setenv("_MARL_ENCIRCLE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(f"{line}.".split()) - 1))
    assert run().out.split() == offered


@pytest.mark.parametrize(
    ("shell", "place"),
    [
        ("bash", ".bash_completions/marl-encircle.sh"),
        ("zsh", ".zfunc/_marl-encircle"),
        ("fish", ".config/fish/completions/marl-encircle.fish"),
    ],
)
def test_completion_is_installed_for_every_shell(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, shell: str, place: str
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")  # the parent of this process is none
    assert run("--install-completion", shell).code == 0
    assert "_MARL_ENCIRCLE_COMPLETE" in (tmp_path / place).read_text()


def test_bash_takes_the_completion_that_is_installed(tmp_path: Path) -> None:
    bin_folder = Path(sys.executable).parent
    script = """
    eval "$(_MARL_ENCIRCLE_COMPLETE=source_bash marl-encircle)"
    COMP_WORDS=(marl-encircle train --reward model_) COMP_CWORD=3
    _marl_encircle_completion marl-encircle
    echo "${COMPREPLY[@]}"
    """
    environment = {"PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}", "HOME": str(tmp_path)}
    done = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "model_a model_b model_c\n"
