"""Change the code in one place, run the tests that should notice, count who does: ``python tools/mutation.py``.

Mutants are cosmic-ray's (the extra ``mutation``). A seeded sample of them covers every module of ``MODULES``; each runs
against the test files that mirror its module, the kernels as plain Python, in a copy of the checkout. Left out is what
says nothing: mutants of annotations and bits of floats, which any run notices, and those that take ``@kernel`` away,
which changes nothing where nothing is compiled.

Results go to ``.cache/mutation/results.jsonl``. A second run goes on from there; what was found with other sources or
tests of a module is not used again. Exit code 0: enough were noticed; 1: too few, a module without mutants, or not all
were run in time; 2: the work could not be done, for example where tests fail on the code as it is.
"""

import argparse
import ast
import hashlib
import json
import math
import os
import random
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / ".cache" / "mutation" / "results.jsonl"
LEAST_SCORE = 0.85

EXPERIMENTS = ("config", "faults", "memory", "overrides", "sections", "sizes", "trainable", "yaml_files")
MODULES = (
    *(f"core/{path.name}" for path in sorted((ROOT / "marl_encircle" / "core").glob("[a-z]*.py"))),
    *(f"maddpg/{path.name}" for path in sorted((ROOT / "marl_encircle" / "maddpg").glob("[a-z]*.py"))),
    *(f"experiments/{name}.py" for name in EXPERIMENTS),
    "files.py",
)
TESTS = {
    "maddpg/agents.py": ("maddpg/test_maddpg.py",),
    "maddpg/arguments.py": ("maddpg/test_maddpg.py",),
    "maddpg/maddpg.py": ("maddpg/test_maddpg.py",),
    "maddpg/matd3.py": ("maddpg/test_maddpg.py",),
    "maddpg/models.py": ("maddpg/test_networks.py", "maddpg/test_gradients.py", "maddpg/test_maddpg.py"),
    "maddpg/policies.py": ("maddpg/test_networks.py", "maddpg/test_maddpg.py"),
    "maddpg/rollouts.py": ("maddpg/test_maddpg.py",),
    "maddpg/saving.py": ("maddpg/test_saving.py", "maddpg/test_maddpg.py"),
    "experiments/config.py": ("experiments/test_config.py", "experiments/test_features.py"),
    "experiments/faults.py": ("experiments/test_faults.py", "experiments/test_config.py"),
    "experiments/overrides.py": ("experiments/test_config.py",),
    "experiments/sections.py": ("experiments/test_config.py", "experiments/test_refusals.py"),
    "experiments/sizes.py": ("experiments/test_config.py", "experiments/test_features.py"),
    "experiments/yaml_files.py": ("experiments/test_yaml_files.py", "experiments/test_config.py"),
}
"""Where other files than ``tests/<folder>/test_<name>.py`` are those that should notice."""

COMPILED = ("core/compilation.py",)
"""All else is tested as plain Python, without the trainings that take longest: what is sharp notices before them."""

ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
"""Without byte code: two mutants of one size within a second would pass for one file."""

SENSELESS = re.compile(
    r"core/ReplaceBinaryOperator_(Add|Sub|Mul|Div|FloorDiv|Mod|Pow)_(RShift|LShift|BitOr|BitAnd|BitXor)"
)
"""Floats have no bits: such a mutant does not run."""


FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
"""A line of pytest's summary."""

WAITING = 30
"""So many times that may pass on the clock, on a busy machine: a mutant that waits for ever uses no processor time."""


class WorkError(Exception):
    """The work could not be done, so that nothing is known."""


class Mutant(NamedTuple):
    """One change of one module, as cosmic-ray counts them."""

    module: str
    operator: str
    arguments: str
    occurrence: int


class Result(NamedTuple):
    """What the tests made of a mutant.

    :param sources: hash of the module and its tests
    :param noticed_by: the test that failed; empty if none did, or none before the limit of time
    :param seconds: processor time [s]
    """

    mutant: Mutant
    sources: str
    killed: bool
    diff: str
    noticed_by: str
    seconds: float


