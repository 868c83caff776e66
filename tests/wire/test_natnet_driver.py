"""The driver of OptiTrack (NatNet): against simulated cameras, which natnet also reads."""

import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.drivers.natnet import Body, frame, open_tracker
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import TargetLostError
from tests.support.instruments import TARGET, TURNED, cell, natnet
from tests.support.rows import first

FRAME_STD, OFF = 5e-5, 2e-4
"""Of a frame along each axis, and the most that the cameras' volume is distorted by, m."""
VERSIONS = ("3.0", "3.1", "4.0", "4.1", "4.2")


@pytest.fixture(scope="module")
def running():
    with natnet() as there:
        yield there


@pytest.fixture
def there(running):
    """The cameras, healthy again after the test."""
    yield running
    cameras = running[0]
    for op in ("beam", "stall", "pause"):
        cameras.admin(op, on=False)
    cameras.admin("lose", share=0.0)
    cameras.admin("bodies", count=0)


def opened(host, **options):
    return closing(open_tracker(cell(host, "natnet", **options)))


def right(sample):
    assert sample.value[:3] == pytest.approx(TARGET, abs=OFF)
    if len(sample.value) == 6:
        turn = Rotation.from_rotvec(sample.value[3:]) * Rotation.from_matrix(TURNED).inv()
        assert turn.magnitude() < 10 * OFF / 0.1


@pytest.mark.parametrize("version", first(1, VERSIONS))
def test_poses_come_in_every_version(version):
    with natnet("--version", version) as (_, host), opened(host) as device:
        right(device.measure())
        facts = dict(device.report().facts)
        assert (facts["NatNet"], facts["rigid body"]) == (version, "tool")


def test_a_later_version_is_asked_for_a_known_one():
    with natnet("--version", "5.1") as (cameras, host):
        with opened(host) as device:
            right(device.measure())
            assert cameras.admin("state")["clients"] == [[4, 2]]
        cameras.admin("forget")
        cameras.admin("insist", on=True)  # it hears of it only afterwards
        with opened(host) as device:
            right(device.measure())
            assert cameras.admin("state")["clients"] == [[4, 2]]


def test_versions_that_are_not_known_are_refused():
    for version, *more in (("2.9",), ("5.0", "--multicast", "239.255.42.99")):
        with (
            natnet("--version", version, *more) as (_, host),
            pytest.raises(DeviceError, match=r"valid: 3\.0 to 4\.2"),
        ):
            open_tracker(cell(host, "natnet"))


def test_frames_to_a_multicast_group():
    with natnet("--multicast", "239.255.42.98") as (_, host), opened(host, local=host) as device:
        right(device.measure())
        assert dict(device.report().facts)["frames"] == "multicast 239.255.42.98:1511"


def test_a_sample_tells_how_frames_scatter_and_not_how_cameras_err(there):
    with opened(there[1], frames=50) as device:
        samples = [device.measure() for _ in range(20)]
        total = sum(float(np.trace(s.covariance[:3, :3])) for s in samples) / (3 * 20)
        assert total == pytest.approx(FRAME_STD**2 / 50, rel=0.2)  # of 2850 numbers
        mean = np.mean([s.value[:3] for s in samples], axis=0)
        off = np.linalg.norm(mean - TARGET)
        assert off > 5 * np.sqrt(total)  # the same in all samples: none of them shows it
    with opened(there[1], target="position") as device:
        sample = device.measure()
        assert (sample.value.shape, sample.covariance.shape) == ((3,), (3, 3))


def test_one_of_several_bodies_is_chosen_by_name_or_number(there):
    there[0].admin("bodies", count=2)
    for name in ("tool", "7"):
        with opened(there[1], rigid_body=name) as device:
            right(device.measure())
    with opened(there[1], rigid_body="other 1") as device, pytest.raises(DeviceError, match="same"):
        device.measure()  # it does not scatter at all
    for options, said in (
        ({}, 'rigid_body is missing; valid: "tool", "other 0", "other 1"'),
        ({"rigid_body": "tol"}, 'no rigid body "tol"'),
        ({"frames": 1}, "2 or more"),
    ):
        with pytest.raises(InputError, match=said):
            open_tracker(cell(there[1], "natnet", **options))


