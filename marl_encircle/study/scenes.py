"""What the policies are worth in scenes that they were never trained in."""

from collections.abc import Iterable, Sequence

from marl_encircle.experiments.records import Cell, Run
from marl_encircle.study.cells import gather, result_of, run_elsewhere
from marl_encircle.study.paper import by_method, label
from marl_encircle.study.paper_layout import notes_on, success_and_length
from marl_encircle.study.tables import record_of
from marl_encircle.study.typeset import Table, Text, markdown, to_csv

SCENE_TABLES = ("table_scenes.md", "table_scenes.csv")

_TITLE = "The same policies in scenes that they were not trained in"
_NOTES: list[Text] = [
    "Cells: S [95 % interval] / MEL of the same policies in each scene; they were trained in the first one.",
    "A policy sees where an obstacle's centre is, not its shape.",
]


def render_scenes(runs: Iterable[Run], notes: Sequence[str] = ()) -> dict[str, str]:
    """Return ``table_scenes.md`` and ``.csv`` -> text; nothing where no policy was played in another scene.

    :param runs: those that were played in no other scene are passed over
    :param notes: further ones
    """
    played: list[Run] = []
    for run in runs:
        others = [other for other in run.elsewhere if other.scene != run.cell.setting.scene]
        if others:
            played += [run, *(run_elsewhere(run, other) for other in others)]
    if not played:
        return {}
    results = {cell: result_of(cell, found) for cell, found in gather(played, {}).items()}
    trained = {run.cell for run in played if run.elsewhere}
    scenes = dict.fromkeys(run.cell.setting.scene for run in played)
    rows: list[list[Text]] = []
    for method, setting in by_method(trained):
        cells = [Cell(method, setting._replace(scene=scene)) for scene in scenes]
        shown = [success_and_length(results[cell]) if cell in results else "" for cell in cells]
        rows.append([label(method), *setting.numbers, *shown])
    header, more = ["Method", "λ", "n", "m", *scenes], [*_NOTES, *notes_on(results.values()), *notes]
    texts = (
        markdown(Table("table_scenes", _TITLE, header, rows, more)),
        to_csv([record_of(result, None) for result in results.values()]),
    )
    return dict(zip(SCENE_TABLES, texts, strict=True))
