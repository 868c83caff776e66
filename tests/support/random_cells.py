"""Random cells, every optional section absent or present, as a lab's first CELL.toml may be."""

LOADS = (
    {"name": "5kg", "mass_kg": 5.0},
    {"name": "3 kg", "mass_kg": 3.0},
    {"name": "pull x", "force_N": [80.0, 0.0, 0.0], "moment_Nm": [0.0, 6.0, 6.0]},
    {"name": "pull y", "force_N": [0.0, 60.0, 0.0]},
)
HIDDEN = ("nothing", "joint_stiffening", "base_compliance", "transmission_error")
LENGTHS = ("1 um", "30 um", "0.1 mm", "1 mm", "1 m")


def random_cell(rng):
    """Return the sections of a cell as TOML has them; plans of it take a second."""

    def some(p=0.5):
        return bool(rng.random() < p)

    def one_of(values):
        return values[int(rng.integers(len(values)))]

    out = {"robot": {"model": one_of(("ur10e", "ur10e", "ur5e"))}}
    if some(0.8):
        tool = {
            "target_m": [0.06, 0.02, 0.12],
            "load_point_m": [0.1, 0.0, 0.15],
            "mass_kg": 0.8,
            "com_m": [0.01, 0.0, 0.06],
        }
        out["tool"] = {key: value for key, value in tool.items() if some(0.7)}
    if some():
        noise = 10.0 ** rng.uniform(-6, -3.7)
        out["tracker"] = {"range_std_m": noise, "transverse_std_m": one_of((1.0, 1.5)) * noise}
    if some():
        out["repeatability"] = {"joint_std_rad": one_of((0.0, 1e-6, 1e-5, [1e-5] * 6))}
    loads = [load for load in LOADS if some(0.4)]
    if loads:
        out["loads"] = loads
        if some():
            out["force_sensor"] = {"driver": "ft300", "port": "simulated"}
    if some():
        out["limits"] = {"workspace_min_m": [-1.6, -1.6, 0.05]}
        if some():
            out["limits"]["accuracy_m"] = one_of((1e-5, 1e-3))
    out["planning"] = {"candidates": 60, "against": []}
    if not loads or some(0.3):
        out["planning"] |= {"readings": "absolute", "model": ["base_frame"]}
    out["simulation"] = {"clock": 20.0, "seed": int(rng.integers(1000))}
    if some():
        hidden = HIDDEN if loads else (HIDDEN[0], HIDDEN[-1])
        out["simulation"]["hide"] = one_of(hidden)
    if some(0.3):
        out["robot"]["repeatability_m"] = 5e-5
    if some(0.3):
        known = {"base_xyz_m": [2.4, -1.6, -0.5], "base_rotvec_rad": [0.0, 0.0, 2.1]}
        out["tracker"] = out.get("tracker", {}) | known
    if some():
        out["motion"] = {"speed_rad_s": one_of((0.3, 0.6)), "acceleration_rad_s2": 0.8}
    if some():
        out["acquire"] = {"samples": one_of((3, 8)), "drift_limit_sigma": one_of((4.0, 8.0))}
    if some(0.3):
        out["sight"] = {"clearance_m": 0.02}
        if "base_xyz_m" not in out.get("tracker", {}):
            out["sight"]["tracker_m"] = [3.0, 0.5, 0.9]
    if some(0.3):
        box = {"name": "box", "center_m": [0.9, -0.9, 0.4], "size_m": [0.3, 0.3, 0.8]}
        out["obstacles"] = [box]
    if some(0.3):
        out["plausible"] = {"joint_compliance": one_of((5.0, 50.0))}
    return out


def random_options(rng):
    """Return options of `calibrate`: a goal, a limit, or none."""
    out = []
    for option in ("--goal", "--limit"):
        if rng.random() < 0.7:
            out += [option, LENGTHS[int(rng.integers(len(LENGTHS)))]]
    return out
