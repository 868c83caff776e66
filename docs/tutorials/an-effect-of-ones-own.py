# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # An effect of one's own, and a law that is discovered
#
# hilcal knows some thirty physical effects. Your arm may have another one. This tutorial shows both ways to deal with it:
#
# 1. you know the law: write it as an effect, and fit, diagnose and predict with it as with any other;
# 2. you do not: let hilcal search the law in the readings, read what it found, and keep it as an effect.
#
# You need hilcal and nothing else; it takes about a minute. [A simulated campaign](simulated-campaign.py) explains the steps that are
# only used here.

# %%
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

import hilcal as hc

Path("CELL.toml").write_text("""
[robot]
model = "ur10e"

[tool]
target_m = [0.06, 0.02, 0.12]
load_point_m = [0.10, 0.0, 0.15]
mass_kg = 0.8
com_m = [0.01, 0.0, 0.06]

[tracker]
frame = "tracker"

[repeatability]
joint_std_rad = 1e-5

[[loads]]
name = "5kg"
mass_kg = 5.0

[[loads]]
name = "10kg"
mass_kg = 10.0

[[loads]]
name = "side pull"
force_N = [0.0, 80.0, 0.0]
moment_Nm = [6.0, 0.0, 6.0]

[limits]
workspace_min_m = [-1.6, -1.6, 0.05]

[planning]
readings = "deflection"
candidates = 100
against = []

[simulation]
strength_sigma = 4.0               # how far the hidden effect moves the target, in units of the noise
""")
cell = hc.Cell.load("CELL.toml")
plan = hc.plan(cell, poses=20, seed=1)

# %% [markdown]
# ## A law that you know
#
# Say that cables are led through the joints, and that a joint gives way more or less as they wind up: dq_j = a_j sin(q_j) τ_j. An effect
# says where it acts and how that depends on its parameters; geometry, fit and diagnosis follow from that.

# %%
from hilcal.effects.protocol import Columns, Effect, Parameter, Response


class CablePull(Effect):
    """dq_j = a_j sin(q_j) τ_j."""

    name = "cable_pull"
    summary = "dq_j = a_j sin(q_j) τ_j"
    elastic = True  # it depends on forces: `response` has to be there

    @property
    def parameters(self):
        return tuple(
            Parameter(f"j{j + 1}", "rad/(N·m)", 3e-6) for j in range(self.cell.arm.n)
        )

    def columns(self, s):
        """The derivative of the deviation by the parameters: here of the joint angles, dq."""
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, np.sin(s.angle) * s.torque),)

    def response(self, theta, s, change):
        """The change of the deviation by a change of the torques (last of each wrench)."""
        return Response(dq=(theta * np.sin(s.angle))[:, None, :] * change[:, :, :-1, 5])


# %% [markdown]
# `hc.check_effect` tries it on example states: shapes, finite values, and its derivatives against difference quotients. It raises an
# error with one clear line where something is wrong.

# %%
hc.check_effect(CablePull)


class Wrong(CablePull):
    name = "wrong"

    def response(self, theta, s, change):
        return Response(dq=np.cos(s.angle)[:, None, :] * theta * change[:, :, :-1, 5])


try:
    hc.check_effect(Wrong)
except hc.InputError as error:
    print(str(error).partition(": ")[2])  # what comes before is the file

# %% [markdown]
# A *catalogue* holds the effects that a diagnosis may name. With the new one in it, hide the effect in a simulated arm, and see whether
# a campaign like this would reveal it:

# %%
known = hc.installed().with_effects(CablePull)
run = hc.simulate(cell, plan, hide="cable_pull", seed=3, catalogue=known)
model = hc.baseline(cell, run.readings, catalogue=known)
diagnosis = hc.diagnose(hc.fit(model, run.readings))
diagnosis

# %%
assert diagnosis.suspects[0].effect == "cable_pull"
fit = hc.fit(model + CablePull, run.readings)
without, within = diagnosis.fit.holdout.rms_m, fit.holdout.rms_m
print(
    f"error on poses left out: {1e6 * without:.0f} µm, with the effect {1e6 * within:.0f} µm"
)
assert within < 0.8 * without

