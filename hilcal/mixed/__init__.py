"""The linear mixed model: all effects at once, each family with a variance of its own.

    y = A b + Σ_f Z_f u_f + e,    u_f ~ N(0, s_f² D_f),    e ~ N(0, R)

y whitened readings at a linearisation, A the frames (without a prior), Z_f the columns of family f,
D_f its pattern of squared magnitudes, R the stated noise and the arm's scatter. The variances are
estimated together by restricted maximum likelihood.
"""
