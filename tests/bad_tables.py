"""Tables of one push as users write them, each with the result that is expected of a fit's reader.

A table is equal to the reference, or is refused with words that the sentence must contain.
"""

import gzip
import io
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
    columns: Any = ""
    suffix: str = ".csv"


def text(change: Change = lambda t: t, encoding: str = "utf-8", **options: Any) -> Any:
    """Return the content of the table that pandas writes."""
    return lambda: change(push()).to_csv(index=False, **options).encode(encoding)


def lines(edit: Callable[[list[str]], list[str]], newline: str = "\n", **options: Any) -> Any:
    """Return the content of the table after an edit of its lines."""

    def content() -> bytes:
        plain = text(**options)().decode()
        return newline.join([*edit(plain.splitlines()), ""]).encode()

    return content


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


def savetxt(**options: Any) -> bytes:
    file = io.BytesIO()
    np.savetxt(file, push().to_numpy(), **options)
    return file.getvalue()


def stamps(form: str) -> Change:
    start = pd.Timestamp("2026-03-01T10:15:00Z")
    return lambda t: t.assign(
        time=[
            f"{start + pd.Timedelta(seconds=s):{form}}" if form else str(pd.Timedelta(seconds=s))
            for s in t.time
        ]
    )


DEG, MM = 180 / np.pi, 1000.0
TITLES = [*push(1)]
CAPITALS = renamed(**{name: name.title().replace("_", " ") for name in TITLES})
OTHER = {"time": ("time [ms]", 1e3), "x": ("x [mm]", MM), "y": ("Y (cm)", 100.0)}
OTHER |= {"yaw": ("yaw [deg]", DEG), "v_x": ("v_x [mm/s]", MM), "omega": ("omega [°/s]", DEG)}
OTHER |= {"contact_x": ("contact_x [mm]", MM), "contact_y": ("contact_y [mm]", MM)}
SHORT = {name: name[0] + name[-2:] for name in TITLES}
PAIRS = ",".join(f"{name}={title}" for name, title in SHORT.items())

