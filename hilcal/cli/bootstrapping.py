"""`bootstrap`: whether the stated standard uncertainties hold, by drawing the poses again."""

from typing import Annotated

from hilcal.campaign.campaign import Campaign
from hilcal.cli.files import fit_of
from hilcal.cli.options import (
    EffectsFrom,
    Json,
    Revision,
    Run,
    Scheduler,
    Workers,
    catalogue_with,
    option,
)
from hilcal.cli.terminal import terminal
from hilcal.engine.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification.bootstrap import DRAWS, check_draws
from hilcal.identification.bootstrap import bootstrap as draw_again
from hilcal.present.bootstrap import bootstrap_json, bootstrap_report
from hilcal.present.progress import counting, working


def bootstrap(
    run: Run,
    revision: Revision = None,
    draws: Annotated[int, option("--draws N", "Campaigns drawn.")] = DRAWS,
    seed: Annotated[int, option("--seed", "Of the draws.")] = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Draw the poses again, refit, and compare the scatter with the stated uncertainties."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    check_draws(draws, seed)
    if effects_from and (scheduler is not None or workers not in (None, 1)):
        raise InputError("--effects-from: other processes do not have its effects; --workers 1")
    with (
        Campaign.open(run, catalogue, read_only=True) as o,
        open_engine(1 if effects_from else workers, scheduler) as engine,
    ):
        with working(t.progress) as say:
            number, fit = fit_of(t, o, say, revision)
            say("computing standard uncertainties")
            _ = fit.uncertainty
        with counting(t.progress, "draws", draws) as advance:
            found = draw_again(fit, engine, draws, seed, advance)
    t.show(bootstrap_report(found))
    t.document({"revision": number, "seed": seed, **bootstrap_json(found)})
