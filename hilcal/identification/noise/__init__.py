"""The arm's scatter and the instrument's noise, estimated from readings."""
