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

/* Probabilities of a point in the two random draws, not normalised: the fourth power of its residual, first times the
 * fourth power of the distance from the nearest pivot, then alone. */
INLINE void NAME(pivot_odds)(const struct pivots *task, const float *residual, const float *nearest, float *odds)
{
    const long count = task->count;
    for (long i = 0; i < count; i++) {
        const float rest = residual[i] > task->captured ? residual[i] : task->captured;
        const float chance = i < task->used ? (rest * rest) * (rest * rest) : 0.0f;
        odds[i] = chance * (nearest[i] + DISTINCT) * (nearest[i] + DISTINCT);
        odds[count + i] = chance;
    }
}

/* Index of the point that a random number in [0, 1) draws. `blocks` (S / LINE) holds the sums of odds of LINE points. */
INLINE long NAME(drawn)(const float *odds, const double *blocks, long used, long count, double draw)
{
    double total = 0.0, reached = 0.0;
    for (long b = 0; b < count / LINE; b++)
        total += blocks[b];
    long block = 0;
    for (; block < count / LINE - 1 && reached + blocks[block] < draw * total; block++)
        reached += blocks[block];
    long point = block * LINE;
    const long last = (point + LINE < used ? point + LINE : used) - 1;
    for (; point < last; point++) {
        reached += odds[point];
        if (reached >= draw * total)
            break;
    }
    return point;
}

/* Squared distances (TRIALS, S) of all points from those proposed. */
INLINE void NAME(distances)(const struct pivots *task, const float *points, const float *norms, const long *proposed,
                            float *distances)
{
    const long size = task->size, count = task->count;
    for (long i = 0; i < count; i += LANES) {
        FLOATS inner[TRIALS];
        for (int t = 0; t < TRIALS; t++)
            inner[t] = (FLOATS){0};
        for (long k = 0; k < size; k++) {
            const float *plane = points + k * count;
            const FLOATS here = *(const FLOATS *)(plane + i);
            for (int t = 0; t < TRIALS; t++)
                inner[t] += plane[proposed[t]] * here;
        }
        for (int t = 0; t < TRIALS; t++)
            *(FLOATS *)(distances + t * count + i) = NAME(clamp)(
                *(const FLOATS *)(norms + i) + norms[proposed[t]] - 2.0f * inner[t], 0.0f, FLT_MAX);
    }
}

/* Index of the proposal that covers the points best, given its squared distances (TRIALS, S); the first of nearly
 * equal ones. */
INLINE int NAME(best_trial)(const struct pivots *task, const float *distances, const float *nearest)
{
    int best = 0;
    double most = 0.0;
    for (int t = 0; t < TRIALS; t++) {
        double covered = 0.0;
        for (long start = 0; start < task->count; start += LINE) {
            FLOATS sum = {0};
            for (long i = start; i < start + LINE; i += LANES) {
                const FLOATS here = *(const FLOATS *)(distances + t * task->count + i);
                const FLOATS least = *(const FLOATS *)(nearest + i);
                const INTS nearer = here < least;
                sum += COVERED / ((FLOATS)(((INTS)here & nearer) | ((INTS)least & ~nearer)) + COVERED);
            }
            for (int lane = 0; lane < LANES; lane++)
                covered += sum[lane];
        }
        covered -= task->count - task->used; /* points beyond the last have a distance of 0 from the nearest pivot */
        if (covered > most * (1 + NEARLY)) {
            best = t;
            most = covered;
        }
    }
    return best;
}

/* Pivots (M) of a randomly pivoted Cholesky decomposition of the affinities between points (D, S), with S a multiple of
 * LINE. Scratch holds norms, residuals, squared distances from the nearest pivot, two rows of odds, the sums of their
 * blocks, squared distances from the proposals, and the columns (M, S). */
static TARGET void NAME(pivots)(const struct pivots *task, const float *points, long *pivots, float *scratch)
{
    const long size = task->size, count = task->count;
    float *norms = scratch, *residual = norms + count, *nearest = residual + count, *odds = nearest + count;
    float *distances = odds + 2 * count, *columns = distances + TRIALS * count;
    double *blocks = (double *)(columns + task->num_landmarks * count); /* (2, S / LINE) */
    memset(norms, 0, count * sizeof(float));
    for (long k = 0; k < size; k++)
        for (long i = 0; i < count; i++)
            norms[i] += points[k * count + i] * points[k * count + i];
    for (long i = 0; i < count; i++) {
        residual[i] = 1.0f;
        nearest[i] = i < task->used ? UNCOVERED : 0.0f;
    }
    for (long m = 0; m < task->num_landmarks; m++) {
        NAME(pivot_odds)(task, residual, nearest, odds);
        for (long b = 0; b < 2 * count / LINE; b++) {
            double sums[8] = {0.0};
            for (long i = b * LINE; i < (b + 1) * LINE; i += 8)
                for (int k = 0; k < 8; k++)
                    sums[k] += odds[i + k];
            blocks[b] = 0.0;
            for (int k = 0; k < 8; k++)
                blocks[b] += sums[k];
        }
        long proposed[TRIALS];
        for (int t = 0; t < TRIALS; t++) {
            const long row = t >= TRIALS / 2;
            proposed[t] = NAME(drawn)(odds + row * count, blocks + row * (count / LINE), task->used, count,
                                      task->draws[m * TRIALS + t]);
        }
        NAME(distances)(task, points, norms, proposed, distances);
        const int best = NAME(best_trial)(task, distances, nearest);
        const long pivot = pivots[m] = proposed[best];
        const float *apart = distances + best * count;
        float *column = columns + m * count;
        for (long i = 0; i < count; i += LANES)
            *(FLOATS *)(column + i) = NAME(exp2)(
                NAME(clamp)(-*(const FLOATS *)(apart + i), -60.0f, 0.0f) * 1.4426950408889634f);
        NAME(accumulate)(columns + pivot, count, columns, m, count, -1.0f, column);
        const float scale = 1.0f / sqrtf(column[pivot] > task->captured ? column[pivot] : task->captured);
        for (long i = 0; i < count; i++) {
            column[i] *= scale;
            residual[i] -= column[i] * column[i];
            nearest[i] = apart[i] < nearest[i] ? apart[i] : nearest[i];
        }
        nearest[pivot] = 0.0f;
    }
}
