"""Linear algebra and tests of a linearised least-squares problem: arrays in, values out."""
