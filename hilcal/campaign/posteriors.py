"""`load_posterior`, `load_prior`: the posterior of a campaign from a file, and a prior of it."""

from collections.abc import Mapping
from pathlib import Path

from hilcal.campaign.campaign import Campaign
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import InputError
from hilcal.identification.carried.carried_prior import CarriedPrior, carried_prior
from hilcal.identification.carried.posterior import Posterior, read_posterior
from hilcal.store.schema import HEADER


def load_posterior(
    path: str | Path, catalogue: Catalogue | None = None, revision: int | None = None
) -> Posterior:
    """Return the posterior of a campaign, which can be the prior of another one.

    >>> with hc.Campaign.open(RUN) as run:
    ...     number = run.append(hc.fit(hc.baseline(run.cell, run.readings), run.readings))
    >>> posterior = hc.load_posterior(RUN)
    >>> posterior.arm, posterior.effects[0].name
    ('ur10e', 'joint_compliance')

    Args:
        path: a campaign file, or a JSON file of a posterior.
        catalogue: the effects that its model can have; None: the installed ones.
        revision: of the campaign; None: the one in use.

    Raises:
        InputError: no such file, a file of another kind, no such revision, or a campaign without
            any.
        CannotAnswerError: the model has no effect of the arm.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            is_campaign = stream.read(len(HEADER)) == HEADER
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if not is_campaign:
        if revision is not None:
            raise InputError(f"{path}: a posterior has no revisions; valid: a campaign")
        return read_posterior(path)
    with Campaign.open(path, catalogue, read_only=True) as run:
        return run.posterior(revision)


def load_prior(
    path: Path,
    catalogue: Catalogue | None,
    relation: str = "arm",
    drift: Mapping[str, float] | None = None,
    revision: int | None = None,
) -> CarriedPrior:
    """Return the prior that a file states for a later campaign; see `carried_prior`.

    Raises:
        InputError: as of `load_posterior`; or the posterior is no prior in this relation.
    """
    posterior = load_posterior(path, catalogue, revision)
    try:
        return carried_prior(posterior, relation, drift or {}, catalogue)
    except InputError as error:
        raise InputError(f"--prior {path}: {error}") from None
