"""Places of a regular grid."""

import numpy as np

from skin.errors import InputError

__all__ = ["grid"]


def grid(rows: int, columns: int) -> np.ndarray:
    """Return the centres (S, 2) of rows x columns equal tiles of the unit square, row by row.

    Raises:
        InputError: fewer than one row or column.
    """
    for name, number in (("rows", rows), ("columns", columns)):
        if type(number) is not int or number < 1:
            raise InputError(
                f"layout.{name} must be a whole number of at least 1, got {number}: as in layout.{name}=5"
            )
    y, x = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])
