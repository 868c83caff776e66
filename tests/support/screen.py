"""A program at a terminal of a given size, as a person sits there: types, and reads the screen."""

import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import time

import pyte

from tests.support.paths import ROOT

HISTORY = 2000  # lines that have scrolled off the top and can still be read
DEADLINE = 120.0  # nothing that is waited for may take longer, s; far above what it takes
STANDING_S = 0.5
"""A question that stands so long is not wiped away; a live bar refreshes ten times a second."""


class AtTerminal:
    """One command of hilcal in a pseudo-terminal of its own, and what stands on its screen."""

    def __init__(
        self, *arguments, columns=80, lines=30, home=None, paper=None, command=("-m", "hilcal")
    ):
        """Start it, in the directory `home`; on wider paper, lines that are too long show."""
        self.columns = paper or columns
        self._screen = pyte.HistoryScreen(self.columns, lines, history=HISTORY, ratio=1.0)
        self._stream = pyte.ByteStream(self._screen)
        self._silences = []
        self._heard = time.monotonic()
        self._open = True
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        hidden = ("COLUMNS", "LINES", "HILCAL_DEBUG")
        self.process = subprocess.Popen(
            [sys.executable, *command, *map(str, arguments)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=home,
            env={name: value for name, value in os.environ.items() if name not in hidden}
            | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "TERM": "xterm-256color"},
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(slave, termios.TIOCSCTTY, 0),
        )
        os.close(slave)

    # what stands there

    @property
    def page(self):
        """The lines of the screen as it is now, without blanks at their ends."""
        return [line.rstrip() for line in self._screen.display]

    @property
    def lines(self):
        """Everything that still stands, from the first line: scrolled off, and on the screen."""
        above = [
            "".join(row[k].data for k in range(self.columns)).rstrip()
            for row in self._screen.history.top
        ]
        below = self.page
        while below and not below[-1]:
            below.pop()
        return above + below

    @property
    def text(self):
        """All lines as one text; words that a line's end divides are joined by a blank."""
        return " ".join(" ".join(self.lines).split())

    def page_with(self, words):
        """The first line of the screen that has some words; empty where there is none."""
        return next((line for line in self.page if words in line), "")

    @property
    def gaps(self):
        """Silences, the longest first."""
        return sorted(self._silences, reverse=True)

    # what happens

    def read_screen(self, seconds=0.05):
        """Let the screen change for a while; False where the program's end has been read."""
        end = time.monotonic() + seconds
        while self._open and (left := end - time.monotonic()) > 0:
            if not select.select([self._master], [], [], left)[0]:
                break
            try:
                received = os.read(self._master, 65536)
            except OSError:  # the program has closed its terminal
                received = b""
            if not received:
                self._open = False
                break
            now = time.monotonic()
            self._silences.append((now - self._heard, (self.lines or [""])[-1]))
            self._heard = now
            self._stream.feed(received)
        return self._open

    def wait_for_words(self, words, times=1):
        """Wait until words stand there, so many times; line ends count as blanks."""
        self.wait(lambda: self.text.count(words) >= times, f"{words!r} for the {times}. time")

    def check_words_stay(self, words, times=1):
        """Wait for words, and see that they still stand after a while."""
        self.wait_for_words(words, times)
        end = time.monotonic() + STANDING_S
        while time.monotonic() < end:
            self.read_screen()
        assert self.text.count(words) >= times, f"wiped away: {words!r}\n" + "\n".join(self.lines)

    def wait(self, holds, what):
        end = time.monotonic() + DEADLINE
        while not holds():
            there = self.read_screen()
            if holds():
                return
            assert there, f"ended before {what}:\n" + "\n".join(self.lines)
            assert time.monotonic() < end, f"never {what}:\n" + "\n".join(self.lines)

    def type_keys(self, keys):
        os.write(self._master, keys.encode())

    def wait_for_end(self, within=DEADLINE):
        end = time.monotonic() + within
        while self.read_screen(0.2):
            assert time.monotonic() < end, "it does not end:\n" + "\n".join(self.lines)
        return self.process.wait(10.0)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        os.close(self._master)
