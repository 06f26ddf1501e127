/* Choice of landmarks; defined in clusters.py. */

/* Nearest of the packed centres (c, -|c|^2 / 2) to each point x of (D, S): the centre with the largest score
 * x . c - |c|^2 / 2. Scores within rounding of each other are ties; the first index wins. sums (M, D + 1) += the sum
 * of the points of each cluster, and their number. */
static TARGET void NAME(assign)(const struct lloyd *task, const float *points, const float *centres, float *tile,
                                int *nearest, float *sums)
{
    const long size = task->size, count = task->count;
    for (int v = 0; v < VECTORS; v++)
        *(FLOATS *)(tile + size * PIXELS + v * LANES) = (FLOATS){0} + 1.0f;
    for (long start = 0; start < count; start += PIXELS) {
        const long width = count - start < PIXELS ? count - start : PIXELS;
        for (long k = 0; k < size; k++) {
            memcpy(tile + k * PIXELS, points + k * count + start, width * sizeof(float));
            memset(tile + k * PIXELS + width, 0, (PIXELS - width) * sizeof(float));
        }
        FLOATS bar[VECTORS], slack[VECTORS]; /* best score plus its rounding margin; the margin's part due to x */
        INTS chosen[VECTORS];
        for (int v = 0; v < VECTORS; v++) {
            bar[v] = (FLOATS){0} - INFINITY;
            chosen[v] = (INTS){0};
            slack[v] = (FLOATS){0};
            for (long k = 0; k < size; k++)
                slack[v] += *(FLOATS *)(tile + k * PIXELS + v * LANES) * *(FLOATS *)(tile + k * PIXELS + v * LANES);
            slack[v] *= task->margin;
        }
        for (long m = 0; m < task->num_landmarks; m += ROWS) {
            FLOATS scores[ROWS][VECTORS];
            NAME(multiply)(centres + m * (size + 1), tile, size + 1, scores);
            for (int r = 0; r < ROWS; r++)
                for (int v = 0; v < VECTORS; v++) {
                    const INTS better = scores[r][v] > bar[v];
                    const FLOATS length = (FLOATS)((INTS)scores[r][v] & INT32_MAX);
                    const FLOATS next = scores[r][v] + (slack[v] + task->margin * length);
                    bar[v] = (FLOATS)(((INTS)next & better) | ((INTS)bar[v] & ~better));
                    chosen[v] = (((INTS){0} + (int)(m + r)) & better) | (chosen[v] & ~better);
                }
        }
        for (long i = 0; i < width; i++) {
            const int centre = chosen[i / LANES][i % LANES];
            nearest[start + i] = centre;
            for (long k = 0; k <= size; k++)
                sums[centre * (size + 1) + k] += tile[k * PIXELS + i];
        }
    }
}

/* Weight of a residual in the random draw: its fourth power. */
INLINE float NAME(pivot_weight)(float residual, float captured)
{
    const float rest = residual > captured ? residual : captured;
    return (rest * rest) * (rest * rest);
}

/* out (S) += sign * sum over r of left[r * step] * row r of right (R, S), four rows per pass. */
INLINE void NAME(accumulate)(const float *left, long step, const float *right, long rows, long count, float sign,
                             float *out)
{
    for (long r = 0; r < rows; r += 4) {
        const float *row[4];
        float weight[4];
        for (long k = 0; k < 4; k++) {
            row[k] = right + (r + k < rows ? r + k : r) * count;
            weight[k] = r + k < rows ? sign * left[(r + k) * step] : 0.0f;
        }
        for (long i = 0; i < count; i++)
            out[i] += weight[0] * row[0][i] + weight[1] * row[1][i] + weight[2] * row[2][i] + weight[3] * row[3][i];
    }
}

/* Pivots (M) of a randomly pivoted Cholesky decomposition of the affinities between points (D, S), with S a multiple of
 * LINE. Scratch holds norms, residuals and the columns (M, S). */
static TARGET void NAME(pivots)(const struct pivots *task, const float *points, long *pivots, float *scratch)
{
    const long size = task->size, count = task->count;
    float *norms = scratch, *residual = norms + count, *columns = residual + count;
    memset(norms, 0, count * sizeof(float));
    for (long k = 0; k < size; k++)
        for (long i = 0; i < count; i++)
            norms[i] += points[k * count + i] * points[k * count + i];
    for (long i = 0; i < count; i++)
        residual[i] = 1.0f;
    for (long m = 0; m < task->num_landmarks; m++) {
        double total = 0.0, reached = 0.0;
        for (long i = 0; i < task->used; i++)
            total += NAME(pivot_weight)(residual[i], task->captured);
        long pivot = 0;
        for (; pivot < task->used - 1; pivot++) {
            reached += NAME(pivot_weight)(residual[pivot], task->captured);
            if (reached >= task->draws[m] * total)
                break;
        }
        float *column = columns + m * count;
        for (long i = 0; i < count; i++)
            column[i] = -norms[i] - norms[pivot];
        NAME(accumulate)(points + pivot, count, points, size, count, 2.0f, column);
        for (long i = 0; i < count; i += LANES)
            *(FLOATS *)(column + i) =
                NAME(exp2)(NAME(clamp)(*(FLOATS *)(column + i), -60.0f, 0.0f) * 1.4426950408889634f);
        NAME(accumulate)(columns + pivot, count, columns, m, count, -1.0f, column);
        const float scale = 1.0f / sqrtf(column[pivot] > task->captured ? column[pivot] : task->captured);
        for (long i = 0; i < count; i++) {
            column[i] *= scale;
            residual[i] -= column[i] * column[i];
        }
        pivots[m] = pivot;
    }
}
