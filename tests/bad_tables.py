"""Tables of one push as users write them, each with the result that is expected of a fit's reader.

A table is equal to the reference, or is refused with words that the sentence must contain.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from rps_jax.errors import InputError
from rps_jax.robot.robot import Robot
from rps_jax.tuning import logs

SHELL = Robot().shell
EQUAL = "equal"
ROWS = 400
Change = Callable[[pd.DataFrame], pd.DataFrame]


def push(count: int = ROWS, **changes: Any) -> pd.DataFrame:
    """Return the log of a base that drives a curve with a contact at its front."""
    time = np.round(0.02 * np.arange(count), 2)
    omega = 0.3 * np.sin(0.7 * time)
    yaw = 2.9 + 0.02 * np.cumsum(np.append(0.0, omega[:-1]))
    x, y = (0.1 * 0.02 * np.cumsum(np.append(0.0, f(yaw)[:-1])) for f in (np.cos, np.sin))
    values = {"time": time, "x": x, "y": y, "yaw": yaw, "contact_type": 1, "contact_x": 0.3625}
    values |= {"contact_y": 0.05, "v_x": 0.1, "v_y": 0.0, "omega": omega}
    values |= {"target_x": -2.0, "target_y": 0.5} | changes
    return pd.DataFrame(values, range(count)).round(9)


def straight(heading: float) -> pd.DataFrame:
    """Return the log of a base that turns little from a heading [deg], with angles in degrees."""
    table = push()
    omega = 0.05 * np.sin(0.7 * table.time)
    yaw = np.radians(heading) + 0.02 * np.cumsum(omega)
    x, y = (0.1 * 0.02 * np.cumsum(f(yaw)) for f in (np.cos, np.sin))
    return table.assign(x=x, y=y, yaw=np.degrees(yaw), omega=np.degrees(omega))


def known_object(**changes: Any) -> Change:
    """Return a change that adds the pose of the object and the force on the base."""

    def change(t: pd.DataFrame) -> pd.DataFrame:
        pose = {"object_x": t.x - 0.6, "object_y": t.y, "object_yaw": 0.5 * t.yaw}
        return t.assign(**pose, force_x=-30.0, force_y=2.0).assign(**changes)

    return change


class Case(NamedTuple):
    """File, with the options and the expected result of reading it."""

    content: Callable[[], bytes]
    expected: str = EQUAL
    suffix: str = ".csv"


def text(change: Change = lambda t: t, encoding: str = "utf-8", **options: Any) -> Any:
    """Return the content of the table that pandas writes."""
    return lambda: change(push()).to_csv(index=False, **options).encode(encoding)


def lines(edit: Callable[[list[str]], list[str]]) -> Any:
    """Return the content of the table after an edit of its lines."""
    return lambda: "\n".join([*edit(text()().decode().splitlines()), ""]).encode()


def renamed(**titles: str) -> Change:
    return lambda t: t.rename(columns=titles)


def scaled(**factors: float) -> Change:
    return lambda t: t.assign(**{name: t[name] * factor for name, factor in factors.items()})


def units(**titles: tuple[str, float]) -> Change:
    """Return a change of units, with new titles."""
    return lambda t: scaled(**{k: f for k, (_, f) in titles.items()})(t).rename(
        columns={k: title for k, (title, _) in titles.items()}
    )


def cell(row: int, column: str, value: object) -> Change:
    def change(t: pd.DataFrame) -> pd.DataFrame:
        t = t.astype(object)
        t.loc[row, column] = value
        return t

    return change


DEG, MM = 180 / np.pi, 1000.0
TITLES = [*push(1)]
CAPITALS = renamed(**{name: name.title().replace("_", " ") for name in TITLES})
OTHER = {"time": ("time [ms]", 1e3), "x": ("x [mm]", MM), "y": ("Y (cm)", 100.0)}
OTHER |= {"yaw": ("yaw [deg]", DEG), "v_x": ("v_x [mm/s]", MM), "omega": ("omega [deg/s]", DEG)}
OTHER |= {"contact_x": ("contact_x [mm]", MM), "contact_y": ("contact_y [mm]", MM)}
CASES: dict[str, Case] = {
    "plain": Case(text()),
    "semicolons": Case(text(sep=";")),
    "tabs": Case(text(sep="\t"), suffix=".txt"),
    "quotes": Case(text(quoting=1)),
    "BOM": Case(text(encoding="utf-8-sig")),
    "blank lines": Case(lines(lambda rows: ["", *rows[:50], "", *rows[50:]])),
    "comments": Case(lines(lambda rows: ["# of robot 3", *rows[:9], "# a;b", *rows[9:]])),
    "additional columns": Case(text(lambda t: t.assign(note="a, b", battery=np.nan))),
    "title of two lines": Case(text(lambda t: t.assign(**{"a\nnote": 1.0}))),
    "capitals": Case(text(CAPITALS)),
    "surrounding blanks": Case(lines(lambda rows: [r.replace(",", " , ") for r in rows])),
    "another suffix": Case(text(), "give a trace, a run folder of rps push, a", suffix=".json"),
    "empty": Case(lambda: b"", "is no table"),
    "no header": Case(lines(lambda rows: rows[1:]), "lacks time, x, y, yaw, contact_type"),
    "lines above the header": Case(lines(lambda rows: ["Log of robot 3", *rows]), "is no table"),
    "binary": Case(lambda: bytes(range(1, 256)) * 9, "is no table|lacks time"),
    # Titles and units.
    "other units": Case(text(units(**OTHER))),
    "nanoseconds": Case(text(units(time=("time [ns]", 1e9)))),
    "unknown unit": Case(
        text(renamed(x="x [px]")), r"unit of the column 'x \[px\]' in .*: 'px': choose from m, cm"
    ),
    "missing columns": Case(
        text(lambda t: renamed(yaw="yaw_rad")(t.drop(columns="y"))),
        "lacks y, yaw: rename its columns time, x, yaw_rad, contact_type",
    ),
    "half an object": Case(
        text(lambda t: known_object()(t).drop(columns="object_yaw")), "lacks object_yaw"
    ),
    "repeated column": Case(text(lambda t: t.assign(X=1.0)), "several columns for x"),
    "same title twice": Case(text(renamed(y="x")), "several columns for x"),
    # Cells.
    "empty cell": Case(text(cell(7, "yaw", "")), "has no number for pose in row 9"),
    "empty cells without contact": Case(
        text(
            lambda t: t.assign(contact_type=1 * (t.index > 9)).assign(
                contact_x=t.contact_x.where(t.index > 9), contact_y=t.contact_y.where(t.index > 9)
            )
        ),
        "other values",
    ),
    "empty cells in contact": Case(
        text(lambda t: t.assign(contact_x=t.contact_x.where(t.index > 9))),
        "no number for p_robot_contact in row 2",
    ),
    "infinity": Case(text(cell(7, "yaw", "inf")), "no number for pose in row 9"),
    "text": Case(text(cell(7, "yaw", "left")), "no number for pose in row 9"),
    "decimal commas": Case(text(sep=";", decimal=","), "no number for time in row 2"),
    "cut file": Case(lambda: text()()[:-40], "no number for p_robot_contact in row 401"),
    "long row": Case(lines(lambda rows: [*rows[:8], rows[8] + ",5", *rows[9:]]), "is no table"),
    "kind of contact": Case(text(lambda t: t.assign(contact_type=3)), "contact_type = 3 in row 2"),
    # Times.
    "Unix stamps": Case(text(lambda t: t.assign(time=t.time + 1_772_360_100)), "later"),
    "milliseconds": Case(text(scaled(time=1e3)), r"a row every 20 s.*'time \[ms\]'"),
    "nanoseconds as seconds": Case(text(scaled(time=1e9)), r"a row every 2e[+]07 s"),
    "time falls": Case(text(cell(9, "time", 0)), "its time must rise, and is 0 s in row 11"),
    "time repeated": Case(text(lambda t: t.assign(time=t.time.round(1))), "its time must rise"),
    # Units that no title names.
    "wrapped degrees": Case(
        text(lambda t: t.assign(yaw=(DEG * t.yaw + 180) % 360 - 180)),
        "pose that jumps: yaw from .* 'yaw .deg.'",
    ),
    "all lengths in mm": Case(
        text(scaled(x=10, y=10, v_x=10, contact_x=MM, contact_y=MM)),
        "contact_x and contact_y may be in mm",
    ),
    "target in mm": Case(
        text(scaled(target_x=MM)), "target_x and target_y up to 2000 m, beyond the limit of 100"
    ),
    "force in mN": Case(text(known_object(force_x=-3e4)), "force_x and force_y up to 3e[+]04 N"),
    "object in mm": Case(
        text(known_object(object_x=-600)), "object_x and object_y up to 600 m, beyond"
    ),
    "object in degrees": Case(
        text(known_object(object_yaw=45.0)), "object_yaw up to 45 rad, beyond"
    ),
    "turning object in degrees": Case(
        text(lambda t: known_object()(t).assign(object_yaw=DEG * (t.yaw - 2.9))),
        "object_yaw up to 31.64 rad, beyond",
    ),
    "yaw in degrees": Case(text(scaled(yaw=DEG)), "yaw may be in deg"),
    "yaw and omega in degrees": Case(text(scaled(yaw=DEG, omega=0.5 * DEG)), "yaw may be in deg"),
    "yaw and omega in degrees, almost straight": Case(
        lambda: straight(50.0).to_csv(index=False).encode(), "yaw may be in deg"
    ),
    "omega in degrees": Case(text(scaled(omega=DEG)), "omega may be in deg/s"),
    "position in mm": Case(text(scaled(x=MM, y=MM)), "x and y may be in mm"),
    "position in cm": Case(text(scaled(x=100, y=100)), "x and y may be in mm or cm"),
    "speed in mm/s": Case(text(scaled(v_x=MM)), "v_x and v_y may be in mm/s"),
    "speed in cm/s": Case(text(scaled(v_x=100)), "v_x and v_y may be in mm/s or cm/s"),
    "contact in mm": Case(text(scaled(contact_x=MM, contact_y=MM)), "contact_y may be in mm"),
    "contact in cm": Case(
        text(scaled(contact_x=100, contact_y=100)), "contact_y may be in mm or cm"
    ),
    "all lengths and speeds in mm": Case(
        text(lambda t: t.assign(**{k: MM * t[k] for k in ("x", "y", "v_x", "contact_x")})),
        "v_x and v_y up to 100 m/s, beyond the limit of 3",
    ),
    "twist in the world": Case(
        text(lambda t: t.assign(v_x=0.1 * np.cos(t.yaw), v_y=0.1 * np.sin(t.yaw))),
        "v_x and v_y may be in the frame of x and y",
    ),
    "x mirrored": Case(text(scaled(x=-1.0)), "does not move in the direction of v_x and v_y"),
    "omega clockwise": Case(text(scaled(omega=-1.0)), "does not move in the direction of omega"),
    "jump": Case(
        text(lambda t: t.assign(x=t.x + 3 * (t.index >= 200))),
        "pose that jumps: x from .* in row 202",
    ),
}


def write(case: Case, folder: Path) -> Path:
    """Write the file of a case."""
    path = folder / f"log{case.suffix}"
    path.write_bytes(case.content())
    return path


def result_of(case: Case, folder: Path) -> str:
    """Return how the reader takes a file: equal to the reference, later, other, or the sentence."""
    try:
        log = logs.read(write(case, folder), SHELL)
    except InputError as error:
        return str(error)
    expected = logs.read(reference(folder), SHELL).columns
    same = [k for k, x in expected.items() if np.allclose(log.columns[k], x, rtol=0, atol=5e-6)]
    if {*same} == {*expected} == {*log.columns}:
        return EQUAL
    shifted = np.allclose(np.ptp(log.columns["time"]), np.ptp(expected["time"]), atol=1e-5)
    return "later" if {*expected} - {*same} == {"time"} and shifted else "other values"


def reference(folder: Path) -> Path:
    """Write the reference table."""
    return write(Case(text()), folder)
