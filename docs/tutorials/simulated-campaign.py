# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A simulated campaign with a hidden effect
#
# A robot arm gives way under a load. In this tutorial you calibrate that: you plan measurements, take them on a simulated arm, fit a
# model, see where it fails, find the physical effect that it lacks, add it, and use the result to put the tool where it should be.
#
# You need hilcal and nothing else: no robot, no tracker, no network. It takes about a minute.
#
# ## The cell
#
# A *cell* is the arm, what hangs on its flange, and the instrument. It is described in a file:

# %%
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

import hilcal as hc

Path("CELL.toml").write_text("""
[robot]
model = "ur10e"

[tool]
target_m = [0.06, 0.02, 0.12]      # the reflector that the tracker follows, in flange axes
load_point_m = [0.10, 0.0, 0.15]   # where weights hang
mass_kg = 0.8
com_m = [0.01, 0.0, 0.06]

[tracker]
frame = "tracker"                  # where the tracker stands is not known: it is estimated

[repeatability]
joint_std_rad = 1e-5               # the arm returns to a pose within 0.01 mm or so

[[loads]]
name = "5kg"
mass_kg = 5.0

[[loads]]
name = "10kg"
mass_kg = 10.0

[[loads]]
name = "side pull"                 # a weight alone makes no torque about the vertical joint 1
force_N = [0.0, 80.0, 0.0]
moment_Nm = [6.0, 0.0, 6.0]

[limits]
workspace_min_m = [-1.6, -1.6, 0.05]

[planning]
readings = "deflection"            # what a load does: loaded position minus unloaded position
candidates = 100                   # few poses to choose from, so that this page is made quickly
against = []
""")
cell = hc.Cell.load("CELL.toml")

# %% [markdown]
# ## Plan
#
# Not every pose tells equally much: a joint that carries no torque does not bend. `hc.plan` chooses poses and loads by optimal design.

# %%
plan = hc.plan(cell, poses=15, seed=1)
plan

# %% [markdown]
# The efficiency is a certified lower bound: even the best choice among the same candidates needs at least that share of the readings
# for the same precision.
#
# ## Measure
#
# `hc.simulate` stands in for the robot. It draws an arm whose joints have compliances of their own, and hides one physical effect in it.
# The simulated arm has mechanics of its own (static equilibrium, by the library Pinocchio); it shares no code with the
# models that will be fitted. With a real cell this step is `hilcal run CELL.toml --plan plan.json -o run.hilcal`.

# %%
simulated = hc.simulate(cell, plan, hide="joint_tilt_compliance", seed=2)
simulated.save("run.hilcal")
run = hc.Campaign.open("run.hilcal")
run

# %% [markdown]
# `run.hilcal` is one file. Its readings never change; each fit is appended to it as a *revision*.
#
# ## Fit
#
# Every campaign starts from the same model: unknown frames, and one compliance per joint, dq_j = c_j τ_j.

# %%
fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
first = run.append(fit)
fit

# %% [markdown]
# ## See where it fails
#
# The *variance factor* is the mean square of the residuals in units of the stated noise. It should be 1, and here it is far above:
# the tracker and the arm's repeatability do not explain what is left. It grows with the load:

# %%
residual = 1e6 * np.linalg.norm(fit.residuals(frame="base"), axis=1)
loaded = run.readings[fit.whitening.reading]  # the loaded reading of each deflection
names = np.array(run.readings.load_names)[loaded.load]


def by_load(values, title):
    """Draw the residual of each deflection, one box for each load."""
    boxes = [
        go.Box(y=values[names == n], name=str(n), boxpoints="all")
        for n in sorted(set(names))
    ]
    chart = go.Figure(
        boxes, {"title": title, "showlegend": False, "template": "plotly_white"}
    )
    return chart.update_yaxes(title="residual, µm", range=[0, 120])


assert np.median(residual[names == "10kg"]) > 1.2 * np.median(residual[names == "5kg"])
by_load(residual, "Joint compliance alone: what the model leaves")

# %% [markdown]
# ## Ask what is missing
#
# `hc.diagnose` tries every effect of the catalogue (`hilcal effects` lists it) and tests each on poses that were left out of the fit.

# %%
diagnosis = hc.diagnose(fit)
diagnosis

# %% [markdown]
# The first suspect is the effect that was hidden. Others explain a part of the misfit because they resemble it, and less of it.

