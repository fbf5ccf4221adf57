"""The report in a real browser: one of the tests of ``make test-browser``.

``SCREENSHOTS=folder`` keeps pictures of the page.
"""

from __future__ import annotations  # Playwright may be missing, which the fixture 'browser' tells

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from packed_rounds import unpacked

from marl_encircle import files
from marl_encircle.experiments.grid import load_grid
from marl_encircle.study.report.write import report

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

RUNS = Path(__file__).parents[2] / "results" / "runs"
DESK, PHONE = (1280, 900), (360, 740)


@pytest.fixture(scope="session")
def report_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "report.html"
    files.write_text(path, report(load_grid("study"), RUNS))
    return path


class Opened:
    """The report, opened; whatever it complains of or asks for is kept."""

    def __init__(self, browser: Browser, path: Path, size: tuple[int, int], scheme: str) -> None:
        width, height = size
        self.name = f"{width}-{scheme}"
        self.context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)  # type: ignore[arg-type]  # light or dark
        self.page: Page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("canvas")

    def part(self, name: str) -> Locator:
        return self.page.locator(f'[data-part="{name}"]')

    def step(self) -> int:
        return int(self.part("scrub").input_value())

    def last(self) -> int:
        return int(self.part("scrub").get_attribute("max") or -1)

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait ten seconds at most; Playwright's own waiting needs eval, which the page forbids."""
        for _ in range(1000):
            if condition():
                return
            self.page.wait_for_timeout(10)
        pytest.fail("waited in vain")

    def picture(self, number: int = 0) -> str:
        """What is on a canvas."""
        picture: str = self.page.locator("canvas").nth(number).evaluate("canvas => canvas.toDataURL()")
        return picture

    def options(self, name: str) -> list[str]:
        return self.part(name).locator("option:not([disabled])").all_text_contents()

    def names(self) -> list[str]:
        return self.page.locator('[data-view="name"]').all_text_contents()

    def overflow(self) -> int:
        """Pixels by which the page is wider than the window."""
        overflow: int = self.page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
        return overflow

    def keep(self, name: str, full: bool = False) -> None:
        """Keep a picture where SCREENSHOTS asks for it."""
        folder = os.environ.get("SCREENSHOTS")
        if folder:
            self.page.screenshot(path=str(Path(folder) / f"{name}-{self.name}.png"), full_page=full)


@pytest.fixture
def opened(browser: Browser, report_file: Path, request: pytest.FixtureRequest) -> Iterator[Opened]:
    """The report at a size in a theme; afterwards it must have complained of nothing and asked for nothing else."""
    size, scheme = getattr(request, "param", (DESK, "light"))
    report = Opened(browser, report_file, size, scheme)
    yield report
    report.context.close()
    assert report.complaints == []
    assert report.requests == [report_file.as_uri()]


EVERYWHERE = pytest.mark.parametrize(
    "opened",
    [(size, scheme) for size in (DESK, PHONE, (320, 600)) for scheme in ("light", "dark")],
    indirect=True,
    ids=lambda value: f"{value[0][0]}-{value[1]}",
)


@EVERYWHERE
def test_it_opens_without_a_complaint_and_fits_the_width(opened: Opened) -> None:
    opened.keep("report", full=True)
    assert opened.overflow() <= 0
    opened.part("other").select_option(index=1)
    opened.page.locator("summary").first.click()
    assert opened.overflow() <= 0
    assert opened.page.title() == "Encircling a faster target: report"
    assert opened.page.locator("h1").count() == 1


@EVERYWHERE
def test_letters_stand_out_from_their_ground(opened: Opened) -> None:
    """WCAG's contrast, at least 4.5 to 1, of every element that has words of its own."""
    poor = opened.page.evaluate(
        """() => {
          const canvas = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
          const rgb = (colour, under) => {
            canvas.fillStyle = under; canvas.fillRect(0, 0, 1, 1);
            canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
            return [...canvas.getImageData(0, 0, 1, 1).data].slice(0, 3);
          };
          const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
          const light = (c) => c.map((v) => linear(v / 255))
            .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
          const ground = (e) => {
            for (let at = e; at; at = at.parentElement) {
              const colour = getComputedStyle(at).backgroundColor;
              if (colour !== "rgba(0, 0, 0, 0)") return colour;
            }
            return "white";
          };
          return [...document.querySelectorAll("body *")]
            .filter((e) => e.checkVisibility() && !e.closest("template, script"))
            .filter((e) => [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim()))
            .map((e) => {
              const style = getComputedStyle(e), under = ground(e);
              const ink = e instanceof SVGElement ? style.fill : style.color;
              const [a, b] = [light(rgb(ink, under)), light(rgb(under, under))].sort((x, y) => y - x);
              return [e.tagName, e.textContent.trim().slice(0, 30), (a + 0.05) / (b + 0.05)];
            }).filter(([, , contrast]) => contrast < 4.5);
        }"""
    )
    assert poor == []