def main() -> int:
    """Test a sample of mutants and report; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--mutants", type=int, default=330, help="at least so many in all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--jobs", type=int, default=2, help="copies that are worked on at a time")
    parser.add_argument("--minutes", type=float, default=60.0, help="start no more after that")
    parser.add_argument("modules", nargs="*", default=MODULES, metavar="MODULE", help="core/geometry.py; default: all")
    options = parser.parse_args()
    deadline = time.monotonic() + 60 * options.minutes
    try:
        found = {module: mutants_of(module) for module in options.modules}
        wanted = sample(found, options.mutants, options.seed)
        results = test_all(wanted, options.jobs, deadline)
    except (WorkError, OSError, subprocess.SubprocessError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return report(found, wanted, results)


def mutants_of(module: str) -> list[Mutant]:
    """Return all mutants of a module that its tests could notice."""
    from cosmic_ray.commands import init
    from cosmic_ray.work_db import use_db

    path = ROOT / "marl_encircle" / module
    text = path.read_text(encoding="utf-8")
    deaf = list(annotations(ast.parse(text)))
    with tempfile.TemporaryDirectory() as folder, use_db(str(Path(folder, "work.sqlite"))) as database:
        init([path], database, {})
        mutations = [item.mutations[0] for item in database.work_items]
    return sorted(
        Mutant(module, m.operator_name, json.dumps(m.operator_args), m.occurrence)
        for m in mutations
        if not SENSELESS.fullmatch(m.operator_name)
        and not any(start <= m.start_pos < end for start, end in deaf)
        and not (m.operator_name == "core/RemoveDecorator" and text.splitlines()[m.start_pos[0] - 1] == "@kernel")
    )


def annotations(tree: ast.AST) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield where annotations begin and end: (line, column) each."""
    for node in ast.walk(tree):
        for field in ("annotation", "returns"):
            part = getattr(node, field, None)
            if part is not None:
                yield (part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)


