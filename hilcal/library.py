"""The functions of `import hilcal`: thin, with defaults that suit a script."""

import atexit
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilcal.campaign.campaign import Campaign, opened
from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.diagnosis.diagnosis import Diagnosis, History
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.verdict import NO_HISTORY
from hilcal.diagnosis.verdict import diagnose as judge_fit
from hilcal.discovery.discovery import LawSearch
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import Options
from hilcal.engine import open_engine, with_one_blas_thread
from hilcal.errors import InputError, expect
from hilcal.identification import baseline as starting_models
from hilcal.identification import bootstrap as bootstraps
from hilcal.identification import fit as fits
from hilcal.identification.carried.carried_prior import CarriedPrior, carried_prior, check_prior
from hilcal.identification.carried.posterior import Posterior
from hilcal.identification.fit import Fit
from hilcal.identification.noise.arm_scatter import with_prior_scatter
from hilcal.identification.noise.full_covariance import (
    CovarianceParts,
    covariance_parts,
    full_readings,
)
from hilcal.identification.noise.noise_estimate import (
    NOISE_KEY,
    NoiseEstimate,
    with_estimated_noise,
)
from hilcal.model.model import Model
from hilcal.optional import needed_by
from hilcal.present.story import build_story
from hilcal.readings.covariance import COVERS_KEY, FROM_KEY, TRACKER, tracker_noise
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, SCALINGS, Mode, usual_mode
from hilcal.refinement import Refinement
from hilcal.refinement import refine as refine_model
from hilcal.robot.arm import array_of
from hilcal.shown import Brief
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, load_plan
from hilcal.stream import StreamFit
from hilcal.stream import fit_stream as fit_all
from hilcal.tables.files import table_file
from hilcal.tables.importing import import_readings
from hilcal.tables.parquet_stream import open_stream
from hilcal.types import Floats

PATHS = (str, Path)
A_CELL = "a Cell, as hc.Cell.load('CELL.toml')"
A_FIT = "a Fit, as of hc.fit(model, readings)"
A_SEED = "a whole number, 0 or more"
A_PRIOR = "a Posterior, as of hc.load_posterior('run.hilcal')"
A_MODEL = "a Model, as of hc.baseline(cell, readings)"
READINGS = (
    "Readings, as of hc.read_table('t.csv', cell), or a Campaign, as hc.Campaign('run.hilcal')"
)

if TYPE_CHECKING:  # needs Pinocchio, which a fit does not, or takes long
    import pandas as pd

    from hilcal.design.summary import CheckedPlan
    from hilcal.drivers.simulated.rehearsal import Rehearsal, SimulationCase


def read_table(
    path: "str | Path | pd.DataFrame", cell: Cell, mapping: str | Path | None = None
) -> Readings:
    """Read a table of readings: the exchange table, or any other by a mapping.

    >>> cell = hc.Cell.load(CELL)
    >>> readings = hc.read_table(TABLE, cell)
    >>> readings.load_names
    ('none', '5kg', '10kg', 'pull x', 'pull y')

    Args:
        path: the table, a file or a pandas data frame; without a mapping the exchange table,
            docs/reference/exchange-table.md.
        cell: the cell that the table was measured in. Where the table has no covariances, they are
            those of the cell's [tracker], or estimated from the readings where it states no noise.
            The cell's [repeatability] is added to covariances that do not include it.
        mapping: as in `hilcal import --format`: the path of a mapping file
            (docs/how-to/import-a-table.md), or the name of a format.

    Raises:
        InputError: an invalid value, with row and column.
    """
    with table_file(path) as table:
        expect(cell, Cell, "cell", A_CELL)
        form, config = "table" if mapping is None else mapping, cell.configured()
        imported = import_readings(table, form, config, cell.arm)
    estimated, noise = with_estimated_noise(imported, cell)
    readings = full_readings(estimated.readings, estimated.covers, cell)
    return replace(readings, noise_stated=noise is None)


@dataclass(frozen=True, slots=True, eq=False)
class Imported(Brief):
    """The result of an import."""

    cell: Cell
    readings: Readings  # as stored
    noise: NoiseEstimate | None  # None where the noise is stated, or cannot be estimated
    parts: CovarianceParts  # components of the covariances
    notes: tuple[str, ...]  # one sentence for each decision

    @property
    def config(self) -> CellConfig:
        """The configuration of the cell."""
        return self.cell.configured()


