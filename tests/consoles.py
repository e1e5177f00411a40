"""A real console in memory, on a terminal or as a file: what a verb says there, and a stop once it says something."""

import io

from rich.console import Console as Terminal

from rtcd_jax.system.console import Console


class Stopped(BaseException):
    """Ends a verb as a kill would: nothing catches it."""


class Output(io.StringIO):
    """What a verb printed into a file."""

    @property
    def console(self) -> Console:
        return Console(self)

    @property
    def lines(self) -> list[str]:
        return self.getvalue().splitlines()


class Screen(io.StringIO):
    """What a terminal was sent. `stop` is the text at which the writer is stopped."""

    def __init__(self, stop: str | None = None):
        super().__init__()
        self._stop = stop

    def write(self, text: str) -> int:
        if self._stop and self._stop in text:
            self._stop = None
            raise Stopped
        return super().write(text)

    @property
    def console(self) -> Console:
        """One that takes this for a wide terminal, and draws its live line."""
        return Console(terminal=Terminal(file=self, force_terminal=True, width=400, color_system=None))

    @property
    def text(self) -> str:
        return self.getvalue()
