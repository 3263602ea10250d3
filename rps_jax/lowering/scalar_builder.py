"""Target that builds the graph of scalar C and JavaScript.

It leaves the precision to the printed code, and a product with a large constant matrix is one node.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection

import numpy as np

from rps_jax.lowering.builder import Factor, GraphBuilder
from rps_jax.lowering.graph import Array, MatrixProduct, gathered_scalar, key_of
from rps_jax.lowering.target import Target, Value, is_constant

_LARGE = 256  # weights of a matrix from which on a product is a loop over its rows


class ScalarBuilder(GraphBuilder):
    """Target that builds the graph of a function for one thread, in float or double."""

    kinds = "fib"
    max_products = 100_000

    def __init__(self, operations: Collection[str]) -> None:
        """Build a graph of the `operations` that the language spells."""
        super().__init__()
        self.operations = frozenset(operations)

    def scalar(self, value: Value, index: int) -> Value:
        """Return one number of a value, from where it was gathered."""
        scalar = super().scalar(value, index)
        while (source := gathered_scalar(scalar)) is not scalar:
            scalar = source
        return scalar

    # The printed code may have a deadline, so the length of each loop must be known.
    while_loop = Target.while_loop

    def products(self, matrix: Factor, rows: Factor, dtype: np.dtype) -> list[Value]:
        (weights, indices), (value, row_indices) = matrix, rows
        is_large = is_constant(weights) and len(indices) == 1 and indices.size >= _LARGE
        if not is_large or dtype.kind != "f":
            return super().products(matrix, rows, dtype)
        columns = np.reshape(weights, -1)[indices[0]].T
        return [self._times_matrix(self._rows(value, row_indices[0]), columns)]

    def _rows(self, value: Value, indices: np.ndarray) -> list[list[Value]]:
        return [[self.scalar(value, int(i)) for i in row] for row in indices]

    def _times_matrix(self, rows: list[list[Value]], matrix: np.ndarray) -> Value:
        """Multiply rows with a constant matrix, in one loop over the matrix.

        Networks with a mirror symmetry have pairs of rows (a, b), (b, a). Sum and difference halve
        their arithmetic: (a + b) (P + Q) / 2 plus or minus (a - b) (P - Q) / 2 of the halves P, Q.
        """
        matrix = np.ascontiguousarray(matrix, float)
        columns, (half, odd) = matrix.shape[1], divmod(matrix.shape[0], 2)
        keys = [list(map(key_of, row)) for row in rows]
        if len(rows) == 2 and not odd and keys[0] == keys[1][half:] + keys[1][:half]:
            template, indices = np.empty(half), np.arange(half)
            pair = [self.gather(x, indices, template) for x in (rows[0][:half], rows[0][half:])]
            p, q = matrix.reshape(2, half, columns) / 2
            products = []
            for name, part in (("add", p + q), ("sub", p - q)):
                row = self._rows(self.apply(name, pair, {}, template), indices[None])
                products.append(self._times_matrix(row, part))
            halves = [self.apply(x, products, {}, np.empty(columns)) for x in ("add", "sub")]
            return self.gather(halves, np.arange(2 * columns), np.empty(0))
        op = MatrixProduct(matrix.shape, matrix.tobytes())
        node = self.node(op, list(itertools.chain(*rows)), "f", len(rows) * columns)
        return Array(node, 0, 1, (node.size,))
