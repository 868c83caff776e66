"""The functions of `import hilcal`: thin, with defaults that suit a script."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilcal.campaign.campaign import Campaign, opened
from hilcal.cell import Cell
from hilcal.diagnosis.diagnosis import Diagnosis, History
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.verdict import NOTHING
from hilcal.diagnosis.verdict import diagnose as judge_fit
from hilcal.discovery.discovery import LawSearch
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import Options
from hilcal.engine.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification import baseline as starting_models
from hilcal.identification import bootstrap as bootstraps
from hilcal.identification import fit as fits
from hilcal.identification import posterior_document
from hilcal.identification.arm_scatter import with_prior_scatter
from hilcal.identification.carried import CarriedPrior, carried_prior, check_prior
from hilcal.identification.fit import Fit
from hilcal.identification.full_covariance import full_readings
from hilcal.identification.noise_estimate import with_estimated_noise
from hilcal.identification.posterior import Posterior
from hilcal.model.model import Model
from hilcal.optional import needed_by
from hilcal.present.story import build_story
from hilcal.readings.covariance import tracker_noise
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, SCALINGS, Mode, usual_mode
from hilcal.refinement import Refinement
from hilcal.refinement import refine as refine_model
from hilcal.store.plan import Plan
from hilcal.store.schema import HEADER
from hilcal.stream import fit as streams
from hilcal.stream.fit import StreamFit
from hilcal.tables.importing import import_readings
from hilcal.tables.parquet_stream import open_stream
from hilcal.types import Floats

if TYPE_CHECKING:  # needs Pinocchio, which a fit does not
    from hilcal.design.summary import CheckedPlan
    from hilcal.drivers.simulated.rehearsal import Rehearsal, SimulationCase


def read_table(path: str | Path, cell: Cell, mapping: str | Path | None = None) -> Readings:
    """Read a table of readings: the exchange table, or any other by a mapping.

    >>> cell = hc.Cell.load(CELL)
    >>> readings = hc.read_table(TABLE, cell)
    >>> readings.load_names
    ('none', '5kg', '10kg', 'pull x', 'pull y')

    Args:
        path: the table; without a mapping the exchange table, docs/reference/exchange-table.md.
        cell: the cell that it was measured in; its tracker gives the covariances where the table
            has none, the readings themselves where it states no noise, and its [repeatability] is
            added where the table's do not include it.
        mapping: what `hilcal import --format` takes: the path of a mapping file
            (docs/how-to/import-a-table.md), or the name of a format.

    Raises:
        InputError: anything that cannot be right, with row and column.
    """
    form, config = "table" if mapping is None else mapping, cell.configured()
    imported = import_readings(Path(path), form, config, cell.arm)
    found, noise = with_estimated_noise(imported, cell, config)
    readings = full_readings(found.readings, found.covers, cell, config)
    return replace(readings, noise_stated=noise is None)


def fit_stream(
    path: str | Path,
    cell: Cell,
    effects: Sequence[str] | None = None,
    *,
    prior: CarriedPrior | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> StreamFit:
    """Fit a model to readings that need not fit into memory: a Parquet file, in passes.

    >>> cell = hc.Cell.load(CELL)
    >>> found = hc.fit_stream(STREAM, cell, ["joint_compliance"], workers=1)
    >>> found.model.names, found.converged
    (('base_frame', 'joint_compliance'), True)

    Args:
        path: a Parquet file with the columns of the exchange table; `pose` and `load` are not
            needed, each row stands alone.
        effects: names of effects, besides unknown frames; the baseline's where None.
        prior: what another campaign taught of the arm.
        workers: processes of this machine, one per processor by default.
        scheduler: address of a Dask cluster in their place, whose workers read the same path.

    Raises:
        InputError: a damaged file, or a row that cannot be right, by its number.
        CannotAnswerError: readings that do not determine an unknown frame.
    """
    tracker = cell.configured().tracker
    stream = open_stream(Path(path), cell.arm, tracker_noise(tracker), tracker.station_m)
    named: dict[str, Options] | None = None if effects is None else {name: {} for name in effects}
    with open_engine(workers, scheduler) as engine:
        return streams.fit_stream(stream, cell, engine, named, prior=prior)


def bootstrap(
    found: Fit,
    draws: int = bootstraps.DRAWS,
    *,
    seed: int = 0,
    workers: int | None = 1,
    scheduler: str | None = None,
) -> bootstraps.Bootstrap:
    """Draw the poses of a fit again and again, and fit its model to each draw.

    >>> cell = hc.Cell.load(CELL)
    >>> readings = hc.read_table(TABLE, cell)
    >>> found = hc.bootstrap(hc.fit(hc.baseline(cell, readings), readings), draws=20)
    >>> found.theta.shape, found.interval(0.9).shape
    ((20, 12), (2, 12))

    Args:
        found: the fit whose standard uncertainties are in question; `ratio` compares them.
        seed: of the draws; the result does not depend on the workers.
        workers: processes of this machine; None is one per processor, for scripts that begin with
            `if __name__ == "__main__"`.
        scheduler: address of a Dask cluster in their place.
    """
    with open_engine(None if scheduler is not None else workers, scheduler) as engine:
        return bootstraps.bootstrap(found, engine, draws, seed)


def baseline(
    cell: Cell | Campaign,
    data: Readings | Campaign | None = None,
    readings: str | None = None,
    catalogue: Catalogue | None = None,
    prior: Posterior | CarriedPrior | None = None,
) -> Model:
    """Return the model that every campaign starts from.

    Unknown frames are registered and become part of the model; joint compliance joins where any
    reading was taken under a load.

    >>> cell = hc.Cell.load(CELL)
    >>> model = hc.baseline(cell, hc.read_table(TABLE, cell))
    >>> (model + "base_compliance" + hc.effect("creep", joints="each")).names
    ('base_frame', 'joint_compliance', 'base_compliance', 'creep')
    >>> hc.baseline(hc.Campaign(RUN)).names
    ('base_frame', 'joint_compliance')

    Args:
        cell: the cell; or a campaign, which has its cell, its readings and its catalogue.
        data: the readings, where `cell` is no campaign.
        readings: "deflection" or "absolute"; as the cell plans and the data allow where None.
        catalogue: the effects that a model can have; the installed ones where None.
        prior: what another campaign taught of this arm, from `load_posterior`; its effects are in
            the model, and fits start from what it knows. `carried_prior` says more of the two.

    Raises:
        InputError: another kind of readings, or a prior that is not one of these readings.
        CannotAnswerError: the readings do not determine an unknown frame.
    """
    if isinstance(cell, Campaign):
        data, catalogue = cell.readings if data is None else data, catalogue or cell.catalogue
        cell = cell.cell
    if data is None:
        raise InputError("a cell without readings; valid: baseline(cell, readings), baseline(run)")
    data, known = _readings(data), _carried(prior, catalogue)
    return starting_models.baseline(cell, data, _mode(readings, data, cell), catalogue, known)


def _readings(data: Readings | Campaign) -> Readings:
    return data.readings if isinstance(data, Campaign) else data


def _with_prior(model: Model, data: Readings, prior: Posterior | CarriedPrior) -> Model:
    """Return a model with what another campaign taught of those effects that it has."""
    carried = _carried(prior, model.catalogue)
    if carried is not None:
        check_prior(carried, model.cell.arm, data)
    return replace(model, prior=carried)


def _carried(
    prior: Posterior | CarriedPrior | None, catalogue: Catalogue | None
) -> CarriedPrior | None:
    """Return a posterior as prior, of the same arm."""
    return carried_prior(prior, catalogue=catalogue) if isinstance(prior, Posterior) else prior


def fit(
    model: Model,
    data: Readings | Campaign,
    readings: str | None = None,
    scaling: str = "gc",
    prior: Posterior | CarriedPrior | Floats | None = None,
    *,
    mode: str | None = None,
) -> Fit:
    """Fit a model to readings by whitened Gauss-Newton.

    >>> with hc.Campaign.open(RUN) as run:
    ...     found = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> found.model.names
    ('base_frame', 'joint_compliance')
    >>> found.parameters["joint_compliance.j2"].unit
    'rad/(N·m)'
    >>> found.error.rms_sigma < found.holdout.rms_sigma
    True

    Args:
        data: the readings, or their campaign.
        readings: "deflection" or "absolute"; as the cell plans and the data allow where None.
        scaling: "none", "gu" or "gc" (whitened by the full covariance).
        prior: what another campaign taught of this arm, for those effects that the model has in
            common with it (`baseline` adds the others); or (P,) standard deviations of zero-mean
            priors, infinite for flat ones, zero for parameters held at zero; where None, those of
            the effects.
        mode: another name of `readings`; results call it `mode`.

    Raises:
        InputError: another kind of readings or of scaling, or a deflection without its unloaded
            reading.
        CannotAnswerError: fewer measured elements than identifiable parameters.
    """
    data, readings = _readings(data), _either(readings, mode)
    std: Floats | None = None
    if isinstance(prior, Posterior | CarriedPrior):
        model = _with_prior(model, data, prior)
    else:
        std = prior
    data = with_prior_scatter(model, data)
    if scaling not in SCALINGS:
        raise InputError(f"scaling {scaling!r} is unknown; valid: {', '.join(SCALINGS)}")
    found = fits.fit(model, data, _mode(readings, data, model.cell), scaling, prior=std)
    return with_serial_noise(found, std)


def diagnose(
    fit: Fit | Campaign, history: History = NOTHING, say: Callable[[str], None] = lambda text: None
) -> Diagnosis:
    """Judge a fit.

    >>> with hc.Campaign.open(RUN) as run:
    ...     found = hc.fit(hc.baseline(run), run)
    >>> d = hc.diagnose(found)
    >>> d.verdict, d.suspects[0].effect
    ('missing_effect', 'joint_tilt_compliance')

    Args:
        fit: the fit; or a campaign, of which the revision in use is judged.
        history: how its model was reached; of a campaign, as it tells.
        say: takes progress, one line each.

    Raises:
        InputError: for a fit whose residual is not whitened, or of too many readings; a campaign
            without a revision.
    """
    if isinstance(fit, Campaign):
        return judge_fit(fit.fit(), fit.history(), say)
    return judge_fit(fit, history, say)


def load_posterior(path: str | Path, catalogue: Catalogue | None = None) -> Posterior:
    """Return what an earlier campaign taught of its arm, as prior of another one.

    >>> with hc.Campaign.open(RUN) as run:
    ...     number = run.append(hc.fit(hc.baseline(run.cell, run.readings), run.readings))
    >>> posterior = hc.load_posterior(RUN)
    >>> posterior.arm, posterior.effects[0].name
    ('ur10e', 'joint_compliance')

    Args:
        path: a campaign file, of which the revision in use is taken, or a JSON file of a posterior.
        catalogue: has its effects; the installed ones where None.

    Raises:
        InputError: no such file, neither of both, or a campaign without a revision.
        CannotAnswerError: its model has no effect of the arm.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            is_campaign = stream.read(len(HEADER)) == HEADER
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if not is_campaign:
        return posterior_document.read(path)
    with Campaign.open(path, catalogue, read_only=True) as run:
        return run.posterior()


