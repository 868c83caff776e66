"""Random faults for hours: `python -m tests.soak --minutes N --seed S [--out FILE]`.

One simulated cell after the other; on each, `check`, `run`, `run --resume`, `run --append` and
`calibrate --rehearse --resume`, which meet faults of the arm, the tracker, the force sensor, their
wires and the computer at random moments, also two at once, and also while the operator goes on
after one. After each: the arm is stopped within 0.5 s of a fault that has to stop it, the program
has ended by itself with one line that names cause and mend (or has overcome the fault), no process
of it and no client of the controller is left, and no reading is lost, doubled or wrong.
"""

import argparse
import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import numpy as np

from hilcal.measuring.route import dry_run
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.support.calibrate_process import CalibrationProcess
from tests.support.campaign_cases import (
    STARTED,
    STARVED,
    EndedError,
    Fault,
    Run,
    Site,
    check_readings,
    check_stopped_on_its_way,
    site,
)
from tests.support.spread_plan import spread_plan
from tests.support.timing import wait_until
from tests.wire.test_fault_matrix import (
    ARM_MOTION,
    ARM_REST,
    FORCE,
    OVERCOME,
    PERSON_MOTION,
    PERSON_REST,
    TRACKER,
    loaded,
)

PATIENCE = 25.0  # so long a program may go on with a fault before it counts as overcome, s
STANDS = 1.0
"""So long after its program was killed an arm may move, s: half of it to be noticed, and a ramp."""
IN_MOTION = 1.0  # so long an arm in motion may go on after what it has to be stopped for, s
NOTICED = re.compile(r"touch the tool|does not stand|asked \d times")
"""What is said of a load that fell."""
DONE = "readings are in"  # what a run says at its end
STOP_MOVING = (*ARM_MOTION, *PERSON_MOTION)
"""Faults for which an arm in motion has to be stopped and the run ended."""
STOP_MEASURING = (*ARM_REST, *TRACKER, *FORCE, *PERSON_REST)
"""Faults that have to end a run whose arm stands and measures."""
BESIDE = (
    ("identify",),
    ("identify", "--readings", "absolute"),
    ("diagnose",),
    ("refine",),
    ("report", "-o", "/dev/null"),
)
"""Commands that are run on a campaign while it is measured."""
CODES = (0, 3, 130, -signal.SIGKILL)  # exit codes: done, a device failed, interrupted, killed


