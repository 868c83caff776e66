"""The workbench: a page on this machine where an operator compares, adds, removes, measures next.

`session` holds the state and does what is asked for by the functions of the library; `work` does
one thing at a time beside the page; `guard` lets in nobody but the operator's own browser; `page`
and `cards` show it all with NiceGUI; `server` serves it.
"""