def refine(
    model: Model | Campaign,
    data: Readings | Campaign | None = None,
    readings: str | None = None,
    prior: Posterior | CarriedPrior | None = None,
    discover: str | Path | None = None,
    background: bool = True,
    *,
    mode: str | None = None,
) -> Refinement:
    """Fit, diagnose, add the leading suspect, and repeat until the model is adequate.

    >>> with hc.Campaign.open(RUN) as run:
    ...     path = hc.refine(hc.baseline(run.cell, run.readings), run.readings)
    ...     number = run.append(path)
    >>> [step.added for step in path.steps]
    [None, 'joint_tilt_compliance']

    Args:
        model: the starting model; or a campaign alone, from its baseline on.
        data: the readings, or their campaign.
        readings: "deflection" or "absolute"; as the cell plans and the data allow where None.
        prior: as for `fit`.
        discover: a folder; a law is then searched where no effect explains the misfit, as by
            `hilcal refine --discover`, and the files of laws that stay are written there.
        background: whether all effects of the catalogue predict together where the named ones
            leave more than noise.
        mode: another name of `readings`.

    Raises:
        InputError: another kind of readings, a prior that is not one of them, or no such folder.
        CannotAnswerError: fewer measured elements than identifiable parameters.
    """
    asked = _either(readings, mode)
    if isinstance(model, Campaign):
        data = model.readings if data is None else data
        model = baseline(model, data, asked, prior=prior)
    elif data is None:
        raise InputError("a model without readings; valid: refine(model, readings), refine(run)")
    data = _readings(data)
    if prior is not None:
        model = _with_prior(model, data, prior)
    kind = _mode(asked, data, model.cell)
    if discover is None:
        return refine_model(model, data, kind, background=background)
    if not Path(discover).is_dir():
        raise InputError(f"discover={str(discover)!r}: no such folder; valid: one for laws' files")
    laws = LawSearch(Path(discover))
    found = refine_model(model, data, kind, laws=laws, background=background)
    laws.write(found.names)
    return found