def test_play_goes_to_the_end_and_stops_there(opened: Opened) -> None:
    assert opened.step() == opened.last() > 3, "it opens with the moment that decides"
    end = opened.picture()
    opened.part("speed").select_option("4")
    opened.part("play").click()
    assert opened.part("play").get_attribute("aria-label") == "Pause"
    opened.until(lambda: 0 < opened.step() < opened.last())
    assert opened.picture() != end
    opened.until(lambda: opened.part("play").get_attribute("aria-label") == "Play")
    assert (opened.step(), opened.picture()) == (opened.last(), end)
    opened.page.wait_for_timeout(300)
    assert opened.step() == opened.last()


def test_a_faster_speed_takes_less_time(opened: Opened) -> None:
    taken = []
    for speed in ("1", "4"):
        opened.part("speed").select_option(speed)
        taken.append(
            opened.page.evaluate(
                """() => new Promise((done) => {
                  const play = document.querySelector("[data-part=play]"), start = performance.now();
                  new MutationObserver((_, watch) => {
                    if (play.ariaLabel === "Play") { watch.disconnect(); done(performance.now() - start); }
                  }).observe(play, { attributes: true });
                  play.click();
                })"""
            )
        )
    assert taken[0] > 2 * taken[1]


def test_scrubbing_and_the_buttons_show_that_step(opened: Opened) -> None:
    opened.part("scrub").fill("3")
    assert opened.part("count").text_content() == f"3 / {opened.last()}"
    third = opened.picture()
    opened.page.get_by_label("One step on").click()
    assert (opened.step(), opened.picture() != third) == (4, True)
    opened.page.get_by_label("One step back").click()
    assert (opened.step(), opened.picture()) == (3, third)
    opened.page.get_by_label("To the start").click()
    assert opened.step() == 0
    opened.page.get_by_label("To the end").click()
    assert opened.step() == opened.last()


def test_method_setting_and_round_change_what_is_shown(opened: Opened) -> None:
    for choice in ("method", "round", "setting"):
        for text in opened.options(choice)[:3]:
            before, chosen = opened.picture(), opened.part(choice).evaluate("s => s.selectedOptions[0].textContent")
            opened.part(choice).select_option(label=text)
            assert (opened.picture() != before) == (text != chosen)
            assert opened.names() == [opened.part("method").evaluate("s => s.selectedOptions[0].textContent")]
            length = re.search(r": (\d+) steps", opened.part("round").evaluate("s => s.selectedOptions[0].textContent"))
            assert opened.last() == int(length[1] if length else 60)
    for setting in opened.options("setting"):
        opened.part("setting").select_option(label=setting)
        for method in opened.options("method"):
            opened.part("method").select_option(label=method)
            assert opened.names() == [method]


@pytest.mark.parametrize("name", ["circles", "ring", "area", "trails", "closeUp"])
def test_every_overlay_is_drawn_only_while_it_is_chosen(opened: Opened, name: str) -> None:
    before, box = opened.picture(), opened.page.locator(f'[data-show="{name}"]')
    box.click()
    assert opened.picture() != before
    box.click()
    assert opened.picture() == before


