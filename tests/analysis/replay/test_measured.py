"""Files of many shapes give one motion; what is no measured motion is one line that names the place."""

import math
import random

import numpy as np
import pytest

from rtcd_jax.analysis.replay.measured import read_measured
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.system.errors import UserError

PENDULUM, CARTPOLE = PLANTS["pendulum"]().states, PLANTS["cartpole"]().states
TIME = [0.0, 0.5, 1.0]
ANGLE, SPEED = [3.0, -2.5, 0.25], [0.0, 12.5, -1.0]
CART, CART_SPEED = [0.1, -0.2, 0.0], [1.5, 0.0, -3.0]


def file(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "lab.csv"
    path.write_bytes(text.encode(encoding))
    return path


def read(path, states=PENDULUM, *arguments):
    return read_measured(path, states, *arguments)


ONE_JOINT = {
    "ours": "time,pos,vel,torque\n{t},{p},{v},9",
    "position, velocity": "time,position,velocity,torque\n{t},{p},{v},9",
    "desired beside measured": "des_time,des_pos,des_vel,des_tau,meas_time,meas_pos,meas_vel,meas_tau\n"
    "7,7,7,7,{t},{p},{v},9",
    "an index": ",time,pos,vel,torque\n7,{t},{p},{v},9",
    "any order, others between": "vel, pos ,note,time\n{v},{p},x,{t}",
    "a comment": "# time, position, velocity\n{t}, {p}, {v}",
    "a comment above": "# recorded by a robot, 2023\n\nTime,Pos,Vel\n{t},{p},{v}",
    "comments between": "time,pos,vel\n{t},{p},{v}\n# paused",
    "capitals and units": "Time [s],Position [rad],Velocity [rad/s]\n{t},{p},{v}",
    "units behind": "time_s,theta_rad,theta_dot_rad_s,torque_Nm\n{t},{p},{v},9",
    "names of the state": "t,theta,thetaDot\n{t},{p},{v}",
    "greek": "t,θ,ω\n{t},{p},{v}",
    "filtered beside measured": "time,vel_filt,pos_filt,pos_meas,vel_meas\n{t},7,7,{p},{v}",
    "quotes": '"time","pos","vel"\n"{t}","{p}","{v}"',
    "semicolons": "time;pos;vel\n{t};{p};{v}",
    "tabs": "time\tpos\tvel\n{t}\t{p}\t{v}",
    "spaces": "time   pos  vel\n  {t}  {p}   {v} ",
    "byte order mark": "\ufefftime,pos,vel\n{t},{p},{v}",
    "a comma at the end": "time,pos,vel\n{t},{p},{v},",
}


@pytest.mark.parametrize("shape", ONE_JOINT)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_one_joint(tmp_path, shape, end):
    *head, row = ONE_JOINT[shape].split("\n") if shape != "comments between" else ("time,pos,vel", "{t},{p},{v}")
    rows = [row.format(t=t, p=p, v=v) for t, p, v in zip(TIME, ANGLE, SPEED, strict=True)]
    if shape == "comments between":
        rows.insert(2, "# paused")
    found = read(file(tmp_path, end.join([*head, *rows, "", ""])))
    np.testing.assert_array_equal(found.time, TIME)
    np.testing.assert_array_equal(found.x, np.column_stack([ANGLE, SPEED]))
    assert found.notes == ()


TWO_JOINTS = {
    "numbers": "time,pos1,pos2,vel1,vel2,tau1,tau2\n{t},{c},{p},{w},{v},9,9",
    "cart and pole": "time,cart_pos,pend_pos,cart_vel,pend_vel,force\n{t},{c},{p},{w},{v},9",
    "measured and filtered": "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,pos_filt1,pos_filt2,vel_filt1,vel_filt2,"
    "tau_con1,tau_con2,tau_meas1,tau_meas2\n{t},{c},{p},{w},{v},7,7,7,7,9,9,9,9",
    "desired too": "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,pos_des1,pos_des2,vel_des1,vel_des2\n"
    "{t},{c},{p},{w},{v},7,7,7,7",
    "simulated beside measured": "time,pos1,pos2,vel1,vel2,meas_pos1,meas_pos2,meas_vel1,meas_vel2\n"
    "{t},7,7,7,7,{c},{p},{w},{v}",
    "joint by joint": "time,pos1,vel1,acc1,pos2,vel2,acc2\n{t},{c},{w},7,{p},{v},7",
    "states' names": "time_s,x_m,theta_rad,x_dot_m_s,theta_dot_rad_s\n{t},{c},{p},{w},{v}",
    "camels": "Time,cartPos,poleAngle,cartVel,poleAngleVel\n{t},{c},{p},{w},{v}",
    "indices": "t,q[1],q[2],qd[1],qd[2]\n{t},{c},{p},{w},{v}",
}


@pytest.mark.parametrize("shape", TWO_JOINTS)
def test_two_joints(tmp_path, shape):
    head, row = TWO_JOINTS[shape].split("\n")
    columns = zip(TIME, CART, ANGLE, CART_SPEED, SPEED, strict=True)
    rows = [row.format(t=t, c=c, p=p, w=w, v=v) for t, c, p, w, v in columns]
    found = read(file(tmp_path, "\n".join([head, *rows])), CARTPOLE)
    np.testing.assert_array_equal(found.time, TIME)
    np.testing.assert_array_equal(found.x, np.column_stack([CART, ANGLE, CART_SPEED, SPEED]))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_units_and_decimal_commas(tmp_path, encoding):
    text = "Zeit;time [ms];Angle [°];vel [deg/s]\nfrüh;0;180,0;-90,0\nfrüh;500;90;0\n"
    found = read(file(tmp_path, text, encoding))
    np.testing.assert_allclose(found.time, [0, 0.5])
    np.testing.assert_allclose(found.x, [[math.pi, -math.pi / 2], [math.pi / 2, 0]])


def test_rows_that_say_nothing_new_are_left_out_and_told(tmp_path):
    text = "time,pos,vel\n0,0,0\n0.1,1,2\n0.1,9,9\n0.2,3,4\n0,0,0\n0,0,0\n"
    found = read(file(tmp_path, text))
    np.testing.assert_array_equal(found.x, [[0, 0], [1, 2], [3, 4]])
    assert found.notes == ("2 rows of zeros at the end left out", "1 rows with the time of the row above left out")


@pytest.mark.parametrize(
    "choices",
    [("time=stamp", "theta=enc", "theta_dot=gyro"), ("t=2", "pos=enc", "vel=4"), ("time=2", "theta=3", "omega=gyro")],
)
def test_the_user_s_columns(tmp_path, choices):
    text = "count,stamp,enc,gyro\n" + "".join(f"7,{t},{p},{v}\n" for t, p, v in zip(TIME, ANGLE, SPEED, strict=True))
    found = read(file(tmp_path, text), PENDULUM, choices)
    np.testing.assert_array_equal(found.time, TIME)
    np.testing.assert_array_equal(found.x, np.column_stack([ANGLE, SPEED]))


def test_columns_by_number_need_no_headings_or_wrong_ones(tmp_path):
    """A table of six columns under the names of four, as one of the labs' tools writes the cart-pole's."""
    rows = "0,0.1,3,0,0,9\n0.5,0.2,2,0,1,9\n"
    choices = [f"{name}={number}" for number, name in enumerate(["time", *CARTPOLE], 1)]
    for head in ("", "time,pos,vel,torque\n"):
        path = file(tmp_path, head + rows)
        np.testing.assert_array_equal(read(path, CARTPOLE, choices).x, [[0.1, 3, 0, 0], [0.2, 2, 0, 1]])
        with pytest.raises(UserError, match="has no column for "):
            read(path, CARTPOLE)
    with pytest.raises(UserError, match=r"line 2 has 6 cells under 4 column names: .*time=1 theta=2 theta_dot=3"):
        read(path, PENDULUM)


BAD = {
    "time,pos,torque\n0,0,0\n": r"no column for theta_dot \[rad/s\]; its columns: time, pos, torque; choose them by "
    "--columns time=COLUMN theta=COLUMN theta_dot=COLUMN",
    "t,p\n0,0\n": "no column for theta .*, theta_dot .*; its columns: t, p; choose",
    "time,pos,pos,vel\n0,0,9,0\n": r"more than one column for theta \(pos, number 2 or pos, number 3\)",
    "time,pos [V],vel\n0,0,0\n": r"the column pos \[V\] must be in rad or deg or °",
    "time,pos,vel\n0,0,0\n1,nan,0\n": "line 3: pos = 'nan': must be a finite number",
    "time,pos,vel\n0,inf,0\n": "line 2: pos = 'inf': must be a finite number",
    "time,pos,vel\n0,1e308,0\n": "line 2: pos = '1e308': must be a finite number, of at most 1e\\+12",
    "time,pos,vel\n0,0,0\n\n1,x,0\n": "line 4: pos = 'x': must be a finite number",
    "time,pos,vel\n0,1_0,0\n": "pos = '1_0'",
    "time,pos,vel\n0,٣,0\n": "line 2: pos = '٣'",
    "time,pos,vel\n0,0\n": "line 2: vel = ''",
    "time,pos,vel\n0,0,0,0\n": "line 2 has 4 cells under 3 column names",
    "time,pos,vel\n0,0,0\n0.1,0,0\n0.05,0,0\n": "line 4: time = 0.05 after 0.1: must not fall",
    'time,pos,vel\n"0,0,0\n0.1,0,0\n': "has no samples, only its columns|no column for",
    "time,pos,vel\n0," + "9" * 200_000 + ",0\n": "line 2: field larger than field limit",
    "time,pos,vel\n0," + "9" * 2000 + ",0\n": "line 2: pos = '9999",
    "time,pos,vel\n0,\x000,0\n": r"is no text \(it has zero bytes\)",
    "\x1b[31mtime,pos\n0,0\n": r"its columns: \\x1b\[31mtime, pos",
    ",".join(f"c{i}" for i in range(1000)) + "\n0\n": "c39 and 960 more",
    "": "is empty: must be a CSV of measured states",
    "\n\n": "is empty",
}


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_what_is_no_measured_motion_is_one_line(tmp_path, text):
    with pytest.raises(UserError, match=BAD[text]) as error:
        read(file(tmp_path, text))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1200


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ("pos", "must be NAME=COLUMN"),
        ("pos=", "must be NAME=COLUMN"),
        ("thta=pos", "did you mean 'theta'"),
        ("pos=angle", "has no such column; its columns: time, pos, pos, vel"),
        ("pos=pos", "has 2 columns of that name: choose by number"),
        ("pos=0", "has no such column"),
        ("pos=" + "9" * 5000, "has no such column"),
        ("pos=9", "line 2: column 9 = ''"),
    ],
)
def test_choices_that_choose_nothing(tmp_path, choice, message):
    with pytest.raises(UserError, match=message):
        read(file(tmp_path, "time,pos,pos,vel\n0,0,0,0\n"), PENDULUM, [choice])


