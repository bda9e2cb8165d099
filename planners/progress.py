"""Progress of a solver on the terminal: a live table, or a few plain lines where the output is not a terminal.

Everything goes to stderr, so that what a command prints on stdout stays readable by programs.
"""

import math
import time
from collections import deque

from rich.console import Console, Group
from rich.live import Live as RichLive
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

ROWS = 10  # iterations that the table keeps in sight
PLAIN_SECONDS = 5.0  # between two plain lines


class Live:
    """Shows what a solver is doing; a context manager.

    Args:
        title: What is being solved.
        seeds: Number of starting points.
        show: False prints nothing at all.
        iterations: Largest number of iterations; it bounds the estimate of the time left.
        tolerance: Feasibility at which the solver stops; with it the time left is extrapolated.
        console: A rich console instead of stderr.
    """

    def __init__(self, title: str, seeds: int = 1, *, show=True, iterations=None, tolerance=None, console=None):
        self.title, self.seeds, self.show = title, seeds, show
        self.limit, self.tolerance = iterations, tolerance
        self.console = console or Console(stderr=True, highlight=False)
        self.compile_s = 0.0
        """Seconds spent under `compiling` so far."""
        self._rows, self._lines, self._pace = deque(maxlen=ROWS), [], deque(maxlen=ROWS)
        self._stage = self._live = self._unsaid = None
        self._start = self._said = time.monotonic()

    def __enter__(self):
        self._start = time.monotonic()
        if self.show and self.console.is_terminal:
            self._live = RichLive(get_renderable=self._draw, console=self.console, refresh_per_second=6)
            self._live.__enter__()
        elif self.show:
            self.console.print(self._heading())
        return self

    def __exit__(self, *error):
        self._end_stage()
        if self._live:
            self._live.__exit__(*error)
        elif self._unsaid:
            self._keep(None)

    def compiling(self, what: str) -> None:
        """A compilation starts; it lasts until the next call of any method, or the end."""
        self._end_stage()
        self._stage = (what, time.monotonic())

    def iteration(self, k: int, cost: float, feasibility: float, step: float, seeds_alive: int | None = None) -> None:
        """The state of the best seed after iteration `k`.

        Args:
            k: Number of iterations done.
            cost: Value of the cost.
            feasibility: Largest violation of a constraint, in the solver's units.
            step: Size of the last step, in the solver's units.
            seeds_alive: Seeds that are still improved.
        """
        self._end_stage()
        elapsed = time.monotonic() - self._start
        self._pace.append((k, elapsed, feasibility))
        row = (k, float(cost), float(feasibility), float(step), duration(elapsed), self._left(), seeds_alive)
        self._rows.append(row)
        if self.show and not self._live:
            self._say(row)

    def note(self, text: str) -> None:
        """One sentence that stays on the screen."""
        self._end_stage()
        self._keep(text)

    def _end_stage(self):
        if self._stage:
            what, start = self._stage
            self._stage = None
            seconds = time.monotonic() - start
            self.compile_s += seconds
            self._keep(f"compiling {what}: {seconds:.1f} s")

    def _keep(self, text):
        if self._live:
            self._lines.append(text)
        elif self.show:
            for line in filter(None, (self._unsaid, text)):
                self.console.print(line, soft_wrap=True)
            self._unsaid = None

    def _say(self, row):
        k, cost, feasibility, step, elapsed, left, _ = row
        text = f"iteration {k}: cost {cost:#.6g}, feasibility {feasibility:.1e}, step {step:.1e}, {elapsed}"
        self._unsaid = text
        if len(self._pace) == 1 or time.monotonic() - self._said >= PLAIN_SECONDS:
            self.console.print(text + (f", {left} left" if left != "-" else ""), soft_wrap=True)
            self._said, self._unsaid = time.monotonic(), None

    def _left(self) -> str:
        """Time to the tolerance at the present pace if feasibility falls; else at most to the limit, as "< 9 s"."""
        if len(self._pace) < 3:
            return "-"
        (k0, t0, f0), (k1, t1, f1) = self._pace[0], self._pace[-1]
        most = (t1 - t0) / (k1 - k0) * max(self.limit - k1, 0) if self.limit else math.inf
        if self.tolerance and self.tolerance < f1 < f0:
            guess = (t1 - t0) * math.log(f1 / self.tolerance) / math.log(f0 / f1)
            return duration(min(guess, most))
        return f"< {duration(most)}" if self.limit else "-"

    def _heading(self):
        return self.title + (f" ({self.seeds} seeds)" if self.seeds > 1 else "")

    def _draw(self):
        parts = [Text(self._heading(), style="bold"), *map(Text, self._lines)]
        if self._stage:
            what, start = self._stage
            parts.append(Spinner("line", text=f"compiling {what}: {time.monotonic() - start:.1f} s", style="cyan"))
        return Group(*parts, self._table()) if self._rows else Group(*parts)

    def _table(self):
        table = Table(box=None, padding=(0, 1, 0, 0), header_style="dim")  # 75 columns where all cells are full
        titles = ["iteration", "cost", "feasibility", "step", "elapsed", "time left"]
        for title in titles + (["seeds"] if self.seeds > 1 else []):
            table.add_column(title, justify="right")
        for k, cost, feasibility, step, elapsed, left, alive in self._rows:
            cells = [str(k), f"{cost:#.6g}", f"{feasibility:.1e}", f"{step:.1e}", elapsed, left]
            table.add_row(*cells, *([str(self.seeds if alive is None else alive)] if self.seeds > 1 else []))
        return table


def duration(x: float) -> str:
    """Seconds to read: 0.3 s, 12 s, 3 min 05 s."""
    if x < 10:
        return f"{x:.1f} s"
    whole = round(x)
    return f"{whole} s" if whole < 120 else f"{whole // 60} min {whole % 60:02d} s"
