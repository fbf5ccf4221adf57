"""The ``marl-encircle`` command.

Exit codes: 0 done, 1 a run failed, 2 wrong configuration or usage, 3 a damaged or unfit file, 128 + n stopped by
signal n.
"""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import torch as th
import typer
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from marl_encircle import files, locks
from marl_encircle.core.simulator import PlacementError
from marl_encircle.envs.view import Layer, Layers
from marl_encircle.experiments.build import Engine, load_run
from marl_encircle.experiments.calibrate import CalibrationError, calibrate, load_protocol
from marl_encircle.experiments.callbacks import Stopped
from marl_encircle.experiments.config import Config, Profile, difference, load_config
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.executors import Executor, LocalExecutor
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.library import PACKAGE, reward_names
from marl_encircle.experiments.live import LiveReport
from marl_encircle.experiments.metrics import summarise_run
from marl_encircle.experiments.ray_executor import RayExecutor
from marl_encircle.experiments.records import read_record
from marl_encircle.experiments.reproduce import reproduce, write_tables
from marl_encircle.experiments.sweep import Progress, sweep
from marl_encircle.experiments.train import train, write_episodes
from marl_encircle.experiments.verify import verify
from marl_encircle.experiments.watch import find_match
from marl_encircle.experiments.yaml_files import ConfigError

