"""A window in which rounds are played, stopped, stepped through and looked at layer by layer."""

from collections.abc import Callable
from typing import Any, NamedTuple

from marl_encircle.drawing.palette import BACKGROUND, FAINT, GROOVE, INK, LINE, PAPER
from marl_encircle.drawing.pen import SUPERSAMPLING, draw_bar, pygame, write
from marl_encircle.drawing.render import EVERYTHING, check_display, open_window
from marl_encircle.drawing.view import Layers
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.replays.film import LAST, large_drawing
from marl_encircle.replays.watch import Match

BAR = 44
"""Height of the bar below a drawing [pixels]."""

SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Of the wanted steps per second."""

REFRESH = 60
"""How often a window looks for keys [1 / s]."""

NO_DISPLAY = "use --save FILE.gif to write a film, or --headless DIR for pictures; both need none"


class Key(NamedTuple):
    """What a key does."""

    codes: tuple[int, ...]
    label: str
    meaning: str
    action: Callable[["Player"], None]


class Player:
    """Which moment of which round is shown, and how it goes on.

    :param match: whose rounds
    :param number: of the first round
    :param fps: steps per second
    :param layers: shown at first
    """

    def __init__(self, match: Match, number: int = 0, fps: float = 6.0, layers: Layers = EVERYTHING) -> None:
        self.match, self.number, self.layers = match, number, layers
        self.step, self.playing, self.help, self.over = 0, True, False, False
        self.speed = SPEEDS.index(1.0)
        self.fps = fps
        self._waited = 0.0

    @property
    def length(self) -> int:
        """Number of steps of the present round."""
        return self.match.length(self.number)

    def handle(self, event: Any) -> bool:
        """Take in a pygame event; return whether it may have changed anything."""
        if event.type == pygame.QUIT:
            self.over = True
        elif event.type == pygame.KEYDOWN:
            for key in KEYS:
                if event.key in key.codes:
                    key.action(self)
        return event.type in (pygame.QUIT, pygame.KEYDOWN, pygame.WINDOWSIZECHANGED, pygame.WINDOWEXPOSED)

    def advance(self, seconds: float) -> bool:
        """Let time go by; return whether another moment is shown.

        The next round follows when the last step has stood for a while.
        """
        if not self.playing:
            return False
        self._waited += seconds
        pause = 1 / (self.fps * SPEEDS[self.speed])
        if self._waited < (pause if self.step < self.length else max(pause, LAST)):
            return False
        if self.step < self.length:
            self._go_to(self.step + 1)
        else:
            self._go_to_round(self.number + 1)
        return True

    def toggle_pause(self) -> None:
        """Stop or go on; from the end of a round, from its start."""
        self.playing = not self.playing
        if self.playing and self.step == self.length:
            self._go_to(0)

    def skip(self, steps: int) -> None:
        """Stop, so many steps further on (or back)."""
        self.playing = False
        self._go_to(self.step + steps)

    def seek(self, share: float) -> None:
        """Stop at a share of the round, 0 to 1."""
        self.playing = False
        self._go_to(round(share * self.length))

    def change_speed(self, by: int) -> None:
        """Play faster or slower, within bounds."""
        self.speed = min(max(self.speed + by, 0), len(SPEEDS) - 1)

    def change_round(self, by: int) -> None:
        """Go to the next or the former round, and play it."""
        self.playing = True
        self._go_to_round(max(self.number + by, 0))

    def toggle_layer(self, name: str) -> None:
        """Show or hide a layer."""
        self.layers = self.layers._replace(**{name: not getattr(self.layers, name)})

    def toggle_help(self) -> None:
        """Show or hide what the keys do."""
        self.help = not self.help

    def stop(self) -> None:
        """Close the window."""
        self.over = True

    def frame(self, tall: bool = False) -> Any:
        """Return what the window shows, as a pygame surface ``SUPERSAMPLING`` times as large as it is meant to be.

        :param tall: for a window that is higher than wide
        """
        scene = large_drawing(self.match, self.number, self.step, self.layers, tall)
        width, height = scene.get_size()
        frame = pygame.Surface((width, height + BAR * SUPERSAMPLING))
        frame.blit(scene, (0, 0))
        frame.blit(self._bar(width // SUPERSAMPLING), (0, height))
        if self.help:
            overlay = _help(self.layers)
            frame.blit(overlay, ((width - overlay.get_width()) // 2, (height - overlay.get_height()) // 2))
        return frame

    def _go_to(self, step: int) -> None:
        self.step, self._waited = min(max(step, 0), self.length), 0.0

    def _go_to_round(self, number: int) -> None:
        self.number = number
        self._go_to(0)

    def _bar(self, width: int) -> Any:
        """Draw what is played: state, round, where in it, speed."""
        large = pygame.Surface((width * SUPERSAMPLING, BAR * SUPERSAMPLING))
        large.fill(BACKGROUND)
        pygame.draw.line(large, LINE, (0, 0), (large.get_width(), 0), SUPERSAMPLING)
        middle = large.get_height() / 2
        left, right = timeline(width)
        self._draw_state((24 * SUPERSAMPLING, middle), large)
        write(large, f"round {self.number}", (44 * SUPERSAMPLING, middle), 12, INK, bold=True)
        area = (left * SUPERSAMPLING, middle - 4 * SUPERSAMPLING)
        size = ((right - left) * SUPERSAMPLING, 8 * SUPERSAMPLING)
        share = self.step / self.length
        pygame.draw.rect(large, LINE, (*area, *size), border_radius=4 * SUPERSAMPLING)
        draw_bar(large, (*area, share * size[0], size[1]), 1.0, INK)
        pygame.draw.circle(large, INK, (area[0] + share * size[0], middle), 8 * SUPERSAMPLING)
        pygame.draw.circle(large, PAPER, (area[0] + share * size[0], middle), 4 * SUPERSAMPLING)
        speed = f"{self.fps * SPEEDS[self.speed]:g} steps/s"
        write(large, speed, ((width - 84) * SUPERSAMPLING, middle), 12, INK, 1.0)
        write(large, "h  help", ((width - 22) * SUPERSAMPLING, middle), 12, FAINT, 1.0)
        return large

    def _draw_state(self, place: tuple[float, float], surface: Any) -> None:
        x, y = place
        unit = SUPERSAMPLING
        if self.playing:
            pygame.draw.polygon(
                surface, INK, [(x - 5 * unit, y - 7 * unit), (x - 5 * unit, y + 7 * unit), (x + 7 * unit, y)]
            )
        else:
            for offset in (-6, 1):
                pygame.draw.rect(surface, INK, (x + offset * unit, y - 7 * unit, 4 * unit, 14 * unit))


KEYS: tuple[Key, ...] = (
    Key((pygame.K_SPACE,), "space", "pause, go on", Player.toggle_pause),
    Key((pygame.K_RIGHT,), "→", "one step on", lambda player: player.skip(1)),
    Key((pygame.K_LEFT,), "←", "one step back", lambda player: player.skip(-1)),
    Key((pygame.K_HOME,), "home", "first step", lambda player: player.seek(0.0)),
    Key((pygame.K_END,), "end", "last step", lambda player: player.seek(1.0)),
    Key((pygame.K_PLUS, pygame.K_EQUALS, pygame.K_KP_PLUS), "+", "faster", lambda player: player.change_speed(1)),
    Key((pygame.K_MINUS, pygame.K_KP_MINUS), "-", "slower", lambda player: player.change_speed(-1)),
    Key((pygame.K_n,), "n", "next round", lambda player: player.change_round(1)),
    Key((pygame.K_p,), "p", "previous round", lambda player: player.change_round(-1)),
    Key((pygame.K_a,), "a", "Apollonius circles", lambda player: player.toggle_layer("circles")),
    Key((pygame.K_c,), "c", "contributing angles", lambda player: player.toggle_layer("angles")),
    Key((pygame.K_r,), "r", "enclosed area R_m", lambda player: player.toggle_layer("area")),
    Key((pygame.K_t,), "t", "trails", lambda player: player.toggle_layer("trails")),
    Key((pygame.K_z,), "z", "lens", lambda player: player.toggle_layer("lens")),
    Key((pygame.K_h,), "h", "this help", Player.toggle_help),
    Key((pygame.K_q, pygame.K_ESCAPE), "q", "quit, as esc", Player.stop),
)
"""Every key of the window, in the order of the help."""

_LAYER_KEYS = {"a": "circles", "c": "angles", "r": "area", "t": "trails", "z": "lens"}


def timeline(width: int) -> tuple[int, int]:
    """Return where the bar's line of steps starts and ends in a window of this width [pixels]."""
    return 130, width - 190


