"""`--prior OTHER.hilcal`: what another campaign of the arm taught, for this one."""

from dataclasses import dataclass
from pathlib import Path

from hilcal.campaign.campaign import Campaign
from hilcal.cli.files import chosen
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import InputError
from hilcal.identification.arm_scatter import with_prior_scatter
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried import CarriedPrior, carried_prior
from hilcal.identification.fit import Fit, fit


@dataclass(frozen=True, slots=True)
class PriorOptions:
    """The options as they were given."""

    path: Path | None
    relation: str
    drift: str | None

    def load(self, catalogue: Catalogue) -> CarriedPrior | None:
        """Return the prior; None where none is asked for.

        Raises:
            InputError: a file or an option that cannot be.
            CannotAnswerError: a campaign that taught nothing of its arm.
        """
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
    """Return a fit of the same effects and those of a prior, with it; nothing is stored.

    Raises:
        InputError: a fit that has a prior already, or a prior that is not one of these readings.
    """
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
