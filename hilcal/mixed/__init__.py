"""The linear mixed model: all effects together, with one variance per family of parameters.

    y = A b + Σ_f Z_f u_f + e,    u_f ~ N(0, s_f² D_f),    e ~ N(0, R)

with y the whitened readings at a linearisation, A the columns of the frames, which have no prior,
Z_f those of family f, D_f the squares of its ordinary magnitudes, and R the covariance of the
stated noise and the arm's scatter. Restricted maximum likelihood estimates all variances together.
"""
