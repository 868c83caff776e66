"""The JSON of a fleet."""

from collections.abc import Mapping
from dataclasses import asdict

from hilcal.transfer.fleet import Fleet
from hilcal.transfer.pooled import Pooled


def to_json(fleet: Fleet, priors: Mapping[str, str]) -> dict[str, object]:
    """Return a fleet as JSON, SI.

    Args:
        fleet: the fleet.
        priors: file of the prior by type.
    """
    return {
        "types": [{**_type(t), "prior": priors.get(t.type)} for t in fleet.types],
        "campaigns": [
            {
                "name": m.name,
                "arm": m.arm,
                "arm_known_by": m.known,
                "type": m.type,
                "date": m.date,
                "verdict": m.verdict,
                "added": list(m.added),
                "holdout_rms_m": m.rms_m,
            }
            for m in fleet.members
        ],
        "failed": [asdict(f) for f in fleet.failures],
    }


def _type(t: Pooled) -> dict[str, object]:
    return {
        "type": t.type,
        "arms": list(t.arms),
        "n_campaigns": len(t.campaigns),
        "parameters": [asdict(p) for p in t.parameters],
        "unlike": [asdict(o) for o in t.odd],
        "effects_added": [asdict(s) for s in t.seen],
        "wear": list(t.wear),
    }