def plan(
    cell: Cell,
    poses: int = 20,
    criterion: str | None = None,
    given: Fit | None = None,
    seed: int = 0,
    prior: Posterior | CarriedPrior | None = None,
) -> "CheckedPlan":
    """Choose poses, loads and their order by optimal design, with a certificate.

    >>> plan = hc.plan(hc.Cell.load(CELL), poses=6)
    >>> plan.efficiency > 0.8
    True

    Args:
        cell: the cell with its limits, loads and `[planning]`, from `Cell.load`.
        poses: how many, each read unloaded and under every load that it bears.
        criterion: "D", "A", "E", "K", "I" or "separate"; as `[planning]` has it where None.
        given: a fit of what has been measured already.
        seed: of the random candidates.
        prior: what another campaign taught of this arm; the model is planned for with what it
            knows. Not beside `given`, which has its own.

    Raises:
        InputError: numbers or names that cannot be, or a cell without configuration.
        CannotAnswerError: the cell leaves too few poses, or the readings are too few.
    """
    with needed_by("a plan"):
        from hilcal.design.planner import Request, make
        from hilcal.design.summary import about, checked, summarise

    config, rng = cell.configured(), np.random.default_rng(seed)
    if given is not None and prior is not None:
        raise InputError("a plan after a fit has the prior of that fit; leave out one of both")
    request = Request(poses, criterion=criterion)
    planned = make(cell, config, request, rng, given, prior=_carried(prior, None))
    file = replace(planned.ordered.plan, about=about(planned))
    return checked(cell, config, file, summarise(planned, config, rng, compare=False))


