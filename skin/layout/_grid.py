"""Places of a regular grid."""

import numpy as np

__all__ = ["grid"]


def grid(rows: int, columns: int) -> np.ndarray:
    """Return the centres (S, 2) of rows x columns equal tiles of the unit square, row by row."""
    y, x = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])