@dataclass
class Soak:
    """What is done, and what was found."""

    rng: Random  # draws everything
    folder: Path  # for the files
    counts: Counter[str] = field(default_factory=Counter)  # how often each thing was done, by name
    findings: list[str] = field(default_factory=list)
    starved: int = 0  # runs that ended because this computer gave a process no turn
    slowest: dict[str, float] = field(default_factory=dict)
    _stack: ExitStack = field(default_factory=ExitStack)
    _site: Site | None = None
    _path: Path | None = None
    _calibration: CalibrationProcess | None = None
    _number: int = 0
    _met: str = ""

    # --- cells ---

    @property
    def site(self) -> Site:
        """The cell; built where there is none."""
        if self._site is None:
            self._number += 1
            here = self.folder / str(self._number)
            here.mkdir()
            seed = self.rng.randrange(1000)
            self._site = self._stack.enter_context(site(here, poses=8, seed=seed))
            self._path = None
        return self._site

    @property
    def path(self) -> Path:
        """The campaign that is measured now."""
        if self._path is None:
            self._path = self.site.directory / f"run{self.counts['campaigns']}.hilcal"
            self.counts["campaigns"] += 1
        return self._path

    def close(self) -> None:
        if self._site is not None:
            self._site.end_runs()
        self._stack.close()
        self._stack, self._site, self._path = ExitStack(), None, None

    # --- actions ---

    def act(self) -> None:
        """Do one thing by chance, and check what must hold after it."""
        ways: list[tuple[float, Callable[[], None]]] = [
            (0.30, self.one_fault),
            (0.15, self.two_faults),
            (0.10, self.fault_during_recovery),
            (0.12, self.load_falls),
            (0.05, self.wrong_weights),
            (0.10, self.second_process),
            (0.08, self.signal),
            (0.05, self.check),
            (0.05, self.calibrate),
        ]
        (way,) = self.rng.choices([w for _, w in ways], [p for p, _ in ways])
        self.do(way)

    def do(self, way: Callable[[], None]) -> None:
        """Do it; a failed check is kept, and the next thing is done on another cell."""
        self.counts[way.__name__] += 1
        before, self._met = self._met, ""
        try:
            way()
        except Exception as error:
            runs = self._site.runs if self._site is not None else []
            if isinstance(error, EndedError) and runs and runs[-1].process.poll() == 0:
                self.counts["done before the fault"] += 1
                self.site.slider(1.0)
                return
            words = "".join(traceback.format_exception_only(error)).strip()
            at = traceback.extract_tb(error.__traceback__)[-1]
            if STARVED.search(words):
                self.starved += 1
            else:
                where = f"{way.__name__} {self._met} (after {before}): {at.name}:{at.lineno}"
                self.findings.append(f"{where}: {words[:200]} … {words[-1500:]}")
            self.close()

    def one_fault(self) -> None:
        """A run meets a fault in motion, while measuring, or at any other moment."""
        run, moment = self._begun()
        fault = self._drawn(moment)
        goal = run.moving() if moment == "moving" else None
        if moment == "measuring":
            run.measuring()
        self._meets(run, (fault,), goal, exact=moment != "any")

    def two_faults(self) -> None:
        """A second fault comes within a second of the first."""
        run, moment = self._begun()
        one, two = self._drawn(moment), self._drawn("any")
        goal = run.moving() if moment == "moving" else None
        self._meets(run, (one, two), goal, exact=False)

    def fault_during_recovery(self) -> None:
        """The operator goes on while the fault is there still, or the next one comes at once."""
        run, moment = self._begun()
        first, second = self._drawn(moment), self._drawn("any")
        goal = run.moving() if moment == "moving" else None
        self._meets(run, (first,), goal, exact=False, undo=False)
        again = self._run()
        try:
            time.sleep(self.rng.uniform(0.0, 3.0))
            second.cause(self.site)
            first.mend(self.site)
            self._ends(again, (first, second), exact=False)
        finally:
            self._undo((first, second))
        self._sound()

    def load_falls(self) -> None:
        """A load falls off in motion or while it is measured, and is hung again."""
        run, moment = self._begun()
        try:
            loaded(run)
            if moment == "moving":
                run.wait_until(lambda: self.site.ask("arm", "state")["moving"], "motion")
            since = len(run.output)
            name = self.site.ask("world", "state")["load"]
            self.site.ask("world", "hang", name=None)
            self.counts["faults"] += 1
            if name is not None:  # else it was being taken off just then
                run.wait_until(lambda: NOTICED.search(run.output[since:]), "words about the load")
        except EndedError:
            self._ended(run)  # the campaign was done before
        else:
            run.interrupt()
            self._ended(run)
        self._sound()

    def wrong_weights(self) -> None:
        """The person hangs another weight than asked for, once or every time."""
        before = self.path
        measured = self._count_stored() > 0
        run = self._run()  # may begin another campaign
        times = self.rng.choice((1, 3)) if measured and self.path == before else 1
        for _ in range(times):
            wrong = self.rng.choice(self.site.config.loads)
            self.site.ask("world", "mistake", name=wrong.name)
            self.counts["faults"] += 1
        try:
            run.some_readings()
        except EndedError:
            self._ended(run)
        else:
            run.interrupt()
            self._ended(run)
        for _ in range(times + 1):  # mistakes that the run did not come to, and nothing at the end
            self.site.ask("world", "hang", name=None)
        self._sound()

    def second_process(self) -> None:
        """Another command fits the campaign, and stores its revision, while it is measured."""
        run, _ = self._begun()
        beside: list[subprocess.Popen[bytes]] = []
        for command in self.rng.sample(BESIDE, 2):
            arguments = [sys.executable, "-m", "hilcal", *command[:1], str(self.path), *command[1:]]
            beside.append(
                subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            )
            time.sleep(self.rng.uniform(0.0, 2.0))
        self.counts["faults"] += len(beside)
        for process in beside:
            _, said = process.communicate(timeout=120.0)
            words = said.decode()
            assert "Traceback" not in words, words[-2000:]
            assert process.returncode in (0, 2, 4), words[-600:]
            self.counts[f"beside: exit {process.returncode}"] += 1
        if run.process.poll() is None:
            run.interrupt()
        self._ended(run)
        self._sound()

    def signal(self) -> None:
        """Ctrl-C or a kill at any moment."""
        run, moment = self._begun()
        goal = run.moving() if moment == "moving" else None
        hard = self.rng.random() < 0.5
        since = time.monotonic()
        (run.kill if hard else run.interrupt)()
        code, words = run.end()
        assert code in ((-signal.SIGKILL, 0) if hard else (130, 0)), words
        if goal is not None and code:
            check_stopped_on_its_way(self.site, since, goal)
        self._still()
        self._gone(run)
        self._sound()
        self.counts["kills" if hard else "interrupts"] += 1

    def check(self) -> None:
        """`hilcal check` names a fault that is there, and is content without."""
        fault = self._drawn("any") if self.rng.random() < 0.7 else None
        command = [sys.executable, "-m", "hilcal", "check", str(self.site.toml)]
        self._still()
        arrivals = self.site.ask("arm", "state")["arrivals"]
        if fault is not None:
            self._count(fault)
            fault.cause(self.site)
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        finally:
            if fault is not None:
                fault.mend(self.site)
        words = done.stdout + done.stderr
        assert "Traceback" not in words, words
        assert done.returncode in (0, 3), words
        if fault is None and done.returncode:  # a run before has lost the target
            assert "it is not locked on its target" in words, words
        assert self.site.ask("arm", "state")["arrivals"] == arrivals, "check has moved the arm"

    def calibrate(self) -> None:
        """`calibrate --rehearse --resume` is killed at a random moment."""
        if self._calibration is None:
            here = self.folder / f"calibrate{self.counts['calibrations']}"
            here.mkdir()
            self._calibration = CalibrationProcess(here)
            self.counts["calibrations"] += 1
        c = self._calibration
        try:
            killed = c.killed_after(self.rng.uniform(0.0, 14.0))
            self.counts["kills of calibrate"] += killed
            c.check_readable()
            if not killed:
                c.check_each_reading_once()
                self._calibration = None
        except BaseException:
            self._calibration = None
            raise

    # --- parts ---

    def _run(self) -> Run:
        """Begin, resume, or append to a campaign that is done."""
        how: tuple[str, ...] = ()
        if self.path.exists() and self._done():
            self.counts["campaigns done"] += 1
            self._sound()
            if self.rng.random() < 0.5:
                how = ("--append", "--plan", str(self._further()))
                self.counts["appends"] += 1
            else:
                self._path = None
        return Run(self.site, self.path, how=how)

    def _further(self) -> Path:
        s = self.site
        rngs = (np.random.default_rng([self.rng.randrange(1000), k]) for k in range(20))
        plans = (spread_plan(s.cell, 2, rng, repeats=0) for rng in rngs)
        with CampaignFile.open(self.path, read_only=True) as campaign:
            log = RunLog(campaign)  # whose reference pose is another one than a plan's own
            plan = next(p for p in plans if not dry_run(s.cell, log.with_new_names(p)).problems)
        path = s.directory / f"further{self.counts['appends']}.json"
        path.write_text(plan.to_json(), encoding="utf-8")
        return path

    def _begun(self) -> tuple[Run, str]:
        """Start or resume a run; returns the moment at which something is to happen, too."""
        run, moment = self._run(), self.rng.choice(("moving", "measuring", "any"))
        if moment == "any":
            time.sleep(self.rng.uniform(0.0, 6.0))
            return run, moment
        try:
            run.some_readings()
        except EndedError:
            self._ended(run)
            if run.process.poll() == 0:
                return self._begun()
            raise
        return run, moment

    def _drawn(self, moment: str) -> Fault:
        """A fault; a person's and a device's that repeats itself come after the tare only."""
        kinds: list[tuple[Fault, ...]] = [
            ARM_MOTION if moment == "moving" else ARM_REST,
            (*TRACKER, *FORCE, *OVERCOME["tracker"], *OVERCOME["force"]),
        ]
        if moment != "any":
            kinds.append(PERSON_MOTION if moment == "moving" else PERSON_REST)
        return self.rng.choice(self.rng.choice(kinds))

    def _count(self, fault: Fault) -> None:
        self.counts["faults"] += 1
        self.counts[f"fault: {fault.name}"] += 1

    def _meets(
        self, run: Run, faults: tuple[Fault, ...], goal: object, *, exact: bool, undo: bool = True
    ) -> None:
        since = time.monotonic()
        self._met = ", ".join(fault.name for fault in faults)
        try:
            for k, fault in enumerate(faults):
                if k:
                    time.sleep(self.rng.uniform(0.0, 1.0))
                self._count(fault)
                fault.cause(self.site)
            must = STOP_MEASURING if goal is None else STOP_MOVING
            alone = [f for f in faults if f in must] if exact and len(faults) == 1 else []
            in_motion = [f for f in alone if goal is not None and f.stops_arm]
            for fault in in_motion:
                self._stands(fault, since)
            ended = self._ends(run, faults, exact=exact)
            if ended and any(f in ARM_MOTION for f in in_motion):
                check_stopped_on_its_way(self.site, since, goal)  # type: ignore[arg-type]
            for fault in alone:
                assert ended or run.process.returncode == 0, f"{fault.name}: not noticed"
        finally:
            if undo:
                self._undo(faults)
        if undo:
            if run.process.poll() is None:
                run.interrupt()
                run.end()
            self._gone(run)
        self._sound()
        self.site.slider(1.0)

    def _undo(self, faults: tuple[Fault, ...]) -> None:
        """Mend everything; twice, since a protective stop is not unlocked in local mode."""
        for fault in (*faults, *faults):
            fault.mend(self.site)

    def _stands(self, fault: Fault, since: float) -> None:
        """Wait until an arm that was in motion stands, and keep how long that took."""
        wait_until(lambda: not self.site.ask("arm", "state")["moving"], "at rest")
        took = self.site.ask("arm", "state")["rest_ns"] * 1e-9 - since
        self.slowest[fault.name] = round(max(took, self.slowest.get(fault.name, 0.0)), 3)
        assert took <= IN_MOTION, f"{fault.name}: the arm stood after {took:.2f} s"

    def _ends(self, run: Run, faults: tuple[Fault, ...], *, exact: bool) -> bool:
        """Wait until a run has ended with one line, or is seen to go on in spite of the fault."""
        end = time.monotonic() + PATIENCE
        while run.process.poll() is None and time.monotonic() < end:
            run.family()
            time.sleep(0.05)
        if run.process.poll() is None:
            self.counts["went on"] += 1
            run.interrupt()
        self._ended(run, faults if exact else ())
        return run.process.returncode == 3

    def _ended(self, run: Run, faults: tuple[Fault, ...] = ()) -> None:
        code, words = run.end()
        assert "Traceback" not in words, words[-2000:]
        if code == -signal.SIGINT and DONE in words:
            code = 0  # it was interrupted after its work, on its way out
        assert code in CODES, f"exit code {code}: {words[-600:]}"
        lines = [line for line in words.splitlines() if line.startswith("error:")]
        assert len(lines) == (code != 0), words[-2000:]
        self.counts[f"exit {code}"] += 1
        if code == 3:
            if STARVED.search(lines[0]) and not all(
                re.search(says, lines[0]) for fault in faults for says in fault.patterns
            ):
                self.starved += 1
            else:
                for fault in faults:
                    for says in fault.patterns:
                        assert re.search(says, lines[0]), f"{fault.name}: {lines[0]}"
            if STARTED in words:  # before that nothing is there to go on with
                assert "--resume" in lines[0], lines[0]
            assert len(lines[0]) > 40, f"too short to name cause and mend: {lines[0]}"
        assert not self.site.ask("arm", "state")["moving"], "the arm moves after the program's end"
        self._gone(run)

    def _still(self) -> None:
        """A program that was killed has left nobody who would let the arm go on."""
        end = time.monotonic() + STANDS
        while self.site.ask("arm", "state")["moving"]:
            assert time.monotonic() < end, "the arm moves though no program commands it"
            time.sleep(0.02)

    def _gone(self, run: Run) -> None:
        assert run.orphans() == [], "a process is left"
        end = time.monotonic() + 3.0
        while self.site.ask("arm", "state")["rtde_clients"]:
            assert time.monotonic() < end, "a client of the controller is left"
            time.sleep(0.05)

    def _sound(self) -> None:
        if not self.path.exists():
            return
        with CampaignFile.open(self.path, read_only=True) as campaign:
            steps = [tuple(d["step"].values()) for d in RunLog(campaign).details()]
            count = campaign.n_readings
        assert len(steps) == len(set(steps)) == count, "a reading is lost or doubled"
        if count:
            check_readings(self.site, self.path)

    def _count_stored(self) -> int:
        if not self.path.exists():
            return 0
        with CampaignFile.open(self.path, read_only=True) as campaign:
            return campaign.n_readings

    def _done(self) -> bool:
        with CampaignFile.open(self.path, read_only=True) as campaign:
            log = RunLog(campaign)
            return log.done() == frozenset(log.plan.steps)


