"""Charts of fits, diagnoses and stories as plotly figures; each a pure function of such values.

`style.says(figure)` is the sentence that a chart shows, for those who do not see it;
`style.in_scheme(figure, dark)` dresses it for a light or dark page.
"""
