/* Gram matrices of the scaled factor; see spectrum.py. */

INLINE float NAME(total)(FLOATS x)
{
    INTS lanes;
    for (int k = 0; k < LANES; k++)
        lanes[k] = k;
#pragma GCC unroll 4
    for (int distance = LANES / 2; distance; distance /= 2)
        x += __builtin_shuffle(x, lanes ^ distance);
    return x[0];
}

/* totals (J, M, M) += F diag(r^j) F^T over the pixels from first to last, F = factor diag(d); lower triangles only. */
static TARGET void NAME(grams)(const struct grams *task, long first, long last, float *scratch, double *totals)
{
    const long marks = task->marks, step = task->step;
    float *weight = scratch, *weighted = weight + step, *scaled = weighted + ROWS * step;
    memset(scaled + marks * step, 0, (task->rows - marks) * step * sizeof(float));
    for (long start = first; start < last; start += step) {
        const long width = last - start < step ? last - start : step, whole = padded(width, LANES);
        for (long m = 0; m < marks; m++) {
            const float *column = task->factor + m * task->factor_stride + start;
            for (long i = 0; i < width; i++)
                scaled[m * step + i] = column[i] * task->scaling[start + i];
            for (long i = width; i < whole; i++)
                scaled[m * step + i] = 0.0f;
        }
        for (long i = 0; i < step; i++)
            weight[i] = 1.0f;
        for (long j = 0; j < task->count; j++) {
            for (long i = 0; j && i < width; i++)
                weight[i] *= task->remainder[start + i];
            for (long m = 0; m < marks; m += ROWS) {
                const float *left = scaled + m * step;
                if (j) {
                    for (long r = 0; r < ROWS; r++)
                        for (long i = 0; i < whole; i++)
                            weighted[r * step + i] = left[r * step + i] * weight[i];
                    left = weighted;
                }
                for (long n = 0; n < m + ROWS && n < marks; n += VECTORS) {
                    const float *right = scaled + n * step;
                    FLOATS sums[ROWS][VECTORS];
#pragma GCC unroll 8
                    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
                        for (int v = 0; v < VECTORS; v++)
                            sums[r][v] = (FLOATS){0};
                    for (long i = 0; i < whole; i += LANES) {
                        FLOATS pixels[VECTORS];
#pragma GCC unroll 8
                        for (int v = 0; v < VECTORS; v++)
                            pixels[v] = *(const FLOATS *)(right + v * step + i);
#pragma GCC unroll 8
                        for (int r = 0; r < ROWS; r++) {
                            const FLOATS row = *(const FLOATS *)(left + r * step + i);
#pragma GCC unroll 8
                            for (int v = 0; v < VECTORS; v++)
                                sums[r][v] += row * pixels[v];
                        }
                    }
#pragma GCC unroll 8
                    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
                        for (int v = 0; v < VECTORS; v++)
                            if (m + r < marks && n + v <= m + r)
                                totals[(j * marks + m + r) * marks + n + v] += NAME(total)(sums[r][v]);
                }
            }
        }
    }
}
