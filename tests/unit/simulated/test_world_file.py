"""A world comes back from its file as it was."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hilcal.drivers.simulated.world_server import read_world, write_world
from hilcal.errors import InputError
from tests.support.living_cell import (
    WEIGHT,
    Q,
    config,
    everything,
    same,
    states,
    world_of,
)
from tests.support.world_cases import further


def test_world_comes_back_from_its_file_to_the_last_bit(tmp_path):
    made = config(force_sensor={"driver": "ft300", "port": "x", "origin_m": [0, 0, 0.1]})
    world = world_of(made, **everything(np.random.default_rng(3)), **further(4))
    world = replace(world, joint_reference=23.4)
    write_world(tmp_path / "world.json", world, made)
    back, told = read_world(tmp_path / "world.json")
    assert told == made
    assert back.truth == world.truth
    assert back.noise == world.noise
    for name in ("registration", "station", "joint_std"):
        assert same(getattr(back, name), getattr(world, name))
    assert back.joint_reference == 23.4
    state = replace(states(Q, WEIGHT, 12.3), joint_temperature=np.full((1, 6), 25.0))
    assert same(back.sight(state).position, world.sight(state).position)


def test_a_configuration_of_another_cell_is_refused(tmp_path):
    world = world_of(config())
    other = config(tool={"mass_kg": 0.9, "load_point_m": [0.1, -0.03, 0.15]})
    with pytest.raises(InputError, match="differ in targets, tool_mass, tool_com;"):
        write_world(tmp_path / "world.json", world, other)
    assert not (tmp_path / "world.json").exists()


@pytest.mark.parametrize("text", ["", "[1]", '{"format": "hilcal-plan"}', "{"])
def test_another_file_is_no_world(tmp_path, text):
    (tmp_path / "world.json").write_text(text)
    with pytest.raises(InputError, match="not a world file"):
        read_world(tmp_path / "world.json")


def test_a_world_written_before_an_effect_was_known_has_none_of_it(tmp_path):
    path = tmp_path / "world.json"
    world = world_of(config(), **everything(np.random.default_rng(3)))
    write_world(path, world, config())
    content = json.loads(path.read_text())
    del content["physics"]["joint_coupling"]
    path.write_text(json.dumps(content))
    back = read_world(path)[0]
    assert back.truth == {
        k: v for k, v in world.truth.items() if not k.startswith("joint_coupling")
    }


def test_a_damaged_world_says_so(tmp_path):
    path = tmp_path / "world.json"
    write_world(path, world_of(config()), config())
    content = json.loads(path.read_text())
    del content["physics"]["base_frame"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="damaged: KeyError 'base_frame'"):
        read_world(path)
    write_world(path, world_of(config()), config())
    path.write_text(path.read_text().replace('"version": 2', '"version": 1'))
    with pytest.raises(InputError, match="version 1; this hilcal reads 2"):
        read_world(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_world(tmp_path / "none.json")