app = typer.Typer(
    name="marl-encircle",
    help="Encircle a faster target: train, evaluate and compare, and reproduce Zheng et al. (2023).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
config_app = typer.Typer(no_args_is_help=True, help="Show, compare and check configurations.")
app.add_typer(config_app, name="config")

RewardOption = Annotated[str, typer.Option(help="A method's name, or the path of a YAML file. See 'config show'.")]
ScenarioOption = Annotated[
    str, typer.Option(help="The world's rules: a name such as default, or the path of a YAML file.")
]
# Those that are not given are the scenario's own.
SpeedRatio = Annotated[
    float | None, typer.Option(help="Target speed / pursuer speed.", show_default="the scenario's; 1.1 in default")
]
Pursuers = Annotated[int | None, typer.Option(help="Number of pursuers.", show_default="the scenario's; 3 in default")]
Obstacles = Annotated[
    int | None, typer.Option(help="Number of obstacles.", show_default="the scenario's; 1 in default")
]
Scene = Annotated[
    str | None,
    typer.Option(
        help="What an obstacle looks like: random, concave or tunnel.",
        show_default="the scenario's; random in default",
    ),
]
Algorithm = Annotated[str, typer.Option(help="maddpg, matd3, or the path of a YAML file.")]
ProfileOption = Annotated[Profile, typer.Option(help="full, or smoke for a few seconds.")]
Set = Annotated[list[str] | None, typer.Option("--set", help="Override: section.key=value. May be repeated.")]
Out = Annotated[Path, typer.Option(help="Folder of runs.")]
Results = Annotated[Path, typer.Option(help="Folder of runs/ and tables/.")]
Jobs = Annotated[int, typer.Option(min=1, help="Runs at a time, one processor core each.")]
ExecutorName = Literal["local", "ray"]
ExecutorOption = Annotated[
    ExecutorName,
    typer.Option(
        "--executor", help="local: this machine; ray: a Ray cluster, all of whose nodes see the folder of runs."
    ),
]
Address = Annotated[
    str | None, typer.Option(help="Ray cluster, HOST:PORT. Default: one on this machine alone, on loopback.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bar.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"marl-encircle {version('marl-encircle')}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")] = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Keep what concerns every command."""
    th.set_num_threads(1)  # results are promised per thread count
    os.environ["MARL_ENCIRCLE_DEBUG"] = "1" if debug else ""


@app.command("train")
def train_command(
    reward: RewardOption = "ours",
    speed_ratio: SpeedRatio = None,
    pursuers: Pursuers = None,
    obstacles: Obstacles = None,
    scene: Scene = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Training seed.")] = 0,
    scenario: ScenarioOption = "default",
    algorithm: Algorithm = "maddpg",
    engine: Annotated[Engine, typer.Option(help="native: fast; supersuit: the reference. Equal results.")] = "native",
    profile: ProfileOption = "full",
    overrides: Set = None,
    out: Out = Path("results/runs"),
    checkpoint_every: Annotated[float, typer.Option(min=1.0, help="Seconds between checkpoints.")] = 120.0,
    tensorboard: Annotated[bool, typer.Option(help="Write event files into the run folder.")] = True,
    quiet: Quiet = False,
) -> None:
    """Train one run, evaluate it, and print its folder; an interrupted run resumes where it stopped.

    Example: marl-encircle train --reward ablations/my_idea.yaml --pursuers 4 --set training.world_steps=200000
    """
    config = _config(reward, speed_ratio, pursuers, obstacles, scene, scenario, algorithm, profile, overrides)
    folder, worked = train(
        config,
        seed,
        engine,
        out,
        checkpoint_every=checkpoint_every,
        progress_bar=not quiet,
        tensorboard=tensorboard,
    )
    diverged = read_record(folder).get("status") == "diverged"
    if not worked:
        typer.echo("already finished", err=True)
    if diverged:
        typer.echo("diverged: the run is kept and counted as diverged; try another seed or configuration", err=True)
    typer.echo(str(folder))
    if diverged:
        raise typer.Exit(1)


@app.command()
def evaluate(
    run_dir: Annotated[Path, typer.Argument(help="A finished run folder.")],
    episodes: Annotated[
        int | None, typer.Option(min=1, max=10**6, help="Rounds to play. Default: as many as the run's configuration.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Evaluation seed. Default: that of the run's configuration.")
    ] = None,
    as_json: AsJson = False,
    write: Annotated[
        bool, typer.Option("--write", help="Replace the episodes.csv of a finished run; only with the default rounds.")
    ] = False,
) -> None:
    """Play rounds with a trained policy, noise off, and print how they ended."""
    policy, config, record = load_run(run_dir)
    own_rounds = config.evaluation.episodes, config.evaluation.seed
    episodes = own_rounds[0] if episodes is None else episodes
    seed = own_rounds[1] if seed is None else seed
    if seed == record["seed"]:
        raise ConfigError(f"--seed {seed} is the run's training seed: its policy has seen these worlds; choose another")
    if write and record["status"] != "finished":
        raise ConfigError(f"--write needs a finished run; the status of {run_dir} is {record['status']}")
    if write and (episodes, seed) != own_rounds:
        flags = f"--episodes {own_rounds[0]} --seed {own_rounds[1]}"
        raise ConfigError(f"--write needs the rounds of the run's configuration: {flags}")
    if record["status"] == "diverged":
        typer.echo("warning: this run diverged; its policy is the last one of its training", err=True)
    rounds = play_rounds(policy, config, episodes, seed)
    closure = config.reward.closure
    own = summarise_run(rounds, closure)
    scenario = config.scenario
    result = {
        "method": config.reward.name,
        "speed_ratio": scenario.speed_ratio,
        "pursuers": scenario.pursuers,
        "obstacles": scenario.obstacles,
        "scene": scenario.scene,
        "train_seed": record["seed"],
        "eval_seed": seed,
        "episodes": episodes,
        "closure": closure,
        "success": own.success,
        "success_low": own.success_interval.low,
        "success_high": own.success_interval.high,
        "mean_episode_length": own.mean_episode_length,
        "success_all": summarise_run(rounds, "all").success,
        "success_pursuers": summarise_run(rounds, "pursuers").success,
        "sigma_c": own.sigma_c,
        "policy_sha256": record["sha256"]["policy.safetensors"],
    }
    if write:
        write_episodes(run_dir, rounds)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print_pairs(result)


@app.command()
def watch(
    method: Annotated[
        str, typer.Argument(help="A method's name, a run folder, or with --policy the YAML file of a reward.")
    ] = "ours",
    speed_ratio: Annotated[
        float | None, typer.Option(help="Target speed / pursuer speed of the run.", show_default="1.1")
    ] = None,
    pursuers: Annotated[int | None, typer.Option(help="Number of pursuers of the run.", show_default="3")] = None,
    obstacles: Annotated[int | None, typer.Option(help="Number of obstacles of the run.", show_default="1")] = None,
    scene: Annotated[
        str | None, typer.Option(help="Play in this scene: random, concave or tunnel.", show_default="the run's")
    ] = None,
    policy: Annotated[Path | None, typer.Option(help="A run folder: its policy, under METHOD's reward.")] = None,
    versus: Annotated[str | None, typer.Option(help="Another METHOD beside it, in the same rounds.")] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Evaluation seed of the rounds.", show_default="7000, not reported ones")
    ] = None,
    round_number: Annotated[int, typer.Option("--round", min=0, max=10**6, help="The (first) round.")] = 0,
    save: Annotated[Path | None, typer.Option(help="Write the round as a film, .gif or .mp4; no window.")] = None,
    headless: Annotated[Path | None, typer.Option(help="Write every step as PNG into a folder; no window.")] = None,
    fps: Annotated[float, typer.Option(min=0.5, max=50, help="Steps per second.")] = 6.0,
    hide: Annotated[list[Layer] | None, typer.Option(help="A layer to leave out. May be repeated.")] = None,
    out: Annotated[Path, typer.Option("--results", help="Folder of runs/.")] = Path("results"),
) -> None:
    """Play rounds of a trained policy in a window (h: its keys), or write one as a film or as pictures.

    Example: marl-encircle watch ours --pursuers 3 --obstacles 1 --versus model_b --save round.gif
    """
    try:
        from marl_encircle.experiments import film, player
    except ImportError as error:
        raise ConfigError(str(error)) from error
    if save is not None:
        film.check_film(save)
    if save is None and headless is None:
        player.check_window()
    given = {"speed_ratio": speed_ratio, "pursuers": pursuers, "obstacles": obstacles}
    fields = {name: value for name, value in given.items() if value is not None}
    match = find_match(method, versus, out, fields, scene, policy, seed)
    for note in match.notes():
        typer.echo(note, err=True)
    layers = Layers()._replace(**{layer.value: False for layer in hide or ()})
    if save is not None:
        film.save(save, match, round_number, fps, layers)
        typer.echo(str(save))
    if headless is not None:
        film.save_pictures(headless, match, round_number, layers)
        typer.echo(str(headless))
    if save is None and headless is None:
        player.show(player.Player(match, round_number, fps, layers))


@app.command("sweep")
def sweep_command(
    grid: Annotated[str, typer.Argument(help="committed, smoke, all, or the path of a YAML file.")],
    jobs: Jobs = 1,
    out: Out = Path("results/runs"),
    executor: ExecutorOption = "local",
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Train the missing runs of a grid."""
    wanted, workers = load_grid(grid).jobs, _executor(executor, address)
    with LiveReport() as report:
        progress = sweep(wanted, out, jobs, report, workers)
    if as_json:
        typer.echo(json.dumps(progress.counts))
    else:
        _print_pairs(progress.counts)
    _exit_if_failed(progress)


@app.command("calibrate")
def calibrate_command(
    protocol: Annotated[str, typer.Argument(help="calibration, or the path of a YAML file.")] = "calibration",
    jobs: Jobs = 1,
    out: Annotated[Path, typer.Option(help="Folder of the calibration.")] = Path("results/calibration"),
) -> None:
    """Train the scenarios of a protocol and choose the one that comes nearest to the paper's cells.

    What is missing is trained, so that it can be stopped and started again. OUT gets the runs, the sensitivity table
    and the chosen scenario.
    """
    plan = load_protocol(protocol)
    with LiveReport() as report:
        calibrate(plan, out, jobs, report)
    typer.echo((out / "sensitivity.md").read_text(encoding="utf-8"))
    typer.echo(str(out / "scenario.yaml"))


@app.command()
def tables(
    grid: Annotated[str, typer.Option(help="The grid whose runs are shown.")] = "committed",
    out: Results = Path("results"),
) -> None:
    """Render the tables from the existing runs."""
    for path in write_tables(load_grid(grid), out):
        typer.echo(str(path))


@app.command()
def figures(
    grid: Annotated[str, typer.Option(help="The grid whose runs are shown.")] = "committed",
    out: Results = Path("results"),
) -> None:
    """Draw Figures 1 and 3 to 6 from the runs there are."""
    try:
        from marl_encircle.experiments.figures.write import write_figures
    except ImportError as error:
        raise ConfigError(str(error)) from error
    for path in write_figures(load_grid(grid), out):
        typer.echo(str(path))


@app.command("report")
def report_command(
    grid: Annotated[str, typer.Option(help="The grid whose runs are shown.")] = "committed",
    out: Results = Path("results"),
) -> None:
    """Write report.html: tables, learning curves and a player of rounds, in one file that needs no network."""
    from marl_encircle.experiments.report.write import write_report

    typer.echo(str(write_report(load_grid(grid), out)))


@app.command("reproduce-tables")
def reproduce_tables(
    grid: Annotated[str, typer.Option(help="committed, smoke, all, or the path of a YAML file.")] = "committed",
    out: Results = Path("results"),
    jobs: Jobs = 1,
    executor: ExecutorOption = "local",
    address: Address = None,
) -> None:
    """Train and evaluate what is missing of a grid, and render Tables 1-4 beside the paper's numbers."""
    workers = _executor(executor, address)
    with LiveReport() as report:
        done = reproduce(grid, out, jobs, report, workers)
    for number in (2, 3, 4):
        typer.echo((out / "tables" / f"table{number}.md").read_text(encoding="utf-8"))
    typer.echo(f"trained={done.trained} evaluated={done.evaluated} reused={done.reused}")
    _exit_if_failed(done.sweep)


@app.command("verify-results")
def verify_results(
    grid: Annotated[str, typer.Option(help="The grid whose runs are verified.")] = "committed",
    out: Results = Path("results"),
    quiet: Quiet = False,
) -> None:
    """Play every committed policy's rounds again, render its tables again, and compare. Nothing is written.

    On the processor that a run was made on every round must be equal; elsewhere 99.5 % of the rounds, and every cell's
    S must lie within its 99 % binomial interval. Exit code 3 where that does not hold, and where there is no finished
    run.
    """
    with tqdm(unit="run", disable=quiet) as bar:
        found = verify(load_grid(grid), out, lambda done, total: _advance(bar, done, total))
    check = "every figure of every round" if found.exact else "how the rounds end: another processor than the runs'"
    if not found.rounds:
        typer.echo(f"nothing was verified: {out / 'runs'} has no finished run of the grid {grid}", err=True)
        raise typer.Exit(3)
    typer.echo(f"check: {check}")
    for name in found.changed:
        typer.echo(f"changed: {out / name}")
    typer.echo(f"rounds={found.rounds} equal={found.equal} cells_off={found.cells_off}")
    if not found.passed:
        raise typer.Exit(3)


@app.command()
def bench() -> None:
    """Measure the speed rows and write benchmarks/results.json; needs a checkout."""
    script = PACKAGE.parent / "benchmarks" / "run.py"
    if not script.exists():
        raise ConfigError("bench needs a checkout of the repository; this installation has no benchmarks/run.py")
    raise typer.Exit(subprocess.run([sys.executable, str(script)], check=False).returncode)


@config_app.command("show")
def config_show(
    reward: RewardOption = "ours",
    speed_ratio: SpeedRatio = None,
    pursuers: Pursuers = None,
    obstacles: Obstacles = None,
    scene: Scene = None,
    scenario: ScenarioOption = "default",
    algorithm: Algorithm = "maddpg",
    profile: ProfileOption = "full",
    overrides: Set = None,
    as_json: AsJson = False,
) -> None:
    """Print a resolved configuration; the reward as a table of terms and weights."""
    config = _config(reward, speed_ratio, pursuers, obstacles, scene, scenario, algorithm, profile, overrides)
    values = config.to_dict()
    if as_json:
        typer.echo(json.dumps(values, indent=2))
        return
    console = Console()
    r = config.reward
    console.print(f"{r.name}: closure {r.closure}, {'two stages' if r.two_stage else 'one stage'}, scale {r.scale:g}")
    console.print(_reward_table(config))
    for section in ("scenario", "algorithm", "training", "evaluation"):
        table = Table("key", "value", title=section)
        for key, value in values[section].items():
            table.add_row(key, str(value))
        console.print(table)
    console.print(f"methods: {', '.join(reward_names())}")


@config_app.command("diff")
def config_diff(first: str, second: str, profile: ProfileOption = "full") -> None:
    """Print what differs between two methods."""
    here, there = (load_config(name, profile=profile).to_dict() for name in (first, second))
    for line in difference(here, there, (f"in {first}", f"in {second}")):
        typer.echo(line)


@config_app.command("validate")
def config_validate(path: Annotated[str, typer.Argument(help="A method's name or the path of a YAML file.")]) -> None:
    """Check a method's file: print 'valid', or what is wrong with it (exit code 2)."""
    load_config(path)
    typer.echo("valid")


def _config(
    reward: str,
    speed_ratio: float | None,
    pursuers: int | None,
    obstacles: int | None,
    scene: str | None,
    scenario: str,
    algorithm: str,
    profile: Profile,
    overrides: list[str] | None,
) -> Config:
    given = {"speed_ratio": speed_ratio, "pursuers": pursuers, "obstacles": obstacles, "scene": scene}
    fields = {name: value for name, value in given.items() if value is not None}
    return load_config(
        reward, algorithm=algorithm, profile=profile, scenario=scenario, fields=fields, overrides=overrides or ()
    )


def _reward_table(config: Config) -> Table:
    table = Table("term", "weight", "parameters", title="reward")
    for name, (weight, parameters) in config.reward.build().active.items():
        table.add_row(name, f"{weight:g}", ", ".join(f"{key}={value:g}" for key, value in parameters.items()))
    return table


def _print_pairs(values: dict[str, Any]) -> None:
    width = max(map(len, values))
    for key, value in values.items():
        typer.echo(f"{key:<{width}}  {value:.4f}" if isinstance(value, float) else f"{key:<{width}}  {value}")


def _executor(name: ExecutorName, address: str | None) -> Executor:
    if name == "ray":
        return RayExecutor(address)
    if address is not None:
        raise ConfigError(f"--address {address} needs --executor ray; the executor local has no address")
    return LocalExecutor()


def _advance(bar: Any, done: int, total: int) -> None:
    bar.total = total
    bar.update(done - bar.n)


def _exit_if_failed(progress: Progress) -> None:
    for name in progress.failed:
        typer.echo(f"failed: {name}", err=True)
    if progress.failed:
        raise typer.Exit(1)


def main() -> None:
    """Run the command; errors become one message and an exit code."""
    try:
        app()
    except (ConfigError, PlacementError, locks.FolderLockedError) as error:
        _fail(error, 2)
    except (files.DamagedFileError, locks.UnfitLockError) as error:
        _fail(error, 3)
    except Stopped as stopped:
        _fail(stopped, 128 + stopped.signum)
    except (CalibrationError, OSError) as error:
        _fail(error, 1)


def _fail(error: Exception, code: int) -> None:
    if os.environ.get("MARL_ENCIRCLE_DEBUG"):
        raise error
    typer.echo(f"error: {error}" if not isinstance(error, Stopped) else str(error), err=True)
    raise SystemExit(code)


if __name__ == "__main__":
    main()
