"""Inverses of small matrices in kernels."""

from numba.extending import register_jitable

from speckle3d.core.arrays import FloatArray


@register_jitable(fastmath=False, error_model="numpy")
def invert_matrix(matrix: FloatArray) -> float:
    """Invert a symmetric, positive definite matrix in place, by elimination; returns its determinant.

    `np.linalg.inv` and `np.linalg.det` do the same, and compile for seconds.
    """
    determinant, size = 1.0, matrix.shape[0]
    for k in range(size):
        pivot = matrix[k, k]
        determinant *= pivot
        matrix[k, k] = 1.0
        for j in range(size):
            matrix[k, j] /= pivot
        for i in range(size):
            factor = matrix[i, k]
            if i != k:
                matrix[i, k] = 0.0
                for j in range(size):
                    matrix[i, j] -= factor * matrix[k, j]
    return determinant
