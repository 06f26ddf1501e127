/* Gram matrices of the scaled factor; defined in grams.py. */

/* totals (J, M, M) += F diag(r^j) F^T over pixels first to last, with F = factor diag(d). Lower triangles only. */
static TARGET void NAME(grams)(const struct grams *task, long first, long last, float *scratch, double *totals)
{
    const long num_landmarks = task->num_landmarks, step = task->step;
    float *weight = scratch, *weighted = weight + step, *scaled = weighted + ROWS * step;
    memset(scaled + num_landmarks * step, 0, (task->rows - num_landmarks) * step * sizeof(float));
    for (long start = first; start < last; start += step) {
        const long width = last - start < step ? last - start : step, whole = padded(width, LANES);
        for (long m = 0; m < num_landmarks; m++) {
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
            for (long m = 0; m < num_landmarks; m += ROWS) {
                const float *left = scaled + m * step;
                if (j) {
                    for (long r = 0; r < ROWS; r++)
                        for (long i = 0; i < whole; i++)
                            weighted[r * step + i] = left[r * step + i] * weight[i];
                    left = weighted;
                }
                for (long n = 0; n < m + ROWS && n < num_landmarks; n += VECTORS) {
                    FLOATS sums[ROWS][VECTORS];
                    NAME(correlate)(left, 0, scaled + n * step, 0, 1, step, whole, sums);
#pragma GCC unroll 8
                    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
                        for (int v = 0; v < VECTORS; v++)
                            if (m + r < num_landmarks && n + v <= m + r)
                                totals[(j * num_landmarks + m + r) * num_landmarks + n + v] += NAME(total)(sums[r][v]);
                }
            }
        }
    }
}
