"""Progress bars that move while nothing is counted, so that who watches sees that the program works."""

import threading
from collections.abc import Callable
from typing import Any

from tqdm import tqdm

SECONDS = 1.0, 5.0  # between two ticks: on a terminal, and in a file, where each stays


class Bar(tqdm):
    """`tqdm` whose elapsed time goes on while nothing is counted.

    Args:
        doing: words for what goes on in the meantime, such as compilation; "" for nothing.
    """

    def __init__(self, *arguments: Any, doing: Callable[[], str] = str, **named: Any) -> None:
        self._doing, self._said, self._ended = doing, "", threading.Event()
        super().__init__(*arguments, **named)
        if not self.disable:
            threading.Thread(target=self._tick, name="progress bar", daemon=True).start()

    def _tick(self) -> None:
        is_terminal = getattr(self.fp, "isatty", bool)()
        while not self._ended.wait(SECONDS[not is_terminal]):
            words = self._doing()
            if words or self.postfix == self._said:  # what another said in the meantime stays
                self.set_postfix_str(words, refresh=False)
            self._said = words
            self.refresh()

    def close(self) -> None:
        self._ended.set()
        super().close()
