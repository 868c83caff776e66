"""What the commands share: the fit in use, effects and their options, a prior, recordings."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hilcal.campaign.campaign import Campaign
from hilcal.cli.options import check_folder, command
from hilcal.cli.terminal import Terminal
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.effects.written import chosen_options, read_effects_text, write_effect
from hilcal.errors import InputError
from hilcal.identification.arm_scatter import with_prior_scatter
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried import CarriedPrior, carried_prior
from hilcal.identification.fit import Fit, fit
from hilcal.model.model import Model
from hilcal.present.fit import model_name
from hilcal.present.progress import Say, working
from hilcal.present.story import Chapter, build_story
from hilcal.readings.whitening import MODES, SCALINGS, Mode, Scaling
from hilcal.store.revision import RevisionRecord


def fit_of(t: Terminal, run: Campaign, say: Say, revision: int | None) -> tuple[int | None, Fit]:
    """Return number and fit of the revision in use; without any the baseline, which is not kept."""
    _tell_accepted(t, run, revision)
    number, found = run.fit_in_use(say, revision)
    if number is None:
        t.notice(
            f"no revision yet: taking the baseline ({model_name(found.model.named)}; "
            f"{found.mode} readings); hilcal identify keeps it"
        )
    return number, found


def record_of(t: Terminal, run: Campaign, say: Say, revision: int | None) -> RevisionRecord:
    """Return the revision in use as stored; without any that of the baseline, number 0."""
    record = run.in_use(revision)
    if record is None:
        return run.record(fit_of(t, run, say, revision)[1])
    _tell_accepted(t, run, revision)
    return record


def stored_fit(t: Terminal, run: Campaign, say: Say, revision: int | None) -> tuple[int, Fit]:
    """Do the same for a command that makes a revision; the baseline becomes revision 1."""
    _tell_accepted(t, run, revision)
    number, found = run.fit_in_use(say, revision)
    if number is None:
        number = run.store(found)
        t.notice(
            f"no revision yet: made the baseline, revision {number} "
            f"({model_name(found.model.named)}; {found.mode} readings)"
        )
    return number, found


def _tell_accepted(t: Terminal, run: Campaign, revision: int | None) -> None:
    """Say that an accepted revision is used where there are later ones."""
    accepted, latest = run.file.accepted(), run.latest()
    if revision is None and latest is not None and accepted not in (None, latest.number):
        t.notice(f"using revision {accepted}, which is accepted; the latest is {latest.number}")


def finish(found: Fit, say: Say) -> None:
    """Compute what a fit's report and its document hold, while it is said what is done."""
    say("predicting the poses left out")
    _ = found.holdout
    say("computing standard uncertainties")
    _ = found.uncertainty


def called(number: int | None) -> str:
    """Return how a revision is called in a heading; None is the baseline that is not kept."""
    return "Baseline, not kept" if number is None else f"Revision {number}"


def mode_of_option(run: Campaign, asked: str | None) -> Mode:
    """Kind of readings: as asked, else as in the latest revision, else what they allow."""
    if asked is None:
        return run.mode()
    for known in MODES:
        if asked == known:
            return known
    raise InputError(f"--readings {asked!r} is unknown; valid: {', '.join(MODES)}")


def scalings(name: str) -> tuple[Scaling, ...]:
    """Return the scalings that `--scaling` asks for; the one that is kept comes last."""
    if name == "all":
        return SCALINGS
    found = tuple(s for s in SCALINGS if s == name)
    if not found:
        raise InputError(f"--scaling {name!r} is unknown; valid: {', '.join(SCALINGS)}, all")
    return found


def wanted_effects(given: str | None, catalogue: Catalogue) -> dict[str, dict[str, object]] | None:
    """Read `--effects "a, b(option=value)"`: options by name, see `read_effects_text`."""
    if given is None:
        return None
    wanted = read_effects_text(given, "--effects", catalogue)
    if not wanted:
        raise InputError("--effects is empty; give one name or several, separated by commas")
    return wanted


