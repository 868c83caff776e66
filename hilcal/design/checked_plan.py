"""A plan that may be run: its file, its dry run, its summary."""

from dataclasses import dataclass, replace
from pathlib import Path

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.summary import PlanSummary
from hilcal.errors import InputError
from hilcal.measuring.route import DryRun, dry_run
from hilcal.shown import Shown, Tabular
from hilcal.store.plan import Plan
from hilcal.whole_file import replace_file


@dataclass(frozen=True, slots=True, eq=False)
class CheckedPlan(Shown, Tabular):
    """A plan whose dry run passed, and its summary."""

    plan: Plan  # poses, loads and steps, as a plan file holds them
    dry: DryRun
    summary: PlanSummary  # cost, predicted precision and efficiency

    @property
    def efficiency(self) -> float | None:
        """Certified lower bound of the efficiency; None without a certificate."""
        return self.summary.efficiency

    def save(self, path: str | Path) -> None:
        """Write the plan file, which `hilcal run --plan` takes."""
        replace_file(path, self.plan.to_json() + "\n")

    def to_dict(self) -> dict[str, object]:
        """Return the JSON document."""
        return {
            **self.summary.to_dict(),
            "loads": list(self.plan.loads),
            "load_changes": self.dry.load_changes,
            "motions": self.dry.motions,
            "duration_s": self.dry.duration,
        }


def checked(cell: Cell, config: CellConfig, plan: Plan, summary: PlanSummary) -> CheckedPlan:
    """Check a plan in a dry run, whose remarks come first in the summary."""
    dry = dry_run(cell, config, plan)
    refuse(dry, "the plan")
    remarks = tuple(dict.fromkeys((*dry.remarks, *summary.remarks)))
    return CheckedPlan(plan, dry, replace(summary, remarks=remarks))


def refuse(dry: DryRun, what: str) -> None:
    """Refuse a plan that did not pass its dry run."""
    if (found := refusal(dry, what)) is not None:
        raise found


def refusal(dry: DryRun, what: str) -> InputError | None:
    """Return the same without raising it; None where the plan has passed."""
    return InputError(f"{what} cannot be run: {dry.first}") if dry.problems else None
