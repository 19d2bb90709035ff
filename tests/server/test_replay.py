"""Recordings on disk, and their replay."""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from fusion.consistency import rms, track_error
from fusion.localiser import Localiser
from fusion.measurements import ImuBatch, PoseFix, PoseHypothesis, WheelOdometry
from fusion.params import GRAVITY, FilterParams
from fusion.simulator import CameraParams, random_ground, simulate
from server.cli import main
from server.recording import FIX_COLUMNS, Recorder, RecordingError, load, robot_folders
from server.replay import replay
from tests.data import data
from tests.fusion import circle


def inputs(seconds=6.0, seed=1):
    """IMU batches and fixes of a robot on its circle, by arrival: batches of ten 10 ms late, fixes 100 to 300 ms."""
    rng = np.random.default_rng(seed)
    samples = circle.imu(np.arange(0.0, seconds, 0.01), rng)
    arriving = []
    for i in range(0, len(samples), 10):
        arrival = samples[i + 9, 0] + 0.01
        arriving.append((arrival, ImuBatch("rover", arrival, samples[i : i + 10])))
        arrival += 0.001
        turning = circle.TURN if i % 3 else math.nan
        wheels = [[t, circle.SPEED, turning] for t in samples[i : i + 10 : 5, 0]]
        arriving.append((arrival, WheelOdometry("rover", arrival, np.array(wheels))))
    for i, t in enumerate(np.arange(0.2, seconds - 0.4, 0.5)):
        arrival = t + rng.uniform(0.1, 0.3)
        hypotheses = [circle.hypothesis(t, rng)]
        if i % 2:
            other = circle.hypothesis(t, rng, turned=0.3)
            covariance = other.covariance + 1e-6 * np.arange(36).reshape(6, 6) * np.eye(6)
            hypotheses.append(PoseHypothesis(other.position, other.quaternion_wxyz, covariance, 7.5, 0.3 * covariance))
        arriving.append((arrival, PoseFix("rover", t, arrival, tuple(hypotheses), "ceiling", (7, 9)[: 1 + i % 2])))
    return [measurement for _, measurement in sorted(arriving, key=lambda pair: pair[0])]


@pytest.fixture
def recorded(tmp_path):
    """A recording made as the service makes it, and the track of that live run."""
    localiser = Localiser("rover")
    tracks = []
    recorder = Recorder(tmp_path / "run", ["rover", "idle"])
    for measurement in inputs():
        if isinstance(measurement, ImuBatch):
            track = np.empty((len(measurement.samples), 8))
            localiser.feed(measurement, track)
            tracks.append(track)
            recorder.imu(measurement)
            recorder.track("rover", track)
        elif isinstance(measurement, WheelOdometry):
            localiser.feed(measurement)
            recorder.wheels(measurement)
        else:
            localiser.feed(measurement)
            recorder.fix(measurement)
    for t in np.arange(0.0, 6.0, 0.05):
        true = circle.hypothesis(t)
        recorder.truth("rover", t, true.position, true.quaternion_wxyz)
    recorder.close()
    return tmp_path / "run" / "rover", np.concatenate(tracks)


def plain(folder, imu=None, fixes=None):
    """A recording in the plain format; lines may be given."""
    folder.mkdir(exist_ok=True)
    t = np.arange(0.0, 3.0, 0.01)
    if imu is None:
        imu = [",".join(map(str, row)) for row in circle.imu(t).tolist()]
    if fixes is None:
        fixes = []
        for at in (0.2, 0.7, 1.2, 1.7, 2.2):
            h = circle.hypothesis(at)
            fixes.append(",".join(map(str, [at, at + 0.15, *h.position, *h.quaternion_wxyz])))
    (folder / "imu.csv").write_text("\n".join(["t_s,gx,gy,gz,ax,ay,az", *imu]) + "\n")
    (folder / "fixes.csv").write_text("\n".join(["t_s,arrival_s,x,y,z,qw,qx,qy,qz", *fixes]) + "\n")
    return folder


def test_a_replay_gives_the_live_poses_to_the_last_bit(recorded):
    folder, live = recorded
    track, outcomes, _ = replay(load(folder), Localiser("rover"))
    np.testing.assert_array_equal(track, live)
    published = np.loadtxt(folder / "poses.tum")
    known = np.isfinite(live).all(axis=1)
    np.testing.assert_array_equal(published, live[known][:, [0, 1, 2, 3, 5, 6, 7, 4]])
    assert {outcome.source for outcome in outcomes} == {"ceiling"}
    error = track_error(track, load(folder).truth)
    assert rms(error.position[error.t > 2.0]) < 0.03  # by then the speed is known


