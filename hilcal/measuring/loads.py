"""Changing the load: the operator, the payload of the controller, and the force sensor's check."""

from collections.abc import Callable
from functools import partial

import numpy as np

from hilcal.config import CellLoad
from hilcal.errors import DeviceError
from hilcal.measuring.connect import Setup
from hilcal.measuring.devices import ConfirmingOperator, TerminalPerson
from hilcal.measuring.force import ForceMeter
from hilcal.measuring.motion import Mover, payload
from hilcal.measuring.progress import Answered, Phase, Question, Remark
from hilcal.store.plan import UNLOADED

TRIES = 3  # requests for one load at most
SWINGING_S = 2.0  # pause before a load that seems wrong is measured again, cell s


class Hook:
    """The hanging load and its changes; DeviceError after `TRIES` wrong loads."""

    def __init__(self, setup: Setup, meter: ForceMeter | None, mover: Mover) -> None:
        """Start with an unknown load, until `take_all_off`."""
        self.hanging, self.since, self._doubted = UNLOADED, setup.clock.now(), False
        self.load_denied = False  # whether a person denied a load that the sensor seems to measure
        self._operator, self._meter = setup.rig.operator, meter
        self._cell, self._config, self._mover = setup.cell, setup.cell.configured(), mover
        self._clock, self._watcher = setup.clock, setup.watcher
        self._loads = {load.name: load for load in self._config.loads}

    def load(self, name: str) -> CellLoad | None:
        """Return a load by name; None for the unloaded state."""
        return self._loads.get(name)

    def take_all_off(self) -> None:
        """Have all loads removed before anything moves, since the present load is unknown."""
        self._ask(None, self._still_hangs)
        self.hanging, self.since = UNLOADED, self._clock.now()

    def change(self, name: str) -> None:
        """Have another load hung, at the present pose.

        A heavier payload is set in the controller before it is hung, a lighter one after the person
        has confirmed the change, before anything moves.
        """
        new, old = self.load(name), self.load(self.hanging)
        heavier = payload(self._cell, new)[0] > payload(self._cell, old)[0]
        if heavier:
            self._mover.set_payload(new)
        self._suspend(self.hanging, name)
        answered = None if heavier else self._mover.set_payload
        self._ask(new, lambda: self._differs(new), answered=answered)
        self._note_hanging(name)

    def restore(self, why: str) -> None:
        """Have a wrong load corrected, where the arm stands.

        If nothing hangs any more, the payload in the controller is set before the person is asked.
        It is set again after the person has confirmed the load.
        """
        name, load = self.hanging, self.load(self.hanging)
        self._suspend(UNLOADED, name)
        if load is not None and not self._differs(None):
            self._mover.set_payload(None)
        self._ask(load, lambda: self._differs(load), why, self._mover.set_payload)
        self._note_hanging(name)

    def confirm(self, question: str) -> None:
        """Ask a person whether the arm may go on."""
        operator = self._operator
        if not isinstance(operator, ConfirmingOperator):
            raise DeviceError(f"arm: {question}: look at it, and start again")
        if not self._at_terminal:
            self._watcher.notify(Remark(question))
        self._watcher.notify(Phase("waiting for the operator to look at the arm"))
        self._ask_person(partial(operator.confirm, question))

    @property
    def _at_terminal(self) -> bool:
        return isinstance(self._operator, TerminalPerson) and self._operator.at_terminal

    def _suspend(self, *hanging: str) -> None:
        """Note that one of these loads hangs, and stop comparing the force with a load."""
        self._mover.hanging = hanging
        if self._mover.watch is not None:
            self._mover.watch.watching = False

    def _note_hanging(self, name: str) -> None:
        """Note that a load hangs, and compare the force with it."""
        self.hanging, self.since = name, self._clock.now()
        self._mover.hanging = (name,)
        if self._mover.watch is not None:
            self._mover.watch.expect(self.load(name))

    def _ask_person(self, ask: Callable[[], None]) -> None:
        """Ask a person; the live display pauses if it is at the same terminal."""
        if self._at_terminal:
            self._watcher.notify(Question())
        ask()
        if self._at_terminal:
            self._watcher.notify(Answered())

    def _ask(
        self,
        load: CellLoad | None,
        wrong: Callable[[], str],
        why: str = "",
        answered: Callable[[CellLoad | None], None] | None = None,
    ) -> None:
        """Ask until the load is correct, `TRIES` times; an arm moved meanwhile is moved back.

        `wrong` returns the problem in one line, or an empty text. `answered` is called with the
        load after each answer, before anything moves.
        """
        task = "take everything off" if load is None else f"hang {load.name}"
        for _ in range(TRIES):
            self._watcher.notify(Phase(f"waiting for the operator to {task}"))
            self._ask_person(partial(self._operator.hang, load, why))
            self._watcher.notify(Phase("checking what hangs"))
            if answered is not None:
                answered(load)
            self._mover.put_back(self.confirm)
            self._mover.checked_sample()
            why = wrong()
            if not why:
                return
            if not self._at_terminal:  # a person at the terminal reads it in the next question
                self._watcher.notify(Remark(f"asked to {task}: {why}"))
        if load is None:
            why += (
                ". If nothing does, a load hung, or the tool was touched, when the sensor was tared"
            )
        raise DeviceError(f"operator: asked {TRIES} times to {task}; {why}")

    def _differs(self, load: CellLoad | None) -> str:
        """Return why the measured wrench is not that of a load; tried twice, as it may swing."""
        if self._meter is None:
            return ""
        text = ""
        for pause in (self._config.acquire.settle_s, SWINGING_S):
            self._mover.wait(pause)
            sample = self._mover.checked_sample()
            tared = self._meter.tared(self._meter.average(), sample.q)
            good, text = self._meter.verify(load, tared, self._config.operator)
            if good:
                return ""
        return text

    def _still_hangs(self) -> str:
        """Return a message on a load that still seems to hang: one that fits better than none.

        The zero is that of a previous session. Without one it is the sensor's zero, which may be
        far off: then a second answer that nothing hangs is accepted, once a person confirms it.
        """
        if self._meter is None:
            return ""
        has_zero = bool(np.any(self._meter.zero))
        denied_twice, self._doubted = self._doubted and not has_zero, True
        sample = self._mover.checked_sample()
        tared = self._meter.tared(self._meter.average(), sample.q)
        force = self._meter.load_wrench(tared)[:3]
        measured = float(np.linalg.norm(force))
        if measured <= self._config.operator.tolerance_N:
            return ""
        gravity = self._cell.gravity
        distances = {
            load.name: float(np.linalg.norm(force - load.wrench(gravity)[:3]))
            for load in self._config.loads
        }
        name = min(distances, key=distances.__getitem__, default="")
        if not name or distances[name] >= measured:
            return ""
        if not denied_twice:
            reference = "in the unloaded readings so far" if has_zero else "the tool weighs"
            return (
                f"the force sensor measures {measured:.1f} N more than {reference}; {name} still "
                "seems to hang"
            )
        self.confirm(
            f"the force sensor measures {measured:.1f} N, as if {name} hung, and the answer was "
            "twice that nothing hangs. If so, the sensor's zero is off; if not, the arm may drop "
            "or stop, as its controller does not know of the load. Look at the flange"
        )
        self.load_denied = True
        return ""
