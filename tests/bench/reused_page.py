"""A live page that serves several tests, each as another run, and whose server is restarted."""

from robins.bench.live import LivePage
from robins.bench.live.history import SampleHistory


class ReusedPage(LivePage):
    """A page whose server shows one run after the other, which saves its start in each test."""

    def next_run(self) -> None:
        """Begin the next run: plots and events are cleared, as of another bench at this port."""
        self.run += 1
        self._sequence = 0
        for old in (self._recent, self._samples, self._lines, self._commands):
            old.clear()
        self._history, self._before = SampleHistory(len(self._signals)), b""
        self._events.kept.clear()
        self._last_status = self._status = None
        self._hello = self._make_hello()
        self._pump()

    def restart(self) -> None:
        """End the server, start it again as `poll` does, and wait until it listens."""
        self._end(kill=True)
        self.restarts += 1
        self._start()
        self._wait_until_it_listens()
