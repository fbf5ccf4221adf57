"""Compare runs that were trained again with those in results/, and keep what was found in results/trained_again.csv.

marl-encircle sweep study --out FOLDER
python docs/trained_again.py FOLDER
"""

import csv
import io
import sys
from pathlib import Path
from typing import Any

from marl_encircle import files
from marl_encircle.experiments.records import RECORD, read_record, run_folders

RESULTS = Path(__file__).parents[1] / "results"
FOUND = RESULTS / "trained_again.csv"


def main() -> None:
    """Compare the runs of the folder that is named, and say how many are the same."""
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    rows = {row["run"]: row for row in read()}
    rows |= {row["run"]: row for row in compare(Path(sys.argv[1]))}
    if not rows:
        raise SystemExit(f"no run in {sys.argv[1]} has ended and has one of its name in {RESULTS / 'runs'}")
    text = io.StringIO()
    writer = csv.DictWriter(text, list(next(iter(rows.values()))), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows[run] for run in sorted(rows))
    files.write_text(FOUND, text.getvalue())
    sys.stdout.write(f"runs={len(rows)} same={sum(row['same'] == 'True' for row in rows.values())}\n")


def read() -> list[dict[str, str]]:
    """Return what was found until now, a row for each run."""
    return list(csv.DictReader(FOUND.read_text().splitlines())) if FOUND.exists() else []


def compare(folder: Path) -> list[dict[str, str]]:
    """Return a row for each run in a folder that has ended, and has one of its name in ``results/runs``."""
    rows = []
    for path in run_folders(folder):
        run = path.relative_to(folder)
        if (path / RECORD).exists() and (RESULTS / "runs" / run / RECORD).exists():
            rows.append(_row(run, read_record(path), read_record(RESULTS / "runs" / run)))
    return rows


def _row(run: Path, again: dict[str, Any], recorded: dict[str, Any]) -> dict[str, str]:
    """Compare two records: policy, learning curve, and the rounds that both played, byte for byte."""
    same = all(recorded["sha256"].get(name) == value for name, value in again["sha256"].items())
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