def _help(layers: Layers) -> Any:
    """Draw what the keys do, and which layers are on."""
    width, row, top = 330, 25, 52
    height = top + row * len(KEYS) + 14
    large = pygame.Surface((width * SUPERSAMPLING, height * SUPERSAMPLING))
    large.fill(PAPER)
    pygame.draw.rect(large, INK, large.get_rect(), 2 * SUPERSAMPLING)
    write(large, "Keys", (24 * SUPERSAMPLING, 28 * SUPERSAMPLING), 16, INK, bold=True)
    for number, key in enumerate(KEYS):
        y = (top + row * (number + 0.5)) * SUPERSAMPLING
        cap = pygame.Rect(24 * SUPERSAMPLING, y - 10 * SUPERSAMPLING, 54 * SUPERSAMPLING, 20 * SUPERSAMPLING)
        pygame.draw.rect(large, GROOVE, cap, border_radius=5 * SUPERSAMPLING)
        write(large, key.label, cap.center, 12, INK, 0.5, bold=True)
        write(large, key.meaning, (94 * SUPERSAMPLING, y), 13, INK)
        if key.label in _LAYER_KEYS:
            state = "on" if getattr(layers, _LAYER_KEYS[key.label]) else "off"
            write(large, state, ((width - 24) * SUPERSAMPLING, y), 13, INK if state == "on" else FAINT, 1.0)
    return large


