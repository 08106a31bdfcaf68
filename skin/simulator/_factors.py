"""The factorisation of a stiffness."""

import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu


def factorised(stiffness: sp.csc_matrix) -> SuperLU:
    """Return the factors of a matrix that is symmetric and positive definite.

    That needs no pivoting, and has an ordering of its own kind.
    """
    return splu(stiffness, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
