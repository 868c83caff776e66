"""The steps of `calibrate`, one after the other; the operator is asked before the arm moves."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from hilcal.cli.asking import agreed, somebody_there
from hilcal.cli.living_cell import LivingCell
from hilcal.cli.planning import refuse_unready
from hilcal.cli.refining import Row, chapter_of
from hilcal.cli.rehearsing import to_the_end
from hilcal.cli.running import measure
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.errors import StoppedError
from hilcal.measuring.connect import connect
from hilcal.present.calibration import decision_report, step_heading, validation_lines
from hilcal.present.diagnosis import key, revisions_table, verdict_line
from hilcal.present.fit import prior_lines
from hilcal.present.live_viewer import LiveViewer
from hilcal.present.plan import plan_facts
from hilcal.present.progress import working
from hilcal.procedure.decision import Decision
from hilcal.procedure.procedure import Procedure
from hilcal.procedure.state import REFINED, Step
from hilcal.refinement import Refinement
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.procedure_log import ProcedureLog


class Operator:
    """Does one step after the other, and asks before the arm moves."""

    def __init__(
        self,
        t: Terminal,
        p: Procedure,
        stack: ExitStack,
        rehearse: bool,
        yes: bool,
        viewer: LiveViewer | None = None,
    ) -> None:
        """Nothing is connected yet."""
        self._viewer = viewer
        self._t, self._p, self._stack = t, p, stack
        self._rehearse, self._yes = rehearse, yes
        self._clock = p.config.simulation.clock if rehearse else 1.0
        self._living: LivingCell | None = None
        self._ready = False

    def to_the_end(self) -> None:
        """Do all steps that are left but the comparison.

        Raises:
            StoppedError: somebody does not want the arm to move.
        """
        while (step := self._p.next()).kind not in ("done", "compare"):
            self._t.show(step_heading(step, self._clock))
            if step.moves:
                self._moving(step)
            else:
                self._computing(step)

    def _moving(self, step: Step) -> None:
        """Ask, and measure what is missing of a plan."""
        self._check()
        if not self._yes and somebody_there(self._t):
            what = "The simulated arm will move." if self._rehearse else "The arm will move."
            if not agreed(self._t, f"Measure now? {what}"):
                raise StoppedError("not measured, nothing has moved")
        config = self._config()

        def work(campaign: CampaignFile, epoch: float | None) -> None:
            measure(self._t, config, self._p.cell, campaign, epoch=epoch, viewer=self._viewer)

        def whole() -> None:
            self._p.measure(step, work)

        if self._rehearse:
            to_the_end(self._t, whole, lambda: _count(step.path))
        else:
            whole()

    def _config(self) -> CellConfig:
        """Return the configuration that leads to the devices; starts simulated ones."""
        if not self._rehearse:
            return self._p.config
        if self._living is None:
            with working(self._t.progress) as say:
                say("starting the simulated devices")
                self._living = self._stack.enter_context(LivingCell.of(self._p))
        return self._living.config

    def _check(self) -> None:
        """Ask every device once whether it is ready; nothing moves."""
        if self._ready or self._rehearse:
            return
        with working(self._t.progress) as say:
            say("connecting to every device")
            rig, answers = connect(self._p.config)
            if rig is not None:
                rig.close()
        for a in answers:
            name = "no answer" if a.report is None else a.report.name
            self._t.show(f"{a.device}: {name}, {'; '.join(a.problems) or 'ready'}")
        refuse_unready(answers)
        self._ready = True

    def _computing(self, step: Step) -> None:
        """Do a step in which nothing moves, and say what came of it."""
        p, t = self._p, self._t
        if step.kind == "plan":
            with working(t.progress) as say:
                made = p.plan(say)
            t.show(plan_facts(made.summary))
            p.begin(made.plan, p.config)
            return
        viewer = self._viewer
        with working(t.progress) as say:
            if step.kind == "refine" and viewer is not None:
                found: object = p.refine(say, lambda n, s: viewer.revised(chapter_of(n, s)))
            else:
                found = p.compute(step, say)
        self._say(step.kind, found)

    def _say(self, kind: str, found: Any) -> None:
        t = self._t
        if kind == "refine":
            _say_refined(t, self._p, found)
        elif kind == "decide":
            decided: Decision = found
            of = self._p.settings
            report = decision_report(decided, of.goal_m, of.readings, self._clock)
            t.show(report)
        elif kind == "validate":
            t.show(validation_lines(found))


def _say_refined(t: Terminal, p: Procedure, found: Refinement) -> None:
    """Show the revisions and the verdict."""
    with CampaignFile.open(p.run, read_only=True) as campaign:
        refined = ProcedureLog(campaign).last(REFINED) or {"revisions": []}
    rows = [
        Row(number, s.fit, s.diagnosis.verdict, s.added, s.removed)
        for number, s in zip(refined["revisions"], found.steps, strict=True)
    ]
    t.show(revisions_table([r.shown for r in rows]))
    t.show([key(), verdict_line(found.diagnosis), ""])
    t.show(prior_lines(found.fit))


def _count(path: Path) -> int:
    with CampaignFile.open(path, read_only=True) as campaign:
        return campaign.n_readings
