"""Compare runs that were trained again with those in results/, and keep what was found in results/trained_again.csv.

marl-encircle sweep study --out FOLDER
python docs/trained_again.py FOLDER

What stands in the file stays: neither a difference nor a slow run goes away when somebody trains once more.
"""

import csv
import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from marl_encircle import files
from marl_encircle.experiments.records import CURVE, POLICY, episodes_name, read_record, read_runs, run_path

RESULTS = Path(__file__).parents[1] / "results"
FOUND = RESULTS / "trained_again.csv"
WRITTEN = (POLICY, CURVE, episodes_name())


def main() -> None:
    """Compare the runs of the folder that is named, and say how many are the same."""
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    rows = {row["run"]: row for row in (*compared(Path(sys.argv[1])), *found())}
    if not rows:
        raise SystemExit(f"no run in {sys.argv[1]} has ended and has one of its name in {RESULTS / 'runs'}")
    text = io.StringIO()
    writer = csv.DictWriter(text, list(next(iter(rows.values()))), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows[run] for run in sorted(rows))
    files.write_text(FOUND, text.getvalue())
    sys.stdout.write(f"runs={len(rows)} same={sum(row['same'] == 'True' for row in rows.values())}\n")


def found() -> list[dict[str, str]]:
    """Return what was found until now, a row for each run."""
    return list(csv.DictReader(FOUND.read_text().splitlines())) if FOUND.exists() else []


def compared(folder: Path) -> Iterator[dict[str, str]]:
    """Compare each ended run of a folder with that of its name in ``results/runs``; copies of that are passed over.

    :param folder: the runs, as a sweep writes them
    :return: a row for each
    :raises files.DamagedFileError: for a file that is not what its run wrote, by name
    """
    for run in read_runs(folder):
        path = run_path(run.cell, run.seed)
        if run.status != "unfinished" and (RESULTS / "runs" / path).exists():
            again, recorded = read_record(folder / path), read_record(RESULTS / "runs" / path)
            if again["cpu_seconds"] != recorded["cpu_seconds"]:
                yield _row(path, again, recorded)


def _row(run: Path, again: dict[str, Any], recorded: dict[str, Any]) -> dict[str, str]:
    """Compare two records: configuration, and by their hashes policy, learning curve, rounds and whatever else."""
    names = {*WRITTEN, *again["sha256"]}
    same = all(again["sha256"].get(name) == recorded["sha256"].get(name) for name in names)
    return {
        "run": run.as_posix(),
        "same": str(same and again["config_hash"] == recorded["config_hash"]),
        "recorded_cpu_seconds": f"{recorded['cpu_seconds']:.1f}",
        "cpu_seconds": f"{again['cpu_seconds']:.1f}",
        "cpu": again["cpu"],
        "git_commit": again["git_commit"],
    }


if __name__ == "__main__":
    main()
