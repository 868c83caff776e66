"""Schemas of the documents in a campaign file, as far as the program reads them.

A document is checked when it is read. Keys that no schema names are kept.
"""

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, create_model

from hilcal.toml import Number

Schema = type[BaseModel]
Text = Annotated[str, Strict()]
Count = Annotated[int, Strict(), Field(ge=0)]
Whole = Annotated[int, Strict()]
Axes = tuple[Number, Number, Number]
Wrench = tuple[Number, Number, Number, Number, Number, Number]
Matrix = Annotated[list[tuple[float, ...]], Field(min_length=1)]


class _Document(BaseModel):
    """A document: finite numbers, further keys allowed."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class _Strict(_Document):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def _of(base: Schema = _Document, /, **keys: Any) -> Any:
    """Return a schema with keys of types, or of pairs of a type and a default."""
    fields: dict[str, Any] = {
        k: kind if isinstance(kind, tuple) else (kind, ...) for k, kind in keys.items()
    }
    return create_model("document", __base__=base, **fields)


def _list(kind: Any) -> Any:
    return list.__class_getitem__(kind)


_ERRORS = _of(mean_m=Number, rms_m=Number, max_m=Number, rms_sigma=Number)
_PARAMETER = _of(name=Text, unit=Text, value=Number | None, std=Number | None, identifiable=bool)
_ERROR = _of(fit=_ERRORS, holdout=_ERRORS)
_IDENTIFIED = _of(
    n_readings=Count, variance_factor=Number, error=_ERROR, parameters=_list(_PARAMETER)
)
_DIAGNOSED = _of(verdict=Text, rejected=(list[Text], []))
_OPTIONS = _of(
    readings=Literal["deflection", "absolute"],
    scaling=Literal["none", "gu", "gc"],
    effects=dict[str, dict[str, Any]],
    effects_from=(dict[str, dict[str, str]], {}),
    cell=(dict[str, dict[str, Any]], {}),
)
REVISION: Schema = _of(
    effects=list[Text],
    added=Text | None,
    removed=(Text | None, None),
    parent=(Whole | None, None),
    data_hash=Text,
    program_version=Text,
    created=(Text, ""),
    options=_OPTIONS,
    parameters_json=dict[str, Any],
    result_json=_of(identify=_IDENTIFIED, diagnose=(_DIAGNOSED | None, None)),
)
"""A revision, see `store.revision`."""
DETAIL: Schema = _of(
    epoch_wall_s=(Number | None, None),
    wall_s=(Number | None, None),
    time_s=(Number | None, None),
    q_actual=(tuple[Number, ...] | None, None),
    tracker_covariance=(Matrix | None, None),
)
"""The details of a reading."""
_DOUBTFUL = _of(DETAIL, pose=Text, load=Text, target=(Text | None, None))
"""A reading that cannot be of its target under its load."""
_EVENT: Schema = _of(kind=Text, utc=Text)
_event = partial(_of, _EVENT)
EVENTS: Mapping[str, Schema] = {
    "devices": _event(
        answers=_list(_of(device=Text, driver=Text, name=Text, facts=dict[str, Text]))
    ),
    "tare": _event(force=_of(wrench=Wrench)),
    "drift": _event(shift_m=Axes, sigma=Number, over=bool),
    "tool": _event(mass_kg=Number, com_m=Axes),
    "repeatability": _event(
        dof=Count, poses=Count, scatter=Number, instrument=Number, joint_std=Number
    ),
    "load": _event(hanging=Text | None, why=(Text, "")),  # None while a wrong load is corrected
    # stored: it is among the readings, since it was recognised too late
    "doubted": _event(why=Text, reading=_DOUBTFUL, stored=(bool, False)),
    "start": _event(missing=Count),
    "finished": _event(readings=Count),
    "noise": _event(
        factors=dict[Text, Number] | None,  # None where the covariances stay as measured
        along_m=(Number, 0.0),
        across_m=(Number, 0.0),
        orientation_rad=(Number | None, None),
        distance_m=(Number, 0.0),
        joint_std_rad=(Number | None, None),
    ),
}
"""Events of a session, by kind."""
_SETTINGS = _of(
    _Strict,
    poses=Count,
    validation=Count,
    max_time_s=Number,
    goal_m=Number | None,
    limit_m=Number | None,
    seed=Whole,
    readings=Literal["deflection", "absolute"],
    hide=Text | None,
    prior=(Text | None, None),
    under_load=(bool, False),
)
ENTRIES: Mapping[str, Schema] = {
    "begun": _event(settings=_SETTINGS),
    "refined": _event(readings_sha256=Text, revisions=Annotated[list[Count], Field(min_length=1)]),
    "decided": _event(action=Text),
    "frozen": _event(readings_sha256=Text),
    "improved": _event(revision=Count, error=_of(inside=Count, count=Count)),
}
"""Entries of a calibration's log, by kind."""


def check(schema: Schema, content: object) -> None:
    """Raise a ValueError of one line for a document that does not fit its schema."""
    try:
        schema.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:40] for part in first["loc"]) or "it"
        raise ValueError(f"{where}: {first['msg']}") from None


def check_event(content: object, known: Mapping[str, Schema] = EVENTS) -> None:
    """Refuse an invalid event of a session, or entry of a log; raises as `check` does."""
    kind = content.get("kind") if isinstance(content, dict) else None
    check(known.get(kind, _EVENT) if isinstance(kind, str) else _EVENT, content)


check_entry = partial(check_event, known=ENTRIES)