EVERY = 40
"""Actions on one cell; then another is built."""


def soak(seconds: float, seed: int, folder: Path, say: Callable[[str], None] = print) -> Soak:
    """Do things for so long."""
    s = Soak(Random(seed), folder)
    end, last_report = time.monotonic() + seconds, 0
    try:
        while time.monotonic() < end:
            s.act()
            if len(s.findings) > last_report:
                last_report = len(s.findings)
                say(f"FOUND {s.findings[-1]}")
            if sum(s.counts[w] for w in ("one_fault", "two_faults", "signal")) % EVERY == EVERY - 1:
                s.close()
    finally:
        s.close()
    return s


def main() -> int:
    """Run for some minutes and say what was found."""
    ask = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    ask.add_argument("--minutes", type=float, default=10.0)
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--out", type=Path, help="JSON file of counts and findings")
    asked = ask.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="hilcal-soak-"))
    try:
        s = soak(60.0 * asked.minutes, asked.seed, folder, lambda line: print(line, flush=True))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    document = {
        "minutes": asked.minutes,
        "seed": asked.seed,
        "faults": s.counts["faults"],
        "starved": s.starved,
        "findings": s.findings,
        "slowest_stop_s": s.slowest,
        "counts": dict(sorted(s.counts.items())),
    }
    if asked.out is not None:
        asked.out.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(document, indent=1))
    return int(bool(s.findings))


if __name__ == "__main__":
    sys.exit(main())