# %%
assert diagnosis.verdict == "missing_effect"
assert diagnosis.suspects[0].effect == simulated.hidden

# %% [markdown]
# ## Add it
#
# A model is the arm and its effects, and `+` adds one:

# %%
better = hc.fit(fit.model + "joint_tilt_compliance", run.readings)
by_load(
    1e6 * np.linalg.norm(better.residuals(frame="base"), axis=1),
    "With joint_tilt_compliance: what is left is noise",
)

# %% [markdown]
# `hc.refine` does both steps, and repeats them until the model is adequate or a doubt needs further measurements. It also
# takes effects out again that later ones make needless.

# %%
path = hc.refine(fit.model, run.readings)
run.append(path)
path

# %%
assert path.verdict == "adequate"
assert path.fit.error.rms_m < 0.75 * fit.error.rms_m

# %% [markdown]
# ## Compare with the truth
#
# On a simulated arm, and only there, the true parameters are known:

# %%
truth = simulated.world.truth
rows = [
    (p.name, 1e6 * p.value, 1e6 * p.std, 1e6 * truth[p.name])
    for p in path.fit.parameters
    if p.name in truth and p.identifiable
]
print(f"{'µrad/(N·m)':30s}{'found':>8s}{'± std':>8s}{'true':>8s}")
for name, value, std, true in rows:
    print(f"{name:30s}{value:8.2f}{std:8.2f}{true:8.2f}")

# %% [markdown]
# ## Test it on readings that were never fitted
#
# A small residual shows only that a model can be bent to its data. So measure ten other poses with the same arm, and predict them with
# the first and the last model.

# %%
fresh = hc.simulate(simulated, hc.plan(cell, poses=10, seed=9), seed=5)
fresh.save("fresh.hilcal")
with hc.Campaign.open("fresh.hilcal") as other:
    before, after = hc.validate(run, other, revision=first), hc.validate(run, other)
after

# %%
rms = [
    1e6 * np.sqrt(np.mean([s.rms_m**2 for s in v.shares.loads])) for v in (before, after)
]
print(f"error at fresh poses: {rms[0]:.0f} µm before, {rms[1]:.0f} µm with the effect")
assert rms[1] < 0.75 * rms[0]

# %% [markdown]
# ## Put it to use
#
# A calibration says which joint values put the loaded tool where the unloaded arm would have it. Ask for it at three of the
# fresh poses under 10 kg:

# %%
calibration = run.calibration()
asked = fresh.readings.states.q[fresh.readings.load == 0][1:4]
corrected = calibration.compensate(asked, calibration.loads["10kg"])
for error, band in zip(corrected.before.error_m, corrected.after.band_m, strict=True):
    print(f"sags by {1e3 * error:.2f} mm; corrected, 95 % lie within {1e3 * band:.3f} mm")

# %% [markdown]
# Is that so? Move the simulated arm there, and measure: each pose unloaded, then under 10 kg as asked for, then under 10 kg at the
# corrected joint values.

# %%
from hilcal.store.plan import Plan, Step

pairs = range(len(asked))
steps = [Step(f"asked{k}", load) for k in pairs for load in ("none", "10kg")]
steps += [Step(f"corrected{k}", "10kg") for k in pairs]
poses = [f"{what}{k}" for what in ("asked", "corrected") for k in pairs]
test = Plan(tuple(poses), np.vstack([asked, corrected.q]), tuple(steps))
position = hc.simulate(simulated, test, seed=6).readings.value
free, sagging, restored = position[0:6:2], position[1:6:2], position[6:]
measured = [np.linalg.norm(x - free, axis=1) for x in (sagging, restored)]
print("measured before, mm:", np.round(1e3 * measured[0], 3))
print("measured after,  mm:", np.round(1e3 * measured[1], 3))
assert measured[1].max() < 0.1 * measured[0].min()

# %% [markdown]
# ## The same by commands
#
# Each step is a command, too; all work on the file that you have made:

# %%
# !hilcal info run.hilcal
# !hilcal report run.hilcal -o report.html

# %%
run.close()

# %% [markdown]
# `report.html` is the whole story as one page. Where to go on:
#
# - [somebody's table of another arm](table-of-another-arm.py): the same without hilcal having measured;
# - [plan and measure a real campaign](../how-to/plan-a-campaign.md), [read a verdict](../how-to/read-a-verdict.md);
# - `hilcal demo` rehearses all of it through the real drivers on simulated devices.