def import_campaign(
    table: "str | Path | pd.DataFrame",
    config: str | Path,
    output: str | Path,
    kind: str | Path = "table",
    second: str | Path | None = None,
    *,
    overwrite: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> Imported:
    """Make a campaign file from a table of readings, as `hilcal import` does.

    >>> made = hc.import_campaign(TABLE, CELL, IMPORTED)
    >>> len(made.readings) == len(hc.Campaign(IMPORTED).readings)
    True

    Args:
        table: a file or a pandas data frame.
        config: the path of the cell's configuration, CELL.toml.
        output: the campaign file.
        kind: as `mapping` of `read_table`.
        second: a second file that holds the other columns of the same readings.
        overwrite: replace an existing campaign.
        say: takes progress, one line each.

    Raises:
        InputError: an invalid value, with row and column, or a file that exists.
    """
    expect(config, PATHS, "config", "the path of a CELL.toml")
    expect(output, PATHS, "output", "the path of a campaign file")
    config, output = Path(config), Path(output)
    settings = load_config(config)
    base_dir = config.absolute().parent
    cell = cell_from_config(settings, base_dir)
    with table_file(table) as path:
        say(f"reading {path}")
        second = None if second is None else Path(second)
        imported = import_readings(path, kind, settings, cell.arm, second)
    if not imported.noise_stated:
        say("estimating the noise, which nothing states")
    imported, noise = with_estimated_noise(imported, cell)
    texts = {COVERS_KEY: imported.covers}
    texts |= {FROM_KEY: TRACKER} if imported.from_tracker else {}
    texts |= {} if noise is None else {NOISE_KEY: noise.to_json()}
    say(f"writing {output}")
    about = settings.to_json(), str(base_dir), f"{path.name} ({Path(kind).name})"
    readings = imported.readings
    CampaignFile.create(
        output, *about, overwrite=overwrite, more_texts=texts, readings=readings
    ).close()
    parts = covariance_parts(imported.covers, settings)
    return Imported(cell, readings, noise, parts, imported.notes)


def fit_stream(
    path: str | Path,
    cell: Cell,
    effects: Sequence[str] | None = None,
    *,
    prior: CarriedPrior | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> StreamFit:
    """Fit a model to a Parquet file of readings, in passes, without loading it into memory.

    >>> cell = hc.Cell.load(CELL)
    >>> fit = hc.fit_stream(STREAM, cell, ["joint_compliance"], workers=1)
    >>> fit.model.names, fit.converged
    (('base_frame', 'joint_compliance'), True)

    Args:
        path: a Parquet file with the columns of the exchange table; `pose` and `load` are not
            needed, rows are independent.
        effects: names of effects, besides unknown frames; None: those of the baseline.
        prior: the prior from another campaign of the arm.
        workers: processes of this machine, one per processor by default.
        scheduler: address of a Dask cluster to use instead, whose workers read the same path.

    Raises:
        InputError: a damaged file, or an invalid row, by its number.
        CannotAnswerError: readings that do not determine an unknown frame.
    """
    tracker = cell.configured().tracker
    stream = open_stream(Path(path), cell.arm, tracker_noise(tracker), tracker.station_m)
    named: dict[str, Options] | None = None if effects is None else {name: {} for name in effects}
    with open_engine(workers, scheduler) as engine:
        return fit_all(stream, cell, engine, named, prior=prior)


def bootstrap(
    fit: Fit,
    draws: int = bootstraps.DRAWS,
    *,
    seed: int = 0,
    workers: int | None = 1,
    scheduler: str | None = None,
) -> bootstraps.Bootstrap:
    """Resample the poses of a fit repeatedly, and fit its model to each draw.

    >>> cell = hc.Cell.load(CELL)
    >>> readings = hc.read_table(TABLE, cell)
    >>> result = hc.bootstrap(hc.fit(hc.baseline(cell, readings), readings), draws=20)
    >>> result.theta.shape, result.interval(0.9).shape
    ((20, 12), (2, 12))

    Args:
        fit: whose standard uncertainties `ratio` of the result compares.
        workers: processes of this machine, which the result does not depend on; None: one per
            processor, for scripts that begin with `if __name__ == "__main__"`.
        scheduler: address of a Dask cluster to use instead.
    """
    with open_engine(None if scheduler is not None else workers, scheduler) as engine:
        return bootstraps.bootstrap(fit, engine, draws, _checked_seed(seed))


@with_one_blas_thread
def baseline(
    cell: Cell | Campaign,
    data: Readings | Campaign | None = None,
    readings: str | None = None,
    catalogue: Catalogue | None = None,
    prior: Posterior | CarriedPrior | None = None,
) -> Model:
    """Return the model that every campaign starts from.

    The model has the unknown frames, and joint compliance where any reading was taken under a load.

    >>> cell = hc.Cell.load(CELL)
    >>> model = hc.baseline(cell, hc.read_table(TABLE, cell))
    >>> (model + "base_compliance" + hc.effect("creep", joints="each")).names
    ('base_frame', 'joint_compliance', 'base_compliance', 'creep')
    >>> hc.baseline(hc.Campaign(RUN)).names
    ('base_frame', 'joint_compliance')

    Args:
        cell: the cell; or a campaign, for its cell, readings and catalogue.
        data: the readings, where `cell` is no campaign.
        readings: "deflection" or "absolute"; None: as for `fit`.
        catalogue: the effects that a model can have; None: the installed ones.
        prior: the posterior of another campaign of this arm, from `load_posterior`, or a prior made
            from one by `carried_prior`. The model has its effects, and fits start from it.

    Raises:
        InputError: another kind of readings, or a prior that does not fit these readings.
        CannotAnswerError: the readings do not determine an unknown frame.
    """
    if isinstance(cell, Campaign):
        data, catalogue = cell if data is None else data, catalogue or cell.catalogue
        cell = cell.cell
    if data is None:
        raise InputError("a cell without readings; valid: baseline(cell, readings), baseline(run)")
    expect(cell, Cell, "cell", A_CELL)
    given, carried, mode = _readings(data), _carried(prior, catalogue), _mode(readings, data, cell)
    return starting_models.baseline(cell, given, mode, catalogue, carried)


def _readings(data: Readings | Campaign) -> Readings:
    if isinstance(data, Campaign):
        return data.readings
    expect(data, Readings, "data", READINGS)
    return data


def _with_prior(model: Model, data: Readings, prior: Posterior | CarriedPrior) -> Model:
    carried = _carried(prior, model.catalogue)
    if carried is not None:
        check_prior(carried, model.cell.arm, data)
    return replace(model, prior=carried)


def _carried(
    prior: Posterior | CarriedPrior | None, catalogue: Catalogue | None
) -> CarriedPrior | None:
    expect(prior, (Posterior, CarriedPrior, type(None)), "prior", A_PRIOR)
    return carried_prior(prior, catalogue=catalogue) if isinstance(prior, Posterior) else prior


@with_one_blas_thread
def fit(
    model: Model,
    data: Readings | Campaign | None = None,
    readings: str | None = None,
    scaling: str = "gc",
    prior: Posterior | CarriedPrior | Floats | None = None,
    *,
    mode: str | None = None,
) -> Fit:
    """Fit a model to readings by whitened Gauss-Newton.

    >>> with hc.Campaign.open(RUN) as run:
    ...     fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> fit.model.names
    ('base_frame', 'joint_compliance')
    >>> fit.parameters["joint_compliance.j2"].unit
    'rad/(N·m)'
    >>> fit.error.rms_sigma < fit.holdout.rms_sigma
    True

    Args:
        model: as of `baseline`, with effects added.
        data: readings, as of `read_table`, or a campaign.
        readings: "deflection" or "absolute"; None: that of a campaign's revision in use, else as
            the cell plans and the data allow.
        scaling: "none", "gu" or "gc" (whitened by the full covariance).
        prior: the posterior of another campaign of this arm, for the effects that the model shares
            with it (`baseline` adds the others); or (P,) standard deviations of zero-mean priors,
            infinite for flat ones, zero for parameters fixed at zero; None: those of the effects.
        mode: another name of `readings`, as in results.

    Returns:
        The fit, in SI units: `parameters`, `residuals`, `error`, `holdout`, `summary`, `predict`.

    Raises:
        InputError: another kind of readings or of scaling, or a deflection without its unloaded
            reading.
        CannotAnswerError: fewer measured elements than identifiable parameters.
    """
    if data is None:
        raise InputError("a model without readings; valid: fit(model, readings), fit(model, run)")
    expect(model, Model, "model", A_MODEL)
    given, kind = _readings(data), _mode(_either(readings, mode), data, model.cell)
    std: Floats | None = None
    if isinstance(prior, (Posterior, CarriedPrior, *PATHS)):
        model = _with_prior(model, given, prior)
    elif prior is not None:
        valid = f"{A_PRIOR}, or ({model.size},) standard deviations"
        std = array_of(prior, "prior", valid)
        if std.shape != (model.size,) or not (std >= 0).all():
            raise InputError(f"prior of shape {std.shape} or with values below 0; valid: {valid}")
    given = with_prior_scatter(model, given)
    if scaling not in SCALINGS:
        raise InputError(f"scaling {scaling!r} is unknown; valid: {', '.join(SCALINGS)}")
    fitted = fits.fit(model, given, kind, scaling, prior=std)
    return with_serial_noise(fitted, std)


@with_one_blas_thread
def diagnose(
    fit: Fit | Campaign,
    history: History = NO_HISTORY,
    say: Callable[[str], None] = lambda text: None,
) -> Diagnosis:
    """Diagnose a fit, or the revision in use of a campaign: what is missing, with a verdict.

    >>> with hc.Campaign.open(RUN) as run:
    ...     fit = hc.fit(hc.baseline(run), run)
    >>> d = hc.diagnose(fit)
    >>> d.verdict, d.suspects[0].effect
    ('missing_effect', 'joint_tilt_compliance')

    Args:
        fit: of scaling "gc"; or a campaign, for its revision in use.
        history: effects added to and removed from the model so far; that of the revision where
            `fit` is a campaign.
        say: takes progress, one line each.

    Returns:
        The diagnosis: `verdict`, `message`, and `suspects`, best first.

    Raises:
        InputError: a fit whose residual is not whitened, or of too many readings; a campaign
            without a revision.
    """
    if isinstance(fit, Campaign):
        return judge_fit(fit.fit(), fit.history(), say)
    expect(fit, Fit, "fit", f"{A_FIT}, or a Campaign with a revision")
    return judge_fit(fit, history, say)


@with_one_blas_thread
def refine(
    model: Model | Fit | Campaign,
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

    `readings`, `prior` and `mode` are as for `fit`.

    Args:
        model: the starting model; or a fit, for its model, its kind of readings and, unless others
            are given, its readings; or a campaign alone, for its baseline.
        data: readings, as of `read_table`, or a campaign.
        discover: a folder. Where no effect explains the misfit, a law is searched, as by
            `hilcal refine --discover`; the files of laws in the final model are written there.
        background: whether all effects of the catalogue are fitted together, as a background, where
            the named ones leave more than noise.

    Returns:
        The steps, with the `fit`, `diagnosis` and `verdict` of the last one.

    Raises:
        InputError: another kind of readings, a prior that does not fit them, or no such folder.
        CannotAnswerError: fewer measured elements than identifiable parameters.
    """
    readings = _either(readings, mode)
    if isinstance(model, Fit):
        data = model.readings if data is None else data
        readings, model = readings or model.mode, model.model
    if isinstance(model, Campaign):
        data = model if data is None else data
        model = baseline(model, data, readings, prior=prior)
    elif data is None:
        raise InputError("a model without readings; valid: refine(model, readings), refine(run)")
    expect(model, Model, "model", f"{A_MODEL}, a Fit, or a Campaign")
    given, kind = _readings(data), _mode(readings, data, model.cell)
    if prior is not None:
        model = _with_prior(model, given, prior)
    if discover is None:
        return refine_model(model, given, kind, background=background)
    if not Path(discover).is_dir():
        raise InputError(f"discover={str(discover)!r}: no such folder; valid: one for laws' files")
    laws = LawSearch(Path(discover))
    refinement = refine_model(model, given, kind, laws=laws, background=background)
    laws.write(refinement.names)
    return refinement


@with_one_blas_thread
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
        poses: number of poses, each read unloaded and under every load that it bears.
        criterion: "D", "A", "E", "K", "I" or "separate"; None: that of `[planning]`.
        given: a fit of the previous readings.
        prior: the prior from another campaign of this arm, unless `given` is stated, which has its
            prior.
        seed: seed of the choice.

    Returns:
        The plan, all motions checked: `efficiency`, `summary`, `to_frame`, `save`.

    Raises:
        InputError: invalid numbers or names, or a cell without configuration.
        CannotAnswerError: the cell leaves too few poses, or the readings are too few.
    """
    with needed_by("a plan"):
        from hilcal.design.planner import PlanRequest, plan_readings
        from hilcal.design.summary import about, checked, summarise

    expect(cell, Cell, "cell", A_CELL)
    expect(poses, (int, np.integer), "poses", "a whole number from 1")
    expect(given, (Fit, type(None)), "given", A_FIT)
    config, rng = cell.configured(), np.random.default_rng(_checked_seed(seed))
    if given is not None and prior is not None:
        raise InputError("a plan after a fit has the prior of that fit; leave out one of both")
    request = PlanRequest(poses, criterion=criterion)
    planned = plan_readings(cell, request, rng, given, prior=_carried(prior, None))
    file = replace(planned.ordered.plan, about=about(planned))
    return checked(cell, file, summarise(planned, config, rng, compare=False))


def simulate(
    cell: "Cell | SimulationCase",
    plan: "CheckedPlan | Plan | str | Path",
    hide: str = "nothing",
    seed: int = 0,
    catalogue: Catalogue | None = None,
) -> "Rehearsal":
    """Measure a plan in a simulated cell in which an effect is hidden.

    The arm, its tracker and the hidden effect are drawn by the seed. No device is simulated; each
    reading is drawn as the mean of `[acquire] samples` measurements.

    >>> cell = hc.Cell.load(CELL)
    >>> plan = hc.plan(cell, poses=6)
    >>> first = hc.simulate(cell, plan, hide="creep", seed=3)
    >>> again = hc.simulate(first, plan, seed=4)  # the same arm, other noise
    >>> first.hidden, len(first.readings) == len(again.readings)
    ('creep', True)

    Args:
        cell: the cell, whose `[simulation]` has the strength of the hidden effect; or the result of
            a previous call, for a further campaign of the same arm.
        plan: what to measure, as of `plan`, or the path of a plan file.
        hide: for a first campaign: an effect of `hilcal effects`, "random", "nothing", or
            "invented", a law that the catalogue lacks.
        seed: seed of all random numbers; for a further campaign, of its noise.
        catalogue: the effects that can be hidden; None: the installed ones.

    Returns:
        The campaign: `readings`, `hidden`, `mode`, and the truth in `world`; `save` writes a
        campaign file.

    Raises:
        InputError: an effect that cannot be hidden; lists the valid ones.
    """
    with needed_by("a simulated cell"):
        from hilcal.design.summary import CheckedPlan
        from hilcal.drivers.simulated import rehearsal  # needed here alone

    plan = load_plan(Path(plan)) if isinstance(plan, PATHS) else plan
    expect(plan, (CheckedPlan, Plan), "plan", "a plan, as of hc.plan(cell), or its path")
    bare_plan = plan if isinstance(plan, Plan) else plan.plan
    expect(cell, (Cell, rehearsal.SimulationCase), "cell", f"{A_CELL}, or a previous result")
    _checked_seed(seed)
    if not isinstance(cell, Cell):
        return rehearsal.simulate_plan(cell, bare_plan, [seed])
    if hide == rehearsal.INVENTED:
        catalogue = rehearsal.invented_law(catalogue or installed())
    case = rehearsal.case_of_plan(
        cell.configured(), bare_plan, hide, seed, catalogue, cell.base_dir
    )
    return rehearsal.simulate_plan(case, bare_plan, [seed, 1])


@dataclass(frozen=True, slots=True, eq=False)
class Served(Brief):
    """A story that rerun viewers can see at `url` until `close`, or until the program ends."""

    url: str
    close: Callable[[], None] = field(repr=False)

    def __enter__(self) -> str:
        """Return the address; the end of the block closes it."""
        return self.url

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()


def view(run: Campaign | str | Path, port: int = 9877) -> Served:
    """Serve the story of a campaign's revision in use to rerun viewers.

    >>> with hc.Campaign.open(RUN) as run, hc.view(run, port=PORT) as url:
    ...     url
    'rerun+http://127.0.0.1:.../proxy'

    Returns:
        The address `url`, served until `close()`, the end of a `with` block, or of the program.
    """
    from hilcal.present.viewer import serve

    server = ExitStack()
    with opened(run) as campaign:
        url = server.enter_context(serve(build_story(campaign.chapters()), port=port))
    atexit.register(server.close)
    return Served(url, server.close)


def _checked_seed(seed: int) -> int:
    expect(seed, (int, np.integer), "seed", A_SEED)
    if seed < 0:
        raise InputError(f"seed = {seed}; valid: {A_SEED}")
    return seed


def _either(readings: str | None, mode: str | None) -> str | None:
    """Return the kind of readings from either argument; refuse two that differ."""
    if readings is not None and mode is not None and readings != mode:
        raise InputError(f"readings = {readings!r} and mode = {mode!r}; valid: one of both")
    return mode if readings is None else readings


def _mode(kind: str | None, data: Readings | Campaign, cell: Cell) -> Mode:
    """Return the checked kind of readings; None: see `fit`."""
    if kind is None:
        if isinstance(data, Campaign):
            return data.mode()
        config = cell.config
        return usual_mode(data) if config is None else usual_mode(data, config.planning.readings)
    if kind not in MODES:
        raise InputError(f"readings {kind!r} is unknown; valid: {', '.join(MODES)}")
    return kind
