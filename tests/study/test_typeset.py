"""Tables as text: what LaTeX reads is balanced, of equal columns and escaped."""

import re

import pytest
from made_up import finished

from marl_encircle.experiments.records import Setting
from marl_encircle.study.tables import MethodOptions, freeze_notes, render_table1, render_tables
from marl_encircle.study.typeset import Styled, Table, latex, markdown, to_csv

HEADER = ["Method", "λ = 1.1", "n = 2"]


def latex_rows(text: str) -> list[list[str]]:
    """Cells of each row between the rules."""
    rows = [line.strip().removesuffix(r" \\") for line in text.splitlines() if line.endswith(r" \\")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)&", row)] for row in rows]


def assert_sound(text: str) -> None:
    """Check what LaTeX would stumble over."""
    open_environments: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if kind == "begin":
            open_environments.append(name)
        else:
            assert open_environments.pop() == name
    assert not open_environments
    code = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    bare = re.sub(r"\\[#$%&_{}]", "", code)
    assert bare.count("{") == bare.count("}")
    [columns] = re.findall(r"\\begin\{tabular\}\{@\{\}(l?c*)@\{\}\}", text)
    rows = latex_rows(text)
    assert rows
    assert {len(row) for row in rows} == {len(columns)}
    # what is left of the special signs: the tabular's own & and, in pairs, the dollars
    assert not re.search(r"[%#~^]", bare)
    assert all(line.count("$") % 2 == 0 for line in bare.splitlines())
    assert "_" not in re.sub(r"\\label\{[^}]*\}", "", bare)
    assert bare.count("&") == len(rows) * (len(columns) - 1)
    assert bare.isascii()


def test_every_latex_table_is_sound() -> None:
    runs = [finished(method, Setting(1.1, 3, 1), seed, 90) for method in ("ours", "my_method") for seed in (0, 1)]
    runs += [finished("ma2019", Setting(1.2, 3, 1), 0, 0, closure="pursuers")]
    rendered = render_tables(runs, notes=freeze_notes("0123456789abcdef" * 2 + "01234567"))
    rendered |= render_table1({"ours": MethodOptions(True, True, False)})
    texts = {name: text for name, text in rendered.items() if name.endswith(".tex")}
    assert sorted(texts) == [f"table{number}.tex" for number in (1, 2, 3, 4)]
    for name, text in texts.items():
        assert_sound(text)
        assert rf"\label{{tab:{name.removesuffix('.tex')}}}" in text
        for rule in ("toprule", "midrule", "bottomrule"):
            assert text.count(rf"\{rule}") == 1


def test_symbols_are_mathematics_and_signs_are_escaped() -> None:
    rows = [["my_method", "95 % & {more}", "–"], ["#1", "~^", r"a\b $"]]  # noqa: RUF001
    text = latex(Table("x", "At λ = 1.1, n = 3", HEADER, rows, []))
    assert_sound(text)
    assert r"\caption{At $\lambda = 1.1$, $n = 3$}" in text
    assert latex_rows(text) == [
        ["Method", r"$\lambda = 1.1$", "$n = 2$"],
        [r"my\_method", r"95 \% \& \{more\}", "--"],
        [r"\#1", r"\textasciitilde{}\textasciicircum{}", r"a\textbackslash{}b \$"],
    ]


def test_styles_are_marked_in_both_languages() -> None:
    rows = [["Ours", (Styled("99.3", "bold"), " / 16.5")], [Styled("paper", "italic"), "x"], ["Ma", "y"]]
    assert markdown(Table("t", "T", ["a", "b"], rows, [("see ", Styled("paper", "italic"))])).splitlines() == [
        "# T", "", "| a | b |", "| --- | --- |", "| Ours | **99.3** / 16.5 |", "| *paper* | x |", "| Ma | y |", "",
        "- see *paper*",
    ]  # fmt: skip
    lines = [line.strip() for line in latex(Table("t", "T", ["a", "b"], rows, [])).splitlines()]
    start = lines.index(r"\midrule")
    assert lines[start + 1 : start + 5] == [
        r"Ours & \textbf{99.3} / 16.5 \\", r"\textit{paper} & x \\", r"\addlinespace", r"Ma & y \\",
    ]  # fmt: skip


def test_rows_are_only_set_apart_where_some_belong_together() -> None:
    assert "addlinespace" not in latex(Table("t", "T", ["a", "b"], [["Ours", "x"], ["Ma", "y"]], []))


def test_tables_of_unequal_records_are_refused() -> None:
    assert to_csv([{"a": "1", "b": "x,y"}]) == 'a,b\n1,"x,y"\n'
    with pytest.raises(ValueError, match="fields not in fieldnames"):
        to_csv([{"a": "1"}, {"a": "1", "b": "2"}])
