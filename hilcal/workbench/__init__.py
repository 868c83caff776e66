"""The workbench: a local page on which an operator compares, adds and removes effects, and plans.

`guard` admits only the operator's browser.
"""
