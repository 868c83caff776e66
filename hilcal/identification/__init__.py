"""Whitened Gauss-Newton, scaling, identifiability, uncertainty, fit."""