def test_what_is_recorded_is_what_was_fed(recorded):
    folder, _ = recorded
    recording = load(folder)
    fed = [measurement for measurement in inputs() if isinstance(measurement, PoseFix)]
    assert [fix.t for fix in recording.fixes] == [fix.t for fix in fed]
    for a, b in zip(recording.fixes, fed, strict=True):
        assert (a.arrival, a.source, a.markers) == (b.arrival, b.source, b.markers)
        for x, y in zip(a.hypotheses, b.hypotheses, strict=True):
            np.testing.assert_array_equal(x.position, y.position)
            np.testing.assert_array_equal(x.covariance, y.covariance)
            np.testing.assert_array_equal(x.systematic, y.systematic)
            assert x.misfit == y.misfit


def test_the_wheels_are_recorded_as_they_were_fed(recorded):
    folder, _ = recorded
    fed = [measurement for measurement in inputs() if isinstance(measurement, WheelOdometry)]
    found = load(folder).wheels
    assert [odometry.arrival for odometry in found] == [odometry.arrival for odometry in fed]
    for a, b in zip(found, fed, strict=True):
        np.testing.assert_array_equal(a.samples, b.samples)
    without, _, _ = replay(load(folder)._replace(wheels=()), Localiser("rover"))
    assert not np.array_equal(without, replay(load(folder), Localiser("rover"))[0], equal_nan=True)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1.0,,,1.0", "line 2: neither speed nor yaw_rate; at least one of the two is needed"),
        ("1.0,fast,,1.0", "line 2: speed is 'fast', a finite number is needed"),
        (",0.5,,1.0", "line 2: t_s is 'empty', a finite number is needed"),
        ("1.0,0.5", "line 2: no value for arrival_s, the line is too short"),
        ("1.0,0.5,,1.0\n1.1,0.5,,0.9", "line 3: arrival_s runs backwards"),
    ],
)
def test_wheels_that_cannot_be_replayed(tmp_path, line, expected):
    folder = plain(tmp_path / "drive")
    (folder / "wheels.csv").write_text(f"t_s,speed,yaw_rate,arrival_s\n{line}\n")
    with pytest.raises(RecordingError, match=expected):
        load(folder)


def test_poses_are_causal(tmp_path):
    """What comes later changes nothing of what was published: a recording cut short gives the same beginning."""
    folder = plain(tmp_path / "whole")
    whole, _, _ = replay(load(folder), Localiser("rover"))
    cut = load(folder)
    for n in (57, 143, 222):
        end = cut.samples[n, 0]
        part = cut._replace(
            samples=cut.samples[: n + 1],
            arrival=cut.arrival[: n + 1],
            fixes=[fix for fix in cut.fixes if fix.arrival <= end],
        )
        track, _, _ = replay(part, Localiser("rover"))
        np.testing.assert_array_equal(track, whole[: n + 1])


def test_a_fix_counts_from_its_arrival_on(tmp_path):
    track, _, _ = replay(load(plain(tmp_path / "r")), Localiser("rover"))
    known = np.flatnonzero(np.isfinite(track[:, 1]))
    assert track[known[0], 0] == pytest.approx(0.35)  # captured at 0.2, 0.15 s on the way


@pytest.mark.parametrize("engine", ["numba", "filterpy"])
def test_command_prints_one_object(tmp_path, capsys, engine):
    folder = plain(tmp_path / "drive")
    assert main(["replay", str(folder), "--json", "--engine", engine, "--motion", "differential"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["samples"] == 300
    assert (figures["fixes_accepted"], figures["fixes_rejected"], figures["fixes_late"]) == (5, 0, 0)
    assert (figures["motion"], figures["engine"]) == ("differential", engine)
    assert figures["speed"] > 0
    assert "rmse_mm" not in figures


def test_command_prints_a_table_and_writes_tum(recorded, tmp_path, capsys):
    folder, _ = recorded
    assert main(["replay", str(folder), "--out", str(tmp_path / "poses.tum")]) == 0
    table = capsys.readouterr().out
    assert "600" in table
    assert "RMSE" in table
    assert "holding the last fix" in table
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "poses.tum"), np.loadtxt(folder / "poses.tum"))


