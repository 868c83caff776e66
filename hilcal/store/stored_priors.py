"""Priors among the records of a campaign file: each is stored once, and named by its hash."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from hilcal.store.revision import RevisionRecord
from hilcal.toml import parse_json

CARRIED = "carried_prior"
"""Key among the parameters of a revision: the prior that it was fitted with, as JSON."""
_POSTERIOR, _HASH = "posterior", "posterior_sha256"


def key_of(sha256: str) -> str:
    """Key of a posterior in the file."""
    return f"posterior {sha256}"


def split(record: RevisionRecord) -> tuple[RevisionRecord, str | None, str]:
    """Return a record that names its posterior, the key of that in the file, and its text."""
    carried = record.parameters_json.get(CARRIED)
    if carried is None:
        return record, None, ""
    text = json.dumps(carried[_POSTERIOR], allow_nan=False, sort_keys=True)
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    named = {k: v for k, v in carried.items() if k != _POSTERIOR} | {_HASH: sha256}
    parameters = {**record.parameters_json, CARRIED: named}
    return replace(record, parameters_json=parameters), key_of(sha256), text


def join(record: RevisionRecord, stored: Mapping[str, str]) -> RevisionRecord:
    """Return a record with the posterior that it names.

    Raises:
        ValueError: the posterior is not among them.
    """
    carried: Any = record.parameters_json.get(CARRIED)
    if carried is None:
        return record
    if not isinstance(carried, Mapping):
        raise ValueError("a prior is no document")
    text = stored.get(key_of(str(carried.get(_HASH))))
    if text is None:
        raise ValueError("a prior is missing")
    whole = {k: v for k, v in carried.items() if k != _HASH} | {_POSTERIOR: parse_json(text)}
    return replace(record, parameters_json={**record.parameters_json, CARRIED: whole})