# %% [markdown]
# An effect of your own is the one case in which the simulated arm moves by the same law as the model: this shows whether the campaign
# reveals the law, not whether the law is right.
#
# In a file of its own, the class is taken by every command: `hilcal diagnose run.hilcal --effects-from cable_pull.py`.
#
# ## A law that nobody knows
#
# Now another arm. What is hidden in it is in no catalogue, and we are not told what it is.

# %%
arm = hc.simulate(cell, plan, hide="invented", seed=5)
arm.save("arm.hilcal")
campaign = hc.Campaign.open("arm.hilcal")
fit = hc.fit(hc.baseline(campaign.cell, campaign.readings), campaign.readings)
diagnosis = hc.diagnose(fit)
diagnosis

# %% [markdown]
# Something predictable is left, and no effect explains it. `hc.discover` searches some millions of laws: sites (which joint, axis or
# frame) times amplitudes (functions of angles, torques, time, temperatures, and their products). The cost of so wide a search is counted
# against each law.

# %%
discovery = hc.discover(fit)
discovery

# %%
law = discovery.laws[0]
print(law.formula)
for c in law.parameters:
    print(f"{c.name} = {c.value:.3g} ± {c.std:.2g} {c.unit}")

# %% [markdown]
# The law over what it depends on, and what the readings say there by themselves (mean of some readings, with its standard deviation):

# %%
curve = discovery.curves[0]
x, y, std, _ = curve.binned
readings = go.Scatter(x=x, y=y, error_y={"array": std}, mode="markers", name="readings")
line = go.Scatter(x=curve.line[0], y=curve.line[1], mode="lines", name=law.formula)
layout = {"title": f"{curve.of} over {curve.quantity}", "template": "plotly_white"}
chart = go.Figure([readings, line], layout)
chart.update_xaxes(title=f"{curve.quantity}, {curve.quantity_unit}")
chart.update_yaxes(title=f"{curve.of}, {curve.unit}")

# %% [markdown]
# This arm is a simulated one, so that the truth can be looked up:

# %%
print("hidden was", arm.world.user_effect.effect.summary)
print(f"a = {arm.world.truth['invented.a']:.3g} rad/(N·m)")
assert law.formula == "dq_3 = a·cos(q_5)·τ_3"
(a,) = law.parameters
assert abs(a.value - arm.world.truth["invented.a"]) < 4 * a.std

# %% [markdown]
# ## Read it, keep it, use it
#
# The law comes as an effect, a Python file like the one above. Read it; give it a name that says what it is; correct it where you know better.

# %%
source = discovery.source.replace('name = "found"', 'name = "forearm_hose"')
Path("forearm_hose.py").write_text(source)
print(source)

# %% [markdown]
# From here on it is an effect like any other:

# %%
catalogue = hc.installed().with_file(Path("forearm_hose.py"))
model = hc.baseline(campaign.cell, campaign.readings, catalogue=catalogue)
path = hc.refine(model, campaign.readings)
path

# %%
assert path.verdict == "adequate"
assert "forearm_hose" in path.fit.model.named

# %% [markdown]
# It predicts, and corrects. At three of the poses under 10 kg:

# %%
calibration = hc.Calibration.of(path.fit)
q = campaign.readings.states.q[campaign.readings.load == 0][1:4]
corrected = calibration.compensate(q, calibration.loads["10kg"])
for error, band in zip(corrected.before.error_m, corrected.after.band_m, strict=True):
    print(f"sags by {1e3 * error:.2f} mm; corrected, 95 % lie within {1e3 * band:.3f} mm")

# %% [markdown]
# The campaign file keeps the law's name, a checksum of its file, and the coefficients. It keeps no code, and nothing that a file names is
# run unasked, so commands are told where the law is:

# %%
campaign.append(path)
campaign.close()

# %%
# !hilcal export arm.hilcal --calibration arm.json --effects-from forearm_hose.py

# %% [markdown]
# Where to go on:
#
# - [add a physical effect](../how-to/add-an-effect.md) has the whole protocol, and the entry point of an installed package;
# - [find a law](../how-to/discover.md) says what is searched, what is said of a law, and when no law is proposed;
# - `hilcal demo --hide invented` tells this story through the real drivers.