def test_bytes_that_are_no_text(tmp_path):
    for content in (b"\xff\xfe\x00\x01\x02", random.Random(0).randbytes(5000)):
        (tmp_path / "lab.csv").write_bytes(content)
        with pytest.raises(UserError, match=r"is no text|has no column"):
            read(tmp_path / "lab.csv")


def mutated(content, rng):
    """Some bytes of a file changed, left out, repeated or replaced by what breaks readers."""
    poison = [
        b"nan",
        b"inf",
        b"-1e999",
        b'"',
        b"\x00",
        b"\xff",
        b",",
        b";",
        b"\n",
        b"\t",
        b"1" * 300,
        b"\x1b[31m",
        b"#",
        b"",
    ]
    for _ in range(rng.choice([1, 1, 1, 2, 6])):
        i = rng.randrange(len(content) + 1)
        j = min(len(content), i + rng.choice([0, 1, 1, 5, 40]))
        piece = rng.choice([*poison, content[i:j] * 2, content[rng.randrange(len(content) + 1) :][:20]])
        content = content[:i] + piece + content[j:]
    return content


def test_a_thousand_mutated_files_are_motions_or_one_line(tmp_path):
    rng, path, messages = random.Random(1), tmp_path / "lab.csv", []
    shapes = [(text.split("\n"), PENDULUM) for text in ONE_JOINT.values() if text.count("\n") == 1]
    shapes += [(text.split("\n"), CARTPOLE) for text in TWO_JOINTS.values()]
    for number in range(1000):
        (head, row), states = shapes[number % len(shapes)]
        rows = [row.format(t=k / 10, c=0.1 * k, p=0.3 * k, w=0, v=k) for k in range(6)]
        path.write_bytes(mutated("\n".join([head, *rows]).encode(), rng))
        try:
            found = read(path, states)
        except UserError as error:
            messages.append(str(error))
        else:
            assert np.isfinite(found.x).all()
            assert (np.diff(found.time) > 0).all()
            assert found.x.shape == (len(found.time), len(states))
    assert 100 < len(messages) < 900
    assert [message for message in messages if not message.isprintable()] == []
