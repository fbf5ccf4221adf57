"""One run: train it, evaluate it, export it."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_encircle.cli.completion import scenes
from marl_encircle.cli.options import (
    OUTPUT,
    Algorithm,
    AsJson,
    Obstacles,
    Out,
    ProfileOption,
    Pursuers,
    Quiet,
    RewardOption,
    ScenarioOption,
    Scene,
    Set,
    SpeedRatio,
    given,
    read_config,
    setting_option,
)
from marl_encircle.cli.printing import print_pairs
from marl_encircle.experiments.choices import Engine, ExportFormat
from marl_encircle.experiments.yaml_files import ConfigError

if TYPE_CHECKING:
    from marl_encircle.experiments.metrics import RunSummary
    from marl_encircle.experiments.tensorboard import Draw

RunFolder = Annotated[Path, typer.Argument(help="A finished run folder, as train prints it.")]


def train_command(
    ctx: typer.Context,
    reward: RewardOption = "ours",
    algorithm: Algorithm = "maddpg",
    seed: Annotated[int, typer.Option(metavar="SEED", help="Training seed.")] = 0,
    scenario: ScenarioOption = "default",
    speed_ratio: SpeedRatio = None,
    pursuers: Pursuers = None,
    obstacles: Obstacles = None,
    scene: Scene = None,
    profile: ProfileOption = "full",
    engine: Annotated[Engine, typer.Option(help="native: fast; supersuit: the reference. Equal results.")] = "native",
    overrides: Set = None,
    checkpoint_every: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            metavar="SECONDS",
            help="Seconds between checkpoints.",
            show_default="so that they take 2 % of the time",
        ),
    ] = None,
    out: Out = Path("results/runs"),
    tensorboard: Annotated[
        bool,
        typer.Option(
            rich_help_panel=OUTPUT, help="Write event files into the run folder; pictures need the extra render."
        ),
    ] = True,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Train one run, evaluate it, and print its folder; an interrupted run resumes where it stopped.

    A shorter training: --set training.world_steps=20000.
    """
    if ctx.args:
        raise ConfigError(f"unexpected argument {ctx.args[0]:.80}; did you mean --reward {ctx.args[0]:.80}?")
    config = read_config(
        reward,
        algorithm=algorithm,
        scenario=scenario,
        profile=profile,
        overrides=overrides,
        speed_ratio=speed_ratio,
        pursuers=pursuers,
        obstacles=obstacles,
        scene=scene,
    )
    from marl_encircle.experiments.records import read_record
    from marl_encircle.experiments.train import train

    folder, worked = train(
        config,
        seed,
        engine,
        out,
        checkpoint_every=checkpoint_every,
        progress_bar=not quiet,
        tensorboard=tensorboard,
        draw=_thumbnails(quiet) if tensorboard else None,
    )
    record = read_record(folder)
    diverged = record["status"] == "diverged"
    if not worked:
        typer.echo("already finished", err=True)
    if diverged:
        typer.echo("diverged: the run is kept and counted as diverged; try another seed or configuration", err=True)
    elif not (quiet or as_json):
        _print_rounds(folder, record)
    typer.echo(json.dumps(_outcome(folder, record)) if as_json else str(folder))
    if diverged:
        raise typer.Exit(1)


def _thumbnails(quiet: bool) -> "Draw | None":
    """Return how rounds are drawn for TensorBoard; None, and one note, where they cannot be."""
    try:
        from marl_encircle.replays.thumbnails import thumbnails
    except ImportError:
        if not quiet:
            typer.echo("no pictures of rounds in the event files: pip install 'marl-encircle[render]'", err=True)
        return None
    return thumbnails


def _print_rounds(folder: Path, record: dict[str, Any]) -> None:
    """Say beside the output, which scripts read the folder from, how the evaluation rounds of a run ended."""
    own = _summary(folder, record)
    if own is None:
        return
    low, high = own.success_interval
    line = f"success {100 * own.success:.1f} % [{100 * low:.1f}, {100 * high:.1f}] of {own.rounds} rounds"
    if own.mean_episode_length is not None:
        line += f"; mean length of the successful ones: {own.mean_episode_length:.1f} steps"
    typer.echo(line, err=True)


def _outcome(folder: Path, record: dict[str, Any]) -> dict[str, Any]:
    """Return what became of a run; one that diverged has no rounds, and so no success."""
    own = _summary(folder, record)
    return {
        "folder": str(folder),
        "status": record["status"],
        "success": own and own.success,
        "mean_episode_length": own and own.mean_episode_length,
        "world_steps": record.get("world_steps"),
        "cpu_seconds": record.get("cpu_seconds"),
    }


