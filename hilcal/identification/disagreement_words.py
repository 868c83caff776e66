"""What is said of readings that are far off and yet fitted."""

from hilcal.identification.fit import Fit
from hilcal.identification.full_prediction import names
from hilcal.identification.robust_start import MOST


def disagreement_words(fit: Fit) -> str:
    """Return the disagreement of a fit's readings in a sentence; empty where there is none."""
    found, readings = fit.disagreement, fit.readings
    if found is None:
        return ""
    count = f"{len(found.rows)} of {len(readings)}"
    if found.kind == "many":
        return (
            f"more than {100 * MOST:.0f} % of the readings disagree with what the others agree on, "
            f"too many to tell wrong ones from right ones ({count} are beyond the noise): none was "
            "set aside, and nothing that is fitted to them holds; find out what went wrong in "
            "measuring"
        )
    first, last = ("/".join(names(readings, int(found.rows[k]))) for k in (0, -1))
    return (
        f"{count} readings, between {first} and {last}, are off by the same shift, so that they "
        "have one cause: another reflector, a target moved on the tool, a tracker that was bumped. "
        "They were not set aside; give them a target of their own, or leave them out"
    )