def check_window() -> None:
    """Raise a ConfigError unless a window can be opened, before anything is played."""
    try:
        check_display(NO_DISPLAY)
    except RuntimeError as error:
        raise ConfigError(str(error)) from error


def show(player: Player) -> None:
    """Open a window and play until it is closed.

    :raises ConfigError: if there is no display
    """
    size = _size(player.frame())
    try:
        screen = open_window("marl-encircle watch", size, NO_DISPLAY, resizable=True)
    except RuntimeError as error:
        raise ConfigError(str(error)) from error
    clock, changed = pygame.time.Clock(), True
    try:
        while not player.over:
            if changed:
                frame = player.frame(tall=screen.get_height() > screen.get_width())
                _show_frame(screen, frame)
            seconds = clock.tick(REFRESH) / 1000
            changed = player.advance(seconds)
            for event in pygame.event.get():
                changed |= _handle(player, event, screen, _size(frame))
    finally:
        pygame.display.quit()


def _handle(player: Player, event: Any, screen: Any, size: tuple[int, int]) -> bool:
    """Take in an event of the window, whose mouse may draw the line of steps along.

    :param size: of what is shown, see :func:`_size`
    """
    pressed = event.type == pygame.MOUSEBUTTONDOWN and event.button == 1
    if pressed or (event.type == pygame.MOUSEMOTION and event.buttons[0]):
        left, top, width, height = _placed(size, screen.get_size())
        x, y = (event.pos[0] - left) * size[0] / width, (event.pos[1] - top) * size[1] / height
        if y >= size[1] - BAR:
            start, end = timeline(size[0])
            player.seek(min(max((x - start) / (end - start), 0.0), 1.0))
            return True
        return False
    return player.handle(event)


def _size(frame: Any) -> tuple[int, int]:
    """Return width and height that a frame is meant to have [pixels]."""
    width, height = frame.get_size()
    return width // SUPERSAMPLING, height // SUPERSAMPLING


def _placed(size: tuple[int, int], window: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, width and height of a frame that is made as large as a window allows."""
    share = min(window[0] / size[0], window[1] / size[1])
    width, height = max(round(share * size[0]), 1), max(round(share * size[1]), 1)
    return (window[0] - width) // 2, (window[1] - height) // 2, width, height


def _show_frame(screen: Any, frame: Any) -> None:
    left, top, width, height = _placed(frame.get_size(), screen.get_size())
    screen.fill(PAPER)
    screen.blit(pygame.transform.smoothscale(frame, (width, height)), (left, top))
    pygame.display.flip()