def effect_names(asked: str | None, catalogue: Catalogue) -> tuple[str, ...] | None:
    """Read names of effects where they cannot have options; raises as `wanted_effects` does."""
    wanted = wanted_effects(asked, catalogue)
    for name, options in (wanted or {}).items():
        if options:
            raise InputError(f"--effects: {name} takes no options here; valid: {name}")
    return None if wanted is None else tuple(wanted)


def check_options(o: Campaign, wanted: Mapping[str, Options]) -> None:
    """Refuse options of effects before any work is done."""
    for name, options in wanted.items():
        o.catalogue.make(name, o.cell, o.readings.states, options).prior_std()


def chosen(found: Fit) -> dict[str, dict[str, object]]:
    """Options of the effects of a fit that are not the usual ones, by name."""
    return chosen_of(found.model, found.readings)


@command()
def chosen_of(model: Model, readings: str | None) -> None:
    """Options of the effects of a model that are not the usual ones for its readings, by name."""
    named = (e for e in model.effects if e.name not in model.background)
    options = {e.name: chosen_options(e, readings.states, readings.m) for e in named}
    return {name: given for name, given in options.items() if given}


@command()
def titles(model: Model, readings: str | None) -> None:
    """Names of a model's effects, with the options that are not the usual ones."""
    given = chosen_of(model, readings)
    return tuple(write_effect(name, given.get(name, {})) for name in model.named)


def check_record(path: Path | None) -> None:
    """Refuse a recording that cannot be written before any work is done."""
    if path is not None:
        check_folder(path, f"--record {path}")


def record_story(t: Terminal, chapters: list[Chapter], path: Path | None) -> None:
    """Write a recording, where it is asked for."""
    if path is None:
        return
    from hilcal.present.viewer import save  # loads the viewer's library, which takes a while

    with working(t.progress) as say:
        say(f"writing {path}")
        save(build_story(chapters), path)
    t.notice(f"recorded {path}; open it with: rerun {path}")


@dataclass(frozen=True, slots=True)
class PriorOptions:
    """The options as they were given."""

    path: Path | None
    relation: str
    drift: str | None

    def load(self, catalogue: Catalogue) -> CarriedPrior | None:
        """Return the prior; None where none is asked for."""
        if self.path is None:
            if self.drift is not None:
                raise InputError("--drift is of a prior; give --prior OTHER.hilcal as well")
            return None
        from hilcal.library import load_posterior  # imports all that a script can do

        posterior = load_posterior(self.path, catalogue)
        try:
            return carried_prior(posterior, self.relation, _drifts(self.drift), catalogue)
        except InputError as error:
            raise InputError(f"--prior {self.path}: {error}") from None


def fitted_with(prior: CarriedPrior, o: Campaign, found: Fit) -> Fit:
    """Return a fit of the same effects and those of a prior, with it; nothing is stored."""
    if found.model.prior is not None:
        known = found.model.prior.posterior.source.campaign or "a posterior"
        raise InputError(f"the revision has a prior already, {known}; leave out --prior")
    learnt = [e.name for e in prior.posterior.effects]
    more = [n for n in learnt if o.catalogue[n].computable(o.readings.states)]
    names = dict.fromkeys((*found.model.names, *more))
    model = with_effects(o.cell, o.readings, found.mode, names, chosen(found), o.catalogue, prior)
    return with_serial_noise(fit(model, with_prior_scatter(model, found.readings), found.mode))


def _drifts(text: str | None) -> dict[str, float]:
    """Read "a=0.1,b=0.2"."""
    found = {}
    for part in (text or "").split(","):
        name, equals, value = (w.strip() for w in part.partition("="))
        if not part.strip():
            continue
        try:
            found[name] = float(value) if equals else float("nan")
        except ValueError:
            raise InputError(f"--drift {part.strip()!r}; valid: EFFECT=NUMBER") from None
    return found
