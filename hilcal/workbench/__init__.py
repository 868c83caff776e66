"""The workbench: a page on this machine where an operator compares, adds, removes, measures next.

`guard` lets in nobody but the operator's own browser.
"""
