"""The record of a model revision: model, data, program and result of a fit."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from typing import Any

from hilcal.config.cell import Changes
from hilcal.errors import InputError
from hilcal.names import check_names
from hilcal.shown import Brief
from hilcal.store.stored_schema import REVISION, check
from hilcal.toml import parse_json

STORED_HASH = "stored_sha256"
"""Key in the options of a revision: hash of the readings as stored, without computed scatter."""

CELL = "cell"  # key in the options of a revision: the changes of the cell, see `config.cell`


def utc_now() -> str:
    """Return the present time, ISO 8601, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def seconds_of(date: str, where: str = "date") -> float:
    """Return the seconds since 1970 of a date in ISO 8601; UTC unless it states a zone."""
    try:
        parsed = datetime.fromisoformat(date)
    except ValueError:
        raise InputError(f"{where}: {date!r}; valid: a date as 2026-03-31") from None
    return (parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)).timestamp()


@dataclass(frozen=True, slots=True)
class RevisionRecord(Brief):
    """A fit as a campaign file stores it; all mappings are JSON."""

    effects: tuple[str, ...]  # canonical names of the model's effects, in order
    added: str | None  # the effect added to the parent's model; None for a first model
    options: Mapping[str, Any]  # scaling, kind of readings, options of the effects
    data_hash: str  # `content_hash` of the fitted readings
    program_version: str  # version of the program that fitted
    parameters_json: Mapping[str, Any]  # the parameters, sufficient for predictions
    result_json: Mapping[str, Any]  # results as in `identify --json` and `diagnose --json`
    created: str = field(default_factory=utc_now)  # ISO 8601, UTC
    number: int = 0  # 1, 2, ... in one campaign, given by it
    removed: str | None = None  # the effect removed from the parent's model
    parent: int | None = None
    """Number of the parent revision; None for the previous revision, or a first model."""

    def _brief(self) -> dict[str, str]:
        return {
            "number": str(self.number),
            "model": " + ".join(self.effects),
            "added": str(self.added),
            "removed": str(self.removed),
            "verdict": str(self.verdict),
            "created": f"{self.created} by hilcal {self.program_version}",
            "more": "Campaign.fit(number)",
        }

    @property
    def verdict(self) -> str | None:
        """The verdict of the diagnosis that was stored with the fit; None without one."""
        verdict = self.result_json.get("diagnose", {}).get("verdict")
        return None if verdict is None else str(verdict)

    @property
    def cell(self) -> Changes:
        """Changes of the campaign's cell for this fit; empty without any."""
        changes: Changes = self.options.get(CELL, {})
        return changes

    @property
    def made_from(self) -> int | None:
        """Number of the parent revision, also where it is the previous one; None without one."""
        if not self.has_parent or self.number <= 1:
            return None
        return self.number - 1 if self.parent is None else self.parent

    @property
    def has_parent(self) -> bool:
        """Whether it was made from another revision."""
        changes = self.added, self.removed, self.parameters_json.get("arm_scatter"), self.parent
        return any(change is not None for change in changes)

    @property
    def scatter_alone(self) -> bool:
        """Whether it only adds the estimated scatter of the arm to the covariance."""
        scatter = self.parameters_json.get("arm_scatter") is not None
        return scatter and self.added is self.removed is None


BACKGROUND = "background"  # `added` of a revision whose other effects are a background


def change(
    added: str | None, removed: str | None, scatter: bool = False, named: Sequence[str] = ()
) -> str:
    """Return the change of a revision as "+ a", "− b" or "+ a − b"; empty for a first model.

    A background takes up added effects that the readings do not prove: with it, all that are
    `named` are listed.
    """
    if added == BACKGROUND and named:
        return " + ".join([*named, BACKGROUND])
    if scatter and added is None and removed is None:
        return "arm's scatter"
    return " ".join(f"{sign} {effect}" for sign, effect in (("+", added), ("−", removed)) if effect)


def to_text(record: RevisionRecord) -> str:
    """Return the JSON text of a record without its number; floats are exact, and finite."""
    content = {f.name: getattr(record, f.name) for f in fields(record) if f.name != "number"}
    if record.parent is None:
        del content["parent"]
    return json.dumps(content, allow_nan=False, sort_keys=True, ensure_ascii=False)


def from_text(text: str, number: int) -> RevisionRecord:
    """Return the record of a JSON text; a ValueError or InputError for a damaged one."""
    try:
        content = parse_json(text)
        r = RevisionRecord(**{**content, "effects": tuple(content["effects"])}, number=number)
        names = [*r.effects, r.data_hash, r.program_version, r.created, r.added, r.removed]
        check_names([name for name in names if name is not None], f"revision {number}, name")
        check(REVISION, content)
        return r
    except (LookupError, TypeError, AttributeError) as e:
        raise ValueError(str(e)) from e


def fitted_to(record: RevisionRecord) -> tuple[int, str] | None:
    """Return number and stored hash of the readings that were fitted; None without the hash."""
    identified = record.result_json.get("identify")
    count = identified.get("n_readings") if isinstance(identified, dict) else None
    stored = record.options.get(STORED_HASH)
    if not isinstance(count, int) or not isinstance(stored, str):
        return None
    return count, stored


CARRIED = "carried_prior"  # key in the parameters of a revision: another campaign's prior, JSON
_POSTERIOR, _HASH = "posterior", "posterior_sha256"
_KEY = "posterior {}"  # key of a posterior in the file, with its hash


def split(record: RevisionRecord) -> tuple[RevisionRecord, str | None, str]:
    """Move the posterior out of a record; return the record, and the posterior's key and text."""
    carried = record.parameters_json.get(CARRIED)
    if carried is None:
        return record, None, ""
    text = json.dumps(carried[_POSTERIOR], allow_nan=False, sort_keys=True)
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    named = {k: v for k, v in carried.items() if k != _POSTERIOR} | {_HASH: sha256}
    parameters = {**record.parameters_json, CARRIED: named}
    return replace(record, parameters_json=parameters), _KEY.format(sha256), text


def join(record: RevisionRecord, stored: Mapping[str, str]) -> RevisionRecord:
    """Put the posterior into a record that names one; a ValueError where it is missing."""
    carried: Any = record.parameters_json.get(CARRIED)
    if carried is None:
        return record
    if not isinstance(carried, Mapping):
        raise ValueError("a prior is no document")
    text = stored.get(_KEY.format(carried.get(_HASH)))
    if text is None:
        raise ValueError("a prior is missing")
    restored = {k: v for k, v in carried.items() if k != _HASH} | {_POSTERIOR: parse_json(text)}
    return replace(record, parameters_json={**record.parameters_json, CARRIED: restored})
