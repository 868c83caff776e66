"""Reports of results: documents of text, tables and charts, and their renderers."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from hilcal.diagnosis.diagnosis import Diagnosis


def html_of(value: object) -> str:
    """Return the HTML of a result for a notebook."""
    from hilcal.present import notebook  # loads all kinds of results

    return notebook.html_of(value)


def frame_of(value: object) -> "pd.DataFrame":
    """Return a result as a data frame."""
    from hilcal.present import notebook  # loads all kinds of results

    return notebook.frame_of(value)


def message(d: "Diagnosis") -> str:
    """Return the verdict of a diagnosis in a sentence."""
    from hilcal.present import verdict

    return verdict.message(d)