def sample(found: dict[str, list[Mutant]], total: int, seed: int) -> list[Mutant]:
    """Return ``total`` mutants or some more: of each module in proportion to those it has, and a few at least."""
    everything = sum(map(len, found.values()))
    few = max(1, total // (4 * len(found)))
    chosen: list[Mutant] = []
    for module, mutants in found.items():
        share = max(few, -(-total * len(mutants) // max(1, everything)))
        chosen += random.Random(f"{seed} {module}").sample(mutants, min(share, len(mutants)))
    return chosen


def test_all(wanted: Sequence[Mutant], jobs: int, deadline: float) -> dict[Mutant, Result]:
    """Return the result of each mutant, from former runs where sources and tests are the same."""
    sources = {module: hash_of(module) for module in {mutant.module for mutant in wanted}}
    known = {r.mutant: r for r in former_results() if sources.get(r.mutant.module) == r.sources}
    todo = [mutant for mutant in wanted if mutant not in known]
    if not todo:
        return known
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copies = [copy_checkout(Path(folder, str(job))) for job in range(jobs)]
        context = get_context("spawn")
        queue = context.SimpleQueue()
        for copy in copies:
            queue.put(copy)
        with ProcessPoolExecutor(jobs, context, _move_into, (queue,)) as pool, RESULTS.open("a") as log:
            modules = sorted({mutant.module for mutant in todo})
            limits = dict(zip(modules, pool.map(limit_of, modules), strict=True))
            futures = [pool.submit(test, m, sources[m.module], limits[m.module], deadline) for m in todo]
            for count, future in enumerate(as_completed(futures), 1):
                result = future.result()
                if result is None:
                    continue
                known[result.mutant] = result
                log.write(json.dumps([*result.mutant, *result[1:]]) + "\n")
                log.flush()
                verdict = f"killed by {result.noticed_by or 'time'}" if result.killed else "SURVIVED"
                print(f"{count}/{len(todo)} {result.mutant.module} {result.mutant.operator} {verdict}", flush=True)
    return known


def copy_checkout(copy: Path) -> Path:
    """Copy the files that git knows, without the results, and return the folder."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in listed.split("\0"):
        source = ROOT / name
        if name and not name.startswith("results/") and source.is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, copy / name)
    return copy


def _move_into(queue: Any) -> None:
    """Work in a copy of one's own from now on, and never in the checkout."""
    copy: Path = queue.get()
    os.chdir(copy)
    # Others' pytests would clear the same temporary folders away at the same time.
    own = {"PYTHONPATH": str(copy), "MARL_ENCIRCLE_CACHE": str(copy / ".cache"), "PYTEST_DEBUG_TEMPROOT": str(copy)}
    os.environ.update(ENVIRONMENT | own)
    code = "import marl_encircle; print(marl_encircle.__file__)"
    used = subprocess.run([sys.executable, "-c", code], cwd="/", check=True, capture_output=True, text=True).stdout
    if not Path(used.strip()).is_relative_to(copy):
        raise WorkError(f"the tests would run on {used.strip()}, not on the copy {copy}")


def tests_of(module: str) -> list[str]:
    """Return the test files that should notice a change of a module."""
    path = Path(module)
    own = path.with_name(f"test_{path.name}")
    return [f"tests/{name}" for name in TESTS.get(module, (own,))]


def command_of(module: str, limit: int | None = None) -> list[str]:
    """Return the command that runs a module's tests up to the first failure.

    :param limit: processor time [s] after which a process of it is killed; unlike a clock it knows of no busy machine
    """
    options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--tb=line", "--durations=0"]
    plain = f"NUMBA_DISABLE_JIT={int(module not in COMPILED)}"
    options += [] if module in COMPILED else ["-m", "not slow"]
    limited = [] if limit is None else ["sh", "-c", f'ulimit -t {limit} && exec "$0" "$@"']
    return ["env", plain, *limited, sys.executable, "-m", "pytest", *options, *tests_of(module)]


def limit_of(module: str) -> int:
    """Return how much processor time [s] a module's tests may take: thrice what they take on the code as it is.

    :raises WorkError: if they fail there
    """
    started = processor_time()
    done = subprocess.run(command_of(module), capture_output=True, text=True, check=False)
    if done.returncode:
        raise WorkError(f"the tests of {module} fail on the code as it is:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    seconds = processor_time() - started
    print(f"{module}: its tests take {seconds:.1f} s of processor time", flush=True)
    return 10 + math.ceil(3 * seconds)


def processor_time() -> float:
    """Return what the programs that this process started and saw end have taken [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test(mutant: Mutant, sources: str, limit: int, deadline: float) -> Result | None:
    """Return what the tests make of a mutant, None if it is too late to begin."""
    from cosmic_ray.mutating import mutate_and_test
    from cosmic_ray.work_item import MutationSpec, TestOutcome

    if time.monotonic() > deadline:
        return None
    path = Path("marl_encircle", mutant.module)
    spec = MutationSpec(path, mutant.operator, mutant.occurrence, (1, 0), (1, 1), json.loads(mutant.arguments))
    started = processor_time()
    done = mutate_and_test([spec], shlex.join(command_of(mutant.module, limit)), timeout=WAITING * limit)
    if done.diff is None:
        raise WorkError(f"{mutant} could not be made: {done.output}")
    failed = FAILED.search(done.output)
    noticed_by = failed.group(1) if failed else ""
    killed = done.test_outcome != TestOutcome.SURVIVED
    return Result(mutant, sources, killed, done.diff, noticed_by, round(processor_time() - started, 1))


def hash_of(module: str) -> str:
    """Return the hash of a module and its tests."""
    digest = hashlib.sha256()
    for name in (f"marl_encircle/{module}", *tests_of(module)):
        digest.update((ROOT / name).read_bytes())
    return digest.hexdigest()[:16]


def former_results() -> Iterator[Result]:
    """Yield the results of former runs."""
    if RESULTS.exists():
        for line in RESULTS.read_text(encoding="utf-8").splitlines():
            values = json.loads(line)
            yield Result(Mutant(*values[:4]), *values[4:])


def report(found: dict[str, list[Mutant]], wanted: Sequence[Mutant], results: dict[Mutant, Result]) -> int:
    """Print what no test noticed and figures by module; return the exit code."""
    tested = [results[mutant] for mutant in wanted if mutant in results]
    for result in tested:
        if not result.noticed_by:
            what = "killed by time alone" if result.killed else "survived"
            print(f"\n{what}: {result.mutant.module}, {result.mutant.operator} {result.mutant.occurrence}")
            print(result.diff)
    print(f"\n{'module':<28} {'all':>6} {'tested':>7} {'killed':>7} {'by time':>8} {'survived':>9} {'minutes':>8}")
    for module, mutants in found.items():
        print_row(module, len(mutants), [result for result in tested if result.mutant.module == module])
    print_row("total", sum(map(len, found.values())), tested)
    score = sum(result.killed for result in tested) / len(tested) if tested else 0.0
    print(f"score: {score:.1%}; at least {LEAST_SCORE:.0%} is wanted")
    empty = [module for module in found if not any(result.mutant.module == module for result in tested)]
    missing = len(wanted) - len(tested)
    for module in empty:
        print(f"error: no mutant of {module} was tested", file=sys.stderr)
    if missing:
        print(f"error: {missing} mutants were not tested in time; run again to go on", file=sys.stderr)
    return 1 if empty or missing or score < LEAST_SCORE else 0


def print_row(name: str, number: int, tested: Sequence[Result]) -> None:
    """Print how many mutants there are, were tested, killed, killed by time alone, survived; and the processor time."""
    killed, minutes = sum(result.killed for result in tested), sum(result.seconds for result in tested) / 60
    by_time = sum(result.killed and not result.noticed_by for result in tested)
    print(f"{name:<28} {number:>6} {len(tested):>7} {killed:>7} {by_time:>8} {len(tested) - killed:>9} {minutes:>8.1f}")


if __name__ == "__main__":
    sys.exit(main())
