/* Linear systems of balancing. */

/* Solve matrix x = right in place, for a positive definite matrix (n, n), which becomes its upper Cholesky factor R:
 * R^T R = matrix. With `inverse`, also compute the inverse there; the matrix then holds nothing of use. */
static TARGET void NAME(positive)(double *matrix, long count, double *right, double *inverse)
{
    for (long k = 0; k < count; k++) {
        double *pivot = matrix + k * count;
        const double root = 1.0 / sqrt(pivot[k]);
        for (long j = k; j < count; j++)
            pivot[j] *= root;
        right[k] *= root;
        for (long i = k + 1; i < count; i++) {
            double *row = matrix + i * count;
            const double factor = pivot[i];
            for (long j = i; j < count; j++)
                row[j] -= factor * pivot[j];
            right[i] -= factor * right[k];
        }
    }
    for (long k = count; k--;) {
        for (long j = k + 1; j < count; j++)
            right[k] -= matrix[k * count + j] * right[j];
        right[k] /= matrix[k * count + k];
    }
    if (!inverse)
        return;
    memset(inverse, 0, count * count * sizeof(double)); /* first the inverse of R^T, a lower triangle */
    for (long k = 0; k < count; k++)
        inverse[k * count + k] = 1.0;
    for (long k = 0; k < count; k++) {
        double *row = inverse + k * count;
        const double root = 1.0 / matrix[k * count + k];
        for (long j = 0; j <= k; j++)
            row[j] *= root;
        for (long i = k + 1; i < count; i++) {
            const double factor = matrix[k * count + i];
            double *other = inverse + i * count;
            for (long j = 0; j <= k; j++)
                other[j] -= factor * row[j];
        }
    }
    memset(matrix, 0, count * count * sizeof(double));
    for (long k = 0; k < count; k++) {
        const double *row = inverse + k * count;
        for (long i = 0; i <= k; i++) {
            const double factor = row[i];
            for (long j = 0; j <= i; j++)
                matrix[i * count + j] += factor * row[j];
        }
    }
    for (long i = 0; i < count; i++)
        for (long j = 0; j < count; j++)
            inverse[i * count + j] = matrix[j <= i ? i * count + j : j * count + i];
}