def _summary(folder: Path, record: dict[str, Any]) -> "RunSummary | None":
    """Return how the rounds of a run ended under its method's own closure rule; None without any."""
    from marl_encircle.experiments.metrics import summarise_run
    from marl_encircle.experiments.records import episodes_name, read_episodes

    if episodes_name() not in record["sha256"]:
        return None
    return summarise_run(read_episodes(folder, record), record["config"]["reward"]["closure"])


def evaluate(
    run_dir: RunFolder,
    episodes: Annotated[
        int | None,
        typer.Option(
            "--episodes",
            "--rounds",
            min=1,
            max=10**6,
            metavar="N",
            help="Rounds to play.",
            show_default="as the run's configuration",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, metavar="SEED", help="Evaluation seed.", show_default="that of the run's configuration"),
    ] = None,
    speed_ratio: Annotated[
        float | None, setting_option("LAMBDA", "Target speed / pursuer speed to play at.", "the run's")
    ] = None,
    pursuers: Annotated[int | None, setting_option("N", "Number of pursuers to play with.", "the run's")] = None,
    obstacles: Annotated[int | None, setting_option("M", "Number of obstacles to play with.", "the run's")] = None,
    scene: Annotated[
        str | None, setting_option("SCENE", "Play in this scene: random, concave or tunnel.", "the run's", scenes)
    ] = None,
    write: Annotated[
        bool,
        typer.Option(
            "--write",
            rich_help_panel=OUTPUT,
            help="Replace the episodes.csv of a finished run; only with the default rounds and setting.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Play rounds with a trained policy, noise off, and print how they ended.

    It plays in the run's own setting unless told otherwise. Any policy plays at other speed ratios and in other scenes,
    with other numbers of pursuers and obstacles only those whose features are sets.

    Printed are method, setting, train_seed and eval_seed; episodes: how many rounds; closure: the method's own rule,
    all bodies or the pursuers alone; success: the share of the rounds that end enclosed by it, with its 95 % interval
    from success_low to success_high; mean_episode_length: the mean length of those rounds alone in steps, the paper's
    MEL; success_all and success_pursuers: the same share by either rule; sigma_c: how unequally the pursuers
    contribute, in radians; policy_sha256: the hash of the weights.
    """
    _check_there(run_dir)
    from marl_encircle.experiments.evaluate import play_rounds
    from marl_encircle.experiments.loading import folder_of, load_run
    from marl_encircle.experiments.metrics import summarise_run
    from marl_encircle.experiments.records import POLICY
    from marl_encircle.experiments.train import write_episodes

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
    trained = config.cell.setting
    setting = trained._replace(**given(speed_ratio=speed_ratio, pursuers=pursuers, obstacles=obstacles, scene=scene))
    if write and setting != trained:
        raise ConfigError("--write needs the setting of the run's configuration")
    if record["status"] == "diverged":
        typer.echo("warning: this run diverged; its policy is the last one of its training", err=True)
    rounds = play_rounds(policy, config, episodes, seed, setting)
    closure = config.reward.closure
    own = summarise_run(rounds, closure)
    result = {
        "method": config.reward.name,
        **setting._asdict(),
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
        "policy_sha256": record["sha256"][POLICY],
    }
    if write:
        write_episodes(folder_of(run_dir), rounds)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        print_pairs(result)


def _check_there(run_dir: Path) -> None:
    if not run_dir.exists():
        name = "results/runs/METHOD/ratio<lambda>_n<n>_m<m>_<scene>/seed<s>"
        raise ConfigError(f"{run_dir}: no such run folder; give what train printed: {name}")


def export(
    run_dir: RunFolder,
    to: Annotated[
        ExportFormat,
        typer.Option(
            metavar="FORMAT",
            help="onnx; torchscript, which torch has deprecated; or torch-export, which it reads in its place.",
        ),
    ] = "onnx",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            rich_help_panel=OUTPUT,
            help="The file.",
            show_default="<method>_<setting>_seed<s>.onnx, .pt or .pt2",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write the actors of a run as one file that is used without this package.

    It maps observations (worlds, agents, numbers) to actions, and says whose they are in its metadata. On 1,000 random
    observations and on those of 16 rounds it must act as the policy does, to 1e-5; else there is no file, and exit
    code 1.
    """
    _check_there(run_dir)
    from marl_encircle.experiments.export import export_run

    done = export_run(run_dir, to, out)
    differences = {"difference_random": done.random, "difference_played": done.played}
    if done.description["status"] == "diverged":
        typer.echo("warning: this run diverged; its policy is the last one of its training", err=True)
    if as_json:
        typer.echo(json.dumps({"file": str(done.path), **differences, **done.description}))
    else:
        typer.echo(f"largest difference from predict: {done.random:.1e} random, {done.played:.1e} played", err=True)
        typer.echo(str(done.path))