CASES: dict[str, Case] = {
    # What pandas, Excel, R, NumPy and ROS write.
    "plain": Case(text()),
    "semicolons": Case(text(sep=";")),
    "bars": Case(text(sep="|")),
    "blanks": Case(lambda: push().to_string(index=False).encode(), suffix=".txt"),
    "decimal commas after tabs": Case(text(sep="\t", decimal=",")),
    "decimal commas in quotes": Case(text(decimal=",")),
    "quotes": Case(text(quoting=1)),
    "BOM": Case(text(encoding="utf-8-sig")),
    "UTF-16 without BOM": Case(text(encoding="utf-16-le")),
    "Latin-1": Case(text(units(yaw=("yaw [°]", DEG)), encoding="latin-1")),
    "CRCRLF": Case(lines(list, "\r\r\n")),
    "blank lines": Case(lines(lambda rows: ["", *rows[:50], "", ",,,,,,,,,,,", *rows[50:]])),
    "comments": Case(lines(lambda rows: ["# of robot 3", "% a;b", *rows[:9], "#,,", *rows[9:]])),
    "header as a comment": Case(lines(lambda rows: ["# 2026", f"#{rows[0]}", *rows[1:]])),
    "numpy.savetxt": Case(lambda: savetxt(header=" ".join(TITLES)), suffix=".dat"),
    "numpy.savetxt without header": Case(lambda: savetxt(delimiter=","), "has no header"),
    "sep= of Excel": Case(lines(lambda rows: ["sep=;", *rows], sep=";", decimal=",")),
    "trailing commas below": Case(lines(lambda rows: [rows[0], *(r + "," for r in rows[1:])])),
    "additional columns": Case(text(lambda t: t.assign(note="a, b", battery=np.nan))),
    "capitals": Case(text(CAPITALS)),
    "surrounding blanks": Case(lines(lambda rows: [r.replace(",", " , ") for r in rows])),
    "gzip, upper suffix": Case(lambda: gzip.compress(text()()), suffix=".CSV.GZ"),
    "cut gzip": Case(lambda: gzip.compress(text()())[:900], "cannot be unpacked", suffix=".csv.gz"),
    "Excel by name": Case(lambda: b"PK\3\4", "save its sheet as CSV", suffix=".xlsx"),
    "another suffix": Case(text(), "give a trace, a run folder of rps push, a", suffix=".json"),
    "Excel's error in the first cell": Case(
        text(cell(7, "time", "#N/A")), "row 9, column time, but '#N/A'"
    ),
    "units in a blank-separated header": Case(
        lambda: savetxt(header="time [s] " + " ".join(TITLES[1:])), suffix=".txt"
    ),
    "date-times below a comment": Case(lambda: b"#" + text(stamps("%Y-%m-%dT%H:%M:%S.%f"))()),
    "note with semicolons": Case(text(lambda t: t.assign(note="a; b; c | d"))),
    "decimal commas and a point": Case(
        text(
            lambda t: cell(7, "x", "1.234,5")(
                t.map("{:.9f}".format).replace(r"[.]", ",", regex=True)
            ),
            sep=";",
        ),
        "row 9, column x, but '1.234,5'",
    ),
    "empty": Case(lambda: b"", "is empty"),
    "lines above the header": Case(
        lines(lambda rows: ["Log of robot 3", *rows]), "write # before lines of text"
    ),
    "binary": Case(lambda: bytes(range(1, 256)) * 9, "has no header"),
    # Titles and units.
    "other units": Case(text(units(**OTHER))),
    "unknown unit": Case(
        text(renamed(x="x [px]")), r"unit of the column 'x \[px\]' in .*: 'px': choose from m, cm"
    ),
    "columns as a mapping": Case(
        text(renamed(**SHORT)), columns={k: f" {x}" for k, x in SHORT.items()}
    ),
    "--columns with a unit": Case(text(units(yaw=("heading", DEG))), columns="yaw=heading[deg]"),
    "--columns of a title with a unit": Case(text(units(yaw=("h [deg]", DEG))), columns="yaw=h"),
    "--columns of SI suffixes": Case(
        text(renamed(x="x_m", yaw="a_rad")), columns="x=x_m,yaw=a_rad"
    ),
    "--columns of one title for two": Case(
        text(lambda t: t.drop(columns="contact_y")), "other values", "v_y=v_y,contact_y=v_y"
    ),
    "--columns of an unknown title": Case(
        text(), "unknown title for yaw in .*: 'yow': .*did you mean 'yaw'", "yaw=yow"
    ),
    "--columns without =": Case(text(), "columns = yaw is not allowed", "yaw"),
    "--columns twice": Case(text(), "name each once", "yaw=x,yaw=y"),
    "missing columns": Case(
        text(lambda t: renamed(yaw="yaw_rad", omega="Omega_z")(t.drop(columns="y"))),
        "lacks the columns y, yaw, omega: .*write --columns 'y=TITLE,yaw=yaw_rad,omega=Omega_z'",
    ),
    "titles of another program": Case(
        text(
            lambda t: t.rename(
                columns={k: f"pose_{k}" for k in ("x", "y", "yaw")}
                | {k: f"cmd_{k}" for k in ("v_x", "v_y", "omega")}
            )
        ),
        "write --columns 'x=pose_x,y=pose_y,yaw=pose_yaw,v_x=cmd_v_x,v_y=cmd_v_y,omega=cmd_omega'",
    ),
    "no similar column": Case(
        text(renamed(yaw="theta")),
        "lacks the column yaw: .*write --columns 'yaw=TITLE' with its titles, as theta",
    ),
    "half an object": Case(
        text(lambda t: known_object()(t).drop(columns="object_yaw")), "lacks the column object_yaw"
    ),
    "repeated column": Case(text(lambda t: t.assign(X=1.0)), "several columns for x, 'x' and 'X'"),
    "repeated column, named": Case(text(lambda t: t.assign(X=1.0)), columns="x=x"),
    "same title twice": Case(text(renamed(y="x")), "several columns for x"),
    # Cells.
    "empty cell": Case(text(cell(7, "yaw", "")), "row 9, column yaw, but an empty cell"),
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
        "row 2, column contact_x, but an empty cell and 9 more",
    ),
    "nan": Case(text(cell(7, "yaw", "nan")), "row 9, column yaw, but 'nan'"),
    "text": Case(
        text(lambda t: CAPITALS(cell(7, "yaw", "left")(t))), "row 9, column Yaw, but 'left'"
    ),
    "text below comments": Case(
        lines(
            lambda rows: [
                "# a",
                "",
                *rows[:9],
                rows[9].replace(rows[9].split(",")[3], "left"),
                *rows[10:],
            ]
        ),
        "row 12, column yaw, but 'left'",
    ),
    "bool": Case(
        text(lambda t: t.assign(contact_type=True)),
        "row 2, column contact_type, but 'True' and 399 more",
    ),
    "units in a row": Case(
        lines(lambda rows: [rows[0], "s,m,m,rad,,m,m,m/s,m/s,rad/s,m,m", *rows[1:]]),
        "row 2, column time, but 's'",
    ),
    "thousands": Case(
        text(cell(7, "x", "1,234.5")), "row 9, column x, but '1,234.5': write a number as 1234.5"
    ),
    "cut file": Case(lambda: text()()[:-40], "row 401, column contact_y, but an empty"),
    "long row": Case(
        lines(lambda rows: [*rows[:8], rows[8] + ",5", *rows[9:]]), "has 13 cells in row 9"
    ),
    "kind of contact": Case(text(lambda t: t.assign(contact_type=3)), "contact_type = 3 in row 2"),
    # Times.
    "ISO date-times": Case(text(stamps("%Y-%m-%dT%H:%M:%S.%f%z"))),
    "durations": Case(text(stamps(""))),
    "Unix stamps": Case(text(lambda t: t.assign(time=t.time + 1_772_360_100)), "later"),
    "Unix stamps [ns]": Case(
        text(lambda t: t.assign(time=[17723601 * 10**11 + round(1e9 * s) for s in t.time])),
        "later",
        "time=time[ns]",
    ),
    "date-times with commas": Case(text(stamps("%Y-%m-%d %H:%M:%S,%f"))),
    "first time missing": Case(
        text(lambda t: cell(0, "time", "")(t.assign(time=(2000 + t.time * 1e3).astype(int)))),
        "row 2, column time, but an empty cell: write a number",
    ),
    "bad date-time": Case(
        text(lambda t: cell(7, "time", "soon")(stamps("%FT%T.%f")(t))),
        "row 9, column time, but 'soon'",
    ),
    "milliseconds": Case(text(scaled(time=1e3)), r"a row every 20 s.*'time \[ms\]'"),
    "time falls": Case(text(cell(9, "time", 0)), "its time must rise, and is 0 s in row 11"),
    "time repeated": Case(text(lambda t: t.assign(time=t.time.round(1))), "its time must rise"),
    # Units that no title names.
    "wrapped yaw in degrees": Case(
        text(lambda t: t.assign(yaw=(DEG * t.yaw + 180) % 360 - 180)), columns="yaw=yaw[deg]"
    ),
    "wrapped degrees": Case(
        text(lambda t: t.assign(yaw=(DEG * t.yaw + 180) % 360 - 180)),
        "pose that jumps: yaw from .* 'yaw .deg.'",
    ),
    "yaw and omega in degrees, almost straight": Case(
        lambda: straight(50.0).to_csv(index=False).encode(), "yaw may be in deg"
    ),
    "omega in degrees": Case(text(scaled(omega=DEG)), "omega may be in deg/s"),
    "position in mm": Case(text(scaled(x=MM, y=MM)), "x and y may be in mm"),
    "speed in mm/s": Case(text(scaled(v_x=MM)), "v_x and v_y may be in mm/s"),
    "all lengths in mm": Case(
        text(scaled(x=10, y=10, v_x=10, contact_x=MM, contact_y=MM)),
        "contact_x and contact_y may be in mm",
    ),
    "target in mm": Case(
        text(scaled(target_x=MM)), "target_x and target_y up to 2000 m, beyond the limit of 100"
    ),
    "twist in the world": Case(
        text(lambda t: t.assign(v_x=0.1 * np.cos(t.yaw), v_y=0.1 * np.sin(t.yaw))),
        "v_x and v_y may be in the frame of x and y",
    ),
    "force in mN": Case(text(known_object(force_x=-3e4)), "force_x and force_y up to 3e[+]04 N"),
    "object in mm": Case(
        text(known_object(object_x=-600)), "object_x and object_y up to 600 m, beyond"
    ),
    "turning object in degrees": Case(
        text(lambda t: known_object()(t).assign(object_yaw=DEG * (t.yaw - 2.9))),
        "object_yaw up to 31.64 rad, beyond",
    ),
    "x mirrored": Case(text(scaled(x=-1.0)), "does not move in the direction of v_x and v_y"),
    "omega clockwise": Case(text(scaled(omega=-1.0)), "does not move in the direction of omega"),
    "all lengths and speeds in mm": Case(
        text(lambda t: t.assign(**{k: MM * t[k] for k in ("x", "y", "v_x", "contact_x")})),
        "v_x and v_y up to 100 m/s, beyond the limit of 3",
    ),
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
        log = logs.read(write(case, folder), SHELL, titles=case.columns)
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