def simulate(
    cell: "Cell | SimulationCase",
    plan: "CheckedPlan | Plan",
    hide: str = "nothing",
    seed: int = 0,
    catalogue: Catalogue | None = None,
) -> "Rehearsal":
    """Measure a plan in a simulated cell in which an effect is hidden.

    The arm, its tracker and what is hidden are drawn from the seed. No device is simulated; the
    readings are drawn at once, each the mean of `[acquire] samples` measurements.

    >>> cell = hc.Cell.load(CELL)
    >>> plan = hc.plan(cell, poses=6)
    >>> first = hc.simulate(cell, plan, hide="creep", seed=3)
    >>> again = hc.simulate(first, plan, seed=4)  # the same arm, other noise
    >>> first.hidden, len(first.readings) == len(again.readings)
    ('creep', True)

    Args:
        cell: the cell, whose `[simulation]` has the strength of what is hidden; or what an earlier
            call returned, for a further campaign of the same arm.
        hide: of the first campaign: an effect of `hilcal effects`, "random", "nothing", or
            "invented", a law that the catalogue lacks.
        seed: of everything random; of a further campaign of its noise.
        catalogue: has effects of your own, which can be hidden, too.

    Returns:
        The campaign: `readings`, `hidden`, `mode`, and the truth in `world`; `save` writes a
        campaign file.

    Raises:
        InputError: an effect that cannot be hidden; lists the valid ones.
    """
    with needed_by("a simulated cell"):
        from hilcal.drivers.simulated import rehearsal  # the simulated world is of no use but here

    what = plan if isinstance(plan, Plan) else plan.plan
    if not isinstance(cell, Cell):
        return rehearsal.read_plan(cell, what, [seed])
    if hide == rehearsal.INVENTED:
        catalogue = rehearsal.invented_law(catalogue or installed())
    config = cell.configured()
    case = rehearsal.case_of_plan(config, what, hide, seed, catalogue, cell.base_dir)
    return rehearsal.read_plan(case, what, [seed, 1])


@contextmanager
def view(run: Campaign | str | Path, port: int = 9877) -> Iterator[str]:
    """Serve the story of a campaign's revision in use to rerun viewers while the block lasts.

    >>> with hc.Campaign.open(RUN) as run, hc.view(run, port=PORT) as url:
    ...     url
    'rerun+http://127.0.0.1:.../proxy'
    """
    from hilcal.present.viewer import serve

    with opened(run) as campaign, serve(build_story(campaign.chapters()), port=port) as url:
        yield url


def _either(readings: str | None, mode: str | None) -> str | None:
    """Return the kind of readings, by either of its names."""
    if readings is not None and mode is not None and readings != mode:
        raise InputError(f"readings = {readings!r} and mode = {mode!r}; valid: one of both")
    return mode if readings is None else readings


def _mode(asked: str | None, data: Readings, cell: Cell) -> Mode:
    """Check the kind of readings; as the cell plans and the data allow where none is asked for."""
    if asked is None:
        config = cell.config
        return usual_mode(data) if config is None else usual_mode(data, config.planning.readings)
    if asked not in MODES:
        raise InputError(f"readings {asked!r} is unknown; valid: {', '.join(MODES)}")
    return asked
