/* Elimination of unknowns from dense equations in float64. */

typedef double NAME(doubles) __attribute__((vector_size(4 * LANES), aligned(8), may_alias));
#define DOUBLES NAME(doubles)
#define BLOCK 4   /* equations processed together */
#define PIVOTS 32 /* unknowns eliminated together */

/* Subtract multiples of `depth` equations from `count` others, a constant, at columns first to last, a multiple of
 * LANES. */
INLINE void NAME(subtract)(const double *pivots, long depth, double factors[][PIVOTS], double *rows, const int count,
                           long stride, long first, long last)
{
    for (long j = first; j < last; j += LANES) {
        DOUBLES sums[BLOCK][2];
#pragma GCC unroll 4
        for (int r = 0; r < count; r++) {
            sums[r][0] = *(const DOUBLES *)(rows + r * stride + j);
            sums[r][1] = *(const DOUBLES *)(rows + r * stride + j + LANES / 2);
        }
        for (long k = 0; k < depth; k++) {
            const DOUBLES left = *(const DOUBLES *)(pivots + k * stride + j);
            const DOUBLES right = *(const DOUBLES *)(pivots + k * stride + j + LANES / 2);
#pragma GCC unroll 4
            for (int r = 0; r < count; r++) {
                sums[r][0] -= factors[r][k] * left;
                sums[r][1] -= factors[r][k] * right;
            }
        }
#pragma GCC unroll 4
        for (int r = 0; r < count; r++) {
            *(DOUBLES *)(rows + r * stride + j) = sums[r][0];
            *(DOUBLES *)(rows + r * stride + j + LANES / 2) = sums[r][1];
        }
    }
}

/* Eliminate the first `own` unknowns from `count` equations of length `stride`, a multiple of LANES. Pivots lie on the
 * diagonal. What remains below it in their columns has no meaning.
 *
 * PIVOTS equations at a time stay in the cache while multiples of them are subtracted from all others. */
TARGET static void NAME(eliminate)(double *equations, long own, long count, long stride)
{
    for (long first = 0; first < own; first += PIVOTS) {
        const long depth = own - first < PIVOTS ? own - first : PIVOTS, last = first + depth;
        double *pivots = equations + first * stride, inverses[PIVOTS], factors[BLOCK][PIVOTS];
        for (long r = 0; r < count - first; r++) { /* pivots completely, other equations at the columns of pivots */
            double *row = pivots + r * stride;
            for (long k = 0; k < depth && k < r; k++) {
                const double *pivot = pivots + k * stride, factor = row[first + k] *= inverses[k];
                for (long j = first + k + 1; j < (r < depth ? stride : last); j++)
                    row[j] -= factor * pivot[j];
            }
            if (r < depth)
                inverses[r] = 1.0 / row[first + r];
        }
        for (long row = last; row < count; row += BLOCK) {
            const long block = count - row < BLOCK ? count - row : BLOCK, column = last / LANES * LANES;
            double *rows = equations + row * stride;
            for (long r = 0; r < block; r++)
                memcpy(factors[r], rows + r * stride + first, depth * sizeof(double));
            if (block == BLOCK)
                NAME(subtract)(pivots, depth, factors, rows, BLOCK, stride, column, stride);
            else
                for (long r = 0; r < block; r++)
                    NAME(subtract)(pivots, depth, factors + r, rows + r * stride, 1, stride, column, stride);
        }
    }
}

/* Solve (own, length) equations after elimination for the first `own` of `count` unknowns, given the others in `values`
 * (sides, count). Right sides follow the coefficients. */
TARGET static void NAME(substitute)(const double *equations, long own, long count, long length, long sides,
                                    double *values)
{
    for (long row = own; row--;) {
        const double *equation = equations + row * length;
        for (long c = 0; c < sides; c++) {
            double *known = values + c * count, left = equation[count + c];
            long j = row + 1;
            DOUBLES sums = {0};
            for (; j + LANES / 2 <= count; j += LANES / 2)
                sums += *(const DOUBLES *)(equation + j) * *(const DOUBLES *)(known + j);
            for (; j < count; j++)
                left -= equation[j] * known[j];
            for (int k = 0; k < LANES / 2; k++)
                left -= sums[k];
            known[row] = left / equation[row];
        }
    }
}
