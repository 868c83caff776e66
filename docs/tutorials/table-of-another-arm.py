# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Somebody's table of another arm
#
# A laboratory has measured its ABB IRB 120 with a laser tracker, 75 poses, each unloaded and with 2.5 kg on the flange, and sends you a
# table. hilcal has neither moved that arm nor read that tracker. In this tutorial you read the table, find out what is wrong with the
# arm, test the answer on poses that were kept aside, and correct joint values with it.
#
# Two files belong to it, [irb120.csv](data/irb120.csv) and [irb120.toml](data/irb120.toml), in a folder `data` beside the notebook.
# **The table is simulated**: no public table of such an arm was at hand. It was made by hilcal's simulated world (`studies/another_arm.py`)
# with errors that the notebook does not use: you will see at the end what they were.

# %%
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

import hilcal as hc

print(*Path("data/irb120.csv").read_text().splitlines()[:5], sep="\n")

# %% [markdown]
# Degrees, millimetres, a decimal comma, semicolons: nothing that anybody agreed on. What the laboratory told about arm, tool and tracker is in
# a second file:

# %%
print(Path("data/irb120.toml").read_text())
cell = hc.Cell.load("data/irb120.toml")

# %% [markdown]
# ## Preview
#
# `hc.preview_table` looks at names and values, and proposes how to read the table. The nominal arm tells whether that can be right:

# %%
preview = hc.preview_table("data/irb120.csv", cell)
print(*preview.outcome, sep="\n")

# %% [markdown]
# The nominal arm leaves 0.4 mm; with a wrong unit, or joint angles of another sign, it would leave a part of a metre. The proposal is
# a *mapping file*. Check it, change what is wrong (here nothing is), and keep it beside the table:

# %%
mapping = preview.proposal.to_toml("irb120.csv")
Path("mapping.toml").write_text(mapping)
print(mapping)

# %% [markdown]
# ## Read it, and keep some poses aside
#
# Fifteen of the 75 poses are not fitted. They will tell at the end whether the model predicts.

# %%
readings = hc.read_table("data/irb120.csv", cell, "mapping.toml")
aside = readings.pose % 5 == 4
fitted, others = readings[~aside], readings[aside]
print(len(fitted), "readings are fitted,", len(others), "kept aside")
print("loads:", *readings.load_names)

# %% [markdown]
# ## The nominal arm, and what it lacks
#
# The first model knows nothing of this arm but its type: frames (where tracker and reflector are), and joints that give way under load.

# %%
model = hc.baseline(cell, fitted)
nominal = hc.fit(model, fitted)
diagnosis = hc.diagnose(nominal)
diagnosis

# %% [markdown]
# ## Refine
#
# `hc.refine` adds what is missing, one effect after the other, as long as that lowers the error on poses left out.

# %%
path = hc.refine(model, fitted)
path

# %% [markdown]
# Two effects are named. `encoder_offset`: the joints' zeros are off, as after a motor was changed without a new calibration of its zero.
# `transmission_error`: the gears' errors go with the joint angle. The verdict is that what is left is noise.

# %%
assert path.verdict == "adequate"
assert {"encoder_offset", "transmission_error"} <= set(path.fit.model.named)
path.fit

# %% [markdown]
# *Not determined* is no fault of the fit: a zero of joint 1 is the same as a tracker that stands a little further round, and one
# of joint 6 the same as a reflector that sits elsewhere on the flange. No table of positions tells these apart.
#
# ## Test it
#
# The poses kept aside are predicted by the first and the last model:

# %%
errors = {
    name: 1e6
    * np.linalg.norm(others.value - found.predict(others.states).position, axis=1)
    for name, found in (("nominal arm", nominal), ("refined", path.fit))
}
for name, error in errors.items():
    print(f"{name:12s} mean {error.mean():4.0f} µm, largest {error.max():4.0f} µm")
assert errors["refined"].mean() < 0.2 * errors["nominal arm"].mean()

# %%
boxes = [go.Box(y=error, name=name, boxpoints="all") for name, error in errors.items()]
layout = {"title": "Error at poses that were not fitted", "template": "plotly_white"}
chart = go.Figure(boxes, {**layout, "showlegend": False})
chart.update_yaxes(title="error, µm", type="log")

# %% [markdown]
# ## Correct
#
# The calibration says which joint values put the tool where the nominal arm would have it at the values that you ask for, with the
# load on the flange:

# %%
calibration = hc.Calibration.of(path.fit)
asked = others.states.q[others.load == 0][:4]
corrected = calibration.compensate(asked, calibration.loads["2.5 kg"])
before, band = 1e3 * corrected.before.error_m, 1e3 * corrected.after.band_m
for k, change in enumerate(np.degrees(corrected.q - asked)):
    print(
        f"error {before[k]:.2f} mm, corrected 95 % within {band[k]:.2f} mm; add", end=" "
    )
    print(*np.round(change, 3), "deg")
assert corrected.after.band_m.max() < 0.3 * corrected.before.error_m.min()

# %% [markdown]
# `calibration.save("irb120.json")` keeps it as one file, which needs neither table nor cell.
#
# ## The same by commands

# %%
# !hilcal import data/irb120.csv --config data/irb120.toml --format mapping.toml -o irb120.hilcal
# !hilcal refine irb120.hilcal
# !hilcal export irb120.hilcal --calibration irb120.json

# %% [markdown]
# ## What was in it
#
# The simulated arm had these errors, and compliant joints:
#
# | | joint 1 | 2 | 3 | 4 | 5 | 6 |
# |---|---|---|---|---|---|---|
# | zero, mrad | 0.4 | −0.9 | 1.4 | 0.6 | −0.8 | 0.5 |
# | gear, cos q, mrad | 0.15 | 0.20 | −0.12 | 0 | 0 | 0 |
# | gear, sin q, mrad | −0.08 | 0.12 | 0.16 | 0 | 0 | 0 |
#
# What the readings determine agrees with it:

# %%
truth = {2: -0.9, 3: 1.4, 4: 0.6, 5: -0.8}
for joint, true in truth.items():
    p = path.fit.parameters[f"encoder_offset.j{joint}"]
    print(
        f"zero of joint {joint}: {1e3 * p.value:6.3f} ± {1e3 * p.std:.3f} mrad; true {true}"
    )
    assert abs(1e3 * p.value - true) < 4e3 * p.std

# %% [markdown]
# Where to go on:
#
# - [import a table](../how-to/import-a-table.md) has every key of a mapping;
# - [add a robot](../how-to/add-a-robot.md), where yours is not among the arms that hilcal knows: a URDF will do;
# - [correct a program](../how-to/correct-a-program.md): RAPID, KRL and others, in place of joint values;
# - [an effect of one's own](an-effect-of-ones-own.py), where the catalogue has not what your arm has.