def test_a_body_that_is_hidden_is_a_lost_target(there):
    with opened(there[1]) as device:
        there[0].admin("beam", on=True)
        for action in (device.measure, device.find_target):
            with pytest.raises(TargetLostError, match="rigid body tool is not seen"):
                action()
        assert any("not seen" in problem for problem in device.report().problems)
        there[0].admin("beam", on=False)
        device.find_target()
        right(device.measure())


def test_frames_from_before_a_measurement_are_not_in_it(there):
    """They wait in the socket since the last one, of the pose before."""
    away = np.array(TARGET) + 0.1
    with opened(there[1]) as device:
        right(device.measure())
        time.sleep(0.2)
        there[0].truth(target=away)
        time.sleep(0.1)
        assert device.measure().value[:3] == pytest.approx(away, abs=2 * OFF)
    there[0].truth(target=np.array(TARGET))


def test_a_pose_that_cannot_be_costs_its_frame_and_one_that_is_not_seen_none(there, monkeypatch):
    none = Body(99, np.full(3, np.nan), np.zeros(4), tracked=False)

    def altered(content, version):
        number, bodies = frame(content, version)
        wrong = {0: np.zeros(4), 1: np.full(4, np.nan)}.get(number % 4)
        bodies = [b if wrong is None else replace(b, quaternion=wrong) for b in bodies]
        return number, [*bodies, none]

    monkeypatch.setattr("hilcal.drivers.natnet.frame", altered)
    with opened(there[1]) as device:
        right(device.measure())


@pytest.mark.long
def test_frames_that_repeat_or_do_not_come_are_no_readings(there):
    with opened(there[1]) as device:
        there[0].admin("pause", on=True)
        with pytest.raises(DeviceError, match="no frames come"):
            device.measure()
        there[0].admin("pause", on=False)
        there[0].admin("stall", on=True)
        begun = time.monotonic()
        with pytest.raises(DeviceError, match="no frames come; is streaming switched on"):
            device.measure()
        assert time.monotonic() - begun < 20.0
        there[0].admin("stall", on=False)
        there[0].admin("lose", share=0.5)
        right(device.measure())
        there[0].admin("forget")  # as one that was restarted
        right(device.measure())


def test_nobody_there():
    with pytest.raises(DeviceError, match="refuses the connection"):
        open_tracker(cell("127.65.43.21", "natnet"))


@pytest.mark.parametrize("version", first(1, ["4.1", "3.1"]))
def test_the_client_of_others_reads_the_same(version):
    """Natnet takes frames and descriptions apart with code of its own."""
    others = pytest.importorskip("natnet")
    bodies, described = [], []
    with natnet("--version", version) as (cameras, host):
        cameras.admin("bodies", count=1)
        client = others.NatNetClient(host, "127.0.0.1", use_multicast=False)
        client.on_data_frame_received_event.handlers.append(lambda f: bodies.append(f.rigid_bodies))
        client.on_data_description_received_event.handlers.append(described.append)
        with client:
            assert str(client.server_info.nat_net_protocol_version).startswith(version)
            client.request_modeldef()
            end = time.monotonic() + 10.0
            while (len(bodies) < 50 or not described) and time.monotonic() < end:
                client.update_sync()
                time.sleep(0.01)
        with opened(host, rigid_body="tool") as device:
            sample = device.measure()
    assert {d.name: d.id_num for d in described[0].rigid_bodies} == {"tool": 7, "other 0": 8}
    body_frames = [next(b for b in frame if b.id_num == 7) for frame in bodies]
    positions = np.array([b.pos for b in body_frames])
    K = len(positions)
    assert K >= 50
    assert positions.mean(axis=0) == pytest.approx(
        sample.value[:3], abs=6 * FRAME_STD / np.sqrt(20)
    )
    turn = Rotation.from_quat([b.rot for b in body_frames]).mean()
    assert (turn * Rotation.from_rotvec(sample.value[3:]).inv()).magnitude() < 1e-3
    assert all(b.tracking_valid for frame in bodies for b in frame)
