"""Run folders whose elite 000 moves into the upright, as far as exports read them."""

from rtcd_jax.elite.records import write_elite
from tests.certificate import balance, swing

UNITS = {
    "pendulum": {
        "states": {"theta": "rad", "theta_dot": "rad/s"},
        "inputs": {"torque": "N m"},
        "design": {"mass": "kg", "length": "m"},
        "volume": "rad rad/s",
    },
    "cartpole": {
        "states": {"cart": "m", "theta": "rad", "cart_dot": "m/s", "theta_dot": "rad/s"},
        "inputs": {"force": "N"},
        "design": {"pole_length": "m", "pole_mass": "kg"},
        "volume": "m rad m/s rad/s",
    },
}
ELITES = {"pendulum": swing.elite, "cartpole": balance.elite}


def run_folder(path, plant, **changes):
    """`path` as a run folder with a rod's or a bob's elite 000 and the same as its initial candidate.

    `changes` replace entries of the record.
    """
    arrays, record = ELITES[plant]()
    if plant == "cartpole":  # balance.py's inertia is a rod's to 6 digits only
        parameters = record["parameters"]
        inertia = parameters["Mp"] * parameters["lp"] ** 2 / 3
        record = record | {"parameters": parameters | {"inertia_about_com": inertia}}
    p = record["parameters"]
    design = (
        {"mass": p["m"], "length": p["l"]} if plant == "pendulum" else {"pole_length": p["lp"], "pole_mass": p["Mp"]}
    )
    record |= {
        "design": design,
        "weights": {"q": [1.0] * len(arrays["x_goal"]), "r": [1.0]},
        "units": UNITS[plant],
        "status": "OK",
        "rung": "sampled",
        "epsilon": 0.01,
        "confidence": 0.99,
        "volumes": {"sum": arrays["volumes_per_knot"].sum(), "inlet": arrays["volumes_per_knot"][0]},
        "config_hash": "0123456789ab",
    } | changes  # fmt: skip
    (path / "elites").mkdir(parents=True)
    write_elite(path / "elites", "000", arrays, record)
    write_elite(path, "initial", arrays, record)
    return path