def late_stamps(folder):
    """A recording of a minute of a camera that stamps its frames 40 ms late."""
    simulation = simulate(random_ground(3), 3, 60.0, camera=CameraParams(stamp_error=0.04))
    recorder = Recorder(folder, ["rover"])
    recorder.imu(ImuBatch("rover", 0.0, simulation.samples))
    for fix in simulation.fixes:
        recorder.fix(replace(fix, robot="rover"))
    recorder.close()
    return folder / "rover"


def test_command_says_what_is_wrong(tmp_path, capsys):
    folder = late_stamps(tmp_path)
    # Recorded in one batch, the IMU has no arrivals of its own.
    lines = (folder / "imu.csv").read_text().splitlines()
    (folder / "imu.csv").write_text("\n".join(line.rsplit(",", 1)[0] for line in lines))
    assert main(["replay", str(folder), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["time_offset_ms"] == pytest.approx(-40.0, abs=10.0)
    assert 0.0 < figures["time_offset_sigma_ms"] < 10.0
    assert len(figures["tilt_deg"]) == len(figures["tilt_sigma_deg"]) == 2
    assert max(figures["gyro_bias_sigma"]) < 0.01
    assert max(figures["accel_bias_sigma"]) < 0.2
    assert figures["nis"]["position"]["low"] < 1.0 < figures["nis"]["position"]["high"]
    assert figures["resets"] == 0
    assert figures["outcomes"]["accepted"] == figures["accuracy"]["fixes"] > 100
    (diagnosis,) = figures["diagnoses"]
    assert (diagnosis["code"], diagnosis["severity"]) == ("stamps", "note")
    assert diagnosis["evidence"]["late_ms"] == pytest.approx(-figures["time_offset_ms"])
    assert diagnosis["from_s"] < diagnosis["to_s"] == figures["ended_s"]

    assert main(["replay", str(folder)]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("note  ")
    assert diagnosis["text"] in last

    # The same with an IMU that speaks in g: that is said, and what follows from it is not.
    header, *rows = (folder / "imu.csv").read_text().splitlines()
    numbers = np.array([[float(number) for number in row.split(",")] for row in rows])
    numbers[:, 4:7] /= GRAVITY
    (folder / "imu.csv").write_text("\n".join([header, *(",".join(map(repr, row)) for row in numbers.tolist())]))
    assert main(["replay", str(folder)]) == 0
    table = capsys.readouterr().out
    assert "these are g, not m/s2" in table
    assert "stamps are" not in table


def test_the_smooth_channel_is_written_too(recorded, tmp_path, capsys):
    folder, _ = recorded
    tracks = {}
    for channel in ("best", "smooth"):
        out = tmp_path / f"{channel}.tum"
        assert main(["replay", str(folder), "--channel", channel, "--out", str(out)]) == 0
        tracks[channel] = np.loadtxt(out)
    capsys.readouterr()
    # from the second fix on; that one may tell a speed that makes even the smooth pose step
    steps = {channel: np.abs(np.diff(track[150:, 1:4], axis=0)).max() for channel, track in tracks.items()}
    assert len(tracks["best"]) == len(tracks["smooth"])
    # 0.5 m/s and at most 0.3 m/s of gliding for 10 ms
    assert steps["smooth"] < 0.008 + 0.001
    assert steps["best"] > 2.0 * steps["smooth"]


def test_ctrl_c_while_the_filter_is_compiled(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("server.compiling.load_or_compile", lambda: time.sleep(30.0))
    monkeypatch.setattr("server.compiling.PATIENCE", 0.1)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    began = time.monotonic()
    assert main(["replay", str(plain(tmp_path / "drive"))]) == 130
    assert time.monotonic() - began < 10.0
    assert "compiling the filters" in capsys.readouterr().err


def test_a_folder_of_robots(recorded, tmp_path, capsys):
    folder, _ = recorded
    assert main(["replay", str(folder.parent), "--json"]) == 2
    captured = capsys.readouterr()
    assert json.loads(captured.out)["recording"] == "rover"
    assert "no sample after the header" in captured.err
    for file in (folder.parent / "idle").iterdir():
        file.unlink()
    assert robot_folders(folder.parent) == [folder]
    assert main(["replay", str(folder.parent), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["recording"] == "rover"


def test_the_motion_of_the_configuration(tmp_path, capsys):
    folder = plain(tmp_path / "drive")
    config = tmp_path / "room.toml"
    robot = '[[robot]]\nname = "%s"\nmotion = "%s"\n[[robot.marker]]\nid = %d\nsize_mm = 60\n'
    config.write_text(robot % ("rover", "free", 7))
    assert main(["replay", str(folder), "--json", "--config", str(config)]) == 0
    assert json.loads(capsys.readouterr().out)["motion"] == "free"
    config.write_text(robot % ("rover", "free", 7) + robot % ("drive", "differential", 8))
    assert main(["replay", str(folder), "--json", "--config", str(config)]) == 0
    assert json.loads(capsys.readouterr().out)["motion"] == "differential"
    assert main(["replay", str(folder), "--json", "--config", str(config), "--robot", "rober"]) != 0
    error = capsys.readouterr().err
    assert "rober" in error
    assert "drive, rover" in error


def test_parameters_of_the_filter_on_the_command_line(tmp_path, capsys):
    folder = plain(tmp_path / "drive")
    config = tmp_path / "room.toml"
    config.write_text(
        '[[robot]]\nname = "drive"\n[robot.filter]\ntime_offset_sigma = 0\ngate_inflation = 1\n'
        "[[robot.marker]]\nid = 7\nsize_mm = 60\n"
    )

    def accepted(*options):
        assert main(["replay", str(folder), "--json", *options]) == 0
        figures = json.loads(capsys.readouterr().out)
        return figures["fixes_accepted"], figures["time_offset_sigma_ms"]

    assert accepted()[0] == 5
    # Nothing but the first fix is believed.
    gates = ("--set", "gate=1e-9", "--set", "gate_block = 1e-9", "--set", "reinit_count=9")
    assert accepted(*gates, "--set", "gate_inflation=1", "--set", "time_offset_sigma=0") == (1, 0.0)
    # On top of a configuration.
    assert accepted("--config", str(config), *gates) == (1, 0.0)
    assert accepted("--config", str(config), *gates, "--set", "time_offset_sigma=0.05")[1] == pytest.approx(
        50.0, rel=0.01
    )


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("gyro_nois=0.1", "no parameter 'gyro_nois'; did you mean gyro_noise?"),
        ("xyz=0.1", "no parameter 'xyz'; fusion/params.py lists them"),
        ("", "no parameter ''"),
        ("gyro_noise", "found nothing; needed: a number above 0"),
        ("gyro_noise=-1", "found -1; needed: a number above 0"),
        ("gyro_noise=loud", "found loud; needed: a number above 0"),
        ("gyro_noise=nan", "found nan; needed: a number above 0"),
        ("gyro_noise=inf", "found inf; needed: a number above 0"),
        ("reinit_count=2.5", "found 2.5; needed: a whole number at least 2"),
    ],
)
def test_parameters_that_cannot_be(tmp_path, capsys, setting, says):
    assert main(["replay", str(plain(tmp_path / "drive")), "--set", setting]) != 0
    error = capsys.readouterr().err
    assert error.startswith(f"steadfix: --set {setting}: ")
    assert says in error


def write(folder, simulation):
    """A simulation as a recording."""
    folder.mkdir()
    recorder = Recorder(folder.parent, [folder.name])
    for sample in simulation.samples:
        recorder.imu(ImuBatch(folder.name, float(sample[0]), sample[np.newaxis]))
    for fix in simulation.fixes:
        recorder.fix(replace(fix, robot=folder.name))
    for row in simulation.truth[::10]:
        recorder.truth(folder.name, float(row[0]), row[1:4], row[4:])
    recorder.close()
    return folder


@pytest.mark.parametrize("channel", ["best", "smooth"])
def test_the_object_carries_what_the_filter_has_found_out(tmp_path, capsys, channel):
    camera = CameraParams(stamp_error=0.05, rate=4.0, dropout=0.2)
    simulation = simulate(random_ground(4), 4, 60.0, camera=camera, tilt=(0.02, 0.0))
    # At 45 s the robot is carried by two metres.
    fixes = [
        replace(fix, hypotheses=tuple(replace(h, position=h.position + [2.0, 0.0, 0.0]) for h in fix.hypotheses))
        if fix.t > 45.0
        else fix
        for fix in simulation.fixes
    ]
    # One is a second older than the buffer, one comes twice.
    fixes.append(replace(fixes[100], t=fixes[100].t - 3.0))
    fixes.append(replace(fixes[50], arrival=fixes[50].arrival))
    fixes.sort(key=lambda fix: fix.arrival)
    folder = write(tmp_path / "rover", replace(simulation, fixes=fixes))
    assert main(["replay", str(folder), "--json", "--channel", channel]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["time_offset_ms"] == pytest.approx(-50.0, abs=4.0 * figures["time_offset_sigma_ms"])
    for i, true in enumerate((math.degrees(0.02), 0.0)):
        assert figures["tilt_deg"][i] == pytest.approx(true, abs=4.0 * figures["tilt_sigma_deg"][i] + 0.01)
    for name in ("gyro", "accel"):
        bias, sigma = np.array(figures[f"{name}_bias"]), np.array(figures[f"{name}_bias_sigma"])
        true = getattr(simulation, f"{name}_bias")[-1]
        assert bias.shape == sigma.shape == (3,)
        # A part of the accelerometer's sideways bias is tilt.
        assert (np.abs(bias - true) < 4.0 * sigma + 0.02).all()
    nis = figures["nis"]
    assert all(0.0 < nis[block]["low"] < 1.0 < nis[block]["high"] for block in ("pose", "position", "attitude"))
    assert nis["pose"]["fixes"] == 60
    outcomes = figures["outcomes"]
    assert sum(outcomes.values()) == figures["fixes"] == len(fixes)
    assert (outcomes["initialised"], outcomes["too_late"], outcomes["duplicate"]) == (1, 1, 1)
    assert outcomes["reinitialised"] == figures["resets"] == 1
    assert outcomes["rejected"] >= 2
    accuracy = figures["accuracy"]
    assert accuracy["channel"] == channel
    assert accuracy["mm_p50"] < 40.0
    assert accuracy["deg_p50"] < 2.0
    # The poses before the reset were wrong by two metres, and that counts.
    assert accuracy["fixes"] == sum(bucket["fixes"] for bucket in accuracy["by_fix_age"])
    assert max(bucket["mm_p95"] or 0.0 for bucket in accuracy["by_fix_age"]) > 100.0
    (diagnosis,) = [diagnosis for diagnosis in figures["diagnoses"] if diagnosis["code"] == "stamps"]
    assert diagnosis["evidence"]["late_ms"] == pytest.approx(50.0, abs=8.0)
    assert figures["rmse_mm"] > 100.0
    assert figures["hold_last_mm"] > 100.0


ROW = ",".join(map(str, circle.imu(np.array([0.0]))[0].tolist()))


@pytest.mark.parametrize(
    ("files", "says"),
    [
        ({"imu.csv": "t_s,gx,gy,gz,ax,ay\n0,0,0,0,0,0\n"}, r"imu.csv, line 1: no column az; found t_s, gx"),
        (
            {"imu.csv": "t_s,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,9.8\n0.01,0,nan,0,0,0,9.8\n"},
            r"imu.csv, line 3: gy is 'nan'",
        ),
        ({"imu.csv": "t_s,gx,gy,gz,ax,ay,az\n0,0,0,x1,0,0,9.8\n"}, r"imu.csv, line 2: gz is 'x1', a finite number"),
        ({"imu.csv": "t_s,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,9.8\n0.01,0,0\n"}, r"imu.csv, line 3: no value for gz"),
        (
            {"imu.csv": f"t_s,gx,gy,gz,ax,ay,az\n0.5{ROW[3:]}\n0.4{ROW[3:]}\n"},
            r"imu.csv, line 3: t_s runs backwards, 0.4",
        ),
        (
            {"imu.csv": f"t_s,gx,gy,gz,ax,ay,az\n\n0.5{ROW[3:]}\n\n\n0.4{ROW[3:]}\n"},
            r"imu.csv, line 6: t_s runs backwards, 0.4",
        ),
        (
            {"fixes.csv": "t_s,arrival_s,x,y,z,qw,qx,qy,qz,sigma_position\n1,1.1,0,0,0,1,0,0,0,-0.005\n"},
            "fixes.csv, line 2: sigma_position is '-0.005', a finite number above 0 is needed",
        ),
        ({"imu.csv": "t_s,gx,gy,gz,ax,ay,az\n"}, "imu.csv: no sample"),
        ({"imu.csv": ""}, "imu.csv, line 1: no column t_s"),
        ({"imu.csv": b"\x89PNG\r\n\x1a\n\xff\xfe"}, "imu.csv: this is no text file"),
        ({"fixes.csv": None}, "fixes.csv: No such file"),
        ({"fixes.csv": "t_s,arrival_s,x,y,z,qw,qx,qy,qz\n"}, "fixes.csv: no fix"),
        ({"fixes.csv": "t_s,x,y,z,qw,qx,qy,qz\n"}, "fixes.csv, line 1: no column arrival_s"),
        ({"fixes.csv": "t_s,arrival_s,x,y,z,qw,qx,qy,qz\n1,1.1,0,0,0,1,0,0,\n"}, "fixes.csv, line 2: no value for qz"),
        (
            {"fixes.csv": "t_s,arrival_s,x,y,z,qw,qx,qy,qz\n1,1.1,0,0,0,2,0,0,0\n"},
            "fixes.csv, line 2: quaternion of norm 2",
        ),
        (
            {"fixes.csv": "t_s,arrival_s,x,y,z,qw,qx,qy,qz,markers\n1,1.1,0,0,0,1,0,0,0,7 x\n"},
            "fixes.csv, line 2: markers is '7 x', ids with spaces between are needed",
        ),
        ({"fixes.csv": b"t_s,arrival_s,x,y,z,qw,qx,qy,qz\n\xff\xfe\n"}, "fixes.csv: this is no text file"),
        ({"fixes.csv": "t_s,arrival_s,x,y,z,qw,qx,qy,qz\n" + "1" * 200_000}, "fixes.csv: cannot be read as CSV"),
        ({"truth.csv": "t_s,x,y\n0,0,0\n"}, "truth.csv, line 1: no column z"),
    ],
)
def test_a_recording_that_cannot_be_replayed_says_why_and_where(tmp_path, capsys, files, says):
    folder = plain(tmp_path / "drive")
    for name, content in files.items():
        if content is None:
            (folder / name).unlink()
        else:
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RecordingError, match=says):
        load(folder)
    assert main(["replay", str(folder)]) != 0
    error = capsys.readouterr().err
    assert error.startswith("steadfix: ")
    assert error.count("\n") == 1


def test_no_folder(tmp_path):
    with pytest.raises(RecordingError, match="no such folder"):
        robot_folders(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="is no folder"):
        robot_folders(tmp_path / "file")
    with pytest.raises(RecordingError, match=r"neither it nor a folder in it holds an imu\.csv"):
        robot_folders(tmp_path)


def test_a_recording_is_not_written_over(recorded):
    folder, _ = recorded
    with pytest.raises(RecordingError, match="holds a recording already"):
        Recorder(folder.parent, ["rover"])


def test_columns_may_stand_in_any_order_and_sigmas_count(tmp_path):
    folder = plain(tmp_path / "drive")
    lines = (folder / "fixes.csv").read_text().splitlines()
    turned = [",".join([*reversed(line.split(",")), "0.02,0.1"]) for line in lines]
    turned[0] = ",".join([*reversed(lines[0].split(",")), "sigma_position,sigma_attitude"])
    (folder / "fixes.csv").write_text("\n".join(turned))
    recording = load(folder)
    np.testing.assert_allclose(np.diag(recording.fixes[0].hypotheses[0].covariance), [4e-4] * 3 + [1e-2] * 3)
    assert recording.fixes[0].t == 0.2
    assert len(set(FIX_COLUMNS)) == len(FIX_COLUMNS)


def test_hand_held_recording_with_mocap_truth():
    recording = load(data("handheld_mocap"))
    track, outcomes, _ = replay(recording, Localiser("handheld", FilterParams(), "free"))
    error = track_error(track, recording.truth)
    assert len(error.t) > 55000
    assert 1e3 * error.position_rmse < 13.0
    assert np.degrees(error.attitude_rmse) < 0.32
    assert len(outcomes) == len(recording.fixes)


def test_a_robot_without_a_configuration_is_not_ignored(tmp_path, capsys):
    assert main(["replay", str(plain(tmp_path / "drive")), "--robot", "rover"]) == 2
    assert "--robot rover: a robot of which configuration? --config names its file" in capsys.readouterr().err
