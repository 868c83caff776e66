"""Changing the load: the operator, the payload of the controller, and the force sensor's check."""

from collections.abc import Callable
from functools import partial

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellLoad
from hilcal.errors import DeviceError
from hilcal.measuring.connect import Setup
from hilcal.measuring.devices import ConfirmingOperator, TerminalPerson, WrongLoadError
from hilcal.measuring.force import ForceMeter
from hilcal.measuring.motion import Mover
from hilcal.measuring.progress import Answered, Phase, Question, Remark
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

TRIES = 3
SWINGING_S = 2.0  # a load that seems wrong is weighed once more after so long, cell seconds


def payload(cell: Cell, load: CellLoad | None) -> tuple[float, Floats]:
    """Return mass (kg) and centre of mass (3,) at the flange of the tool with a dead weight."""
    hung = 0.0 if load is None else load.mass_kg
    mass = cell.tool_mass + hung
    if mass == 0.0:
        return 0.0, np.zeros(3)
    com = (cell.tool_mass * cell.tool_com + hung * cell.load_point) / mass
    return mass, com


class Hook:
    """What hangs at the arm; WrongLoadError where what hangs is wrong `TRIES` times."""

    def __init__(self, setup: Setup, meter: ForceMeter | None, mover: Mover) -> None:
        """Nothing is known of what hangs before `begin`."""
        self.hanging, self.since, self._doubted = UNLOADED, setup.clock.now(), False
        self._arm, self._operator, self._meter = setup.rig.arm, setup.rig.operator, meter
        self._cell, self._config, self._mover = setup.cell, setup.config, mover
        self._clock, self._watcher = setup.clock, setup.watcher
        self._loads = {load.name: load for load in setup.config.loads}

    def load(self, name: str) -> CellLoad | None:
        """Return a load by name, None for the unloaded state."""
        return self._loads.get(name)

    def begin(self) -> None:
        """Have every load taken off before anything moves, for what hangs is unknown."""
        self._ask(None, self._still_hangs)
        self.hanging, self.since = UNLOADED, self._clock.now()

    def change(self, name: str) -> None:
        """Have another load hung, at the present pose.

        A heavier payload is set in the controller before it is hung, a lighter one as soon as it is
        said that the heavier has been taken off, before anything moves.
        """
        new, old = self.load(name), self.load(self.hanging)
        heavier = payload(self._cell, new)[0] > payload(self._cell, old)[0]
        if heavier:
            self._carry(new)
        self._suspend(self.hanging, name)
        self._ask(new, lambda: self._differs(new), answered=None if heavier else self._carry)
        self._hangs(name)

    def restore(self, why: str) -> None:
        """Have what should hang put right, where the arm stands, after it was found wrong.

        The controller is told at once if nothing hangs any more, and that it hangs again as soon as
        that is answered.
        """
        name, load = self.hanging, self.load(self.hanging)
        self._suspend(UNLOADED, name)
        if load is not None and not self._differs(None):
            self._carry(None)
        self._ask(load, lambda: self._differs(load), why, self._carry)
        self._hangs(name)

    def confirm(self, question: str) -> None:
        """Ask whether the arm may go on."""
        operator = self._operator
        if not isinstance(operator, ConfirmingOperator):
            raise DeviceError(f"arm: {question}: look at it, and start again")
        if not self._at_terminal:
            self._watcher.notify(Remark(question))
        self._watcher.notify(Phase("waiting for the operator to look at the arm"))
        self._asked(partial(operator.confirm, question))

    @property
    def _at_terminal(self) -> bool:
        return isinstance(self._operator, TerminalPerson) and self._operator.at_terminal

    def _carry(self, load: CellLoad | None) -> None:
        self._arm.set_payload(*payload(self._cell, load))

    def _suspend(self, *hanging: str) -> None:
        """Take note that one of some loads hangs, and do not watch it."""
        self._mover.hanging = hanging
        if self._mover.watch is not None:
            self._mover.watch.suspend()

    def _hangs(self, name: str) -> None:
        """Take note that a load hangs, and watch it from now on."""
        self.hanging, self.since = name, self._clock.now()
        self._mover.hanging = (name,)
        if self._mover.watch is not None:
            self._mover.watch.expect(self.load(name))

    def _asked(self, ask: Callable[[], None]) -> None:
        """Ask a person; one at the terminal gets it from the display."""
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
        """Ask until nothing is wrong, `TRIES` times; an arm moved meanwhile is put back.

        `wrong` returns what is wrong in one line, empty where nothing is. `answered` is told what
        hangs after each answer, before anything moves.
        """
        what = "take everything off" if load is None else f"hang {load.name}"
        for _ in range(TRIES):
            self._watcher.notify(Phase(f"waiting for the operator to {what}"))
            self._asked(partial(self._operator.hang, load, why))
            self._watcher.notify(Phase("checking what hangs"))
            if answered is not None:
                answered(load)
            self._mover.put_back(self.confirm)
            self._mover.look()
            why = wrong()
            if not why:
                return
            if not self._at_terminal:  # a person is told with the next question
                self._watcher.notify(Remark(f"asked to {what}: {why}"))
        if load is None:
            why += ". If nothing does, the tool was touched while the sensor was tared"
        raise WrongLoadError(f"operator: asked {TRIES} times to {what}; {why}")

    def _differs(self, load: CellLoad | None) -> str:
        """Why the measured wrench is not that of a load; weighed twice, for it may swing."""
        if self._meter is None:
            return ""
        text = ""
        for pause in (self._config.acquire.settle_s, SWINGING_S):
            self._mover.wait(pause)
            sample = self._mover.look()
            tared = self._meter.tared(self._meter.average(), sample.q)
            good, text = self._meter.verify(load, tared, self._config.operator)
            if good:
                return ""
        return text

    def _still_hangs(self) -> str:
        """What seems to hang still: a load that fits better than nothing does.

        By the zero of an earlier session. Without one it is the sensor's own, which may be far off:
        then a second answer that nothing hangs is believed, and said to be.
        """
        if self._meter is None:
            return ""
        known = bool(np.any(self._meter.zero))
        believed, self._doubted = self._doubted and not known, True
        sample = self._mover.look()
        tared = self._meter.tared(self._meter.average(), sample.q)
        force = self._meter.load_wrench(tared)[:3]
        felt = float(np.linalg.norm(force))
        if felt <= self._config.operator.tolerance_N:
            return ""
        for load in self._config.loads:
            if np.linalg.norm(force - load.wrench(self._cell.gravity)[:3]) < felt:
                if believed:
                    self._watcher.notify(
                        Remark(
                            f"the force sensor's own zero is taken to be off by {felt:.1f} N: it "
                            "was answered twice that nothing hangs"
                        )
                    )
                    return ""
                since = "in the unloaded readings so far" if known else "the tool weighs"
                return (
                    f"the force sensor feels {felt:.1f} N more than {since}; {load.name} seems to "
                    "hang still"
                )
        return ""
