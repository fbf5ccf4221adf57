"""Soak tests: ``make soak``; each prints the promise that it holds, its figure, and the command that shows it.

They are not part of ``make test``. All of them together take at most 40 minutes on two cores.
"""

from collections.abc import Callable, Iterator

import pytest

PROMISE = "promise"

Promise = Callable[..., None]


@pytest.fixture
def promise(record_property: Callable[[str, object], None], request: pytest.FixtureRequest) -> Promise:
    """Note a figure, to be printed whatever becomes of the test: what is promised, the figure, the one needed.

    Call it before the assertion: a promise that is broken is shown with its figure. The command is that of the test
    itself unless another one is named.
    """

    def note(text: str, figure: object, needed: object, command: str = f"pytest {request.node.nodeid}") -> None:
        # a report's properties come from any worker
        record_property(PROMISE, f"{text}: {figure} (needed {needed}) | {command}")

    return note


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [report for outcome in ("passed", "failed") for report in terminalreporter.stats.get(outcome, [])]
    lines = list(_lines(reports))
    if lines:
        terminalreporter.section("promises")
        for line in lines:
            terminalreporter.write_line(line)


def _lines(reports: list[pytest.TestReport]) -> Iterator[str]:
    for report in sorted(reports, key=lambda report: report.nodeid):
        if report.when == "call":
            broken = "BROKEN " if report.failed else ""
            yield from (f"{broken}{text}" for name, text in report.user_properties if name == PROMISE)