@pytest.mark.parametrize("opened", [(DESK, "light"), (PHONE, "dark")], indirect=True, ids=["desk", "phone"])
def test_two_methods_play_the_same_round_side_by_side(opened: Opened) -> None:
    opened.part("other").select_option(label="Ma")
    assert opened.names() == ["Ours", "Ma"]
    first, second = (opened.page.locator("canvas").nth(i).bounding_box() or {} for i in (0, 1))
    assert (first["y"], first["width"]) == (second["y"], second["width"])
    assert first["x"] + first["width"] < second["x"]
    opened.keep("compared")
    for rule in ("area", "ring"):  # each method's own closure rule is drawn, which may differ from the start
        opened.page.locator(f'[data-show="{rule}"]').click()
    opened.part("stage").focus()
    opened.page.keyboard.press("Home")
    assert opened.picture(0) == opened.picture(1), "the same places at the start"
    opened.page.keyboard.press("End")
    assert opened.picture(0) != opened.picture(1)
    opened.part("other").select_option(label="nobody")
    assert opened.names() == ["Ours"]


def test_the_keyboard_is_enough(opened: Opened) -> None:
    press = opened.page.keyboard.press
    for _ in range(30):
        press("Tab")
        outline = opened.page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline not in ("none", "hidden"), "what has the focus can be seen"
        if opened.page.evaluate("document.activeElement.dataset.part") == "stage":
            break
    else:
        pytest.fail("Tab does not reach the stage")
    press("Home")
    assert opened.step() == 0
    press("ArrowRight")
    press("ArrowRight")
    press("ArrowLeft")
    assert opened.step() == 1
    press("Space")
    opened.until(lambda: opened.step() > 2)
    press("Space")
    halted = opened.step()
    opened.page.wait_for_timeout(400)
    assert opened.step() == halted
    assert opened.part("status").text_content() == f"Ours: step {halted} of {opened.last()}, open."
    press("End")
    assert opened.step() == opened.last()
    # Space on a box ticks it, arrows on a choice choose: they are not the player's there.
    box = opened.page.locator('[data-show="trails"]')
    box.focus()
    press("Space")
    assert (box.is_checked(), opened.part("play").get_attribute("aria-label")) == (False, "Play")
    opened.part("round").focus()
    press("ArrowRight")
    assert (opened.part("round").evaluate("s => s.selectedIndex"), opened.step()) == (1, opened.last())


def test_every_control_has_a_name(opened: Opened) -> None:
    nameless = opened.page.evaluate(
        """() => [...document.querySelectorAll("button, select, input, canvas, [tabindex]")]
          .filter((e) => !(e.ariaLabel || e.getAttribute("aria-labelledby") || e.labels?.length))
          .map((e) => e.outerHTML)"""
    )
    assert nameless == []


def test_the_page_decodes_what_was_packed(opened: Opened) -> None:
    decoded: list[dict[str, Any]] = opened.page.evaluate(
        """() => {
          const data = JSON.parse(document.getElementById("rounds").textContent);
          return data.cells.map((cell) => {
            if (!cell.rounds.length) return null;
            const { world } = cell, round = decodeRound(cell.rounds[1], world, data.units);
            const reach = (moment) => moment.reach.map((value) => (Number.isFinite(value) ? value : -1));
            const moments = round.moments.map((moment) => ({ ...moment, reach: reach(moment) }));
            return { round: cell.rounds[1], world, units: data.units, discs: round.discs, moments };
          });
        }"""
    )
    compared = 0
    for each in filter(None, decoded):
        wanted = unpacked(each["round"], each["world"], each["units"])
        wanted["reach"][np.isinf(wanted["reach"])] = -1
        assert len(each["moments"]) == each["round"]["moments"]
        np.testing.assert_allclose(np.reshape(each["discs"], (-1, 3)), wanted.pop("discs"), atol=1e-9)
        for name, values in wanted.items():
            np.testing.assert_allclose([moment[name] for moment in each["moments"]], values, atol=1e-9)
        compared += 1
    assert compared > 3


def test_nothing_can_be_fetched_or_slipped_in(browser: Browser, report_file: Path) -> None:
    opened = Opened(browser, report_file, DESK, "light")
    refused = opened.page.evaluate("fetch('https://example.org/').then(() => 'fetched', () => 'refused')")
    opened.page.evaluate(
        "document.body.append(Object.assign(document.createElement('script'), {text: 'window.bad = 1'}))"
    )
    assert (refused, opened.page.evaluate("window.bad")) == ("refused", None)
    assert len(opened.complaints) >= 2
    assert all("Content Security Policy" in text or "Fetch API" in text for text in opened.complaints)
    assert opened.requests == [report_file.as_uri()]
    opened.context.close()
