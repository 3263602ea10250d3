"""A record of how close each numeric assertion is to its tolerance: `pytest --tolerances FILE`.

A row of the file has the test, the line, the worst error over its tolerance, and the assertion.
"""

import csv
import re
import sys
from pathlib import Path

import numpy as np
import pytest

SIDE = r"([-+*/(). \de]+)"
COMPARED = re.compile(rf"{SIDE} <=? {SIDE}(?: <=? {SIDE})?")
SMALL = 0.2  # a larger right-hand side is an outcome or a count, not a tolerance


class Ratios:
    """Largest ratio of error over tolerance of each assertion of this process."""

    def __init__(self, path: Path):
        self.path, self.test = path, ""
        self.rows: dict[tuple[str, str, int], tuple[float, str]] = {}

    def add(self, ratio: float, text: str, line: int | None = None) -> None:
        """Record a ratio of the test that runs, if it is its line's largest."""
        file = self.test.partition("::")[0]
        if line is None:
            frame = sys._getframe(2)
            while frame.f_back and not frame.f_code.co_filename.endswith(file):
                frame = frame.f_back
            line = frame.f_lineno
        key = (file, self.test, line)
        if ratio <= 1 and ratio > self.rows.get(key, (-1.0, ""))[0]:
            self.rows[key] = (float(ratio), text)

    def write(self) -> None:
        """Append the rows to the file of this process."""
        with self.path.open("w", newline="") as file:
            table = csv.writer(file)
            for (_, test, line), (ratio, text) in sorted(self.rows.items()):
                table.writerow((f"{ratio:.3f}", test, line, text))


def install(path: Path) -> Ratios:
    """Record the ratios of `assert_allclose`, `np.allclose`, `approx` and `error < tolerance`."""
    ratios = Ratios(path)
    scalar = type(pytest.approx(1.0))
    close, approx = np.isclose, scalar.__eq__
    assert_allclose = np.testing.assert_allclose

    def worst(actual: object, desired: object, rtol: float, atol: float) -> None:
        a, d = np.asarray(actual), np.asarray(desired)
        if a.dtype.kind not in "fiuc" or d.dtype.kind not in "fiuc":
            return
        with np.errstate(all="ignore"):
            error, tolerance = np.abs(a - d), atol + rtol * np.abs(d)
            quotient = np.where(error == 0, 0.0, error / tolerance)
        if quotient.size and np.isfinite(quotient).any():
            ratios.add(np.nanmax(quotient), f"rtol {rtol:g}, atol {atol:g}")

    def recorded(actual, desired, rtol=1e-7, atol=0, *rest, **options):
        worst(actual, desired, rtol, atol)
        return assert_allclose(actual, desired, rtol, atol, *rest, **options)

    def equal(self, actual):
        result = approx(self, actual)
        if result and isinstance(actual, (int, float, complex, np.number)):
            error = abs(actual - self.expected)
            if error:
                ratios.add(error / self.tolerance, f"approx({self.expected}) {self.tolerance:.2g}")
        return result

    def isclose(a, b, rtol=1e-5, atol=1e-8, equal_nan=False):
        worst(a, b, rtol, atol)
        return close(a, b, rtol, atol, equal_nan)

    np.testing.assert_allclose = recorded
    scalar.__eq__ = equal
    np.isclose = isclose
    np.allclose = lambda *a, **k: bool(np.all(isclose(*a, **k)))
    return ratios


def compare(ratios: Ratios, line: int, text: str, explanation: str) -> None:
    """Record a comparison `error < tolerance`, or `low < value < high`, that has passed."""
    first_line = re.sub(r"np\.\w+\(", "(", explanation.strip().split("\n")[0])
    first_line = re.sub(r"^\((.*)\) == \w+$", r"\1", first_line)
    if not (match := COMPARED.fullmatch(first_line)):
        return
    try:
        error, *bounds = (eval(side) for side in match.groups() if side)
    except (ArithmeticError, NameError, SyntaxError, TypeError):
        return
    if len(bounds) == 2:
        low, (value, high) = error, bounds
        error, bounds = value - (low + high) / 2, [(high - low) / 2]
    if 0 < bounds[0] <= SMALL:
        ratios.add(abs(error) / bounds[0], text, line)
