"""What the documents in a campaign file hold, as far as the program reads it.

Each is checked where it comes out of the file. Keys beside those named here are kept.
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
    """Return a document with keys of types, or of pairs of a type and a default."""
    given: dict[str, Any] = {
        k: of if isinstance(of, tuple) else (of, ...) for k, of in keys.items()
    }
    return create_model("document", __base__=base, **given)


def _list(of: Any) -> Any:
    return list.__class_getitem__(of)


_ERRORS = _of(mean_m=Number, rms_m=Number, max_m=Number, rms_sigma=Number)
_PARAMETER = _of(name=Text, unit=Text, value=Number | None, std=Number | None, identifiable=bool)
_IDENTIFIED = _of(
    n_readings=Count,
    variance_factor=Number,
    error=_of(fit=_ERRORS, holdout=_ERRORS),
    parameters=_list(_PARAMETER),
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
    q_actual=(tuple[Number, ...] | None, None),
    tracker_covariance=(Matrix | None, None),
)
"""What is kept with a reading."""
_DOUBTFUL = _of(DETAIL, pose=Text, load=Text, target=(Text | None, None))
"""A reading that was measured and cannot be of its target under its load."""
_HAPPENED: Schema = _of(kind=Text, utc=Text)
_happened = partial(_of, _HAPPENED)
EVENTS: Mapping[str, Schema] = {
    "devices": _happened(
        answers=_list(_of(device=Text, driver=Text, name=Text, facts=dict[str, Text]))
    ),
    "tare": _happened(force=_of(wrench=Wrench)),
    "drift": _happened(shift_m=Axes, sigma=Number, over=bool),
    "tool": _happened(mass_kg=Number, com_m=Axes),
    "repeatability": _happened(
        dof=Count, poses=Count, scatter=Number, instrument=Number, joint_std=Number
    ),
    "load": _happened(hanging=Text | None, why=(Text, "")),  # None while that is being put right
    # stored: among the readings, since it was seen too late to be doubtful
    "doubted": _happened(why=Text, reading=_DOUBTFUL, stored=(bool, False)),
    "start": _happened(missing=Count),
    "finished": _happened(readings=Count),
    "noise": _happened(
        factors=dict[Text, Number] | None,  # None where the covariances stay as measured
        along_m=(Number, 0.0),
        across_m=(Number, 0.0),
        orientation_rad=(Number | None, None),
        distance_m=(Number, 0.0),
        joint_std_rad=(Number | None, None),
    ),
}
"""Of a session, by kind."""
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
    "begun": _happened(settings=_SETTINGS),
    "refined": _happened(
        readings_sha256=Text, revisions=Annotated[list[Count], Field(min_length=1)]
    ),
    "decided": _happened(action=Text),
    "frozen": _happened(readings_sha256=Text),
}
"""Of a calibration's log, by kind."""


def check(schema: Schema, content: object) -> None:
    """Refuse, by a ValueError of a line, a document that is not as it should be."""
    try:
        schema.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:40] for part in first["loc"]) or "it"
        raise ValueError(f"{where}: {first['msg']}") from None


def check_event(content: object, known: Mapping[str, Schema] = EVENTS) -> None:
    """Refuse what is no event of a session, or no entry of a log; raises as `check` does."""
    kind = content.get("kind") if isinstance(content, dict) else None
    check(known.get(kind, _HAPPENED) if isinstance(kind, str) else _HAPPENED, content)


check_entry = partial(check_event, known=ENTRIES)
