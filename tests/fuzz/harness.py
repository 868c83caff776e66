"""Gives a parser damaged inputs and judges what comes out.

Only the project's own errors may come out. Anything else is a finding: another exception, more time
than a limit, more memory than a limit, or a reading accepted that was damaged (the parser's own
check raises `Accepted`). An input of a finding is kept as a file, which `--replay` gives again.
"""

import gc
import hashlib
import re
import resource
import signal
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from hilcal.errors import CannotAnswerError, DeviceError, InputError

BATCH = 200  # inputs of one random stream; a choice
MEMORY = 3 << 30
"""Address space beyond what the process has, bytes; a choice: a table of readings needs little."""


class Accepted(AssertionError):
    """A damaged reading passed for a sound one."""


class Collision(Accepted):
    """Damage that a checksum of 16 bits does not see: one of 65,536 at random; no short burst."""


class Hung(BaseException):
    """An input took longer than the limit."""


Make = Callable[[Random], bytes]
"""Returns a damaged input."""


@dataclass(frozen=True, slots=True)
class Parser:
    """What is tried."""

    name: str  # on the command line
    make: Make
    parse: Callable[[bytes], bool]
    limit_s: float = 2.0  # processor time that one input may take
    refusals: tuple[type[Exception], ...] = ()


@dataclass(slots=True)
class Outcome:
    """What became of the inputs."""

    inputs: int = 0  # how many were given
    read: int = 0  # those that were read as sound
    refused: Counter[str] = field(default_factory=Counter)
    findings: Counter[str] = field(default_factory=Counter)
    collisions: int = 0  # damaged readings that a sound checksum let pass, see `Collision`
    kept: dict[str, str] = field(default_factory=dict)  # a file with an input for each
    slowest_s: float = 0.0  # processor time of the slowest input
    stopped: bool = False  # whether it was told to end before


def fuzz(parser: Parser, inputs: int, seed: int, keep: Path | None = None) -> Outcome:
    """Give a parser so many damaged inputs; Ctrl-C ends it before."""
    out = Outcome()
    with limited(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for k in range(inputs):
                if k % BATCH == 0:
                    rng = Random(f"{parser.name}/{seed}/{k // BATCH}")
                _one(parser, parser.make(rng), out, keep)
        except KeyboardInterrupt:
            out.stopped = True
    return out


def _one(parser: Parser, data: bytes, out: Outcome, keep: Path | None) -> None:
    """Give one input."""
    out.inputs += 1
    text, begun = "", time.process_time()
    signal.setitimer(signal.ITIMER_PROF, parser.limit_s)
    try:
        out.read += parser.parse(data)
    except (InputError, CannotAnswerError, DeviceError, *parser.refusals) as error:
        out.refused[type(error).__name__] += 1
    except Collision:
        out.collisions += 1
    except Hung:
        text = f"more than {parser.limit_s:g} s"
    except Exception as error:
        text = finding(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    out.slowest_s = max(out.slowest_s, time.process_time() - begun)
    if text:
        out.findings[text] += 1
        if keep is not None and text not in out.kept:
            keep.mkdir(parents=True, exist_ok=True)
            path = keep / f"{parser.name}-{hashlib.sha256(data).hexdigest()[:12]}"
            path.write_bytes(data)
            out.kept[text] = str(path)
    if out.inputs % 5000 == 0:
        gc.collect()


def passed(what: str, data: bytes, sound: Iterable[bytes]) -> Accepted:
    """What it is that `data`, which is none of the sound ones, was accepted."""
    for one in sound:
        if len(one) == len(data):
            differ = int.from_bytes(one, "big") ^ int.from_bytes(data, "big")
            if differ and differ.bit_length() - (differ & -differ).bit_length() < 16:
                return Accepted(f"{what}: one that a burst of 16 bits or less has damaged")
    return Collision(f"{what}: one that was damaged")


def finding(error: Exception) -> str:
    """One line on an error that should not have come out, and where it came from."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/tests/" not in f.filename]
    ours = [f for f in frames if "/hilcal/" in f.filename or "/drivers/" in f.filename]
    at = (ours or frames or [None])[-1]
    where = "" if at is None else f" at {'/'.join(Path(at.filename).parts[-2:])}:{at.lineno}"
    words = re.sub(r"\d+|0x[0-9a-f]+", "#", " ".join(str(error).split()))[:100]
    return f"{type(error).__name__}{where}: {words if isinstance(error, Accepted) else words[:60]}"


@contextmanager
def limited() -> Iterator[None]:
    """Let no input use more than its share of time and memory."""

    def hung(*_: object) -> None:
        raise Hung

    limits, handler = resource.getrlimit(resource.RLIMIT_AS), signal.getsignal(signal.SIGPROF)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, limits[1]))
    signal.signal(signal.SIGPROF, hung)
    try:
        yield
    finally:
        signal.signal(signal.SIGPROF, handler)
        resource.setrlimit(resource.RLIMIT_AS, limits)
